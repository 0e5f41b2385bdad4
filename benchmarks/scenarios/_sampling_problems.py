"""What `bench sampling` measures: a stochastic volatility model, and a regression."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxfilters as jf
from jaxfilters.filter import Filter
from jaxfilters.typing import AnyKey

RHO, PRIOR_MEAN, PRIOR_SD = 0.95, -1.2, 0.5
"""Persistence of the log-variance; prior of the logarithm of its standard deviation."""
NOISE = 0.5


class Sizes(NamedTuple):
    """Of all problems."""

    num_frames: int = 100
    num_states: int = 100
    """Particles of a sweep."""
    num_sweeps: int = 20
    """Sweeps in one measured call."""
    num_frames_nested: int = 50
    num_parameters: int = 100
    num_states_nested: int = 100
    """Particles of each filter of SMC^2."""
    num_moves: int = 2
    num_tempered: int = 1000
    num_tempered_moves: int = 10


def simulated(seed: int, num_frames: int) -> Float[Array, " t"]:
    """Returns of the model."""
    rng = np.random.default_rng(seed)
    x, returns = rng.normal(), []
    for _ in range(num_frames):
        x = RHO * x + np.exp(PRIOR_MEAN) * rng.normal()
        returns.append(np.exp(x / 2) * rng.normal())
    return jnp.asarray(returns, float)


def filter_of(z: Float[Array, ""], num_particles: int) -> Filter:
    """Bootstrap filter of the model, for a log standard deviation."""
    return jf.bootstrap(
        jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1))),
        lambda noise, x: RHO * x + jnp.exp(z) * noise,
        lambda x, y: jax.scipy.stats.norm.logpdf(y, 0.0, jnp.exp(x[0] / 2)),
        num_particles=num_particles,
        noise=jf.StandardNormal(1),
        ess_threshold=1.0,
    )


def log_prior(z: Float[Array, ""]) -> Float[Array, ""]:
    """Of the log standard deviation."""
    return jax.scipy.stats.norm.logpdf(z, PRIOR_MEAN, PRIOR_SD)


def log_evidence_of_first(returns: Float[Array, " t"]) -> float:
    """Log density of the first return alone, by a million draws of parameters and states; its error is about 1e-3."""
    rng = np.random.default_rng(0)
    z, before, noise = PRIOR_MEAN + PRIOR_SD * rng.normal(size=10**6), *rng.normal(size=(2, 10**6))
    x = RHO * before + np.exp(z) * noise
    densities = np.exp(-0.5 * float(returns[0]) ** 2 * np.exp(-x) - 0.5 * x) / np.sqrt(2 * np.pi)
    return float(np.log(densities.mean()))


def regression() -> tuple[Callable[[Array], Array], Callable[[Array], Array], Callable[[AnyKey], Array]]:
    """Log prior and log-likelihood of three coefficients, and a random-walk step as wide as their posterior."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(100, 3))
    answers = jnp.asarray(features @ np.array([1.0, -0.5, 0.2]) + NOISE * rng.normal(size=100), float)
    posterior = np.linalg.inv(features.T @ features / NOISE**2 + np.eye(3))
    root = jnp.asarray(2.38 / np.sqrt(3) * np.linalg.cholesky(posterior), float)
    table = jnp.asarray(features, float)

    def log_prior(theta: Float[Array, " 3"]) -> Float[Array, ""]:
        return jax.scipy.stats.norm.logpdf(theta).sum()

    def log_likelihood(theta: Float[Array, " 3"]) -> Float[Array, ""]:
        return jax.scipy.stats.norm.logpdf(answers, table @ theta, NOISE).sum()

    return log_prior, log_likelihood, lambda key: root @ jax.random.normal(key, (3,))
