r"""Particle filter with adaptive diffusion: process noise that is small while a target rests and large while it moves.

The target is predicted to keep the velocity of its last estimate, with noise that grows with that velocity (K. Oka,
Y. Sato et al. 2006, equations 15 and 18-24; in English: K. Oka, Y. Sato, Y. Nakanishi and H. Koike, "Head pose
estimation system based on particle filtering with adaptive diffusion control", IAPR Conference on Machine Vision
Applications, 2005; Y. Sugano, "User-independent techniques for real-time estimation of non-rigid 3D head motion",
2007, section 3.3).
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter
from jaxfilters.math import diffusion
from jaxfilters.math.diffusion import DiffusionFit
from jaxfilters.math.linalg import safe_sqrt
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme
from jaxfilters.particle.partitioned import EnsembleLogLikelihood, Partitions, move_one_group, partitioned_update
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, ResamplingScheme, SamplePrior, as_pytree, taking_inputs


class AdaptiveDiffusionState(NamedTuple):
    """Weighted particles, their estimate and its velocity. The first m of d coordinates keep their velocity."""

    particles: Float[Array, "d n"]
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    spread: Float[Array, " d"]
    """Standard deviations of the process noise of the last prediction."""
    estimate: Float[Array, " d"]
    """Mean around the mode at the last update that explained its observation; before the first, mean of the prior."""
    velocity: Float[Array, " m"]
    """Velocity of the estimate, per unit of time, between the last two such updates."""
    elapsed: Float[Array, ""]
    """Time since `estimate` was made."""
    num_estimates: Int32[Array, ""]
    """Number of updates that explained their observation."""
    fit: DiffusionFit
    """Regression of the changes of velocity on the velocity."""


@pytree_dataclass
class AdaptiveDiffusion:
    """Parameters of a particle filter with adaptive diffusion."""

    sample_prior: SamplePrior
    log_likelihood: EnsembleLogLikelihood
    fit: DiffusionFit
    update_fit: Callable[[DiffusionFit, Array, Array], DiffusionFit]
    low: Float[Array, " m"]
    high: Float[Array, " m"]
    steady_std: Float[Array, " d-m"]
    mode_scale: Float[Array, " d"]
    mode_distance: ArrayLike
    partitions: Partitions | None
    num_particles: int = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})


def adaptive_diffusion(
    sample_prior: SamplePrior,
    log_likelihood: EnsembleLogLikelihood,
    fit: DiffusionFit,
    *,
    num_particles: int,
    mode_scale: Float[Array, " d"],
    steady_std: Float[Array, " k"] | None = None,
    low: float | Float[Array, " m"] = 0.0,
    high: float | Float[Array, " m"] = math.inf,
    update_fit: Callable[[DiffusionFit, Array, Array], DiffusionFit] = diffusion.update,
    partitions: Partitions | None = None,
    mode_distance: ArrayLike = 2.0,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
) -> Filter:
    r"""Build a particle filter of a vector that keeps its velocity, with noise that adapts to that velocity.

    The transition is $x_t = x'_{t-1} + \tau v_{t-1} + \omega$ with a resampled particle $x'$, the velocity $v$ of the
    last *estimate* (the mean around the mode), and noise $\omega$ of standard deviation $\tau (A |v| + b)$. Only the
    first m coordinates move like this; the others perform a random walk with $\sqrt\tau$ times `steady_std`. The
    inputs is $\tau$, the time since the last prediction; `None` is 1. An update in which no particle explains the
    observation leaves estimate, velocity and fit unchanged, as a missed frame does.

    Args:
        sample_prior: `key -> x`, a vector `(d,)`.
        log_likelihood: `(particles (d, n), y) -> (n,)`; `batch_log_likelihood` makes it from `(x, y) -> log p(y | x)`.
        fit: Initial diffusion from `jaxfilters.math.diffusion.start`; its size is m.
        num_particles: Number n of particles.
        mode_scale: Scale `(d,)` of each coordinate for `jaxfilters.weights.mean_around_mode`.
        steady_std: Standard deviations `(d - m,)` of the random walks; `None` if m = d.
        low: Lower limit of the standard deviation, in each coordinate's unit per unit of time; a number or `(m,)`.
        high: Upper limit of the same.
        update_fit: `diffusion.update`, `diffusion.fixed`, or a partial of the former with a `forgetting` below 1.
        partitions: Evaluates every observation in two stages, see `Partitions`; `None` in one.
        mode_distance: Argument `distance` of `mean_around_mode`.
        scheme: Function of `jaxfilters.resampling`; of `jaxfilters.differentiable_resampling` also `soft(...)`, and
            `transport(...)` without `partitions`.

    Returns:
        A filter whose state is an `AdaptiveDiffusionState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If `num_particles < 1`, a scale, a distance or a limit is out of range, or sizes do not agree; and
            when the filter is traced, if a callback returns an array of the wrong shape or type.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> fit = jf.math.diffusion.start(jnp.ones(2))
        >>> log_likelihood = lambda particles, y: -jnp.sum((particles - y[:, None]) ** 2, axis=0)
        >>> prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), jnp.eye(2)))
        >>> pf = jf.adaptive_diffusion(prior, log_likelihood, fit, num_particles=100, mode_scale=jnp.ones(2))
        >>> state, _ = jf.run(pf, jax.random.key(0), jnp.ones((5, 2)))
        >>> state.estimate.shape, int(state.num_estimates)
        ((2,), 5)
    """
    checks.check_callables(sample_prior=sample_prior, log_likelihood=log_likelihood, update_fit=update_fit)
    checks.check_ensemble(num_particles, 1.0, scheme, None)
    if not isinstance(fit, DiffusionFit):
        raise TypeError(f"fit must be a DiffusionFit of jaxfilters.math.diffusion.start; got {fit!r}.")
    params = AdaptiveDiffusion(
        as_pytree(sample_prior),
        taking_inputs("log_likelihood", log_likelihood, "particles", "y"),
        fit,
        as_pytree(update_fit),
        _limits("low", low, fit.scale.shape),
        _limits("high", high, fit.scale.shape),
        jnp.asarray(() if steady_std is None else steady_std, dtype=float),
        jnp.asarray(mode_scale, dtype=float),
        mode_distance,
        partitions,
        num_particles,
        scheme,
    )
    _check(params)
    return Filter(params, _init, _predict, _update)


def _limits(name: str, limit: ArrayLike, shape: tuple[int, ...]) -> Array:
    """One limit for each coordinate that keeps its velocity."""
    given = jnp.asarray(limit, dtype=float)
    if given.shape not in ((), shape):
        raise ValueError(f"{name} must be one number or have the shape {shape}; got {given.shape}.")
    return jnp.broadcast_to(given, shape)


def _init(model: AdaptiveDiffusion, key: AnyKey) -> AdaptiveDiffusionState:
    particles = sample_ensemble(key, model.sample_prior, model.num_particles)
    checks.check_vectors("sample_prior", particles)
    if particles.shape[0] != model.mode_scale.shape[0]:
        raise ValueError(f"sample_prior must draw {model.mode_scale.shape[0]} numbers; got {particles.shape[0]}.")
    log_weights = weights.uniform(model.num_particles, particles.dtype)
    return AdaptiveDiffusionState(
        particles,
        log_weights,
        jnp.arange(model.num_particles, dtype=jnp.int32),
        spread=jnp.zeros_like(model.mode_scale),
        estimate=weights.mean(particles, log_weights),
        velocity=jnp.zeros_like(model.fit.scale),
        elapsed=jnp.zeros((), particles.dtype),
        num_estimates=jnp.zeros((), jnp.int32),
        fit=model.fit,
    )


def _predict(
    model: AdaptiveDiffusion, key: AnyKey, state: AdaptiveDiffusionState, inputs: PyTree
) -> AdaptiveDiffusionState:
    resample_key, noise_key = jax.random.split(key)
    tau = jnp.asarray(1.0 if inputs is None else inputs, state.elapsed.dtype)
    checks.check_shape("inputs", tau, (), "it is the time since the last prediction")
    tau = jnp.where(tau > 0, tau, 0.0)
    particles, log_weights, ancestors = resample(resample_key, state.particles, state.log_weights, model.scheme, 1.0)
    changing = tau * diffusion.velocity_change_std(state.fit, state.velocity, low=model.low, high=model.high)
    spread = jnp.concatenate([changing, safe_sqrt(tau) * model.steady_std])
    drift = jnp.pad(tau * state.velocity, (0, model.steady_std.shape[0]))
    noise = standard_normal(noise_key, particles.shape, particles.dtype)
    displacement = drift[:, None] + spread[:, None] * noise
    if model.partitions is not None:
        displacement = move_one_group(displacement, model.partitions.groups)
    return state._replace(
        particles=particles + displacement,
        log_weights=log_weights,
        ancestors=ancestors,
        spread=spread,
        elapsed=state.elapsed + tau,
    )


def _update(
    model: AdaptiveDiffusion, key: AnyKey, state: AdaptiveDiffusionState, observation: PyTree, inputs: PyTree
) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
    particles, log_weights, ancestors = state.particles, state.log_weights, state.ancestors

    def log_likelihood(particles: Array) -> Array:
        values = model.log_likelihood(particles, observation, inputs)
        return checks.log_likelihoods_of_ensemble(values, particles.shape[1])

    if model.partitions is None:
        log_weights, info = reweight(log_weights, log_likelihood(particles), ancestors, no_tempering)
    else:
        particles, log_weights, ancestors, info = partitioned_update(
            key,
            particles,
            log_weights,
            ancestors,
            log_likelihood,
            model.partitions.jitter * state.spread,
            stage_weights=model.partitions.stage_weights,
            scheme=model.scheme,
        )
    state = state._replace(particles=particles, log_weights=log_weights, ancestors=ancestors)
    return _with_estimate(model, state, info.log_evidence > -jnp.inf), info


def _with_estimate(model: AdaptiveDiffusion, state: AdaptiveDiffusionState, explained: Array) -> AdaptiveDiffusionState:
    """Update estimate, velocity and fit, unless no particle explained the observation."""
    estimate = weights.mean_around_mode(
        state.particles, state.log_weights, model.mode_scale, distance=model.mode_distance
    )
    m = state.velocity.shape[0]
    passed = state.elapsed > 0
    velocity = (estimate - state.estimate)[:m] / jnp.where(passed, state.elapsed, 1.0)
    # The mean of the prior is not an estimate of the target, so that the first estimate has no velocity and the second
    # one no change of velocity.
    moves = explained & passed & (state.num_estimates >= 1)
    updates = moves & (state.num_estimates >= 2)
    fit = model.update_fit(state.fit, state.velocity, velocity - state.velocity)
    return state._replace(
        estimate=jnp.where(explained, estimate, state.estimate),
        velocity=jnp.where(moves, velocity, state.velocity),
        elapsed=jnp.where(explained, 0.0, state.elapsed),
        num_estimates=state.num_estimates + explained.astype(jnp.int32),
        fit=jax.tree.map(lambda new, old: jnp.where(updates, new, old), fit, state.fit),
    )


def _check(model: AdaptiveDiffusion) -> None:
    m, steady, size = model.low.shape[0], jnp.shape(model.steady_std), jnp.shape(model.mode_scale)
    if len(steady) != 1 or size != (m + steady[0],):
        given = f"a fit of {m} coordinates, steady_std {steady} and mode_scale {size}"
        raise ValueError(f"mode_scale must have one number for each of {m} + {sum(steady)} coordinates; got {given}.")
    checks.check_values("mode_scale", model.mode_scale, "positive", lambda value: value > 0)
    checks.check_values("steady_std", model.steady_std, "at least 0", lambda value: value >= 0)
    checks.check_scalar("mode_distance", model.mode_distance, "positive", lambda value: value > 0)
    checks.check_values(
        "low and high", (model.low, model.high), "0 <= low <= high", lambda v: (v[0] >= 0) & (v[1] >= v[0])
    )
    if model.partitions is not None:
        checks.check_partitions(model.partitions, size[0])
