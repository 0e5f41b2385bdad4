"""Cumulative sums without rounding error, for the positions of particles among the grid points of resampling.

A float32 cumulative sum of 10^6 weights has errors of several hundredths of the distance between two grid points, and
depends on the order of summation. Here every weight is rounded once to an integer of two digits, `high` and `low`,
which are small enough that all their sums, in any order, are integers that the float type represents exactly. Sums
within rows are products with a triangular matrix, which are fast on every device and, unlike a scan, vectorised.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

ROW = 32
"""Number of columns of the arrays of weights."""

Digits = tuple[Array, ...]


def positions(
    weights: Float[Array, "rows 32"], total: int | Float[Array, ""], most: int | None = None
) -> tuple[Int[Array, "rows 32"], Float[Array, "rows 32"]]:
    """The cumulative sum of weights, row by row, scaled to end at `total`, as integers and fractions in [0, 1].

    It never decreases; a weight of zero, or below 2e-12 of the sum in float32, adds exactly 0. The integer part is
    `total` from the last positive weight on, whatever the fraction, and at most `total` before.

    Args:
        weights: (rows, 32), not negative.
        total: An integer from 0 to `most`.
        most: By default `total` where that is a Python number.

    Raises:
        ValueError: If there are more than 2**23 weights or draws in float32 (2**52 in float64): sums are not exact.
    """
    mantissa = jnp.finfo(weights.dtype).nmant
    largest = max(weights.size, int(total) if most is None else most)
    high_bits = mantissa - (largest - 1).bit_length()
    low_bits = mantissa + 1 - ROW.bit_length()
    if high_bits < 0:
        raise ValueError(
            f"log_weights: at most 2**{mantissa} particles can be resampled in {weights.dtype.name}; "
            f"got {largest}. Use a wider float type."
        )
    unit, low_unit = 2.0**high_bits, 2.0**low_bits
    digits = _digits(weights, total * unit, low_unit)
    high, low = _carry(_running_sums(digits, lambda digits: _carry(digits, low_unit)), low_unit)

    # The sum that scaled the weights was rounded; the exact sum corrects the scale.
    last_high, last_low = high[-1, -1], low[-1, -1]
    excess = (last_high - total * unit) * low_unit + last_low
    rate = excess / jnp.maximum(last_high * low_unit + last_low, 1.0)
    at_end = (high == last_high) & (low == last_low)
    low = low - jnp.floor((high * low_unit + low) * rate + 0.5)

    high, low = _carry((high, low), low_unit)
    whole = jnp.floor(high / unit)
    fraction = (high - whole * unit) / unit + low / (unit * low_unit)
    return jnp.where(at_end, total, jnp.minimum(whole, total)).astype(jnp.int32), fraction


def in_rows(values: Num[Array, " n"]) -> Num[Array, "rows 32"]:
    """The values in rows of 32, padded with zeros."""
    return jnp.pad(values, (0, -values.size % ROW)).reshape(-1, ROW)


def running_count(counts: Num[Array, "rows 32"]) -> Int[Array, "rows 32"]:
    """The cumulative sum, row by row, of nonnegative integers, of any type, whose sum is at most 2**24."""
    (running,) = _running_sums((counts.astype(jnp.float32),), lambda digits: digits)
    return running.astype(jnp.int32)


def _digits(weights: Array, total: float | Array, low_unit: float) -> Digits:
    weight_sum = jnp.sum(jnp.sum(weights, axis=1))
    scaled = weights * (total / jnp.where(weight_sum > 0, weight_sum, 1.0))
    high = jnp.floor(scaled)
    return high, jnp.floor((scaled - high) * low_unit + 0.5)


def _carry(digits: Digits, low_unit: float) -> Digits:
    high, low = digits
    carried = jnp.floor(low / low_unit)
    return high + carried, low - carried * low_unit


def _running_sums(digits: Digits, carry: Callable[[Digits], Digits]) -> Digits:
    """Cumulative sums of (rows, 32) arrays, row by row; `carry` bounds the low digits of the sums of rows."""
    triangle = np.triu(np.ones((ROW, ROW), digits[0].dtype))
    # Full precision, because accelerators round the factors to ten bits of mantissa by default.
    inside = [jnp.matmul(digit, triangle, precision="highest") for digit in digits]
    count = len(digits[0])
    if count == 1:
        return tuple(inside)
    totals = carry(tuple(sums[:, -1] for sums in inside))
    through = carry(_running_sums(tuple(in_rows(total) for total in totals), carry))
    starts = [sums.reshape(-1)[:count] - total for sums, total in zip(through, totals, strict=True)]
    # The result keeps two axes, because the CPU compiler does not vectorise the addition over a flat axis.
    return tuple(sums + start[:, None] for sums, start in zip(inside, starts, strict=True))
