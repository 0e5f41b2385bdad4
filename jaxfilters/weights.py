"""Log weights of an ensemble: normalisation, effective sample size, moments, quantiles, tempering.

The ensemble axis is the last one of every leaf. Everywhere in this module a log weight of NaN counts as `-inf` (the log
sum of `normalize` is NaN then, so that a log evidence shows it), `+inf` as the largest finite number, and an ensemble
in which no particle has any weight counts as evenly weighted.
Particles without weight contribute nothing, whatever their values are, NaN included. Every function raises a
`ValueError` where `log_weights` is not a vector, and a `TypeError` where it does not hold floating-point numbers.

Examples:
    >>> import jax.numpy as jnp, jaxfilters as jf
    >>> log_weights = jnp.log(jnp.array([1.0, 3.0]))
    >>> round(float(jf.weights.mean(jnp.array([0.0, 10.0]), log_weights)), 3)
    7.5
    >>> round(float(jf.weights.effective_sample_size(log_weights)), 3)
    1.6
"""

import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, Num, PyTree, Shaped

_TEMPER_STEPS = 24
_TEMPER_LOWEST_LOG2 = -40.0


def uniform(num: int, dtype: DTypeLike = float) -> Float[Array, " n"]:
    """Return equal log weights `(num,)` that sum to one.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> [round(w, 3) for w in jnp.exp(jf.weights.uniform(4)).tolist()]
        [0.25, 0.25, 0.25, 0.25]
    """
    return jnp.full(num, -math.log(num), dtype=dtype)


def normalize(log_weights: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return log weights that sum to one, and the logarithm of the sum of the given ones.

    Where all are `-inf` the weights become equal and the log sum is `-inf`. Where one is NaN it gets no weight and the
    log sum is NaN.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> log_weights, log_sum = jf.weights.normalize(jnp.log(jnp.array([1.0, 3.0])))
        >>> [round(w, 3) for w in jnp.exp(log_weights).tolist()], round(float(jnp.exp(log_sum)), 3)
        ([0.25, 0.75], 4.0)
    """
    shifted, peak, any_nan = _below_peak(log_weights)
    log_sum = jnp.log(jnp.sum(jnp.exp(shifted)))
    return shifted - log_sum, jnp.where(any_nan, jnp.nan, peak + log_sum)


def relative(log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return weights `(n,)` scaled so that the largest is one.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> [round(w, 3) for w in jf.weights.relative(jnp.log(jnp.array([1.0, 2.0, 4.0]))).tolist()]
        [0.25, 0.5, 1.0]
    """
    return jnp.exp(_below_peak(log_weights)[0])


def linear(log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return weights `(n,)` that sum to one.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> [round(w, 3) for w in jf.weights.linear(jnp.log(jnp.array([1.0, 3.0]))).tolist()]
        [0.25, 0.75]
    """
    weights = relative(log_weights)
    return weights / jnp.sum(weights)


def _below_peak(log_weights):
    _check(log_weights)
    # NaN shows in the largest of all, which is all that is needed where there is none.
    frozen = jax.lax.stop_gradient(log_weights)
    largest = jnp.max(frozen)
    any_nan = jnp.isnan(largest)
    peak = jax.lax.cond(any_nan, lambda: jnp.max(jnp.where(jnp.isnan(frozen), -jnp.inf, frozen)), lambda: largest)
    limit = jnp.finfo(log_weights.dtype).max
    peak = jnp.minimum(peak, limit)
    finite = jnp.where(jnp.isnan(log_weights), -jnp.inf, jnp.minimum(log_weights, limit))
    no_weight = peak == -jnp.inf
    return jnp.where(no_weight, 0.0, finite - jnp.where(no_weight, 0.0, peak)), peak, any_nan


def _check(log_weights):
    if jnp.ndim(log_weights) != 1:
        raise ValueError(f"log_weights must have the shape (n,); got {jnp.shape(log_weights)}.")
    if not jnp.issubdtype(log_weights.dtype, jnp.floating):
        raise TypeError(f"log_weights must hold floating-point numbers; got {log_weights.dtype}.")


def effective_sample_size(log_weights: Float[Array, " n"]) -> Float[Array, ""]:
    """Return `1 / sum(w**2)` of the normalised weights: 1 if one particle has all weight, n if all are equal.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> round(float(jf.weights.effective_sample_size(jnp.log(jnp.array([2.0, 2.0, 2.0, 0.0])))), 3)
        3.0
    """
    return 1 / jnp.sum(jnp.square(linear(log_weights)))


def mean(particles: PyTree[Shaped[Array, "..."]], log_weights: Float[Array, " n"]) -> PyTree[Float[Array, "..."]]:
    """Return the weighted mean of every leaf `(..., n)` over its last axis; of a boolean leaf, the probability.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> particles = {"x": jnp.array([0.0, 10.0]), "moves": jnp.array([True, False])}
        >>> mean = jf.weights.mean(particles, jnp.log(jnp.array([1.0, 3.0])))
        >>> round(float(mean["x"]), 3), round(float(mean["moves"]), 3)
        (7.5, 0.25)
    """
    w = linear(log_weights)
    return jax.tree.map(lambda leaf: jnp.sum(jnp.where(w > 0, leaf, 0) * w, axis=-1), particles)


def mean_around_mode(
    x: Float[Array, "d n"],
    log_weights: Float[Array, " n"],
    scale: Float[Array, " d"],
    *,
    distance: ArrayLike = 2.0,
) -> Float[Array, " d"]:
    """Return the weighted mean `(d,)` of the particles near the one with the largest weight.

    For a posterior with several modes this is the position of the highest one. A particle is near if its Euclidean
    distance is below `distance` once every coordinate is divided by its `scale`, which is positive and in the unit of
    the coordinate (K. Oka, Y. Sato et al. 2006, equations 18-19; in English: K. Oka, Y. Sato, Y. Nakanishi and
    H. Koike, "Head pose estimation system based on particle filtering with adaptive diffusion control", IAPR Conference
    on Machine Vision Applications, 2005). Of equal weights the first is taken; which particles are near is a constant
    to differentiation.

    Examples:
        Of two clusters, the one about 8 has the particle of the highest weight.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> x, log_weights = jnp.array([[0.0, 1.0, 8.0, 9.0]]), jnp.log(jnp.array([2.0, 2.0, 3.0, 1.0]))
        >>> [round(v, 3) for v in jf.weights.mean_around_mode(x, log_weights, jnp.ones(1)).tolist()]
        [8.25]
    """
    map_particle = jnp.argmax(linear(log_weights))
    apart = jax.lax.stop_gradient((x - x[:, map_particle, None]) / scale[:, None])
    near = jnp.sum(jnp.square(apart), axis=0) < distance**2
    near = near | (jnp.arange(log_weights.shape[0]) == map_particle)
    return mean(x, jnp.where(near, _below_peak(log_weights)[0], -jnp.inf))


def covariance(x: Float[Array, "d n"], log_weights: Float[Array, " n"]) -> Float[Array, "d d"]:
    """Return the weighted covariance `sum_i w_i (x_i - mean)(x_i - mean)^T`, without a small-sample correction.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> P = jf.weights.covariance(jnp.array([[-1.0, 1.0], [-2.0, 2.0]]), jf.weights.uniform(2))
        >>> [[round(v, 3) for v in row] for row in P.tolist()]
        [[1.0, 2.0], [2.0, 4.0]]
    """
    w = linear(log_weights)
    centred = jnp.where(w > 0, x - mean(x, log_weights)[:, None], 0.0)
    return jnp.matmul(centred * w, centred.T, precision="highest")


def quantile(
    x: Num[Array, "*batch n"], log_weights: Float[Array, " n"], probability: float | Num[Array, ""]
) -> Float[Array, "*batch"]:
    """Return the smallest value with at least `probability` of the weight at or below it, along the last axis.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> x, log_weights = jnp.array([30.0, 10.0, 20.0]), jnp.log(jnp.array([1.0, 1.0, 2.0]))
        >>> float(jf.weights.quantile(x, log_weights, 0.5))
        20.0
    """
    w = linear(log_weights)
    values = jnp.where(w > 0, x, jnp.inf)
    order = jnp.argsort(values, axis=-1)
    below = jnp.cumsum(w[order], axis=-1)
    rank = jnp.sum(below < probability * below[..., -1:], axis=-1, keepdims=True)
    return jnp.take_along_axis(values, jnp.take_along_axis(order, rank, axis=-1), axis=-1)[..., 0]


def temper_exponent(
    log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"], target_ess: float | Num[Array, ""]
) -> Float[Array, ""]:
    """Return the largest exponent in (0, 1] for which `log_weights + exponent * log_likelihood` reaches `target_ess`.

    The effective sample size of that sum must be at least `target_ess`; the exponent is 1 where the whole likelihood
    fulfils this. It is found by bisection of its logarithm, to a relative error of 2e-6; from equal weights the
    effective sample size decreases monotonically in it. Where `log_weights` alone do not reach the target, the result
    is 2**-40. The exponent is a constant to differentiation.

    Examples:
        The square root of a ratio of 1 : 9 is 1 : 3, which has an effective sample size of 1.6.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> log_likelihood = jnp.log(jnp.array([1.0, 9.0]))
        >>> round(float(jf.weights.temper_exponent(log_likelihood, jf.weights.uniform(2), 1.6)), 3)
        0.5
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
