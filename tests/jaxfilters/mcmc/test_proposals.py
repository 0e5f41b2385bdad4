"""Random walks of parameters: their target on rotations, and parameters that they reject."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxfilters as jf

normal = jax.scipy.stats.norm.logpdf
KEY = jax.random.key(0)


@pytest.mark.system
def test_a_random_walk_that_starts_anew_keeps_a_density_of_rotations():
    """Density exp(4 w^2) of unit quaternions: the mean of w^2 by quadrature, at four standard errors of 4096 chains."""
    walk = jf.mcmc.random_walk(jf.fit.rotation, step=1.0)
    update = jf.mcmc.metropolis_update(lambda q, path: 4 * q[0] ** 2, proposal=walk, num_steps=1)

    @jax.jit
    @jax.vmap
    def last(key):
        step = lambda q, key: (update(key, q, None), None)
        return jax.lax.scan(step, jnp.array([1.0, 0, 0, 0]), jax.random.split(key, 60))[0]

    w = np.asarray(last(jax.random.split(KEY, 4096)))[:, 0].astype(float)
    # Half the angle of a uniform rotation has the density sin^2.
    density = lambda half: np.sin(half) ** 2 * np.exp(4 * np.cos(half) ** 2)
    expected = quad(lambda half: np.cos(half) ** 2 * density(half), 0, np.pi)[0] / quad(density, 0, np.pi)[0]
    assert abs(np.mean(w**2) - expected) < 4 * np.std(w**2) / 64


def test_integers_are_rejected_unless_they_are_fixed():
    sampler = jf.mcmc.pmmh(lambda key, theta: normal(theta["a"]) + 0 * theta["b"], lambda theta: 0.0)
    with pytest.raises(TypeError, match=r"theta\['b'\] must be floating-point, or fit.fixed; got int"):
        jf.mcmc.init(KEY, sampler, {"a": jnp.zeros(2), "b": jnp.zeros(2, int)})
    with pytest.raises(TypeError, match="theta must be floating-point"):
        jf.mcmc.tempered_smc(
            KEY, lambda key: jax.random.randint(key, (), 0, 5), lambda theta: 0.0, normal, num_particles=4
        )


@pytest.mark.parametrize(("constraint", "value"), [(jf.fit.positive, 0.0), (jf.fit.interval(-1, 1), 1.0)])
def test_a_chain_cannot_start_on_an_open_bound(constraint, value):
    walk = jf.mcmc.random_walk(constraint)
    sampler = jf.mcmc.pmmh(lambda key, theta: normal(theta), lambda theta: 0.0, proposal=walk)
    with pytest.raises(ValueError, match=r"constraints .* in the chains \[0\] of 2"):
        jf.mcmc.init(KEY, sampler, jnp.array([value, 0.5]))


def test_a_chain_can_start_at_zero_within_an_interval():
    walk = jf.mcmc.random_walk(jf.fit.interval(-1, 2))
    sampler = jf.mcmc.pmmh(lambda key, theta: normal(theta), lambda theta: 0.0, proposal=walk)
    np.testing.assert_array_equal(jf.mcmc.init(KEY, sampler, jnp.array([0.0, 0.5])).theta, [0, 0.5])


def test_a_transition_density_that_is_no_number_is_counted():
    redraw, particles = jf.mcmc.ancestor_sampling(lambda x_next, x: 0 * jnp.log(x)), jnp.array([1.0, 2.0, -1.0])
    # A particle without weight is no predecessor anyway.
    weights = jnp.array([[0.2, 0.4, 0.4], [0.5, 0.5, 0.0]])
    parent = lambda weights: redraw.parent(jnp.array(0.7), jnp.log(weights), particles, 0.0, None)
    indices, impossible = jax.jit(jax.vmap(parent))(weights)
    np.testing.assert_array_equal(indices, [1, 1])
    np.testing.assert_array_equal(impossible, [True, False])
