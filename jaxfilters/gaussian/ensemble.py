r"""Ensemble Kalman filter: particles that are moved by what they see, not weighted.

For states of hundreds of numbers and more, where a covariance is too large to carry and weights of particles would
degenerate at once. Each particle is moved by the Kalman gain of the ensemble's own covariances, towards an observation
with noise of its own, so that the spread comes out right (G. Burgers, P. J. van Leeuwen, G. Evensen, "Analysis scheme
in the ensemble Kalman filter", 1998). Exact for linear Gaussian models as N grows; unlike a particle filter it is not
for other ones, however many particles there are. The gain lies in the span of the ensemble: no n x n matrix is formed.
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter
from jaxfilters.math.linalg import cholesky, solve_triangular
from jaxfilters.noise import random_keys
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, DrawNoise, SamplePrior, SampleTransition, as_pytree


class EnsembleState(NamedTuple):
    """Equally weighted particles."""

    particles: Float[Array, "n k"]
    noise: PyTree
    """What will move them next; see `jaxfilters.particle.ParticleState`."""


class EnsembleInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1) as if the predicted observations were Gaussian; biased by the order of 1 / N."""
    innovation: Float[Array, " m"]
    """y minus the mean of the predicted observations; zero where nothing was seen."""


@pytree_dataclass
class EnsembleKalman:
    """Parameters of an ensemble Kalman filter."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    observe: Callable
    R: Float[Array, "m m"]
    inflation: float | Float[Array, ""]
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})


def ensemble_kalman(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    observe: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    R: Float[Array, "m m"],
    *,
    num_particles: int,
    noise: DrawNoise = random_keys,
    inflation: float = 1.0,
) -> Filter:
    """Ensemble Kalman filter of a state that is a vector.

    Components of an observation that are NaN were not seen.

    Args:
        sample_prior: `key -> x`, or one of `jaxfilters.priors`.
        sample_transition: `(randomness, x, control) -> x`.
        observe: `x -> y` without noise.
        R: Covariance of the noise of an observation, positive definite.
        num_particles: Size N of the ensemble, at least 2.
        noise: What `randomness` is, e.g. `StandardNormal(d)`; by default a random key.
        inflation: Factor on the spread about the mean before every update, at least 1: small ensembles come out too
            narrow, and a little more than 1 keeps them listening.

    Raises:
        ValueError: If `num_particles < 2` or `inflation < 1`.
    """
    if not isinstance(num_particles, int) or num_particles < 2:
        raise ValueError(f"num_particles must be an integer of at least 2; got {num_particles!r}.")
    if not inflation >= 1:
        raise ValueError(f"inflation must be at least 1; got {inflation!r}.")
    params = EnsembleKalman(
        as_pytree(sample_prior),
        as_pytree(sample_transition),
        as_pytree(observe),
        jnp.asarray(R, dtype=float),
        float(inflation),
        num_particles,
        noise,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: EnsembleKalman, key: AnyKey) -> EnsembleState:
    prior_key, noise_key = jax.random.split(key)
    particles = sample_ensemble(prior_key, model.sample_prior, model.num_particles)
    return EnsembleState(particles, model.noise(noise_key, model.num_particles))


def _predict(model: EnsembleKalman, key: AnyKey, state: EnsembleState, control: PyTree) -> EnsembleState:
    move = jax.vmap(model.sample_transition, in_axes=(-1, -1, None), out_axes=-1)
    return EnsembleState(move(state.noise, state.particles, control), model.noise(key, model.num_particles))


def _update(
    model: EnsembleKalman, key: AnyKey, state: EnsembleState, observation: Float[Array, " m"]
) -> tuple[EnsembleState, EnsembleInfo]:
    count = model.num_particles
    mean = jnp.mean(state.particles, axis=1, keepdims=True)
    x = mean + model.inflation * (state.particles - mean)
    seen = jnp.isfinite(observation)
    # A component that was not seen is a zero that was seen to be zero: it moves nothing and says nothing.
    predicted = jnp.where(seen[:, None], jax.vmap(model.observe, in_axes=-1, out_axes=-1)(x), 0.0)
    together = seen[:, None] & seen
    R = jnp.where(together, model.R, jnp.eye(seen.size, dtype=model.R.dtype))
    spread = predicted - jnp.mean(predicted, axis=1, keepdims=True)
    matmul = lambda a, b: jnp.matmul(a, b, precision="highest")
    root = cholesky(matmul(spread, spread.T) / (count - 1) + R)

    noise = matmul(cholesky(R), standard_normal(key, predicted.shape, predicted.dtype))
    noise = jnp.where(seen[:, None], noise - jnp.mean(noise, axis=1, keepdims=True), 0.0)
    surprise = jnp.where(seen, jnp.where(seen, observation, 0.0) - jnp.mean(predicted, axis=1), 0.0)
    missing = jnp.where(seen[:, None], jnp.where(seen, observation, 0.0)[:, None] + noise - predicted, 0.0)
    wanted = solve_triangular(root, solve_triangular(root, missing), transpose=True)
    moved = x + matmul(x - mean, matmul(spread.T, wanted)) / (count - 1)

    whitened = solve_triangular(root, surprise)
    log_scale = jnp.sum(jnp.log(jnp.diagonal(root))) + 0.5 * math.log(2 * math.pi) * jnp.sum(seen)
    log_evidence = -0.5 * jnp.sum(jnp.square(whitened)) - log_scale
    return state._replace(particles=moved), EnsembleInfo(log_evidence, surprise)
