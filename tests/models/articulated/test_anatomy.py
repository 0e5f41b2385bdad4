"""The average hand of five fingers: what it is at ease keeps its own limits, and left mirrors right."""

import jax
import numpy as np
import pytest

from jaxfilters.models.articulated.anatomy import (
    five_finger_limits,
    flexion_correlation,
    relaxed_angles,
    template_lengths,
    template_shape,
)
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.limits import limit_rows


def relaxed_state(layout):
    x = np.zeros(layout.size)
    x[layout.quaternion], x[layout.static] = (0.5, -0.5, 0.5, -0.5), template_shape()
    x[layout.angles] = relaxed_angles(layout).ravel()
    return x


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_hand_at_ease_keeps_its_limits_with_room_to_spare(side):
    layout = five_fingers(side=side)
    rows = limit_rows(layout, five_finger_limits(layout))
    value = np.asarray(rows.normals) @ relaxed_state(layout)
    angles = ~np.asarray(rows.static)
    room = np.minimum(value - np.asarray(rows.lower), np.asarray(rows.upper) - value)
    assert angles.sum() == 5 * 4 + 4
    assert (room[angles] > np.radians(5.0)).all()
    assert (room[~angles] > 0).all()


def test_fingers_of_left_and_right_spread_to_opposite_sides():
    right, left = (relaxed_angles(five_fingers(side=side)) for side in (1.0, -1.0))
    np.testing.assert_allclose(left[:, 0], -right[:, 0])
    np.testing.assert_allclose(left[:, 1:], right[:, 1:])
    assert (np.diff(right[1:, 0]) > 0).all()


def test_little_finger_spreads_away_from_the_thumb():
    """Positive abduction turns away from +z, the thumb's side of a right hand."""
    layout = five_fingers()
    rows = limit_rows(layout, five_finger_limits(layout))
    upper = dict(zip(rows.names, np.asarray(rows.upper), strict=True))
    lower = dict(zip(rows.names, np.asarray(rows.lower), strict=True))
    # Its metacarpal goes 22 mm aside and 64 mm along; it may spread by 20 degrees to either side of that.
    fan = np.arctan2(22, 64)
    assert upper["theta_50"] == pytest.approx(fan + np.radians(20.0))
    assert lower["theta_50"] == pytest.approx(fan - np.radians(20.0))


def test_lengths_can_be_asked_for_while_something_is_traced():
    inside = jax.jit(lambda: template_lengths() + 0.0)()
    np.testing.assert_allclose(inside, template_lengths(), rtol=1e-6)


def test_fingers_and_the_joints_of_one_flex_together_and_nothing_else():
    C = flexion_correlation(five_fingers()).reshape(5, 4, 5, 4)
    assert np.linalg.eigvalsh(C.reshape(20, 20))[0] > 0.02
    np.testing.assert_array_equal(C.reshape(20, 20), C.reshape(20, 20).T)
    np.testing.assert_allclose([C[2, 1, 3, 1], C[1, 2, 4, 2], C[0, 2, 0, 3], C[4, 1, 4, 2]], [0.6, 0.6**3, 0.8, 0.3])
    # What flexes a joint flexes the outer joint beside it in every finger.
    assert C[1, 2, 2, 3] == pytest.approx(0.6 * 0.8)
    spreads = C[:, 0].reshape(5, 20)
    np.testing.assert_array_equal(spreads, np.eye(20)[::4])
    assert not C[0, :, 1:].any()


@pytest.mark.parametrize("make", [five_finger_limits, flexion_correlation])
def test_other_hands_are_refused(make):
    with pytest.raises(ValueError, match="five fingers; got 2"):
        make(Layout(2))
