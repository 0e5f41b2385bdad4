"""Mean, variance and mass of a standard normal variable that is cut, in both tails and in both precisions.

Written elementwise: any shape goes in, and comes out. Bounds may be infinite. Values and first derivatives are finite
everywhere; beyond the fourth root of the largest number a bound counts as that (4e9 in float32).
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
# 1e-7 from 1 on (float32), against 60 digits. Without its estimate of the rest 60 levels would be as good from 3 on.
_DEPTH = 28
# Where the tail begins. Before it the variance is 1 minus something, which multiplies the error of `erfc`, of some
# roundings, by 160 at 3 and by 16 at 1.
_TAIL_STARTS = {jnp.dtype("float64"): 3.0, jnp.dtype("float32"): 1.0}
# An interval that leaves more than this share of the tail beyond it is integrated numerically, for which 14 points
# are right to rounding; a wider one is a difference of two tails, which multiplies rounding by no more than 3.
_NARROW = 0.1
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(14) + np.array([[1.0], [0.0]])) / 2


class Moments(NamedTuple):
    """The standard normal variable given that it lies within bounds."""

    mean: Float[Array, "..."]
    variance: Float[Array, "..."]
    log_mass: Float[Array, "..."]
    """Log of the probability of lying there."""


class _Tail(NamedTuple):
    """The standard normal variable given that it exceeds a."""

    mean: Array
    excess: Array
    """mean - a"""
    variance: Array
    slope: Array
    """Derivative of the variance."""
    log_mass: Array


def one_sided(c: Float[Array, "..."] | float) -> Moments:
    """Moments of z ~ N(0, 1) given z <= c.

    The mean is `-phi(c) / Phi(c)` and the variance `1 + c mean - mean^2` (N. Shimada et al., "Shape and pose
    estimation of an articulated object", 1997, equations 26 and 27), in forms that do not cancel: relative errors
    stay below 1e-12 (float64) and 1e-5 (float32).
    """
    tail = _exceeding(-_bounded(c))
    return Moments(-tail.mean, tail.variance, tail.log_mass)


def interval(lower: Float[Array, "..."] | float, upper: Float[Array, "..."] | float) -> Moments:
    """Moments of z ~ N(0, 1) given lower <= z <= upper, where lower <= upper.

    Relative errors stay below 1e-12 (float64) and 1e-5 (float32). An interval without width is a point: no variance,
    and the smallest number as its mass.
    """
    a, b = jnp.broadcast_arrays(_bounded(lower), _bounded(upper))
    mirrored = a + b < 0
    near, far = jnp.where(mirrored, -b, a), jnp.where(mirrored, -a, b)
    both = _exceeding(jnp.stack([near, far]))
    beyond_near, beyond_far = (jax.tree.map(itemgetter(i), both) for i in (0, 1))
    left_over = jnp.exp(-0.5 * (far - near) * (near + far)) * beyond_near.mean / beyond_far.mean
    narrow = left_over > _NARROW
    wide = _difference(beyond_near, beyond_far, far - near, jnp.where(narrow, 0.0, left_over))
    thin = _integral(jnp.where(narrow, near, 0.0), jnp.where(narrow, far - near, 0.0))
    mean, variance, log_mass = jax.tree.map(partial(jnp.where, narrow), thin, wide)
    return Moments(jnp.where(mirrored, -mean, mean), variance, log_mass)


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
    # Far cheaper to compile, and to run, than the derivative of every level of the fraction.
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
    # rest solves f^2 + a f = n - f f', where f f' = 1/2 - a / (2 sqrt(a^2 + 4 n)) to first order.
    n = _DEPTH + 1
    f3 = 0.5 * (jnp.sqrt(a * a + (4 * n - 2) + 2 * a / jnp.sqrt(a * a + 4 * n)) - a)
    for n in range(_DEPTH, 2, -1):
        f3 = n / (a + f3)
    f2 = 2 / (a + f3)
    excess = 1 / (a + f2)
    mean = a + excess
    log_mass = -0.5 * a * a - jnp.log(mean) - 0.5 * math.log(2 * math.pi)
    return _Tail(mean, excess, excess * (f2 - excess), mean * excess * excess * f2 * (f2 - f3), log_mass)


def _difference(near: _Tail, far: _Tail, width, left_over) -> Moments:
    """What exceeds `near` is a mixture of what lies between and of the share `left_over` that exceeds `far`."""
    kept = 1 - left_over
    apart = width + far.excess - near.excess
    variance = (near.variance - left_over * far.variance) / kept - left_over * (apart / kept) ** 2
    return Moments(near.mean - left_over / kept * apart, variance, near.log_mass + jnp.log1p(-left_over))


def _integral(near, width) -> Moments:
    """Gauss-Legendre quadrature of the density relative to its value at `near`."""
    nodes, weights = (jnp.asarray(x, width.dtype) for x in (_NODES, _WEIGHTS))
    steps = width[..., None] * nodes
    density = weights * jnp.exp(-steps * (near[..., None] + 0.5 * steps))
    total = jnp.sum(density, axis=-1)
    centre = jnp.sum(density * nodes, axis=-1) / total
    spread = jnp.sum(density * (nodes - centre[..., None]) ** 2, axis=-1) / total
    has_width = width > 0
    log_width = jnp.log(jnp.where(has_width, width, jnp.finfo(width.dtype).tiny))
    log_mass = jnp.log(total) + log_width - 0.5 * near * near - 0.5 * math.log(2 * math.pi)
    return Moments(near + width * centre, width * width * spread, log_mass)
