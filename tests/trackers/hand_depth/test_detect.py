"""Finding the nearest hand in a frame."""

import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth.detect import nearest_hand

CAMERA = Pinhole.from_intrinsics((200.0, 200.0), (80.0, 60.0), (120, 160))


def blank():
    return np.full((120, 160), np.nan, np.float32)


def with_palm(frame, row=50, col=90, depth=0.6):
    frame[row - 14 : row + 15, col - 14 : col + 15] = depth  # 87 mm square at 0.6 m
    return frame


def test_the_palm_is_the_middle_of_the_nearest_object():
    frame = with_palm(np.full((120, 160), 2.0, np.float32))
    sighting = nearest_hand(CAMERA, frame)
    np.testing.assert_allclose(sighting.center, [10 / 200 * 0.6, -10 / 200 * 0.6, 0.615], atol=0.004)
    np.testing.assert_array_equal(sighting.forearm, 0)


def test_an_arm_behind_the_palm_is_seen_as_such():
    frame = with_palm(blank())
    for row in range(65, 120):
        frame[row, 80:100] = 0.6 + 0.002 * (row - 64)
    sighting = nearest_hand(CAMERA, frame)
    np.testing.assert_allclose(np.linalg.norm(sighting.forearm), 1, rtol=1e-5)
    assert sighting.forearm[1] > 0.7
    assert abs(sighting.forearm[0]) < 0.2
    assert sighting.forearm[2] > 0


def test_specks_in_front_are_looked_past():
    frame = with_palm(blank())
    frame[5, 5] = frame[100, 30:32] = 0.3
    np.testing.assert_allclose(nearest_hand(CAMERA, frame).center[2], 0.615, atol=0.002)


@pytest.mark.parametrize("value", [np.nan, 2.5, 0.05])
def test_nothing_within_reach_is_no_hand(value):
    assert nearest_hand(CAMERA, np.full((120, 160), value, np.float32)) is None
