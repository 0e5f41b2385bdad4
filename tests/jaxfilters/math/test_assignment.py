"""Assignments: the dynamic programmes beside exhaustive enumeration and SciPy."""

from itertools import permutations
from math import perm

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxfilters.math import assignment

MOST = 6
ordered = jax.jit(jax.vmap(assignment.match_noncrossing))
ordered_gated = jax.jit(jax.vmap(assignment.match_noncrossing_gated, in_axes=(0, None, 0, 0)))
any_order = jax.jit(jax.vmap(assignment.match))
any_order_gated = jax.jit(jax.vmap(assignment.match_gated, in_axes=(0, None, 0, 0)))


def random_cases(seed, count):
    """Costs of random sizes from 1 to `MOST`, in random places of arrays of one shape; junk where nothing is."""
    rng = np.random.default_rng(seed)
    costs = np.full((count, MOST, MOST), np.nan)
    sizes = rng.integers(1, MOST + 1, (count, 2))
    rows, columns = (np.argsort(rng.random((count, MOST)), axis=1) < sizes[:, k, None] for k in range(2))
    for cost, i, j in zip(costs, rows, columns, strict=True):
        cost[np.ix_(i, j)] = rng.random((i.sum(), j.sum()))
    return costs, rows, columns


def pairs_of(matching, case):
    return [(i, int(j)) for i, j in enumerate(np.asarray(matching.column[case])) if j >= 0]


def small(cost, row, column):
    return cost[np.ix_(row, column)]


def in_place(pairs, row, column):
    i, j = np.flatnonzero(row), np.flatnonzero(column)
    return [(int(i[a]), int(j[b])) for a, b in pairs]


def cheapest(cost, gate, *, keep_order):
    """By trying every choice of a column, or none, for every row."""
    n, m = cost.shape
    best = np.inf
    for size in range(min(n, m) + 1):
        for rows in permutations(range(n), size):
            if list(rows) != sorted(rows):
                continue
            for columns in permutations(range(m), size):
                if keep_order and list(columns) != sorted(columns):
                    continue
                skipped = n + m - 2 * size
                best = min(best, cost[list(rows), list(columns)].sum() + skipped * gate / 2)
    return best


def test_ordered_combinations_are_few():
    """Oracle 6."""
    counts = {(n, m): assignment.count_noncrossing(n, m) for n in range(1, 6) for m in range(1, 6)}
    assert counts[2, 3] == counts[3, 2] == 3
    assert counts[2, 5] == counts[3, 5] == 10
    assert counts[5, 5] == 1
    assert max(counts.values()) == 10
    assert max(perm(max(size), min(size)) for size in counts) == 120


def test_the_programme_is_the_enumeration(x64):
    """Oracle 7: 3000 random costs up to 6x6, the same pairs, costs within 1e-12; what is masked is not looked at."""
    costs, rows, columns = random_cases(0, 3000)
    found = jax.tree.map(np.asarray, ordered(jnp.asarray(costs), jnp.asarray(rows), jnp.asarray(columns)))
    for case, (cost, row, column) in enumerate(zip(costs, rows, columns, strict=True)):
        pairs, total = assignment.enumerate_noncrossing(small(cost, row, column))
        assert pairs_of(found, case) == in_place(pairs, row, column)
        assert abs(float(found.cost[case]) - total) < 1e-12


def test_equal_costs_take_the_first_columns(x64):
    """Skipping a later column wins a tie, as the specification's way back has it."""
    cases = (((1, 3), [(0, 0)]), ((2, 4), [(0, 0), (1, 1)]), ((3, 2), [(0, 0), (1, 1)]))
    there = np.arange(MOST) < np.asarray([shape for shape, _ in cases])[:, :, None]
    found = ordered(jnp.ones((len(cases), MOST, MOST)), jnp.asarray(there[:, 0]), jnp.asarray(there[:, 1]))
    for case, (shape, pairs) in enumerate(cases):
        assert assignment.enumerate_noncrossing(np.ones(shape))[0] == pairs
        assert pairs_of(found, case) == pairs


def test_on_a_line_the_order_costs_nothing(x64):
    """Oracle 8: squared distances of sorted points, 2000 cases, against SciPy."""
    rng = np.random.default_rng(1)
    costs, rows, columns = random_cases(2, 2000)
    for cost, row, column in zip(costs, rows, columns, strict=True):
        a, b = np.sort(rng.normal(size=row.sum())), np.sort(rng.normal(size=column.sum()))
        cost[np.ix_(row, column)] = (a[:, None] - b) ** 2
    found = jax.tree.map(np.asarray, ordered(jnp.asarray(costs), jnp.asarray(rows), jnp.asarray(columns)))
    for case, (cost, row, column) in enumerate(zip(costs, rows, columns, strict=True)):
        own = small(cost, row, column)
        assert abs(float(found.cost[case]) - own[linear_sum_assignment(own)].sum()) < 1e-12


def test_without_order_it_is_scipys_assignment(x64):
    costs, rows, columns = random_cases(3, 500)
    found = jax.tree.map(np.asarray, any_order(jnp.asarray(costs), jnp.asarray(rows), jnp.asarray(columns)))
    for case, (cost, row, column) in enumerate(zip(costs, rows, columns, strict=True)):
        own = small(cost, row, column)
        pairs = list(zip(*linear_sum_assignment(own), strict=True))
        assert pairs_of(found, case) == in_place(pairs, row, column)
        assert abs(float(found.cost[case]) - own[linear_sum_assignment(own)].sum()) < 1e-12


def test_gated_matchings_are_the_cheapest_of_all(x64):
    """Against every choice of a column, or none, for every row; and no pair is beyond the gate."""
    costs, rows, columns = random_cases(4, 40)
    rows &= np.cumsum(rows, axis=1) <= 3
    columns &= np.cumsum(columns, axis=1) <= 4
    for gate in (0.05, 0.4, 10.0):
        for keep_order, matcher in ((True, ordered_gated), (False, any_order_gated)):
            found = jax.tree.map(np.asarray, matcher(jnp.asarray(costs), gate, jnp.asarray(rows), jnp.asarray(columns)))
            for case, (cost, row, column) in enumerate(zip(costs, rows, columns, strict=True)):
                least = cheapest(small(cost, row, column), gate, keep_order=keep_order)
                pairs = pairs_of(found, case)
                skipped = row.sum() + column.sum() - 2 * len(pairs)
                spent = sum(cost[pair] for pair in pairs) + skipped * gate / 2
                np.testing.assert_allclose([found.cost[case], spent], least, atol=1e-12)
                assert all(cost[pair] <= gate for pair in pairs)
                assert not keep_order or [j for _, j in pairs] == sorted(j for _, j in pairs)


def test_rows_and_columns_say_the_same(x64):
    costs, rows, columns = (jnp.asarray(part) for part in random_cases(0, 3000))
    for found in (ordered(costs, rows, columns), any_order(costs[:500], rows[:500], columns[:500])):
        column, row = np.asarray(found.column), np.asarray(found.row)
        case, i = np.nonzero(column >= 0)
        np.testing.assert_array_equal(row[case, column[case, i]], i)
        np.testing.assert_array_equal((row >= 0).sum(axis=1), (column >= 0).sum(axis=1))


def test_nothing_is_matched_with_nothing(x64):
    everybody, nobody = jnp.ones((1, MOST), bool), jnp.zeros((1, MOST), bool)
    unknown = jnp.full((1, MOST, MOST), jnp.nan)
    found = ordered(jnp.ones((1, MOST, MOST)), nobody, everybody)
    np.testing.assert_array_equal(found.column, -1)
    assert float(found.cost[0]) == 0
    found = ordered_gated(unknown, 8.0, everybody, everybody)
    np.testing.assert_array_equal(found.row, -1)
    assert float(found.cost[0]) == 2 * MOST * 4.0
    assert not np.isfinite(ordered(unknown, everybody, everybody).cost[0])


def test_subsets_of_too_many_columns_are_refused():
    with pytest.raises(ValueError, match="at most 12 columns; got 13"):
        assignment.match(jnp.ones((2, 13)))
