from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.priors import gaussian_prior

FORMS = {
    "covariance": lambda mean, root: Gaussian(jnp.asarray(mean), jnp.asarray(root @ root.T)),
    "root": lambda mean, root: GaussianRoot(jnp.asarray(mean), jnp.asarray(root)),
}


def covariance_of(belief):
    if isinstance(belief, Gaussian):
        return belief.covariance
    return jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest")


@pytest.fixture(params=FORMS, ids=str)
def form(request):
    return FORMS[request.param]


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def everything_about(belief, x, known, chosen):
    """Density at `x`, the belief in the chosen components, and that in the others once the known ones are as in `x`."""
    return belief.logpdf(x), belief.marginal(chosen), belief.condition(known, x[np.array(known)])


@pytest.mark.parametrize("width", [4, 7])
def test_density_marginal_and_condition_agree_with_textbook(x64, rng, form, width):
    mean, root = rng.normal(size=4), rng.normal(size=(4, width))
    P = root @ root.T
    x = rng.normal(size=4)
    chosen, known, rest = [2, 0], [3, 1], [0, 2]
    look = jax.jit(partial(everything_about, known=known, chosen=chosen))
    density, marginal, conditioned = look(form(mean, root), jnp.asarray(x))
    np.testing.assert_allclose(density, multivariate_normal(mean, P).logpdf(x), rtol=1e-10)

    np.testing.assert_allclose(marginal.mean, mean[chosen])
    np.testing.assert_allclose(covariance_of(marginal), P[np.ix_(chosen, chosen)], atol=1e-12)

    gain = P[np.ix_(rest, known)] @ np.linalg.inv(P[np.ix_(known, known)])
    np.testing.assert_allclose(conditioned.mean, mean[rest] + gain @ (x - mean)[known], atol=1e-9)
    expected = P[np.ix_(rest, rest)] - gain @ P[np.ix_(known, rest)]
    np.testing.assert_allclose(covariance_of(conditioned), expected, atol=1e-9)


def test_a_certain_component_adds_nothing_and_tells_nothing(x64, rng, form):
    mean, root = rng.normal(size=3), rng.normal(size=(3, 3))
    root[0] = 0
    x = np.append(mean[0], rng.normal(size=2))
    rest = multivariate_normal(mean[1:], (root @ root.T)[1:, 1:])

    @jax.jit
    def look(belief, x):
        slopes = jax.grad(lambda belief: belief.logpdf(x))(belief)
        return everything_about(belief, x, known=[0], chosen=[1]), jax.tree.leaves(slopes)[1]

    (density, _, conditioned), slope = look(form(mean, root), jnp.asarray(x))
    np.testing.assert_allclose(density, rest.logpdf(x[1:]), rtol=1e-10)
    np.testing.assert_allclose(conditioned.mean, mean[1:])
    np.testing.assert_allclose(covariance_of(conditioned), rest.cov, atol=1e-12)
    assert np.isfinite(slope).all()


def test_samples_have_the_mean_and_covariance(rng, form):
    mean, root = rng.normal(size=3), np.tril(rng.normal(size=(3, 3)))
    count = 20_000
    draws = np.asarray(form(mean.astype(np.float32), root.astype(np.float32)).sample(jax.random.key(2), count))
    assert draws.shape == (3, count)
    P = root @ root.T
    assert (abs(draws.mean(axis=1) - mean) < 4 * np.sqrt(np.diag(P) / count)).all()
    sigma = np.sqrt((np.outer(np.diag(P), np.diag(P)) + P**2) / count)
    assert (abs(np.cov(draws) - P) < 4 * sigma).all()


def test_indices_from_the_end_are_those_from_the_beginning_and_differ(form, rng):
    belief = form(rng.normal(size=3), rng.normal(size=(3, 3)))
    found, expected = (belief.condition(indices, jnp.array([0.5])) for indices in ([-1], [2]))
    assert found.mean.shape == (2,)
    np.testing.assert_allclose(found.mean, expected.mean)
    with pytest.raises(ValueError, match=r"indices must name different components; got \[2, -1\] of 3"):
        belief.condition([2, -1], jnp.zeros(2))


@pytest.mark.system
def test_draws_of_a_large_covariance_that_has_lost_rank_lie_in_its_space(x64, rng):
    # Rank 3 of 12: the first three variables determine the others.
    mean, A = rng.normal(size=12), rng.normal(size=(12, 3))
    A[:3] = np.tril(A[:3], -1) + np.eye(3)
    belief = Gaussian(jnp.asarray(mean), jnp.asarray(A @ A.T))
    for draws in (belief.sample(jax.random.key(3), 20_000), gaussian_prior(belief).ensemble(jax.random.key(4), 20_000)):
        noise = np.linalg.lstsq(A, np.asarray(draws) - mean[:, None])[0]
        np.testing.assert_allclose(A @ noise + mean[:, None], draws, atol=1e-6)
        # Nine moments, each with a standard error of at most sqrt(2 / 20000) = 0.01: 4.5 of them, probability 1e-4.
        np.testing.assert_allclose(noise @ noise.T / 20_000, np.eye(3), atol=0.045)


def test_variables_without_variance_cost_the_others_no_precision(rng):
    # In float32 the condition number 1e5 leaves two digits; noise on the diagonal would leave none.
    orthogonal = np.linalg.qr(rng.normal(size=(11, 11)))[0]
    P = (orthogonal * np.geomspace(1.0, 1e-5, 11)) @ orthogonal.T
    with_zero = jnp.zeros((12, 12)).at[1:, 1:].set(P.astype(np.float32))
    x = rng.normal(size=12).astype(np.float32)
    x[0] = 0
    found = Gaussian(jnp.zeros(12), with_zero).logpdf(jnp.asarray(x))
    alone = Gaussian(jnp.zeros(11), with_zero[1:, 1:]).logpdf(jnp.asarray(x[1:]))
    np.testing.assert_allclose(found, alone, rtol=1e-4)
