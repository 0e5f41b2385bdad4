"""Places in a frame that may be a hand, and units of depth that cannot be."""

import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth.detect import check_unit, hand_sightings

CAMERA = Pinhole.from_intrinsics((200.0, 200.0), (80.0, 60.0), (120, 160))
PALM = [10 / 200 * 0.6, -10 / 200 * 0.6, 0.615]


def blank():
    return np.full((120, 160), np.nan, np.float32)


def with_palm(frame, row=50, col=90, depth=0.6):
    frame[row - 14 : row + 15, col - 14 : col + 15] = depth  # 87 mm square at 0.6 m
    return frame


def nearest_to(sightings, center):
    return min(np.linalg.norm(sighting.center - center) for sighting in sightings)


def test_the_palm_is_the_middle_of_a_surface():
    sighting = hand_sightings(CAMERA, with_palm(np.full((120, 160), 1.9, np.float32)))[0]
    np.testing.assert_allclose(sighting.center, PALM, atol=0.006)
    assert np.isposinf(sighting.frame[0, 0])
    assert sighting.frame[50, 90] == np.float32(0.6)


def test_a_wall_just_behind_the_hand_is_not_part_of_it():
    frame = with_palm(np.full((120, 160), 0.64, np.float32))
    sighting = hand_sightings(CAMERA, frame)[0]
    np.testing.assert_allclose(sighting.center, PALM, atol=0.006)
    assert np.isposinf(sighting.frame[30, 60])


def test_a_desk_nearer_than_the_hand_does_not_hide_it():
    frame = with_palm(np.full((120, 160), 1.9, np.float32))
    frame[80:] = np.linspace(0.5, 0.4, 40)[:, None]
    assert nearest_to(hand_sightings(CAMERA, frame), PALM) < 0.01


def test_a_level_desk_of_many_wide_places_leaves_one_to_the_hand():
    frame = with_palm(np.full((120, 160), 1.9, np.float32))
    below = np.arange(1, 60)
    frame[61:] = np.minimum(frame[61:], (0.1 * 200 / below)[:, None])  # 0.1 m below the camera, from 0.34 m on
    sightings = hand_sightings(CAMERA, frame)
    assert nearest_to(sightings, PALM) < 0.01
    assert nearest_to(sightings[:1], PALM) > 0.2


def test_small_holes_and_specks_change_nothing():
    frame = with_palm(blank())
    frame[5, 5] = frame[100, 30:32] = 0.3
    frame[40:60:4, 80:100:4] = np.nan
    np.testing.assert_allclose(hand_sightings(CAMERA, frame)[0].center, PALM, atol=0.006)


def test_fingers_before_the_palm_do_not_cut_it_into_pieces():
    frame = with_palm(np.full((120, 160), 1.9, np.float32))
    frame[36:65, 78:104:7] = frame[36:65, 79:104:7] = 0.56  # no piece of palm between them is a palm's width
    assert nearest_to(hand_sightings(CAMERA, frame), PALM) < 0.06


def test_the_edge_of_a_hand_is_wide_enough_where_nothing_is_wider():
    thin = np.full((120, 160), 1.9, np.float32)
    thin[46:55, 76:105] = 0.6  # 27 x 87 mm
    assert nearest_to(hand_sightings(CAMERA, thin), PALM) < 0.05
    assert nearest_to(hand_sightings(CAMERA, with_palm(thin, row=90)), PALM) > 0.1


@pytest.mark.parametrize("value", [np.nan, 2.5, 0.05])
def test_nothing_within_reach_is_no_hand(value):
    assert hand_sightings(CAMERA, np.full((120, 160), value, np.float32)) == []


def test_a_unit_that_cannot_be_metres_is_noticed():
    frame = with_palm(np.full((120, 160), 1.9, np.float32))
    assert check_unit(frame) is None
    assert check_unit(blank()) is None
    assert "is the unit of depth right?" in check_unit(10 * frame)
    with pytest.raises(ValueError, match=r"depth must be in metres: no reading is beyond 0\.19 m"):
        check_unit(frame / 10)
