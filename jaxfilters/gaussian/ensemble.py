r"""Ensemble Kalman filter: a Kalman filter whose belief is a set of equally weighted samples.

It is meant for states of hundreds of numbers and more, for which a covariance matrix is too large to store and the
weights of a particle filter degenerate. By default every sample is moved by the Kalman gain that the sample covariances
give, towards the observation perturbed by its own draw of the observation noise, which keeps the spread of the ensemble
consistent (G. Burgers, P. J. van Leeuwen and G. Evensen, "Analysis scheme in the ensemble Kalman filter", Monthly
Weather Review 126, 1998); `jf.ensemble` has deterministic schemes. The result converges to the Kalman filter for linear
Gaussian models as the ensemble grows; for other models it does not converge to the exact posterior, however large the
ensemble is.
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla import last_axis
from jaxfilters.filter import Filter
from jaxfilters.gaussian.ensemble_analysis import Analysis, Forecast, perturbed_observations, serial, transform
from jaxfilters.gaussian.localization import Localization
from jaxfilters.math.linalg import cholesky, matmul, safe_norm, solve_triangular
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
    relaxation: Float[Array, ""] | None
    localization: Localization | None
    analysis: Analysis = field(metadata={"static": True})
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
    relaxation: ArrayLike | None = None,
    localization: Localization | None = None,
    analysis: Analysis = perturbed_observations,
) -> Filter:
    """Build an ensemble Kalman filter for a state that is a vector of n numbers.

    Components of an observation that are NaN count as not observed. No matrix of n x n numbers is stored, and for
    large ensembles no matrix of N x N numbers either: memory grows as N (n + m) + n m + m^2, or as N (n + m + N) + m^2
    where N^2 < n m; localisation stores n m numbers. The filter is differentiable in `R`, `inflation`, `relaxation`,
    `localization` and the parameters of its callbacks.

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
        relaxation: Share, from 0 to 1, of the loss of standard deviation in an update that is given back to each number
            of the state: inflation that adapts to how much was observed (relaxation to prior spread, J. S. Whitaker and
            T. M. Hamill, "Evaluating methods to account for system errors in ensemble data assimilation", Monthly
            Weather Review 140, 2012, equation 2). `None` gives nothing back.
        localization: Factors of the sample covariances, as `jf.ensemble.localization` makes them from coordinates;
            `None` leaves all as they are. For large states and ensembles smaller than about the number of growing
            directions of the dynamics, a filter without it diverges.
        analysis: `jf.ensemble.perturbed_observations` (stochastic, the default), `transform` (square root, ETKF and
            LETKF) or `serial` (EnSRF); or a function of the type `jf.ensemble.Analysis`.

    Returns:
        A filter whose state is an `EnsembleState` and whose info is an `EnsembleInfo`.

    Raises:
        ValueError: If `num_particles < 2`, `inflation < 1`, `relaxation` is outside [0, 1], `R` is not a covariance,
            factors of `localization` have another shape or are outside [0, 1], or `R` is not diagonal for `serial` or a
            localised `transform`; and when the filter is traced, if a callback returns an array of the wrong shape or
            type, or an observation is not of shape `(m,)`.
        TypeError: If `localization` is no `Localization`, or a callback no function.

    Examples:
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
    checks.check_callables(analysis=analysis)
    checks.check_num_particles(num_particles, at_least=2)
    checks.check_scalar("inflation", inflation, "at least 1", lambda value: value >= 1)
    if relaxation is not None:
        checks.check_scalar("relaxation", relaxation, "from 0 to 1", lambda value: 0 <= value <= 1)
        relaxation = jnp.asarray(relaxation, dtype=float)
    checks.check_covariance("R", R)
    if localization is not None:
        _check_localization(localization, jnp.shape(R)[0])
    if analysis is serial or (analysis is transform and localization is not None):
        _check_diagonal(R)
    params = EnsembleKalman(
        as_pytree(sample_prior),
        taking_inputs("sample_transition", sample_transition, "randomness", "x"),
        taking_inputs("observe", observe, "x"),
        jnp.asarray(R, dtype=float),
        jnp.asarray(inflation, dtype=float),
        relaxation,
        localization,
        analysis,
        num_particles,
        noise,
    )
    return Filter(params, _init, _predict, _update)


def _check_localization(localization: Localization, m: int) -> None:
    if not isinstance(localization, Localization):
        raise TypeError(f"localization must be a Localization; got a {type(localization).__name__}.")
    checks.check_shape("localization.observation", localization.observation, (m, m), "one number for each row of R")
    if jnp.ndim(localization.state) != 2 or jnp.shape(localization.state)[1] != m:
        raise ValueError(f"localization.state must have the shape (n, {m}); got {jnp.shape(localization.state)}.")
    for name, factors in localization._asdict().items():
        known = checks.concrete(factors)
        if known is not None and not np.all((known >= 0) & (known <= 1)):
            raise ValueError(f"localization.{name} must be from 0 to 1; got {known.min():.6g} to {known.max():.6g}.")


def _check_diagonal(R: ArrayLike) -> None:
    known = checks.concrete(R)
    if known is not None and np.any(known != np.diag(np.diagonal(known))):
        raise ValueError(
            f"R must be diagonal, as one observation is assimilated after the other; got {known.tolist()}."
        )


def _init(model: EnsembleKalman, key: AnyKey) -> EnsembleState:
    prior_key, noise_key = jax.random.split(key)
    particles = sample_ensemble(prior_key, model.sample_prior, model.num_particles)
    checks.check_vectors("sample_prior", particles)
    return EnsembleState(particles, checks.checked_noise(model.noise(noise_key, model.num_particles), particles))


def _predict(model: EnsembleKalman, key: AnyKey, state: EnsembleState, inputs: PyTree) -> EnsembleState:
    transition = checks.checked_transition(model.sample_transition)
    move = last_axis.vmap(transition, in_axes=(-1, -1, None))
    return EnsembleState(move(state.noise, state.particles, inputs), model.noise(key, model.num_particles))


def _update(
    model: EnsembleKalman, key: AnyKey, state: EnsembleState, observation: Array, inputs: PyTree
) -> tuple[EnsembleState, EnsembleInfo]:
    checks.check_shape("observation", observation, model.R.shape[:1], "one number for each row of R")
    forecast = _forecast(model, state.particles, observation, inputs)
    moved = model.analysis(key, forecast)
    checks.check_shape("the result of analysis", moved, state.particles.shape, "that of the samples")
    if model.relaxation is not None:
        moved = _relaxed(moved, forecast.deviations, model.relaxation)
    innovation = forecast.innovation
    standardized = solve_triangular(forecast.root, innovation)
    log_scale = jnp.sum(jnp.log(jnp.diagonal(forecast.root))) + 0.5 * math.log(2 * math.pi) * jnp.sum(forecast.observed)
    log_evidence = -0.5 * jnp.sum(jnp.square(standardized)) - log_scale
    return state._replace(particles=moved.astype(state.particles.dtype)), EnsembleInfo(log_evidence, innovation)


def _forecast(
    model: EnsembleKalman, particles: Float[Array, "n k"], observation: Float[Array, " m"], inputs: PyTree
) -> Forecast:
    n, m = particles.shape[0], observation.size
    if model.localization is not None:
        checks.check_shape("localization.state", model.localization.state, (n, m), "states by observations")
    mean = jnp.mean(particles, axis=1, keepdims=True)
    deviations = model.inflation.astype(mean.dtype) * (particles - mean)
    observed = jnp.isfinite(observation)
    # For a component that was not observed, prediction, observation and noise are set to zero and its row of R to that
    # of the identity: it then changes no particle and adds nothing to the log evidence.
    predicted = last_axis.vmap(_observe(model, inputs))(mean + deviations)
    predicted = jnp.where(observed[:, None], predicted, 0.0)
    R = jnp.where(observed[:, None] & observed, model.R, jnp.eye(m, dtype=model.R.dtype))
    spread = predicted - jnp.mean(predicted, axis=1, keepdims=True)
    covariance = matmul(spread, spread.T) / (particles.shape[1] - 1)
    if model.localization is not None:
        covariance = model.localization.observation * covariance
    readings = jnp.where(observed, observation, 0.0)
    root = cholesky(covariance + R)
    # The same in every step: the compiler moves it out of the loop.
    noise_root = cholesky(model.R)
    return Forecast(mean[:, 0], deviations, predicted, readings, observed, R, noise_root, root, model.localization)


def _relaxed(
    particles: Float[Array, "n k"], before: Float[Array, "n k"], share: Float[Array, ""]
) -> Float[Array, "n k"]:
    """Samples whose standard deviations are `share` of the way back to those before the update."""
    mean = jnp.mean(particles, axis=1, keepdims=True)
    after = particles - mean
    prior, posterior = (safe_norm(deviations)[:, None] for deviations in (before, after))
    lost = jnp.where(posterior > 0, (prior - posterior) / jnp.where(posterior > 0, posterior, 1.0), 0.0)
    return mean + (1 + share.astype(mean.dtype) * lost) * after


def _observe(model: EnsembleKalman, inputs: PyTree) -> Callable:
    def observe(x: Array) -> Array:
        predicted = model.observe(x, inputs)
        checks.check_shape("the result of observe", predicted, model.R.shape[:1], "one number for each row of R")
        return predicted

    return observe
