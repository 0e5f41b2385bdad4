"""Inequalities: the paper's table, free combinations, and what is refused by name."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.limits import (
    Limit,
    difference,
    limit_rows,
    proportions,
    ratio,
    table_1,
    within,
)
from jaxfilters.models.hand.skeleton import hand_geometry


def test_table_1_has_24_rows_of_which_13_are_on_lengths():
    rows = limit_rows(Layout(2), table_1())
    assert rows.normals.shape == (24, 37)
    assert int(rows.static.sum()) == 13
    np.testing.assert_array_equal(rows.static, [name.startswith("r_") for name in rows.names])
    assert len(set(rows.names)) == 24
    assert np.all(np.asarray(rows.lower) < np.asarray(rows.upper))


@pytest.mark.parametrize(
    ("name", "components", "lower", "upper"),
    [
        ("theta_12 - theta_13", {8: 1, 9: -1}, -10, 10),
        ("theta_10", {6: 1}, -20, 0),
        ("theta_20", {10: 1}, 0, 20),
        ("theta_23", {13: 1}, 0, 90),
        ("theta_11 - theta_21", {7: 1, 11: -1}, -35, 35),
    ],
)
def test_angles_of_table_1_are_in_radians(name, components, lower, upper):
    rows = limit_rows(Layout(2), table_1())
    at = rows.names.index(name)
    expected = np.zeros(37)
    for index, factor in components.items():
        expected[index] = factor
    np.testing.assert_array_equal(rows.normals[at], expected)
    np.testing.assert_allclose([rows.lower[at], rows.upper[at]], np.deg2rad([lower, upper]), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "components", "lower", "upper"),
    [
        ("r_11 - r_12", {28: 1, 29: -1}, 0, 30),
        ("r_22 - r_23", {32: 1, 33: -1}, -10, 10),
        ("r_11", {28: 1}, 55, 70),
        ("r_22", {32: 1}, 30, 50),
        ("r_23", {33: 1}, 25, 50),
        ("r_13 - r_23", {30: 1, 33: -1}, -5, 5),
    ],
)
def test_lengths_of_table_1_are_in_pixels(name, components, lower, upper):
    rows = limit_rows(Layout(2), table_1())
    at = rows.names.index(name)
    assert {int(i): float(rows.normals[at, i]) for i in np.flatnonzero(rows.normals[at])} == components
    np.testing.assert_array_equal([rows.lower[at], rows.upper[at]], [lower, upper])


def test_free_combinations_over_any_layout():
    layout = five_fingers(3)
    limits = [
        within("theta_53", -0.1, 1.5),
        difference("theta_31", "theta_41", -0.5, math.inf),
        Limit((("r_12", 1.0), ("r_11", -0.65), ("theta_11", 0.001)), -math.inf, 3.0),
    ]
    rows = limit_rows(layout, limits)
    assert rows.names == ("theta_53", "theta_31 - theta_41", "r_12 - 0.65 r_11 + 0.001 theta_11")
    x = np.random.default_rng(0).normal(size=layout.size)
    value = dict(zip(layout.names, x, strict=True))
    expected = [
        value["theta_53"],
        value["theta_31"] - value["theta_41"],
        value["r_12"] - 0.65 * value["r_11"] + 0.001 * value["theta_11"],
    ]
    np.testing.assert_allclose(rows.normals @ jnp.asarray(x, jnp.float32), expected, atol=1e-5)
    np.testing.assert_array_equal(rows.static, [False, False, False])
    assert not limit_rows(layout, []).names


def test_ratios_and_proportions_do_not_depend_on_the_size():
    layout = five_fingers(3)
    template = np.asarray(hand_geometry().lengths, float)
    rows = limit_rows(layout, proportions(layout, template, 0.095, 0.3))
    assert rows.normals.shape[0] == 2 * 15
    assert bool(np.all(rows.static))

    def holds(lengths, height):
        x = np.zeros(layout.size)
        x[layout.lengths], x[layout.size - 2] = np.ravel(lengths), height
        value = np.asarray(rows.normals, float) @ x
        return (value >= np.asarray(rows.lower)) & (value <= np.asarray(rows.upper))

    for size in (0.5, 1.0, 700.0):
        assert np.all(holds(size * template, size * 0.095))
    longer = template.copy()
    longer[1, 1] *= 1.4
    broken = [name for name, ok in zip(rows.names, holds(longer, 0.095), strict=True) if not ok]
    # 40 % too long against the link before; the next link is then 29 % too short, which is allowed.
    assert len(broken) == 1
    assert broken[0].startswith("r_22 - ")


def test_a_ratio_is_two_half_spaces():
    low, high = ratio("r_12", "r_11", 0.5, 0.8)
    assert (low.name, low.lower, low.upper) == ("r_12 - 0.5 r_11", 0.0, math.inf)
    assert (high.name, high.lower, high.upper) == ("r_12 - 0.8 r_11", -math.inf, 0.0)


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (within("theta_31", 0.0, 1.0), "'theta_31' speaks of 'theta_31'"),
        (difference("theta_12", "theta_13", 1.0, 0.0), "'theta_12 - theta_13' must have lower <= upper"),
        (within("r_11", float("nan"), 1.0), "must have lower <= upper"),
        (within("r_11", -math.inf, math.inf), "must have lower <= upper"),
        (difference("r_11", "r_11", 0.0, 1.0), "not all zero"),
        (Limit((), 0.0, 1.0), "not all zero"),
        (Limit((("r_11", math.inf),), 0.0, 1.0), "must be finite"),
    ],
)
def test_bad_limits_are_refused_by_name(limit, message):
    with pytest.raises(ValueError, match=message):
        limit_rows(Layout(2), [limit])


def test_bad_templates_are_refused():
    layout = Layout(2)
    for lengths, height, tolerance, message in [
        (np.ones((3, 3)), 1.0, 0.3, r"lengths must be \(2, 3\)"),
        (np.zeros((2, 3)), 1.0, 0.3, "positive"),
        (np.ones((2, 3)), 0.0, 0.3, "positive"),
        (np.ones((2, 3)), 1.0, 1.0, "tolerance must be in"),
    ]:
        with pytest.raises(ValueError, match=message):
            proportions(layout, lengths, height, tolerance)
