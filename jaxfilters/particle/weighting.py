"""Weights of particles: Bayes' rule on them, and resampling where they have become uneven.

The ensemble axis is the last axis of every leaf. Resampling belongs to the start of a prediction, so that the state
after an update holds the weighted posterior: estimates taken before resampling have less variance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Resampled
from jaxfilters.particle.resampling import BY_WEIGHTS
from jaxfilters.typing import AnyKey, ResamplingScheme, Temper


class ParticleInfo(NamedTuple):
    """Diagnostics of one update of a particle filter."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1); `-inf` if no particle explains the observation."""
    effective_sample_size: Float[Array, ""]
    """Of the weights after the update, between 1 and N."""
    resampled: Bool[Array, ""]
    """Whether the prediction before this update began by resampling."""
    num_invalid: Int32[Array, ""]
    """Number of particles whose log-likelihood or log weight was NaN or `+inf`; they were given weight zero."""


def resample(
    key: AnyKey,
    particles: PyTree,
    log_weights: Float[Array, " n"],
    scheme: ResamplingScheme | EnsembleScheme,
    ess_threshold: ArrayLike,
) -> tuple[PyTree, Float[Array, " n"], Int32[Array, " n"]]:
    """Resample where the effective sample size is below `ess_threshold * n`; the total weight stays the same.

    The new weights keep the derivative of the old ones, though not their values, which makes the gradient of the log
    evidence a consistent estimate of the score (A. Scibior and F. Wood, "Differentiable particle filtering without
    modifying the forward pass", 2021).

    Args:
        key: Random key.
        particles: Leaves `(..., n)`.
        log_weights: Log weights `(n,)`, not necessarily normalised.
        scheme: Resampling scheme.
        ess_threshold: Threshold as a fraction of n; 1 or more resamples always, 0 never.

    Returns:
        Particles, log weights, and the index `(n,)` of the ancestor of each particle.

    Raises:
        ValueError: If the scheme returns something other than n integers.
    """
    num_particles = log_weights.shape[0]
    normalized, log_sum = weights.normalize(log_weights)
    identity = jnp.arange(num_particles, dtype=jnp.int32)
    relative = weights.relative(jax.lax.stop_gradient(log_weights))
    # The effective sample size below the threshold, which a threshold of 1 does not leave to rounding.
    uneven = jnp.square(jnp.sum(relative)) < ess_threshold * num_particles * jnp.sum(jnp.square(relative))
    uneven = uneven | (jnp.asarray(ess_threshold) >= 1.0)
    if isinstance(scheme, EnsembleScheme):
        unchanged = Resampled(particles, normalized, identity)
        result = jax.lax.cond(uneven, lambda: scheme.resample(key, particles, normalized), lambda: unchanged)
        return result.particles, log_sum + result.log_weights, result.ancestors

    def draw() -> Int32[Array, " n"]:
        if scheme in BY_WEIGHTS:
            return BY_WEIGHTS[scheme](key, relative, num_particles)
        ancestors = scheme(key, jax.lax.stop_gradient(normalized))
        checks.check_ancestors(ancestors, num_particles)
        return jnp.asarray(ancestors, jnp.int32)

    ancestors = jax.lax.cond(uneven, draw, lambda: identity)
    return (
        jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), particles),
        log_sum + jnp.where(uneven, _equal(normalized, ancestors), normalized),
        ancestors,
    )


@jax.custom_jvp
def _equal(normalized: Float[Array, " n"], ancestors: Int32[Array, " n"]) -> Float[Array, " n"]:
    """Equal log weights, which change as those of the ancestors do."""
    # Under `vmap` the value must be mapped where its derivative is: JAX 0.10 does not transpose the other case.
    return weights.uniform(normalized.size, normalized.dtype) + 0.0 * ancestors.astype(normalized.dtype)


@_equal.defjvp
def _equal_jvp(primals, tangents):
    normalized, ancestors = primals
    chosen = jnp.where(jnp.isfinite(normalized), tangents[0], 0.0)[ancestors]
    return _equal(normalized, ancestors), chosen


def reweight(
    log_weights: Float[Array, " n"],
    log_factor: Float[Array, " n"],
    ancestors: Int32[Array, " n"],
    temper: Temper,
) -> tuple[Float[Array, " n"], ParticleInfo]:
    """Multiply the weights by the factors of an update, which are tempered first.

    A factor whose logarithm is NaN or `+inf` counts as zero and is reported. If no factor is left, the weights become
    equal and the log evidence is `-inf`. A log weight before the update that is NaN is reported likewise, and the log
    evidence is NaN.

    Args:
        log_weights: Log weights `(n,)` before the update.
        log_factor: Log-likelihoods `(n,)`, plus the log importance ratios of the proposal where it depends on the
            observation.
        ancestors: Ancestor of each particle in the last prediction, for the diagnostics.
        temper: `(log_factor, log_weights) -> log_factor`.

    Returns:
        Normalised log weights `(n,)`, and the diagnostics of the update.

    Raises:
        ValueError: If `temper` returns another shape than `(n,)`.
    """
    # A weight before the update that is NaN makes the sum so, and the log evidence, too.
    product = log_weights + log_factor
    invalid = jnp.isnan(product) | jnp.isposinf(product)
    usable = jnp.where(invalid, -jnp.inf, log_factor)
    tempered = temper(usable, log_weights)
    checks.check_shape("the result of temper", tempered, log_weights.shape, "that of its arguments")
    normalized, log_evidence = weights.normalize(log_weights + tempered)
    info = ParticleInfo(
        log_evidence=log_evidence,
        effective_sample_size=weights.effective_sample_size(normalized),
        resampled=jnp.any(ancestors != jnp.arange(ancestors.shape[0], dtype=ancestors.dtype)),
        num_invalid=jnp.sum(invalid, dtype=jnp.int32),
    )
    return normalized, info
