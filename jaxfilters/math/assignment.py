"""What belongs to what: assignments that keep an order and such that do not, exact or gated, of one fixed shape.

Rows are one kind of things (tracks), columns the other (detections); masks say which of them are there. All functions
are for `vmap`. Programmes over all cells, and over all subsets of the columns: exact, in time that does not depend on
the numbers. On the host, for many columns, `scipy.optimize.linear_sum_assignment` does what `match` does.
"""

import math
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

MOST_COLUMNS = 12
"""Of an assignment without order, whose work grows with two to the power of the columns."""
_SKIP_COLUMN, _SKIP_ROW, _PAIR = range(3)


class Matching(NamedTuple):
    """Pairs of rows and columns."""

    column: Int32[Array, " n"]
    """Of every row; -1 where it has none."""
    row: Int32[Array, " m"]
    """Of every column; -1 where it has none."""
    cost: Float[Array, ""]
    """Of the pairs, and of what was skipped where skipping has a price; `inf` where no matching is possible."""


class _Prices(NamedTuple):
    pair: Float[Array, "n m"]
    row: Float[Array, " n"]
    """Of leaving a row alone."""
    column: Float[Array, " m"]


def match_ordered(
    cost: Float[Array, "n m"], rows: Bool[Array, " n"] | None = None, columns: Bool[Array, " m"] | None = None
) -> Matching:
    """The cheapest pairs of which no two cross, as many as rows and columns allow: min of the two numbers.

    The ordered combinations of section 2.3 (K. Oka, Y. Sato, H. Koike, "Real-time fingertip tracking and gesture
    recognition", IEEE CG&A 22(6), 2002) by a dynamic programme. Among equally cheap matchings the one whose last
    column, then the one before it and so on, is the smallest.

    Args:
        cost: Of every pair; one that is not finite is impossible.
        rows: Which rows are there; all of them without it.
        columns: Which columns are there.
    """
    return _in_order(_all_of_the_fewer(cost, rows, columns))


def match_ordered_gated(
    cost: Float[Array, "n m"],
    gate: float | Float[Array, ""],
    rows: Bool[Array, " n"] | None = None,
    columns: Bool[Array, " m"] | None = None,
) -> Matching:
    """The cheapest pairs of which no two cross, where a row and a column left alone cost as much as a pair at `gate`.

    `gate` is the highest cost of a pair, a squared distance where costs are; what is farther apart stays alone on
    both sides: each skip costs half of it (section 2.3). Arguments as of `match_ordered`.
    """
    return _in_order(_gated(cost, gate, rows, columns))


def match(
    cost: Float[Array, "n m"], rows: Bool[Array, " n"] | None = None, columns: Bool[Array, " m"] | None = None
) -> Matching:
    """The cheapest pairs in any order, as many as rows and columns allow. Arguments as of `match_ordered`.

    Raises:
        ValueError: If there are more than `MOST_COLUMNS` columns.
    """
    return _in_any_order(_all_of_the_fewer(cost, rows, columns))


def match_gated(
    cost: Float[Array, "n m"],
    gate: float | Float[Array, ""],
    rows: Bool[Array, " n"] | None = None,
    columns: Bool[Array, " m"] | None = None,
) -> Matching:
    """The cheapest pairs in any order with a gate. Arguments as of `match_ordered_gated`.

    Raises:
        ValueError: If there are more than `MOST_COLUMNS` columns.
    """
    return _in_any_order(_gated(cost, gate, rows, columns))


def enumerate_ordered(cost: Float[np.ndarray, "n m"]) -> tuple[list[tuple[int, int]], float]:
    """Pairs and cost of `match_ordered`, by trying all ordered combinations as the paper does."""
    cost = np.asarray(cost, float)
    if cost.shape[0] > cost.shape[1]:
        pairs, total = enumerate_ordered(cost.T)
        return [(i, j) for j, i in pairs], total
    n, m = cost.shape
    totals = [(float(cost[range(n), list(chosen)].sum()), chosen[::-1]) for chosen in combinations(range(m), n)]
    total, chosen = min(totals)
    return list(zip(range(n), chosen[::-1], strict=True)), total


def count_ordered(n: int, m: int) -> int:
    """How many ordered combinations of n rows and m columns there are: C(max, min)."""
    return math.comb(max(n, m), min(n, m))


def _all_of_the_fewer(cost: Array, rows: Array | None, columns: Array | None) -> _Prices:
    rows, columns, pair = _masked(cost, rows, columns)
    skip_columns = jnp.sum(rows) <= jnp.sum(columns)
    return _Prices(
        pair,
        jnp.where(rows & skip_columns, jnp.inf, 0.0).astype(pair.dtype),
        jnp.where(columns & ~skip_columns, jnp.inf, 0.0).astype(pair.dtype),
    )


def _gated(cost: Array, gate: float | Array, rows: Array | None, columns: Array | None) -> _Prices:
    rows, columns, pair = _masked(cost, rows, columns)
    half = 0.5 * jnp.asarray(gate, pair.dtype)
    return _Prices(pair, jnp.where(rows, half, 0.0), jnp.where(columns, half, 0.0))


def _masked(cost: Array, rows: Array | None, columns: Array | None) -> tuple[Array, Array, Array]:
    n, m = cost.shape
    rows = jnp.ones(n, bool) if rows is None else rows
    columns = jnp.ones(m, bool) if columns is None else columns
    usable = rows[:, None] & columns & jnp.isfinite(cost)
    return rows, columns, jnp.where(usable, cost, jnp.inf)


def _in_order(prices: _Prices) -> Matching:
    """D[i,j] = min(D[i,j-1] + column j skipped, D[i-1,j] + row i skipped, D[i-1,j-1] + pair), and the way back.

    One diagonal i + j at a time, whose cells do not depend on each other, as a vector over i.
    """
    n, m = prices.pair.shape
    if not n or not m:
        return _matching(jnp.full(n, -1, jnp.int32), jnp.sum(prices.row) + jnp.sum(prices.column), m)
    i = jnp.arange(n + 1)
    j = jnp.arange(1, n + m + 1)[:, None] - i
    inside = (j >= 1) & (j <= m)
    beside = jnp.where(inside, prices.column[jnp.clip(j - 1, 0, m - 1)], jnp.inf)
    above = jnp.where(i >= 1, prices.row[jnp.maximum(i - 1, 0)], jnp.inf)
    pair = jnp.where(inside & (i >= 1), prices.pair[jnp.maximum(i - 1, 0), jnp.clip(j - 1, 0, m - 1)], jnp.inf)
    nowhere = jnp.full(n + 1, jnp.inf, prices.pair.dtype)
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

    # A pair lies two diagonals behind, so that the one between is passed.
    first = (jnp.asarray(n), jnp.asarray(False))
    _, columns = jax.lax.scan(back, first, (choices, jnp.arange(n + m)), reverse=True)
    return _matching(jnp.max(columns, axis=0).astype(jnp.int32), end[-1], m)


def _in_any_order(prices: _Prices) -> Matching:
    """Row by row, the least cost of having used each subset of the columns, and the way back."""
    m = prices.pair.shape[1]
    if m > MOST_COLUMNS:
        raise ValueError(f"cost must have at most {MOST_COLUMNS} columns; got {m}.")
    subsets = jnp.arange(2**m)
    uses = (subsets[:, None] >> jnp.arange(m)) & 1 == 1
    without = jnp.where(uses, subsets[:, None] - (1 << jnp.arange(m)), 0)
    nothing = jnp.where(subsets == 0, 0.0, jnp.inf).astype(prices.pair.dtype)

    def next_row(before: Array, inputs: tuple) -> tuple[Array, Array]:
        pair, skip_row = inputs
        paired = jnp.where(uses, before[without] + pair, jnp.inf)
        options = jnp.concatenate([(before + skip_row)[:, None], paired], axis=1)
        return jnp.min(options, axis=1), jnp.argmin(options, axis=1).astype(jnp.int32) - 1

    used, choices = jax.lax.scan(next_row, nothing, (prices.pair, prices.row))
    left = jnp.sum(jnp.where(uses, 0.0, prices.column), axis=1)
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
