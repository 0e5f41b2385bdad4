r"""Ensemble Kalman filter: a Kalman filter whose belief is a set of equally weighted samples.

It is meant for states of hundreds of numbers and more, for which a covariance matrix is too large to store and the
weights of a particle filter degenerate. Every sample is moved by the Kalman gain that the sample covariances give,
towards the observation perturbed by its own draw of the observation noise, which keeps the spread of the ensemble
consistent (G. Burgers, P. J. van Leeuwen and G. Evensen, "Analysis scheme in the ensemble Kalman filter", Monthly
Weather Review 126, 1998). The result converges to the Kalman filter for linear Gaussian models as the ensemble grows;
for other models it does not converge to the exact posterior, however large the ensemble is.
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter
from jaxfilters.math.linalg import cholesky, matmul, solve_triangular
from jaxfilters.noise import random_keys
from jaxfilters.particle import checks
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, DrawNoise, SamplePrior, SampleTransition, as_pytree, taking_inputs


class EnsembleState(NamedTuple):
    """Equally weighted samples of the state."""

    particles: Float[Array, "n k"]
    """One sample a column."""
    noise: PyTree
    """Randomness of the next prediction, leaves `(..., k)`; drawn one step ahead as in `bootstrap`."""


class EnsembleInfo(NamedTuple):
    """Diagnostics of one update of an ensemble Kalman filter."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1) for a Gaussian with the sample moments of the predicted observations; its bias is of the
    order of one over the number of samples."""
    innovation: Float[Array, " m"]
    """The observation minus the mean of the predicted observations; zero for components that were not observed."""


@pytree_dataclass
class EnsembleKalman:
    """Parameters of an ensemble Kalman filter."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    observe: Callable
    R: Float[Array, "m m"]
    inflation: Float[Array, ""]
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})


def ensemble_kalman(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    observe: Callable[..., Float[Array, " m"]],
    R: ArrayLike,
    *,
    num_particles: int,
    noise: DrawNoise = random_keys,
    inflation: ArrayLike = 1.0,
) -> Filter:
    """Build an ensemble Kalman filter with perturbed observations, for a state that is a vector of n numbers.

    Components of an observation that are NaN count as not observed. No matrix of n x n numbers is stored, and for
    large ensembles no matrix of N x N numbers either: memory grows as N (n + m) + n m + m^2, or as N (n + m + N) + m^2
    where N^2 < n m. The filter is differentiable in `R`, `inflation` and the parameters of its callbacks.

    Args:
        sample_prior: `key -> x`, a vector `(n,)`; or one of `jaxfilters.priors`, which draw the whole ensemble at once.
        sample_transition: `(randomness, x) -> x`, the state one step later with its process noise; or with the inputs
            of the step after them, see `jf.typing`.
        observe: `x -> y` or `(x, inputs) -> y`, the noise-free observation `(m,)` of the state `(n,)`.
        R: Covariance `(m, m)` of the observation noise, positive definite.
        num_particles: Number N of samples, at least 2.
        noise: Source of `randomness`: by default a random key for each sample; `StandardNormal(d)` passes d standard
            normal numbers instead.
        inflation: Factor by which the deviations from the ensemble mean are multiplied before every update, at least 1
            (J. L. Anderson and S. L. Anderson, Monthly Weather Review 127, 1999). It compensates for the
            underestimated spread of small ensembles. May be an array or a traced value.

    Returns:
        A filter whose state is an `EnsembleState` and whose info is an `EnsembleInfo`.

    Raises:
        ValueError: If `num_particles < 2`, `inflation < 1`, or `R` is not a covariance; and when the filter is traced,
            if a callback returns an array of the wrong shape or type, or an observation is not of shape `(m,)`.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(3), jnp.eye(3)))
        >>> transition, observe = lambda noise, x: 0.9 * x + 0.1 * noise, lambda x: x[:2]
        >>> filter = jf.ensemble_kalman(
        ...     prior, transition, observe, 0.2 * jnp.eye(2), num_particles=100, noise=jf.StandardNormal(3)
        ... )
        >>> state, (states, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 2)))
        >>> state.particles.shape, infos.innovation.shape
        ((3, 100), (5, 2))
    """
    checks.check_callables(sample_prior=sample_prior, sample_transition=sample_transition, observe=observe, noise=noise)
    checks.check_num_particles(num_particles, at_least=2)
    checks.check_scalar("inflation", inflation, "at least 1", lambda value: value >= 1)
    checks.check_covariance("R", R)
    params = EnsembleKalman(
        as_pytree(sample_prior),
        taking_inputs("sample_transition", sample_transition, "randomness", "x"),
        taking_inputs("observe", observe, "x"),
        jnp.asarray(R, dtype=float),
        jnp.asarray(inflation, dtype=float),
        num_particles,
        noise,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: EnsembleKalman, key: AnyKey) -> EnsembleState:
    prior_key, noise_key = jax.random.split(key)
    particles = sample_ensemble(prior_key, model.sample_prior, model.num_particles)
    checks.check_vectors("sample_prior", particles)
    return EnsembleState(particles, checks.checked_noise(model.noise(noise_key, model.num_particles), particles))


def _predict(model: EnsembleKalman, key: AnyKey, state: EnsembleState, inputs: PyTree) -> EnsembleState:
    transition = checks.checked_transition(model.sample_transition)
    move = jax.vmap(transition, in_axes=(-1, -1, None), out_axes=-1)
    return EnsembleState(move(state.noise, state.particles, inputs), model.noise(key, model.num_particles))


def _update(
    model: EnsembleKalman, key: AnyKey, state: EnsembleState, observation: Array, inputs: PyTree
) -> tuple[EnsembleState, EnsembleInfo]:
    checks.check_shape("observation", observation, model.R.shape[:1], "one number for each row of R")
    count = model.num_particles
    mean = jnp.mean(state.particles, axis=1, keepdims=True)
    x = mean + model.inflation.astype(mean.dtype) * (state.particles - mean)
    observed = jnp.isfinite(observation)
    # For a component that was not observed, prediction, observation and noise are set to zero and its row of R to that
    # of the identity: it then changes no particle and adds nothing to the log evidence.
    predicted = jnp.where(observed[:, None], jax.vmap(_observe(model, inputs), in_axes=-1, out_axes=-1)(x), 0.0)
    R = jnp.where(observed[:, None] & observed, model.R, jnp.eye(observed.size, dtype=model.R.dtype))
    spread = predicted - jnp.mean(predicted, axis=1, keepdims=True)
    root = cholesky(matmul(spread, spread.T) / (count - 1) + R)

    noise = matmul(cholesky(R), standard_normal(key, predicted.shape, predicted.dtype))
    noise = jnp.where(observed[:, None], noise - jnp.mean(noise, axis=1, keepdims=True), 0.0)
    readings = jnp.where(observed, observation, 0.0)
    innovation = jnp.where(observed, readings - jnp.mean(predicted, axis=1), 0.0)
    innovations = jnp.where(observed[:, None], readings[:, None] + noise - predicted, 0.0)
    whitened = solve_triangular(root, solve_triangular(root, innovations), transpose=True)
    moved = x + _in_cheaper_order(x - mean, spread, whitened) / (count - 1)

    standardized = solve_triangular(root, innovation)
    log_scale = jnp.sum(jnp.log(jnp.diagonal(root))) + 0.5 * math.log(2 * math.pi) * jnp.sum(observed)
    log_evidence = -0.5 * jnp.sum(jnp.square(standardized)) - log_scale
    return state._replace(particles=moved.astype(x.dtype)), EnsembleInfo(log_evidence, innovation)


def _observe(model: EnsembleKalman, inputs: PyTree) -> Callable:
    def observe(x: Array) -> Array:
        predicted = model.observe(x, inputs)
        checks.check_shape("the result of observe", predicted, model.R.shape[:1], "one number for each row of R")
        return predicted

    return observe


def _in_cheaper_order(
    deviations: Float[Array, "n k"], spread: Float[Array, "m k"], whitened: Float[Array, "m k"]
) -> Float[Array, "n k"]:
    """The product `deviations @ spread.T @ whitened`, with the smaller one of the two possible intermediate matrices.

    These are the cross-covariance (n, m) and the matrix (k, k) of inner products between samples. The first keeps large
    ensembles linear in k; the second is smaller where both the state and the observation are longer than the ensemble.
    """
    (n, k), m = deviations.shape, spread.shape[0]
    if n * m <= k * k:
        return matmul(matmul(deviations, spread.T), whitened)
    return matmul(deviations, matmul(spread.T, whitened))
