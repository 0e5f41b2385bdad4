"""Ancestors drawn in proportion to their weights: systematic, stratified, multinomial, residual.

Every scheme takes `(key, log_weights (n,))` and returns n sorted int32 indices in [0, n). Expected counts are n times
the normalised weights. Log weights need not be normalised; NaN counts as `-inf`, and if nothing has any weight all
are drawn evenly. A particle without weight is never drawn.

Nothing is searched. The grid is regular, so the number of grid points below a running total is arithmetic on its
whole number and fraction; a histogram of these numbers, summed, is the list of ancestors (A. Doucet, A. Johansen,
"A tutorial on particle filtering and smoothing", 2009, section 3.4, for the schemes). The histogram is of integers.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32, PRNGKeyArray

from jaxfilters import weights
from jaxfilters._xla import prefix

Key = PRNGKeyArray | Array


def systematic(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Ancestors by one uniform number on a grid of n: particle i comes floor(n w_i) or ceil(n w_i) times."""
    n = log_weights.size
    whole, fraction = prefix.positions(_relative(log_weights), n)
    offset = jax.random.uniform(key, (), log_weights.dtype)
    return _ancestors(whole + (fraction > offset), n)


def stratified(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Ancestors by one uniform number in each of n equal parts: counts within 2 of n w_i."""
    n = log_weights.size
    whole, fraction = prefix.positions(_relative(log_weights), n)
    offsets = jax.random.uniform(key, (n,), log_weights.dtype)
    return _ancestors(whole + (fraction > offsets[jnp.minimum(whole, n - 1)]), n)


def multinomial(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Ancestors by n independent draws."""
    n = log_weights.size
    return _ancestors(_draws_below(key, _relative(log_weights), jnp.int32(n)), n)


def residual(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Ancestors by floor(n w_i) certain copies of each particle and independent draws from what remains."""
    n = log_weights.size
    relative = _relative(log_weights)
    expected = relative * (n / jnp.sum(relative))
    # An expected count that is whole must be met exactly, though it may come out rounded to just below.
    copies = jnp.floor(expected * (1 + 4 * jnp.finfo(expected.dtype).eps))
    remainder = jnp.maximum(expected - copies, 0.0)
    remainder = jnp.where(jnp.sum(remainder) > 0, remainder, relative)
    certain = prefix.running_count(copies.astype(jnp.int32))
    return _ancestors(certain + _draws_below(key, remainder, n - certain[-1, -1]), n)


def _relative(log_weights: Array) -> Array:
    """Weights in rows, after the last one zeros."""
    frozen = jax.lax.stop_gradient(log_weights)
    padded = jnp.pad(frozen, (0, -frozen.size % prefix.ROW), constant_values=-jnp.inf)
    alive = jnp.arange(padded.size) < frozen.size
    return prefix.in_rows(jnp.where(alive, weights.relative(padded), 0.0))


def _ancestors(ends: Int32[Array, "rows 32"], n: int) -> Int32[Array, " n"]:
    """Ancestor of each slot, when particle i fills the slots from `ends[i - 1]` to `ends[i]`: how many have ended."""
    ended = jnp.zeros(ends.size, jnp.int32).at[ends.reshape(-1)].add(1, mode="drop", indices_are_sorted=True)
    return prefix.running_count(prefix.in_rows(ended)).reshape(-1)[:n]


def _draws_below(key: Key, weights: Float[Array, "rows 32"], draws: Int32[Array, ""]) -> Int32[Array, "rows 32"]:
    """How many of `draws` independent points, uniform on the sum of the weights, lie below each running total.

    The points come sorted: they are running totals of exponential gaps, one more than there are points
    (L. Devroye, "Non-uniform random variate generation", 1986, section V.3.1).
    """
    n = weights.size
    total = draws.astype(weights.dtype)
    gaps = jax.random.exponential(key, (n + prefix.ROW,), weights.dtype)
    gaps = prefix.in_rows(jnp.where(jnp.arange(gaps.size) <= draws, gaps, 0.0))
    point_whole, point_fraction = (axis.reshape(-1) for axis in prefix.positions(gaps, total))
    whole, fraction = prefix.positions(weights, total)

    # Points per unit interval; of the interval in which a running total falls, the few points are counted singly.
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
