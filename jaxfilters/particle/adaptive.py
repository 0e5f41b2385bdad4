r"""Particle filter with adaptive diffusion: particles spread little while the target rests and far while it moves.

The target coasts: it is predicted to go on with the velocity of its last estimate, in noise that grows with that
velocity (K. Oka, Y. Sato et al. 2006, equations 15 and 18-24; Y. Sugano 2007, section 3.3).
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter
from jaxfilters.math import diffusion
from jaxfilters.math.diffusion import DiffusionFit
from jaxfilters.math.linalg import safe_sqrt
from jaxfilters.particle.bootstrap import ParticleInfo, check_ensemble, resample, reweight, untempered
from jaxfilters.particle.differentiable_resampling import EnsembleScheme
from jaxfilters.particle.partitioned import EnsembleLogLikelihood, Partitions, in_one_group, partitioned_update
from jaxfilters.particle.resampling import systematic
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, ResamplingScheme, SamplePrior, as_pytree


class AdaptiveDiffusionState(NamedTuple):
    """Weighted particles, and where their estimate went. The first m of d coordinates coast."""

    particles: Float[Array, "d n"]
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    spread: Float[Array, " d"]
    """Standard deviations of the noise in the last prediction."""
    estimate: Float[Array, " d"]
    """Mean around the mode at the last update that explained its observation; before the first, of the prior."""
    velocity: Float[Array, " m"]
    """Of the estimate, per unit of time, between the last two such updates."""
    elapsed: Float[Array, ""]
    """Time since `estimate`."""
    num_estimates: Int32[Array, ""]
    """Updates that explained their observation."""
    fit: DiffusionFit
    """Of the changes of velocity that were seen."""


@pytree_dataclass
class AdaptiveDiffusion:
    """Parameters of a particle filter with adaptive diffusion."""

    sample_prior: SamplePrior
    log_likelihood: EnsembleLogLikelihood
    fit: DiffusionFit
    learn: Callable[[DiffusionFit, Array, Array], DiffusionFit]
    low: Float[Array, " m"]
    high: Float[Array, " m"]
    steady_std: Float[Array, " d-m"]
    mode_scale: Float[Array, " d"]
    mode_distance: float | Float[Array, ""]
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
    learn: Callable[[DiffusionFit, Array, Array], DiffusionFit] = diffusion.update,
    partitions: Partitions | None = None,
    mode_distance: float = 2.0,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
) -> Filter:
    r"""Particle filter for a vector that coasts with the velocity of its estimate, in noise that adapts to it.

    $x_t = x'_{t-1} + \tau v_{t-1} + \omega$ with a resampled particle $x'$, $v$ the velocity of the last *estimate*,
    which is the mean around the mode, and $\omega$ of standard deviation $\tau (A |v| + b)$ in the coordinates that
    coast; the others, after them in the vector, keep still but for $\sqrt\tau$ times `steady_std`. The control is
    $\tau$, the time since the last prediction; `None` is 1. An update in which no particle explains the observation
    leaves estimate, velocity and fit as they were, as a missed frame does.

    Args:
        sample_prior: `key -> x`, a vector of d numbers.
        log_likelihood: `(particles (d, n), y) -> (n,)`; `over_ensemble` makes it of `(x, y) -> log p(y | x)`.
        fit: Diffusion at first, from `jaxfilters.diffusion.start`; its size m is the number of coordinates that coast.
        num_particles: Size n of the ensemble.
        mode_scale: Of each coordinate, for `jaxfilters.weights.mean_around_mode`.
        steady_std: Of the d - m coordinates that do not coast; `None` if all do.
        low: Lower limit of the diffusion, in each coordinate's unit per unit of time.
        high: The upper limit.
        learn: `diffusion.update`, `diffusion.fixed`, or `jax.tree_util.Partial(diffusion.update, forgetting=0.99)`.
        partitions: Weighs every observation in two stages; `None` in one.
        mode_distance: For `mean_around_mode`.
        scheme: Resampling scheme; of `jf.differentiable_resampling`, `soft`, and `transport` without `partitions`.

    Raises:
        ValueError: If `num_particles < 1`, a scale, a distance or a limit is out of range, or sizes do not agree.
    """
    check_ensemble(num_particles, 1.0)
    steady_std = jnp.zeros(0) if steady_std is None else jnp.asarray(steady_std, dtype=float)
    mode_scale = jnp.asarray(mode_scale, dtype=float)
    low, high = (jnp.broadcast_to(jnp.asarray(limit, dtype=float), fit.scale.shape) for limit in (low, high))
    params = AdaptiveDiffusion(
        as_pytree(sample_prior),
        as_pytree(log_likelihood),
        fit,
        as_pytree(learn),
        low,
        high,
        steady_std,
        mode_scale,
        float(mode_distance),
        partitions,
        num_particles,
        scheme,
    )
    _check(params)
    return Filter(params, _init, _predict, _update)


def _init(model: AdaptiveDiffusion, key: AnyKey) -> AdaptiveDiffusionState:
    particles = sample_ensemble(key, model.sample_prior, model.num_particles)
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
    model: AdaptiveDiffusion, key: AnyKey, state: AdaptiveDiffusionState, control: PyTree
) -> AdaptiveDiffusionState:
    resample_key, noise_key = jax.random.split(key)
    tau = jnp.asarray(1.0 if control is None else control, state.elapsed.dtype)
    tau = jnp.where(tau > 0, tau, 0.0)
    particles, log_weights, ancestors = resample(resample_key, state.particles, state.log_weights, model.scheme, 1.0)
    changing = tau * diffusion.velocity_change_std(state.fit, state.velocity, low=model.low, high=model.high)
    spread = jnp.concatenate([changing, safe_sqrt(tau) * model.steady_std])
    drift = jnp.pad(tau * state.velocity, (0, model.steady_std.shape[0]))
    noise = standard_normal(noise_key, particles.shape, particles.dtype)
    displacement = drift[:, None] + spread[:, None] * noise
    if model.partitions is not None:
        displacement = in_one_group(displacement, model.partitions.groups)
    return state._replace(
        particles=particles + displacement,
        log_weights=log_weights,
        ancestors=ancestors,
        spread=spread,
        elapsed=state.elapsed + tau,
    )


def _update(
    model: AdaptiveDiffusion, key: AnyKey, state: AdaptiveDiffusionState, observation: PyTree
) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
    particles, log_weights, ancestors = state.particles, state.log_weights, state.ancestors

    def log_likelihood(particles: Array) -> Array:
        return model.log_likelihood(particles, observation)

    if model.partitions is None:
        log_weights, info = reweight(log_weights, log_likelihood(particles), ancestors, untempered)
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
    return _followed(model, state, info.log_evidence > -jnp.inf), info


def _followed(model: AdaptiveDiffusion, state: AdaptiveDiffusionState, explained: Array) -> AdaptiveDiffusionState:
    """Estimate, velocity and fit after an update; as they were if it explained nothing."""
    estimate = weights.mean_around_mode(
        state.particles, state.log_weights, model.mode_scale, distance=model.mode_distance
    )
    coasting = state.velocity.shape[0]
    passed = state.elapsed > 0
    velocity = (estimate - state.estimate)[:coasting] / jnp.where(passed, state.elapsed, 1.0)
    # The mean of the prior is no place where the target was: the first estimate has no velocity, the second no change.
    moves = explained & passed & (state.num_estimates >= 1)
    learns = moves & (state.num_estimates >= 2)
    learnt = model.learn(state.fit, state.velocity, velocity - state.velocity)
    return state._replace(
        estimate=jnp.where(explained, estimate, state.estimate),
        velocity=jnp.where(moves, velocity, state.velocity),
        elapsed=jnp.where(explained, 0.0, state.elapsed),
        num_estimates=state.num_estimates + explained.astype(jnp.int32),
        fit=jax.tree.map(lambda new, old: jnp.where(learns, new, old), learnt, state.fit),
    )


def _check(model: AdaptiveDiffusion) -> None:
    low, high = np.asarray(model.low), np.asarray(model.high)
    coasting, steady, size = low.shape[0], model.steady_std.shape[0], model.mode_scale.shape[0]
    diffusion.check_positive("mode_scale", model.mode_scale)
    diffusion.check_positive("mode_distance", model.mode_distance)
    if not np.all((low >= 0) & (high >= low)):
        raise ValueError(f"low and high must be 0 <= low <= high; got {low} and {high}.")
    if size != coasting + steady:
        raise ValueError(f"mode_scale must have one number for each of {coasting} + {steady} coordinates; got {size}.")
    if model.partitions is not None and model.partitions.groups.shape[1] != size:
        raise ValueError(f"partitions must have groups of {size} coordinates; got {model.partitions.groups.shape[1]}.")
