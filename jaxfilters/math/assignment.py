"""Exact linear assignment of rows (tracks) to columns (detections), non-crossing or in any order, optionally gated.

Arrays have fixed shapes, with masks for the rows and columns that exist, so that all functions can be mapped by `vmap`.
They are dynamic programmes over all cells, or over all subsets of the columns, whose time does not depend on the
values. On the host, for many columns, `scipy.optimize.linear_sum_assignment` solves the problem of `match`.
"""

import math
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

MAX_COLUMNS = 12
"""Largest number of columns of `match`, whose work is proportional to two to the power of the columns."""
_SKIP_COLUMN, _SKIP_ROW, _PAIR = range(3)


class Matching(NamedTuple):
    """An assignment of n rows to m columns."""

    column: Int32[Array, " n"]
    """The column of every row; -1 if it has none."""
    row: Int32[Array, " m"]
    """The row of every column; -1 if it has none."""
    cost: Float[Array, ""]
    """Total cost of the pairs and, with a gate, of unmatched rows and columns; `inf` if no matching is possible."""


class _Costs(NamedTuple):
    pair: Float[Array, "n m"]
    row: Float[Array, " n"]
    """Cost of an unmatched row."""
    column: Float[Array, " m"]
    """Cost of an unmatched column."""


def match_noncrossing(
    cost: Float[Array, "n m"], rows: Bool[Array, " n"] | None = None, columns: Bool[Array, " m"] | None = None
) -> Matching:
    """The matching of least cost in which no two pairs cross, with as many pairs as rows and columns permit.

    These are the ordered combinations of K. Oka, Y. Sato and H. Koike, "Real-time fingertip tracking and gesture
    recognition", IEEE CG&A 22(6), 2002, found by dynamic programming. Among matchings of equal cost it is the one whose
    last column is smallest, then the one before it, and so on.

    Args:
        cost: (n, m): cost of every pair; `inf` for an impossible one. NaN counts as `inf` where it is not known before
            compilation.
        rows: (n,): rows that exist; `None` is all of them.
        columns: (m,): columns that exist; `None` is all of them.

    Raises:
        ValueError: If `cost` is not a matrix, holds NaN, or a mask does not match it.

    Examples:
        The cheapest pairs cross, so that without crossing both rows keep their order.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> cost = jnp.array([[4.0, 1.0], [1.0, 5.0]])
        >>> print(jf.math.assignment.match_noncrossing(cost).column, jf.math.assignment.match(cost).column)
        [0 1] [1 0]
    """
    return _in_order(_all_of_the_fewer(cost, rows, columns))


def match_noncrossing_gated(
    cost: Float[Array, "n m"],
    gate: float | Float[Array, ""],
    rows: Bool[Array, " n"] | None = None,
    columns: Bool[Array, " m"] | None = None,
) -> Matching:
    """The matching of least cost in which no two pairs cross and no pair costs more than `gate`.

    An unmatched row and an unmatched column cost `gate / 2` each. Arguments are those of `match_noncrossing`.

    Args:
        cost: (n, m): cost of every pair.
        gate: Highest cost of a pair, in the unit of `cost`, not negative.
        rows: (n,): rows that exist.
        columns: (m,): columns that exist.

    Raises:
        ValueError: As for `match_noncrossing`, or if `gate` is negative.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> matching = jf.math.assignment.match_noncrossing_gated(jnp.array([[1.0, 9.0], [9.0, 8.0]]), 4.0)
        >>> print(matching.column, matching.cost)
        [ 0 -1] 5.0
    """
    return _in_order(_gated(cost, gate, rows, columns))


def match(
    cost: Float[Array, "n m"], rows: Bool[Array, " n"] | None = None, columns: Bool[Array, " m"] | None = None
) -> Matching:
    """The matching of least cost, with as many pairs as rows and columns permit. Arguments as of `match_noncrossing`.

    Raises:
        ValueError: As for `match_noncrossing`, or if there are more than `MAX_COLUMNS` columns.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> matching = jf.math.assignment.match(jnp.array([[4.0, 1.0, 3.0], [2.0, 0.0, 5.0]]))
        >>> print(matching.column, matching.row, matching.cost)
        [1 0] [ 1  0 -1] 3.0
    """
    return _in_any_order(_all_of_the_fewer(cost, rows, columns))


def match_gated(
    cost: Float[Array, "n m"],
    gate: float | Float[Array, ""],
    rows: Bool[Array, " n"] | None = None,
    columns: Bool[Array, " m"] | None = None,
) -> Matching:
    """The matching of least cost in which no pair costs more than `gate`. Arguments as of `match_noncrossing_gated`.

    Raises:
        ValueError: As for `match_noncrossing_gated`, or if there are more than `MAX_COLUMNS` columns.

    Examples:
        The second row costs too much to be paired, so it stays without a column, at half the gate.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> matching = jf.math.assignment.match_gated(jnp.array([[9.0, 1.0], [8.0, 9.0]]), 4.0)
        >>> print(matching.column, matching.row, matching.cost)
        [ 1 -1] [-1  0] 5.0
    """
    return _in_any_order(_gated(cost, gate, rows, columns))


def enumerate_noncrossing(cost: Float[np.ndarray, "n m"]) -> tuple[list[tuple[int, int]], float]:
    """The pairs and the cost of `match_noncrossing` by enumeration of all ordered combinations, for small problems.

    Examples:
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> jf.math.assignment.enumerate_noncrossing(np.array([[4.0, 1.0, 3.0], [2.0, 0.0, 5.0]]))
        ([(0, 0), (1, 1)], 4.0)
    """
    cost = np.asarray(cost, float)
    if cost.shape[0] > cost.shape[1]:
        pairs, total = enumerate_noncrossing(cost.T)
        return [(i, j) for j, i in pairs], total
    n, m = cost.shape
    totals = [(float(cost[range(n), list(chosen)].sum()), chosen[::-1]) for chosen in combinations(range(m), n)]
    total, chosen = min(totals)
    return list(zip(range(n), chosen[::-1], strict=True)), total


def count_noncrossing(n: int, m: int) -> int:
    """The number of ordered combinations of n rows and m columns, the binomial coefficient (max, min).

    Examples:
        >>> import jaxfilters as jf
        >>> jf.math.assignment.count_noncrossing(5, 3)
        10
    """
    return math.comb(max(n, m), min(n, m))


def _all_of_the_fewer(cost: Array, rows: Array | None, columns: Array | None) -> _Costs:
    rows, columns, pair = _masked(cost, rows, columns)
    skip_columns = jnp.sum(rows) <= jnp.sum(columns)
    return _Costs(
        pair,
        jnp.where(rows & skip_columns, jnp.inf, 0.0).astype(pair.dtype),
        jnp.where(columns & ~skip_columns, jnp.inf, 0.0).astype(pair.dtype),
    )


def _gated(cost: Array, gate: float | Array, rows: Array | None, columns: Array | None) -> _Costs:
    if not isinstance(gate, jax.core.Tracer) and not np.all(np.asarray(gate) >= 0):
        raise ValueError(f"gate must not be negative; got {gate}.")
    rows, columns, pair = _masked(cost, rows, columns)
    half = 0.5 * jnp.asarray(gate, pair.dtype)
    return _Costs(pair, jnp.where(rows, half, 0.0), jnp.where(columns, half, 0.0))


def _masked(cost: Array, rows: Array | None, columns: Array | None) -> tuple[Array, Array, Array]:
    if jnp.ndim(cost) != 2:
        raise ValueError(f"cost must be (n, m), rows by columns; got {jnp.shape(cost)}.")
    if not isinstance(cost, jax.core.Tracer) and np.any(np.isnan(np.asarray(cost))):
        raise ValueError(f"cost must not be NaN; got {int(np.isnan(np.asarray(cost)).sum())} of {cost.size} numbers.")
    n, m = cost.shape
    for name, mask, size in (("rows", rows, n), ("columns", columns, m)):
        if mask is not None and jnp.shape(mask) != (size,):
            raise ValueError(f"{name} must be ({size},) for cost {cost.shape}; got {jnp.shape(mask)}.")
    rows = jnp.ones(n, bool) if rows is None else rows
    columns = jnp.ones(m, bool) if columns is None else columns
    usable = rows[:, None] & columns & jnp.isfinite(cost)
    return rows, columns, jnp.where(usable, cost, jnp.inf)


def _in_order(costs: _Costs) -> Matching:
    """D[i,j] = min(D[i,j-1] + column j unmatched, D[i-1,j] + row i unmatched, D[i-1,j-1] + pair), and backtracking.

    It advances one antidiagonal i + j at a time, whose cells are independent of each other, as a vector over i.
    """
    n, m = costs.pair.shape
    if not n or not m:
        return _matching(jnp.full(n, -1, jnp.int32), jnp.sum(costs.row) + jnp.sum(costs.column), m)
    i = jnp.arange(n + 1)
    j = jnp.arange(1, n + m + 1)[:, None] - i
    inside = (j >= 1) & (j <= m)
    beside = jnp.where(inside, costs.column[jnp.clip(j - 1, 0, m - 1)], jnp.inf)
    above = jnp.where(i >= 1, costs.row[jnp.maximum(i - 1, 0)], jnp.inf)
    pair = jnp.where(inside & (i >= 1), costs.pair[jnp.maximum(i - 1, 0), jnp.clip(j - 1, 0, m - 1)], jnp.inf)
    nowhere = jnp.full(n + 1, jnp.inf, costs.pair.dtype)
    start = nowhere.at[0].set(0.0)

    def next_diagonal(before: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], Array]:
        last, last_but_one = before
        beside, pair = inputs
        options = jnp.stack([last + beside, jnp.roll(last, 1) + above, jnp.roll(last_but_one, 1) + pair])
        return (jnp.min(options, axis=0), last), jnp.argmin(options, axis=0)

    (end, _), choices = jax.lax.scan(next_diagonal, (start, nowhere), (beside, pair))

    def back(place: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], Array]:
        i, passed = place
        choice = jnp.where(passed, _SKIP_COLUMN, inputs[0][i])
        is_pair = choice == _PAIR
        column = inputs[1] - i
        return (i - (choice != _SKIP_COLUMN), is_pair), jnp.where(is_pair & (jnp.arange(n) == i - 1), column, -1)

    # A pair steps back by two diagonals, so the one between is passed over.
    first = (jnp.asarray(n), jnp.asarray(False))
    _, columns = jax.lax.scan(back, first, (choices, jnp.arange(n + m)), reverse=True)
    return _matching(jnp.max(columns, axis=0).astype(jnp.int32), end[-1], m)


def _in_any_order(costs: _Costs) -> Matching:
    """The least cost of using each subset of the columns, row by row, and backtracking."""
    m = costs.pair.shape[1]
    if m > MAX_COLUMNS:
        raise ValueError(f"cost must have at most {MAX_COLUMNS} columns; got {m}.")
    subsets = jnp.arange(2**m)
    uses = (subsets[:, None] >> jnp.arange(m)) & 1 == 1
    without = jnp.where(uses, subsets[:, None] - (1 << jnp.arange(m)), 0)
    nothing = jnp.where(subsets == 0, 0.0, jnp.inf).astype(costs.pair.dtype)

    def next_row(before: Array, inputs: tuple) -> tuple[Array, Array]:
        pair, skip_row = inputs
        paired = jnp.where(uses, before[without] + pair, jnp.inf)
        options = jnp.concatenate([(before + skip_row)[:, None], paired], axis=1)
        return jnp.min(options, axis=1), jnp.argmin(options, axis=1).astype(jnp.int32) - 1

    used, choices = jax.lax.scan(next_row, nothing, (costs.pair, costs.row))
    left = jnp.sum(jnp.where(uses, 0.0, costs.column), axis=1)
    best = jnp.argmin(used + left)

    def back(subset: Array, choice: Array) -> tuple[Array, Array]:
        column = choice[subset]
        return jnp.where(column >= 0, without[subset, jnp.maximum(column, 0)], subset), column

    _, columns = jax.lax.scan(back, best, choices, reverse=True)
    return _matching(columns, (used + left)[best], m)


def _matching(column: Array, cost: Array, m: int) -> Matching:
    is_pair = column[:, None] == jnp.arange(m)
    row = jnp.max(jnp.where(is_pair, jnp.arange(len(column))[:, None], -1), axis=0, initial=-1)
    return Matching(column, row.astype(jnp.int32), cost)
