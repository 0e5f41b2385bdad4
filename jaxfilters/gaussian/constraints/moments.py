"""Mean, variance and mass of a truncated normal variable, accurate in both tails and in both precisions.

All functions work elementwise on arrays of any shape. Bounds may be infinite. Values and first derivatives are finite
everywhere; a bound beyond the fourth root of the largest floating-point number (4e9 in float32) is replaced by that
number. `docs/derivations/narrow_constraints.md` derives the forms that do not cancel.
"""

import math
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, Float

# Depth at which the continued fraction of the tail has a relative error below 1e-13 from 3 on (float64) and below
# 1e-7 from 1 on (float32), compared with 60 digits. Without the estimate of the remainder, 60 levels would be needed.
_DEPTH = 28
# Where the tail begins. Below it the variance is computed as 1 minus a product, which multiplies the rounding error of
# `erfc` by 160 at 3 and by 16 at 1.
_TAIL_STARTS = {jnp.dtype("float64"): 3.0, jnp.dtype("float32"): 1.0}
# An interval beyond which more than this share of the tail remains is integrated numerically: 14 points are exact to
# rounding. A wider one is a difference of two tails, which multiplies rounding errors by no more than 3.
_NARROW = 0.1
_LOG_ROOT_2PI = 0.5 * math.log(2 * math.pi)
# Gauss-Legendre quadrature on [-1/2, 1/2].
_NODES, _WEIGHTS = np.array(np.polynomial.legendre.leggauss(14)) / 2


class Moments(NamedTuple):
    """Moments of a variable given that it lies within bounds; all fields have the shape of the bounds."""

    mean: Float[Array, "..."]
    """Conditional mean."""
    variance: Float[Array, "..."]
    """Conditional variance."""
    log_mass: Float[Array, "..."]
    """Log of the integral of the density over the interval."""


class _Tail(NamedTuple):
    """A standard normal variable given that it exceeds a."""

    mean: Array
    excess: Array
    """mean - a"""
    variance: Array
    slope: Array
    """Derivative of the variance with respect to a."""
    log_mass: Array


class _Interval(NamedTuple):
    """An interval of a normal variable, mirrored where necessary so that its near end has the higher density."""

    mirrored: Array
    near: Array
    """The near end in standard deviations from the mean of the untruncated variable."""
    start: Array
    """The near end in the units of the argument."""
    slope: Array
    """Negative derivative of the log density at 0, mirrored with the interval."""
    scale: Array
    """Square root of the curvature."""
    tail: _Tail
    """The tail that begins at the near end."""
    remainder: Array
    """Share of that tail beyond the far end; 0 where the interval is narrow."""
    narrow: Array
    """Whether the interval is integrated by quadrature."""
    wide: tuple[Array, Array, Array]
    """Mean, distance of the mean from the near end, and variance by the difference of two tails; standard units."""
    thin: Moments
    """Moments by quadrature."""


def one_sided(c: Float[Array, "..."] | float) -> Moments:
    """Moments of a standard normal variable z given z <= c.

    The mean is `-phi(c) / Phi(c)` and the variance is `1 + c mean - mean^2` (N. Shimada et al., "Shape and pose
    estimation of an articulated object", 1997, equations 26 and 27), in forms that do not cancel: relative errors
    stay below 1e-12 (float64) and 1e-5 (float32).

    Args:
        c: Upper bound, of any shape.

    Returns:
        Mean, variance and log probability, each with the shape of `c`.
    """
    tail = _exceeding(-_bounded(c))
    return Moments(-tail.mean, tail.variance, tail.log_mass)


def interval(lower: Float[Array, "..."] | float, upper: Float[Array, "..."] | float) -> Moments:
    """Moments of a standard normal variable z given lower <= z <= upper.

    Relative errors stay below 1e-12 (float64) and 1e-5 (float32). An interval of zero width is a point: its variance
    is zero, and its mass is the smallest positive floating-point number times the density.

    Args:
        lower: Lower bound, at most `upper`; broadcast against it.
        upper: Upper bound.

    Returns:
        Mean, variance and log probability, each with the broadcast shape.
    """
    a, b = jnp.broadcast_arrays(_bounded(lower), _bounded(upper))
    cut = _truncated(jnp.zeros_like(a), jnp.ones_like(a), a, b)
    mean, variance = _moments(cut)
    log_mass = cut.tail.log_mass + jnp.log1p(-cut.remainder)
    return Moments(mean, variance, jnp.where(cut.narrow, cut.thin.log_mass - _LOG_ROOT_2PI, log_mass))


def exponential_quadratic(
    slope: Float[Array, "..."],
    curvature: Float[Array, "..."],
    lower: Float[Array, "..."],
    upper: Float[Array, "..."],
) -> Moments:
    """Moments of the density proportional to `exp(-slope z - curvature z^2 / 2)` within lower <= z <= upper.

    A truncated normal distribution in a form that stays accurate where the curvature is close to zero or known to
    rounding only: on a narrow interval the density is nearly constant, and between a bound and infinity it is nearly
    exponential (`docs/derivations/narrow_constraints.md`, section 2).

    Args:
        slope: Negative derivative of the log density at 0.
        curvature: Positive; all arguments have the same shape.
        lower: Lower bound, at most `upper`.
        upper: Upper bound.

    Returns:
        Mean, variance, and the log of the integral of the unnormalised density over the interval.
    """
    cut = _truncated(slope, curvature, lower, upper)
    mean, variance = _moments(cut)
    # The log density at the near end, or at the mean of the untruncated variable where that lies within the interval.
    at_start = -jnp.log(cut.tail.mean) - cut.start * (cut.slope + 0.5 * curvature * cut.start)
    at_mean = cut.tail.log_mass + 0.5 * (cut.slope / cut.scale) ** 2 + _LOG_ROOT_2PI
    wide = jnp.where(cut.near > 0, at_start, at_mean) + jnp.log1p(-cut.remainder) - jnp.log(cut.scale)
    return Moments(mean, variance, jnp.where(cut.narrow, cut.thin.log_mass, wide))


def _truncated(slope, curvature, lower, upper) -> _Interval:
    scale = jnp.sqrt(curvature)
    a, b = (_bounded(scale * bound + slope / scale) for bound in (lower, upper))
    mirrored = a + b < 0
    near, far = jnp.where(mirrored, -b, a), jnp.where(mirrored, -a, b)
    start, slope = jnp.where(mirrored, -upper, lower), jnp.where(mirrored, -slope, slope)
    width = upper - lower
    both = _exceeding(jnp.stack([near, far]))
    at_near, at_far = (jax.tree.map(itemgetter(i), both) for i in (0, 1))
    centre = start + 0.5 * width
    fall = width * (slope + curvature * centre)
    remainder = jnp.exp(-jnp.maximum(fall, 0.0)) * at_near.mean / at_far.mean
    narrow = remainder > _NARROW
    remainder = jnp.where(narrow, 0.0, remainder)
    thin = _quadrature(*(jnp.where(narrow, x, 0.0) for x in (centre, slope, curvature, width)))
    wide = _difference(at_near, at_far, jnp.where(narrow, 0.0, scale * width), remainder)
    return _Interval(mirrored, near, start, slope, scale, at_near, remainder, narrow, wide, thin)


def _moments(cut: _Interval):
    mean, excess, variance = cut.wide
    # Beyond the mean of the untruncated variable the distance from the near end is small, and the mean large.
    outside = cut.start + excess / cut.scale
    mean = jnp.where(cut.near > 0, outside, (mean - cut.slope / cut.scale) / cut.scale)
    mean = jnp.where(cut.narrow, cut.thin.mean, mean)
    variance = jnp.where(cut.narrow, cut.thin.variance, variance / cut.scale**2)
    return jnp.where(cut.mirrored, -mean, mean), variance


def _bounded(x):
    x = jnp.asarray(x, dtype=None if hasattr(x, "dtype") else float)
    limit = float(jnp.finfo(x.dtype).max) ** 0.25
    return jnp.clip(x, -limit, limit)


@jax.custom_jvp
def _exceeding(a) -> _Tail:
    starts = _TAIL_STARTS[a.dtype]
    body, tail = _from_error_function(jnp.minimum(a, starts)), _from_continued_fraction(jnp.maximum(a, starts))
    return jax.tree.map(partial(jnp.where, a > starts), tail, body)


@_exceeding.defjvp
def _exceeding_jvp(primals, tangents):
    # This is far cheaper to compile and to run than the derivative of every level of the continued fraction.
    (da,) = tangents
    tail = _exceeding(*primals)
    mean, excess, variance, slope, _ = tail
    change_of_slope = mean * (excess * (variance - excess**2) + slope + 2 * excess * variance)
    return tail, _Tail(mean * excess * da, -variance * da, slope * da, change_of_slope * da, -mean * da)


def _from_error_function(a) -> _Tail:
    below = a < 0
    smaller = 0.5 * erfc(abs(a) * math.sqrt(0.5))
    mass = jnp.where(below, 1 - smaller, smaller)
    mean = jnp.exp(-0.5 * a * a) / (math.sqrt(2 * math.pi) * mass)
    excess = mean - a
    variance = 1 - mean * excess
    log_mass = jnp.where(below, jnp.log1p(-smaller), jnp.log(smaller))
    return _Tail(mean, excess, variance, mean * (variance - excess**2), log_mass)


def _from_continued_fraction(a) -> _Tail:
    # mean = a + 1 / (a + 2 / (a + 3 / (a + ...))). With f(n) = n / (a + f(n + 1)) and f(n + 1) = f(n) + f'(n) the
    # remainder solves f^2 + a f = n - f f', where f f' = 1/2 - a / (2 sqrt(a^2 + 4 n)) to first order.
    n = _DEPTH + 1
    f3 = 0.5 * (jnp.sqrt(a * a + (4 * n - 2) + 2 * a / jnp.sqrt(a * a + 4 * n)) - a)
    for n in range(_DEPTH, 2, -1):
        f3 = n / (a + f3)
    f2 = 2 / (a + f3)
    excess = 1 / (a + f2)
    mean = a + excess
    log_mass = -0.5 * a * a - jnp.log(mean) - _LOG_ROOT_2PI
    return _Tail(mean, excess, excess * (f2 - excess), mean * excess * excess * f2 * (f2 - f3), log_mass)


def _difference(near: _Tail, far: _Tail, width, remainder):
    """The tail beyond `near` is a mixture of the interval and of the share `remainder` that lies beyond `far`."""
    kept = 1 - remainder
    apart = width + far.excess - near.excess
    variance = (near.variance - remainder * far.variance) / kept - remainder * (apart / kept) ** 2
    shift = remainder / kept * apart
    return near.mean - shift, near.excess - shift, variance


def _quadrature(centre, slope, curvature, width) -> Moments:
    """Quadrature of the density relative to its value at the centre, of which only the difference from 1 is summed."""
    nodes, weights = (jnp.asarray(x, width.dtype) for x in (_NODES, _WEIGHTS))
    fall, bend = width * (slope + curvature * centre), 0.5 * curvature * width**2
    change = jnp.expm1(-nodes * (fall[..., None] + bend[..., None] * nodes))
    total = 1 + jnp.sum(weights * change, axis=-1)
    # The weighted sum of the nodes is zero, so that a small shift of the mean keeps its relative accuracy.
    shift = jnp.sum(weights * nodes * change, axis=-1) / total
    spread = jnp.sum(weights * (1 + change) * (nodes - shift[..., None]) ** 2, axis=-1) / total
    log_width = jnp.log(jnp.where(width > 0, width, jnp.finfo(width.dtype).tiny))
    log_mass = jnp.log(total) + log_width - centre * (slope + 0.5 * curvature * centre)
    return Moments(centre + width * shift, width * width * spread, log_mass)
