import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.manifold import euclidean, hashable, product, retract_belief, rotation, to_tangent, vector
from jaxfilters.math import lie

BODY = product(vector(3), rotation, vector(2))


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def body(rng):
    return jnp.concatenate([jnp.asarray(part) for part in (rng.normal(size=3), unit(rng), rng.normal(size=2))])


def unit(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def test_a_product_moves_each_block_on_its_own_manifold(x64, rng):
    x, delta = body(rng), jnp.asarray(0.3 * rng.normal(size=8))
    moved = BODY.retract(x, delta)
    np.testing.assert_allclose(moved[:3], x[:3] + delta[:3])
    np.testing.assert_allclose(moved[3:7], lie.so3_retract(x[3:7], delta[3:6]))
    np.testing.assert_allclose(moved[7:], x[7:] + delta[6:])
    np.testing.assert_allclose(BODY.local(x, moved), delta, atol=1e-12)
    assert not BODY.flat
    assert product(vector(2), vector(1)).flat


def test_products_of_the_same_blocks_compile_once():
    again = product(vector(3), rotation, vector(2))
    assert jax.tree.structure(hashable(BODY)) == jax.tree.structure(hashable(again))
    assert jax.tree.structure(hashable(BODY)) != jax.tree.structure(hashable(euclidean))


@pytest.mark.system
@pytest.mark.parametrize("form", [Gaussian, GaussianRoot])
def test_a_belief_seen_from_elsewhere_and_settled_again_is_itself(x64, rng, form):
    x = body(rng)
    root = jnp.asarray(np.tril(rng.normal(size=(8, 8))))
    belief = form(BODY.retract(x, jnp.asarray(0.4 * rng.normal(size=8))), root)
    there = to_tangent(BODY, x, belief)
    np.testing.assert_allclose(there.mean, BODY.local(x, belief.mean), atol=1e-12)
    back = retract_belief(BODY, x, there)
    for found, expected in zip(jax.tree.leaves(back), jax.tree.leaves(belief), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.system
def test_covariances_follow_the_tangent_space(x64, rng):
    # Draws about x, far from it, have their covariance in the tangent space at their own mean.
    x, offset = jnp.asarray(unit(rng)), jnp.array([0.9, -0.6, 0.4])
    root = 1e-3 * np.tril(rng.normal(size=(3, 3)))
    turning = product(rotation)
    settled = retract_belief(turning, x, Gaussian(offset, jnp.asarray(root @ root.T)))
    draws = offset[:, None] + root @ rng.normal(size=(3, 40_000))
    points = jax.vmap(turning.retract, (None, -1), -1)(x, jnp.asarray(draws))
    observed = np.asarray(jax.vmap(turning.local, (None, -1), -1)(settled.mean, points))
    P = np.asarray(settled.covariance)
    # Four standard errors of a sample covariance; curvature adds 1e-3 of a standard deviation.
    assert (abs(np.cov(observed) - P) < 4 * np.sqrt((np.outer(np.diag(P), np.diag(P)) + P**2) / 40_000)).all()
    assert np.linalg.norm(P - root @ root.T) > 0.05 * np.linalg.norm(P)


def test_a_product_of_nothing_is_rejected():
    with pytest.raises(ValueError, match="at least one block"):
        product()
