"""Particle filters: weighted samples that are moved, weighted and resampled.

The ensemble axis is the last axis of every leaf. Resampling happens at the start of a prediction, so that the state
after an update still holds the weighted posterior: estimates are taken from it before resampling, as they should be.
"""

from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.noise import random_keys
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Resampled
from jaxfilters.particle.resampling import systematic
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import (
    AnyKey,
    DrawNoise,
    LogLikelihood,
    ResamplingScheme,
    SamplePrior,
    SampleTransition,
    Temper,
    as_pytree,
)


class ParticleState(NamedTuple):
    """Weighted particles."""

    particles: PyTree
    """Leaves `(..., N)`."""
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    noise: PyTree
    """What will move the particles next. Drawn one step ahead: XLA would otherwise fuse the generator into the
    transition and evaluate it without vector instructions, three times slower on a CPU."""


class ParticleInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1); `-inf` if no particle explains the observation."""
    effective_sample_size: Float[Array, ""]
    """Between 1 and N, after the update."""
    resampled: Bool[Array, ""]
    """Whether the prediction before this update began by resampling."""
    num_invalid: Int32[Array, ""]
    """Particles whose log-likelihood was NaN or `+inf`; they were given weight zero."""


@pytree_dataclass
class Bootstrap:
    """Parameters of a bootstrap particle filter: the user's callbacks and how to resample."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    log_likelihood: LogLikelihood
    temper: Temper
    ess_threshold: float
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})


def bootstrap(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    log_likelihood: LogLikelihood,
    *,
    num_particles: int,
    noise: DrawNoise | None = None,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: float = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Particle filter that proposes from the transition (Gordon, Salmond and Smith 1993).

    Args:
        sample_prior: `key -> x`; or one of `jaxfilters.priors`, which draw all particles at once, twice as fast.
        sample_transition: `(randomness, x, control) -> x`.
        log_likelihood: `(x, y) -> log p(y | x)`.
        num_particles: Size N of the ensemble.
        noise: What `randomness` is. Default: a random key for each particle. `StandardNormal(d)` hands over `d`
            standard normal numbers instead and is several times faster.
        scheme: Resampling scheme, e.g. `jaxfilters.resampling.stratified`, or one of
            `jaxfilters.differentiable_resampling`.
        ess_threshold: Resample before a prediction if the effective sample size is below this share of N; 1 or more
            resamples always, 0 never.
        temper: Flattens log-likelihoods, e.g. `TemperToShare(0.2)`; the log evidence is then that of the flattened
        ones.

    Raises:
        ValueError: If `num_particles < 1` or `ess_threshold < 0`.
    """
    check_ensemble(num_particles, ess_threshold)
    params = Bootstrap(
        as_pytree(sample_prior),
        as_pytree(sample_transition),
        as_pytree(log_likelihood),
        as_pytree(temper or untempered),
        float(ess_threshold),
        num_particles,
        noise or random_keys,
        scheme,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Bootstrap, key: AnyKey) -> ParticleState:
    prior_key, noise_key = jax.random.split(key)
    particles = sample_ensemble(prior_key, model.sample_prior, model.num_particles)
    return start(particles, model.noise(noise_key, model.num_particles), model.num_particles)


def _predict(model: Bootstrap, key: AnyKey, state: ParticleState, control: PyTree) -> ParticleState:
    resample_key, noise_key = jax.random.split(key)
    particles, log_weights, ancestors = resample(
        resample_key, state.particles, state.log_weights, model.scheme, model.ess_threshold
    )
    move = jax.vmap(model.sample_transition, in_axes=(-1, -1, None), out_axes=-1)
    return ParticleState(
        move(state.noise, particles, control), log_weights, ancestors, model.noise(noise_key, model.num_particles)
    )


def _update(
    model: Bootstrap, key: AnyKey, state: ParticleState, observation: PyTree
) -> tuple[ParticleState, ParticleInfo]:
    del key
    log_likelihood = jax.vmap(model.log_likelihood, in_axes=(-1, None))(state.particles, observation)
    log_weights, info = reweight(state.log_weights, log_likelihood, state.ancestors, model.temper)
    return state._replace(log_weights=log_weights), info


def start(particles: PyTree, noise: PyTree, num_particles: int) -> ParticleState:
    """Equally weighted particles that are their own ancestors."""
    log_weights = weights.uniform(num_particles)
    return ParticleState(particles, log_weights, jnp.arange(num_particles, dtype=jnp.int32), noise)


def resample(
    key: AnyKey,
    particles: PyTree,
    log_weights: Float[Array, " n"],
    scheme: ResamplingScheme | EnsembleScheme,
    ess_threshold: float | Float[Array, ""],
) -> tuple[PyTree, Float[Array, " n"], Int32[Array, " n"]]:
    """Resample where the effective sample size is below `ess_threshold * N`; keeps the total weight.

    Returns particles, log weights, and the ancestor of each. The new weights keep the derivative of the old ones (their
    value does not), which makes the gradient of the log evidence a consistent estimate of the score
    (Scibior and Wood 2021, "Differentiable particle filtering without modifying the forward pass").
    """
    num_particles = log_weights.shape[0]
    normalized, log_sum = weights.normalize(log_weights)
    identity = jnp.arange(num_particles, dtype=jnp.int32)
    uneven = weights.effective_sample_size(normalized) < ess_threshold * num_particles
    uneven = uneven | (jnp.asarray(ess_threshold) >= 1.0)
    if isinstance(scheme, EnsembleScheme):
        as_it_is = Resampled(particles, normalized, identity)
        found = jax.lax.cond(uneven, lambda: scheme.resample(key, particles, normalized), lambda: as_it_is)
        return found.particles, log_sum + found.log_weights, found.ancestors

    def draw() -> Int32[Array, " n"]:
        return scheme(key, jax.lax.stop_gradient(normalized))

    ancestors = jax.lax.cond(uneven, draw, lambda: identity)
    chosen = normalized[ancestors]
    chosen = jnp.where(jnp.isfinite(chosen), chosen, 0.0)
    equal = weights.uniform(num_particles, log_weights.dtype) + (chosen - jax.lax.stop_gradient(chosen))
    return (
        jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), particles),
        log_sum + jnp.where(uneven, equal, normalized),
        ancestors,
    )


def reweight(
    log_weights: Float[Array, " n"],
    log_likelihood: Float[Array, " n"],
    ancestors: Int32[Array, " n"],
    temper: Temper,
) -> tuple[Float[Array, " n"], ParticleInfo]:
    """Bayes' rule on the weights: normalised log weights, and the diagnostics of the update.

    A NaN or `+inf` log-likelihood counts as `-inf` and is reported; if nothing is left, the weights become equal and
    the log evidence is `-inf`.
    """
    invalid = jnp.isnan(log_likelihood) | jnp.isposinf(log_likelihood)
    usable = jnp.where(invalid, -jnp.inf, log_likelihood)
    normalized, log_evidence = weights.normalize(log_weights + temper(usable, log_weights))
    info = ParticleInfo(
        log_evidence=log_evidence,
        effective_sample_size=weights.effective_sample_size(normalized),
        resampled=jnp.any(ancestors != jnp.arange(ancestors.shape[0], dtype=ancestors.dtype)),
        num_invalid=jnp.sum(invalid, dtype=jnp.int32),
    )
    return normalized, info


def untempered(log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Log-likelihoods as they are."""
    del log_weights
    return log_likelihood


@pytree_dataclass
class AdaptiveTempering:
    """Raise the likelihood to the largest power, at most 1, that leaves a share of the effective sample size."""

    share: float | Float[Array, ""]
    """Of the effective sample size before the update, in (0, 1]."""

    def __call__(self, log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
        target = self.share * weights.effective_sample_size(log_weights)
        exponent = weights.temper_exponent(log_likelihood, log_weights, target)
        return jax.lax.stop_gradient(exponent) * log_likelihood


def check_ensemble(num_particles: int, ess_threshold: float) -> None:
    """Reject ensembles that cannot be.

    Raises:
        ValueError: If `num_particles < 1` or `ess_threshold < 0`.
    """
    if not isinstance(num_particles, int) or num_particles < 1:
        raise ValueError(f"num_particles must be an integer of at least 1; got {num_particles!r}.")
    if not ess_threshold >= 0:
        raise ValueError(f"ess_threshold must be a share of the particles, at least 0; got {ess_threshold!r}.")
