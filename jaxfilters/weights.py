"""Log weights of an ensemble: normalising, effective sample size, moments, tempering.

The ensemble axis is the last one of every leaf. Everywhere in this module a log weight of NaN counts as `-inf`,
`+inf` as the largest finite number, and an ensemble in which nothing has any weight counts as evenly weighted.
Particles without weight contribute nothing, whatever their values: not even NaN.
"""

import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Num, PyTree, Shaped

_TEMPER_STEPS = 24
_TEMPER_LOWEST_LOG2 = -40.0


def uniform(num: int, dtype: DTypeLike = float) -> Float[Array, " n"]:
    """Equal log weights of `num` particles."""
    return jnp.full(num, -math.log(num), dtype=dtype)


def normalize(log_weights: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Log weights that sum to one, and the log of what they summed to.

    Where all are `-inf` the weights come out even and the log sum is `-inf`.
    """
    shifted, peak = _below_peak(log_weights)
    log_sum = jnp.log(jnp.sum(jnp.exp(shifted)))
    return shifted - log_sum, peak + log_sum


def relative(log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Weights of which the largest is one."""
    return jnp.exp(_below_peak(log_weights)[0])


def linear(log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Weights that sum to one."""
    weights = relative(log_weights)
    return weights / jnp.sum(weights)


def _below_peak(log_weights):
    finite_above = jnp.minimum(log_weights, jnp.finfo(log_weights.dtype).max)
    log_weights = jnp.where(jnp.isnan(log_weights), -jnp.inf, finite_above)
    peak = jax.lax.stop_gradient(jnp.max(log_weights))
    dead = peak == -jnp.inf
    return jnp.where(dead, 0.0, log_weights - jnp.where(dead, 0.0, peak)), peak


def effective_sample_size(log_weights: Float[Array, " n"]) -> Float[Array, ""]:
    """`1 / sum(w**2)` of the normalised weights: from 1, one particle has it all, to n, all are equal."""
    return 1 / jnp.sum(jnp.square(linear(log_weights)))


def mean(particles: PyTree[Shaped[Array, "..."]], log_weights: Float[Array, " n"]) -> PyTree[Float[Array, "..."]]:
    """Weighted mean of every leaf `(..., n)` over its last axis; of a boolean leaf, the probability of truth."""
    w = linear(log_weights)
    return jax.tree.map(lambda leaf: jnp.sum(jnp.where(w > 0, leaf, 0) * w, axis=-1), particles)


def mean_around_mode(
    x: Float[Array, "d n"],
    log_weights: Float[Array, " n"],
    scale: Float[Array, " d"],
    *,
    distance: float | Num[Array, ""] = 2.0,
) -> Float[Array, " d"]:
    """Weighted mean of the particles near the heaviest one: where the highest peak of several is.

    Near means a Euclidean distance below `distance` once every coordinate is divided by its `scale`, positive and in
    the coordinate's own unit (K. Oka, Y. Sato et al. 2006, equations 18-19). Of equally heavy particles the first
    counts as the heaviest; which particles are near is a constant to differentiation.
    """
    heaviest = jnp.argmax(linear(log_weights))
    apart = jax.lax.stop_gradient((x - x[:, heaviest, None]) / scale[:, None])
    near = jnp.sum(jnp.square(apart), axis=0) < distance**2
    near = near | (jnp.arange(log_weights.shape[0]) == heaviest)
    return mean(x, jnp.where(near, _below_peak(log_weights)[0], -jnp.inf))


def covariance(x: Float[Array, "d n"], log_weights: Float[Array, " n"]) -> Float[Array, "d d"]:
    """Weighted covariance `sum_i w_i (x_i - mean)(x_i - mean)^T`, without a small-sample correction."""
    w = linear(log_weights)
    centred = jnp.where(w > 0, x - mean(x, log_weights)[:, None], 0.0)
    return jnp.matmul(centred * w, centred.T, precision="highest")


def quantile(
    x: Num[Array, "*batch n"], log_weights: Float[Array, " n"], probability: float | Num[Array, ""]
) -> Float[Array, "*batch"]:
    """Smallest value with at least `probability` of the weight at or below it, along the last axis."""
    w = linear(log_weights)
    values = jnp.where(w > 0, x, jnp.inf)
    order = jnp.argsort(values, axis=-1)
    below = jnp.cumsum(w[order], axis=-1)
    rank = jnp.sum(below < probability * below[..., -1:], axis=-1, keepdims=True)
    return jnp.take_along_axis(values, jnp.take_along_axis(order, rank, axis=-1), axis=-1)[..., 0]


def temper_exponent(
    log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"], target_ess: float | Num[Array, ""]
) -> Float[Array, ""]:
    """Largest exponent in (0, 1] at which `log_weights + exponent * log_likelihood` still has `target_ess` particles.

    1 where the whole likelihood leaves that many. By bisection of the exponent's logarithm, right to 2e-6 of
    itself; from even weights the effective sample size falls steadily with the exponent. Where not even `log_weights`
    alone reaches the target, the answer is 2**-40. The exponent is a constant to differentiation.
    """
    log_likelihood, log_weights = jax.lax.stop_gradient((log_likelihood, log_weights))

    def enough(exponent):
        return effective_sample_size(log_weights + exponent * log_likelihood) >= target_ess

    def halve(_, bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        keep = enough(jnp.exp2(middle))
        return jnp.where(keep, middle, low), jnp.where(keep, high, middle)

    lowest = jnp.full((), _TEMPER_LOWEST_LOG2, log_weights.dtype)
    low, _ = jax.lax.fori_loop(0, _TEMPER_STEPS, halve, (lowest, jnp.zeros_like(lowest)))
    return jnp.where(enough(jnp.ones_like(low)), 1.0, jnp.exp2(low)).astype(log_weights.dtype)
