"""Resampling schemes, which draw ancestors in proportion to their weights.

Every scheme takes `(key, log_weights (n,))` and returns n int32 indices in [0, n). The expected number of copies of a
particle is n times its normalised weight, but for `metropolis`, which approximates it. Log weights need not be
normalised; if no particle has any weight all are equally likely. Otherwise a particle without weight is never drawn
(`metropolis` has exceptions). Every scheme raises a `ValueError` where `log_weights` is not a vector or holds NaN, and
a `TypeError` where it does not hold floating-point numbers. Under `jit` and `vmap`, where values are not known, NaN
counts as `-inf`: indices cannot be NaN, and filters report it in their infos.

`systematic`, `stratified`, `multinomial` and `residual` are those of A. Doucet and A. Johansen, "A tutorial on particle
filtering and smoothing: fifteen years later", 2009, section 3.4; they and `ssp` return sorted indices, and draw another
number than n of them where `num_samples` says so: on average `num_samples` times the normalised weight.

`optimal` differs: it reduces a larger number of weighted particles to n different ones with weights of their own.

No binary search is needed. The grid is regular, so that the number of grid points below a cumulative weight follows
from its integer and fractional part; the cumulative sum of a histogram of these numbers is the list of ancestors.

Examples:
    >>> import jax, jax.numpy as jnp, jaxfilters as jf
    >>> log_weights = jnp.log(jnp.array([0.0, 0.5, 0.5, 0.0]))
    >>> jf.resampling.systematic(jax.random.key(0), log_weights).tolist()
    [1, 1, 2, 2]
    >>> jf.resampling.systematic(jax.random.key(0), log_weights, 6).tolist()
    [1, 1, 1, 2, 2, 2]
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PRNGKeyArray

from jaxfilters import weights
from jaxfilters._xla import prefix
from jaxfilters._xla.noise import uniform
from jaxfilters.particle import checks

Key = PRNGKeyArray | Array


def systematic(key: Key, log_weights: Float[Array, " n"], num_samples: int | None = None) -> Int32[Array, " m"]:
    """Draw ancestors by a grid of n points with a common offset: particle i is copied floor or ceil of n w_i times.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jf.resampling.systematic(jax.random.key(0), jnp.log(jnp.array([0.5, 0.0, 0.5, 0.0]))).tolist()
        [0, 0, 2, 2]
    """
    return _systematic(key, _relative(log_weights), _count(log_weights, num_samples))


def _systematic(key: Key, relative: Float[Array, "rows 32"], m: int) -> Int32[Array, " m"]:
    whole, fraction = prefix.positions(relative, m)
    return _ancestors(whole + (fraction > uniform(key, relative.dtype)), m)


def stratified(key: Key, log_weights: Float[Array, " n"], num_samples: int | None = None) -> Int32[Array, " m"]:
    """Draw ancestors by one point in each of n equal intervals: the number of copies is within 2 of n w_i.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jf.resampling.stratified(jax.random.key(0), jnp.log(jnp.array([0.5, 0.0, 0.5, 0.0]))).tolist()
        [0, 0, 2, 2]
    """
    return _stratified(key, _relative(log_weights), _count(log_weights, num_samples))


def _stratified(key: Key, relative: Float[Array, "rows 32"], m: int) -> Int32[Array, " m"]:
    whole, fraction = prefix.positions(relative, m)
    offsets = jax.random.uniform(key, (m,), relative.dtype)
    return _ancestors(whole + (fraction > offsets[jnp.minimum(whole, m - 1)]), m)


def _by_weights(draw: Callable) -> Callable:
    return lambda key, weights, m: draw(key, prefix.in_rows(weights), m)


BY_WEIGHTS = {systematic: _by_weights(_systematic), stratified: _by_weights(_stratified)}
"""Schemes as functions `(key, weights (n,), m) -> ancestors (m,)` of weights of any positive sum, none of them NaN."""


def multinomial(key: Key, log_weights: Float[Array, " n"], num_samples: int | None = None) -> Int32[Array, " m"]:
    """Draw n ancestors independently.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jax.jit(jf.resampling.multinomial)(jax.random.key(0), jnp.log(jnp.array([0.0, 1.0, 0.0]))).tolist()
        [1, 1, 1]
    """
    m = _count(log_weights, num_samples)
    return _ancestors(_draws_below(key, _relative(log_weights), jnp.int32(m), m), m)


def residual(key: Key, log_weights: Float[Array, " n"], num_samples: int | None = None) -> Int32[Array, " m"]:
    """Copy each particle floor(n w_i) times and draw the other ancestors independently from the remaining weights.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jax.jit(jf.resampling.residual)(jax.random.key(0), jnp.log(jnp.array([2.0, 0.0, 1.0, 1.0]))).tolist()
        [0, 0, 2, 3]
    """
    m = _count(log_weights, num_samples)
    relative = _relative(log_weights)
    expected = relative * (m / jnp.sum(relative))
    # An expected number of copies that is an integer may be rounded to just below it.
    copies = jnp.floor(expected * (1 + 4 * jnp.finfo(expected.dtype).eps))
    remainder = jnp.maximum(expected - copies, 0.0)
    remainder = jnp.where(jnp.sum(remainder) > 0, remainder, relative)
    certain = prefix.running_count(copies.astype(jnp.int32))
    return _ancestors(certain + _draws_below(key, remainder, m - certain[-1, -1], m), m)


def ssp(key: Key, log_weights: Float[Array, " n"], num_samples: int | None = None) -> Int32[Array, " m"]:
    """Draw ancestors by Srinivasan's sampling process: floor or ceil of n w_i copies, negatively associated.

    As even as `systematic`, but consistent in any order of the particles (M. Gerber, N. Chopin and N. Whiteley,
    "Negative association, ordering and convergence of resampling methods", Annals of Statistics 47, 2019, algorithm 2).
    The fractional parts of n w_i meet in pairs: one of the two becomes 0 or 1, and the other meets the next. The pairs
    are those of a knockout tournament, as in A. Srinivasan, "Distributions on level-sets with applications to
    approximation algorithms", FOCS 2001, which takes log2 n rounds instead of n steps.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jax.jit(jf.resampling.ssp)(jax.random.key(0), jnp.log(jnp.array([0.5, 0.0, 0.5, 0.0]))).tolist()
        [0, 0, 2, 2]
    """
    m = _count(log_weights, num_samples)
    whole, fraction = (axis.reshape(-1) for axis in prefix.positions(_relative(log_weights), m))
    # The differences of exact cumulative sums: they are exact too, and sum to m. At the end the fraction says nothing.
    fraction = jnp.where(whole >= m, 0.0, fraction)
    before = lambda ends: jnp.pad(ends[:-1], (1, 0))
    share = fraction - before(fraction)
    certain = whole - before(whole) - (share < 0)
    up, last = _tournament(key, jnp.where(share < 0, share + 1, share))
    copies = (certain + up).at[last].set(0)
    # What the last one keeps is an integer but for rounding.
    copies = copies.at[last].set(jnp.maximum(m - jnp.sum(copies, dtype=copies.dtype), 0))
    return _ancestors(prefix.running_count(prefix.in_rows(copies)), m)


def killing(key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
    """Keep particle i in its place with the probability w_i / max w; replace the others by independent draws.

    Most particles stay where they are if their weights are nearly equal, which suits models with many short time steps
    (N. Chopin, S. Singh, T. Soto and M. Vihola, "On resampling schemes for particle filters with weakly informative
    observations", Annals of Statistics 50, 2022, section 3). The indices are not sorted.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jax.jit(jf.resampling.killing)(jax.random.key(0), jnp.log(jnp.array([0.5, 0.0, 0.5]))).tolist()[::2]
        [0, 2]
    """
    n = log_weights.size
    survive_key, draw_key = jax.random.split(key)
    relative = _relative(log_weights)
    killed = jax.random.uniform(survive_key, (n,), log_weights.dtype) >= relative.reshape(-1)[:n]
    rank = prefix.running_count(prefix.in_rows(killed.astype(jnp.int32))).reshape(-1)[:n]
    # So many draws as are needed: in order, they are independent of one another only if all of them are used.
    drawn = _ancestors(_draws_below(draw_key, relative, rank[-1], n), n)
    places = jnp.arange(n, dtype=jnp.int32)
    return jnp.where(killed, drawn[jnp.maximum(rank - 1, 0)], places)


@dataclass(frozen=True)
class Metropolis:
    """A scheme made by `metropolis`."""

    num_steps: int

    def __call__(self, key: Key, log_weights: Float[Array, " n"]) -> Int32[Array, " n"]:
        """Ancestors where the chains end."""
        checks.check_log_weights(log_weights)
        n = log_weights.size
        # Weights relative to the largest: the total of an ensemble without weight would be lost otherwise.
        relative = _relative(log_weights).reshape(-1)[:n]

        def step(i: Array, ancestors: Array) -> Array:
            propose_key, accept_key = jax.random.split(jax.random.fold_in(key, i))
            other = jax.random.randint(propose_key, (n,), 0, n, jnp.int32)
            bar = jax.random.uniform(accept_key, (n,), log_weights.dtype) * relative[ancestors]
            return jnp.where((bar < relative[other]) | (relative[ancestors] == 0), other, ancestors)

        return jax.lax.fori_loop(0, self.num_steps, step, jnp.arange(n, dtype=jnp.int32))


def metropolis(num_steps: int) -> Metropolis:
    """Build Metropolis resampling, which compares weights in pairs and never sums them.

    In every place a Metropolis chain starts from its own particle, and proposes another one `num_steps` times. The
    ancestors are biased: with normalised weights w, the distribution of each differs from w by at most
    (1 - 1 / (n max w))^num_steps in total variation (L. Murray, A. Lee and P. Jacob, "Parallel resampling in the
    particle filter", Journal of Computational and Graphical Statistics 25, 2016, section 3), so that the evidence of a
    filter is not unbiased. A particle without weight is left at the first proposal; with few steps, it may be for
    another one without. The indices are not sorted.

    Args:
        num_steps: Number of steps, at least 1; `metropolis_steps` says how many a bias needs.

    Returns:
        The scheme, `(key, log_weights (n,)) -> ancestors (n,)`; those of equal numbers are equal.

    Raises:
        ValueError: If `num_steps` is not an integer of at least 1.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> scheme = jf.resampling.metropolis(jf.resampling.metropolis_steps(4.0, 1e-3))
        >>> scheme(jax.random.key(0), jnp.log(jnp.array([0.0, 1.0, 0.0, 0.0]))).tolist()
        [1, 1, 1, 1]
    """
    checks.check_num_particles(num_steps, name="num_steps")
    return Metropolis(num_steps)


def metropolis_steps(largest: float, bias: float) -> int:
    """Return how many steps of `metropolis` bound the total variation by `bias`, in (0, 1).

    `largest` is n times the largest normalised weight that is to be expected, at least 1.

    Raises:
        ValueError: If an argument is out of range.

    Examples:
        With weights of at most 2 / n, every step halves the bound.

        >>> import jaxfilters as jf
        >>> jf.resampling.metropolis_steps(2.0, 1e-3)
        10
    """
    checks.check_scalar("largest", largest, "at least 1", lambda value: value >= 1)
    checks.check_scalar("bias", bias, "in (0, 1)", lambda value: 0 < value < 1)
    return 1 if largest == 1 else math.ceil(math.log(bias) / math.log1p(-1 / largest))


def _count(log_weights: Array, num_samples: int | None) -> int:
    if num_samples is not None:
        checks.check_num_particles(num_samples, name="num_samples")
    return log_weights.size if num_samples is None else num_samples


def _tournament(key: Key, shares: Float[Array, " n"]) -> tuple[Bool[Array, " n"], Int32[Array, ""]]:
    """Which shares in [0, 1) become 1 in the tournament of their pairs, and the index of the last one, undecided."""
    n = shares.size
    players = jnp.arange(n, dtype=jnp.int32)
    up = jnp.zeros(n, bool)
    numbers = jax.random.uniform(key, (n + n.bit_length(),), shares.dtype)
    while players.size > 1:
        if players.size % 2:
            # A share of 0 loses to everyone.
            players, shares = jnp.append(players, players[-1]), jnp.append(shares, 0.0)
        u, numbers = jnp.split(numbers, [players.size // 2])
        (i, j), (a, b) = players.reshape(-1, 2).T, shares.reshape(-1, 2).T
        # Below 1 together, one of them gets both shares; else one of them becomes 1, and the other keeps the rest.
        crowded = a + b >= 1
        first = u * jnp.where(crowded, 2 - a - b, a + b) < jnp.where(crowded, 1 - b, a)
        up = up.at[jnp.where(crowded, jnp.where(first, i, j), n)].set(True, mode="drop")
        players = jnp.where(first ^ crowded, i, j)
        shares = jnp.where(crowded, a + b - 1, a + b)
    return up, players[0]


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
        log_weights: Log weights (m,), not necessarily normalised. If no particle has any weight, none survives with
            any.
        num_survivors: Number n of places, from 1 to m.

    Returns:
        The survivors, in n places.

    Raises:
        ValueError: If `num_survivors` is not an integer from 1 to m, or `log_weights` no vector or NaN.
        TypeError: If `log_weights` holds no floating-point numbers.

    Examples:
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
    whole, fraction = prefix.positions(small, places, num_survivors)
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

    values = jnp.where(few, jnp.inf, 0.0), jnp.where(few, 0.0, num), jnp.where(few, 0.0, jnp.sum(relative))
    start = tuple(value.astype(relative.dtype) for value in values)
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
    # What ends beyond the last place, in the padding of the last row, has no effect. The option `indices_are_sorted`
    # would be true, but it makes GPUs add one after the other, which takes three to seven times as long.
    ended = jnp.zeros(n - n % -prefix.ROW, jnp.float32)
    ended = ended.at[ends.reshape(-1)].add(1.0, mode="drop")
    return prefix.running_count(prefix.in_rows(ended)).reshape(-1)[:n]


def _draws_below(
    key: Key, weights: Float[Array, "rows 32"], draws: Int32[Array, ""], most: int
) -> Int32[Array, "rows 32"]:
    """Number of `draws <= most` independent points, uniform on [0, sum of the weights), below each cumulative weight.

    The points are generated in order, as the cumulative sums of exponential gaps, one more than there are points
    (L. Devroye, "Non-Uniform Random Variate Generation", 1986, section V.3.1).
    """
    size = most - most % -prefix.ROW
    total = draws.astype(weights.dtype)
    gaps = jax.random.exponential(key, (size + prefix.ROW,), weights.dtype)
    gaps = prefix.in_rows(jnp.where(jnp.arange(gaps.size) <= draws, gaps, 0.0))
    point_whole, point_fraction = (axis.reshape(-1) for axis in prefix.positions(gaps, total, most))
    whole, fraction = prefix.positions(weights, total, most)

    # The points are counted by unit intervals; those of the interval that holds a cumulative weight, one by one.
    occupied = jnp.zeros(gaps.size, jnp.int32).at[point_whole].add(1)
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
