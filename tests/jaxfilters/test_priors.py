"""Ensembles that are drawn at once follow the prior, and single particles still do."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters
from jaxfilters import weights
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.noise import StandardNormal
from jaxfilters.priors import from_noise, gaussian_prior, sample_ensemble

MEAN = jnp.array([1.0, -2.0, 0.5])
ROOT = jnp.array([[2.0, 0.0, 0.0], [1.0, 0.5, 0.0], [0.0, -0.3, 0.1]])


def start(noise):
    return {"pose": MEAN + ROOT @ noise, "squared": jnp.sum(noise**2)}


def chi_squared(particles):
    """Squared errors of mean and covariance, in units of what they vary by: each about 1 on average."""
    count = particles.shape[1]
    P = np.asarray(ROOT @ ROOT.T, np.float64)
    x = np.linalg.solve(np.asarray(ROOT, np.float64), np.asarray(particles, np.float64) - np.asarray(MEAN)[:, None])
    variance = np.where(np.eye(len(P)) > 0, 2.0, 1.0) / count
    return np.concatenate([x.mean(1) ** 2 * count, ((x @ x.T / count - np.eye(len(P))) ** 2 / variance).ravel()])


@pytest.mark.system
@pytest.mark.parametrize("prior", [from_noise(start, StandardNormal(3)), gaussian_prior(Gaussian(MEAN, ROOT @ ROOT.T))])
def test_an_ensemble_and_single_particles_have_the_moments_of_the_prior(prior):
    together = sample_ensemble(jax.random.key(0), prior, 20_000)
    alone = jax.vmap(prior, out_axes=-1)(jax.random.split(jax.random.key(1), 20_000))
    for particles in (together, alone):
        pose = particles["pose"] if isinstance(particles, dict) else particles
        assert pose.shape == (3, 20_000)
        # Twelve numbers within 4.5 standard errors: wrong by chance once in 10^4.
        assert np.all(chi_squared(pose) < 4.5**2)


@pytest.mark.system
def test_a_filter_with_such_a_prior_differs_only_by_its_draws_and_gives_gradients():
    """Against the Kalman update of one reading: 4.5 standard errors of the mean of 20 000 particles."""
    read = lambda x, y: -0.5 * (y - x[0]) ** 2

    def posterior_mean(mean):
        prior = gaussian_prior(Gaussian(mean, ROOT @ ROOT.T))
        still = lambda noise, x, inputs: x
        filter = jaxfilters.bootstrap(prior, still, read, num_particles=20_000, noise=StandardNormal(1))
        state, _ = jaxfilters.step(filter, jax.random.key(1), jaxfilters.init(filter, jax.random.key(2)), 2.0)
        return weights.mean(state.particles, state.log_weights)

    P = ROOT @ ROOT.T
    gain = P[:, 0] / (P[0, 0] + 1)
    spread = jnp.sqrt(jnp.diag(P) / 20_000)
    np.testing.assert_array_less(jnp.abs(posterior_mean(MEAN) - MEAN - gain * (2.0 - MEAN[0])), 4.5 * 1.5 * spread)
    exact = jnp.eye(3) - jnp.outer(gain, jnp.eye(3)[0])
    np.testing.assert_allclose(jax.jacrev(posterior_mean)(MEAN), exact, atol=0.05)


def test_a_dataclass_of_the_user_may_draw_its_ensemble_itself():
    @dataclass(frozen=True)
    class Grid:
        def __call__(self, key):
            return jax.random.uniform(key)

        def ensemble(self, key, num_particles):
            return jnp.linspace(0.0, 1.0, num_particles)

    np.testing.assert_array_equal(sample_ensemble(jax.random.key(0), Grid(), 5), np.linspace(0, 1, 5))


def test_a_covariance_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"belief must have a mean \(n,\) and a covariance \(n, n\)"):
        gaussian_prior(Gaussian(jnp.zeros(3), jnp.eye(2)))
