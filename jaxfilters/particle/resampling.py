"""Resampling schemes, which draw ancestors in proportion to their weights.

Every scheme takes `(key, log_weights (n,))` and returns n sorted int32 indices in [0, n). The expected number of copies
of a particle is n times its normalised weight. Log weights need not be normalised; NaN counts as `-inf`, and if no
particle has any weight all are equally likely. Otherwise a particle without weight is never drawn. Every scheme raises
a `ValueError` where `log_weights` is not a vector, and a `TypeError` where it does not hold floating-point numbers. The
schemes are those of A. Doucet and A. Johansen, "A tutorial on particle filtering and smoothing: fifteen years later",
2009, section 3.4.

`optimal` differs: it reduces a larger number of weighted particles to n different ones with weights of their own.

No binary search is needed. The grid is regular, so that the number of grid points below a cumulative weight follows
from its integer and fractional part; the cumulative sum of a histogram of these numbers is the list of ancestors.

Example:
    >>> import jax, jax.numpy as jnp, jaxfilters as jf
    >>> jf.resampling.systematic(jax.random.key(0), jnp.log(jnp.array([0.0, 0.5, 0.5, 0.0]))).tolist()
    [1, 1, 2, 2]
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PRNGKeyArray

from jaxfilters import weights
from jaxfilters._xla import prefix
from jaxfilters.particle import checks

Key = PRNGKeyArray | Array


def systematic(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Draw ancestors by a grid of n points with a common offset: particle i is copied floor or ceil of n w_i times."""
    n = log_weights.size
    whole, fraction = prefix.positions(_relative(log_weights), n)
    offset = jax.random.uniform(key, (), log_weights.dtype)
    return _ancestors(whole + (fraction > offset), n)


def stratified(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Draw ancestors by one point in each of n equal intervals: the number of copies is within 2 of n w_i."""
    n = log_weights.size
    whole, fraction = prefix.positions(_relative(log_weights), n)
    offsets = jax.random.uniform(key, (n,), log_weights.dtype)
    return _ancestors(whole + (fraction > offsets[jnp.minimum(whole, n - 1)]), n)


def multinomial(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Draw n ancestors independently."""
    n = log_weights.size
    return _ancestors(_draws_below(key, _relative(log_weights), jnp.int32(n)), n)


def residual(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Copy each particle floor(n w_i) times and draw the other ancestors independently from the remaining weights."""
    n = log_weights.size
    relative = _relative(log_weights)
    expected = relative * (n / jnp.sum(relative))
    # An expected number of copies that is an integer may be rounded to just below it.
    copies = jnp.floor(expected * (1 + 4 * jnp.finfo(expected.dtype).eps))
    remainder = jnp.maximum(expected - copies, 0.0)
    remainder = jnp.where(jnp.sum(remainder) > 0, remainder, relative)
    certain = prefix.running_count(copies.astype(jnp.int32))
    return _ancestors(certain + _draws_below(key, remainder, n - certain[-1, -1]), n)


class Survivors(NamedTuple):
    """Particles that optimal resampling leaves."""

    indices: Int32[Array, " n"]
    """Sorted indices of different particles; places beyond the last survivor hold the last index of all."""
    log_weights: Float[Array, " n"]
    """Their log weights, with the sum of the old ones in expectation; `-inf` beyond the last survivor."""


def optimal(key: Key, log_weights: Float[Array, " m"], num_survivors: int) -> Survivors:
    r"""Reduce m weighted particles to at most n different ones, with the least error of the weights.

    With the c for which $\sum_i \min(1, c w_i) = n$, particles of $c w_i \ge 1$ are kept with their weights; of the
    others one survives with the probability $c w_i$ and the weight 1/c. The expected new weight of each is its old one,
    and no unbiased scheme has a smaller expected squared error (P. Fearnhead and P. Clifford, "On-line inference for
    hidden Markov models via particle filters", Journal of the Royal Statistical Society B 65(4), 2003). Where at most
    n particles have any weight, all are kept as they are. It suits particles that take few discrete values, where a
    copy of a particle adds nothing. c is found by Newton's method, some steps of one pass over the weights each.

    The new weights keep the derivatives of the old ones.

    Args:
        key: Random key.
        log_weights: Log weights (m,), not necessarily normalised; NaN counts as `-inf`. If no particle has any weight,
            none survives with any.
        num_survivors: Number n of places, from 1 to m.

    Returns:
        The survivors, in n places.

    Raises:
        ValueError: If `num_survivors` is not an integer from 1 to m, or `log_weights` no vector.
        TypeError: If `log_weights` holds no floating-point numbers.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> log_weights = jnp.log(jnp.array([0.6, 0.1, 0.0, 0.1, 0.1, 0.1]))
        >>> kept = jf.resampling.optimal(jax.random.key(0), log_weights, 3)
        >>> [round(float(w), 3) for w in jnp.exp(kept.log_weights)]
        [0.6, 0.2, 0.2]
    """
    checks.check_log_weights(log_weights)
    checks.check_num_particles(num_survivors, name="num_survivors")
    count = log_weights.size
    if num_survivors > count:
        raise ValueError(f"num_survivors must be at most the number of log_weights, {count}; got {num_survivors}.")
    relative = _relative(log_weights)
    kept, places, small_sum = _kept(relative, num_survivors)
    small = jnp.where(kept, 0.0, relative)
    whole, fraction = prefix.positions(small, places)
    drawn_below = jnp.minimum(
        whole + (fraction > jax.random.uniform(key, (), relative.dtype)), places.astype(jnp.int32)
    )
    ends = prefix.running_count(kept.astype(jnp.int32)) + drawn_below
    indices = jnp.minimum(_ancestors(ends, num_survivors), count - 1)
    survives = (jnp.arange(num_survivors) < ends[-1, -1]) & (log_weights[indices] > -jnp.inf)
    chance = jnp.where(kept, 1.0, small * (places / jnp.where(small_sum > 0, small_sum, 1.0))).reshape(-1)[indices]
    survives = survives & (chance > 0)
    log_chance = jnp.log(jnp.where(survives, chance, 1.0))
    return Survivors(indices, jnp.where(survives, log_weights[indices] - log_chance, -jnp.inf))


def _kept(
    relative: Float[Array, "rows 32"], num: int
) -> tuple[Bool[Array, "rows 32"], Float[Array, ""], Float[Array, ""]]:
    """Which particles are kept for certain, the number of places for the others, and the sum of the others."""
    positive = relative > 0
    few = jnp.sum(positive) <= num

    def unsolved(carry: tuple) -> Array:
        _, places, small_sum, more = carry
        return more & (places > 0) & (small_sum > 0)

    def newton(carry: tuple) -> tuple:
        # The sum of min(1, c w) is concave in c: from below, no step leads beyond the solution. It is reached when no
        # particle is added to those that are kept.
        _, places, small_sum, _ = carry
        c = places / small_sum
        kept = relative * c >= 1
        rest = num - jnp.sum(kept, dtype=relative.dtype)
        return c, rest, jnp.sum(jnp.where(kept, 0.0, relative)), rest < places

    start = jnp.where(few, jnp.inf, 0.0), jnp.where(few, 0.0, num), jnp.where(few, 0.0, jnp.sum(relative))
    start = tuple(value.astype(relative.dtype) for value in start)
    c, places, small_sum, _ = jax.lax.while_loop(unsolved, newton, (*start, ~few))
    return positive & (relative * c >= 1), jnp.where(small_sum > 0, places, 0.0), small_sum


def _relative(log_weights: Array) -> Array:
    """Weights relative to the largest one, in rows, padded with zeros."""
    checks.check_log_weights(log_weights)
    frozen = jax.lax.stop_gradient(log_weights)
    padded = jnp.pad(frozen, (0, -frozen.size % prefix.ROW), constant_values=-jnp.inf)
    exists = jnp.arange(padded.size) < frozen.size
    return prefix.in_rows(jnp.where(exists, weights.relative(padded), 0.0))


def _ancestors(ends: Int32[Array, "rows 32"], n: int) -> Int32[Array, " n"]:
    """Ancestor of each of n places, of which particle i fills those from `ends[i - 1]` to `ends[i]`."""
    ended = jnp.zeros(ends.size, jnp.int32).at[ends.reshape(-1)].add(1, mode="drop", indices_are_sorted=True)
    return prefix.running_count(prefix.in_rows(ended)).reshape(-1)[:n]


def _draws_below(key: Key, weights: Float[Array, "rows 32"], draws: Int32[Array, ""]) -> Int32[Array, "rows 32"]:
    """Number of `draws` independent points, uniform on [0, sum of the weights), below each cumulative weight.

    The points are generated in order, as the cumulative sums of exponential gaps, one more than there are points
    (L. Devroye, "Non-Uniform Random Variate Generation", 1986, section V.3.1).
    """
    n = weights.size
    total = draws.astype(weights.dtype)
    gaps = jax.random.exponential(key, (n + prefix.ROW,), weights.dtype)
    gaps = prefix.in_rows(jnp.where(jnp.arange(gaps.size) <= draws, gaps, 0.0))
    point_whole, point_fraction = (axis.reshape(-1) for axis in prefix.positions(gaps, total))
    whole, fraction = prefix.positions(weights, total)

    # The points are counted by unit intervals; those of the interval that holds a cumulative weight, one by one.
    occupied = jnp.zeros(gaps.size, jnp.int32).at[point_whole].add(1, indices_are_sorted=True)
    occupied = prefix.in_rows(occupied)
    before = (prefix.running_count(occupied) - occupied).reshape(-1)

    def count_one_more(carry):
        below, _ = carry
        more = ~at_end & (point_whole[below] == whole) & (point_fraction[below] < fraction)
        return below + more, jnp.any(more)

    at_end = whole >= draws
    start = before[whole]
    below, _ = jax.lax.while_loop(lambda carry: carry[1], count_one_more, (start, jnp.any(start >= 0)))
    return jnp.where(at_end, draws, below)
