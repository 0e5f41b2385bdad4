"""Conditions of hands in depth images: surroundings against plain geometry, and what counts as wrong."""

import math

import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import hand_conditions as conditions
from jaxfilters.benchmarks.scenarios._real_hands import WALL_M, HandRecording, load
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth.tracker import DOUBTFUL, LOST, SEARCHING, TRACKING

CAMERA = Pinhole.from_intrinsics(100.0, (40.0, 30.0), (60, 80))


@pytest.fixture
def square(monkeypatch):
    """A square of 20 pixels at the distance that is asked for stands in for the motion; also where it is moved to."""

    def loaded(name, num_frames, *, every=1, palm_at_m=None, wall_m=WALL_M):
        places = np.zeros((num_frames, 3)) if palm_at_m is None else palm_at_m(np.full((num_frames, 3), 0.6))
        depth = np.full((num_frames, *CAMERA.shape), wall_m, np.float32)
        depth[:, 20:40, 30:50] = places[:, 2, None, None]
        times = np.arange(num_frames, dtype=np.float32) * every / 30
        return HandRecording(CAMERA, times, depth, np.repeat(places[:, None], 21, axis=1), 1.0)

    monkeypatch.setattr(conditions, "load", loaded)
    return loaded


def test_a_plane_keeps_its_margin_and_its_slope(square):
    margin, normal = 0.06, np.array([0.0, 0.5, math.sqrt(0.75)])
    depth = conditions.CASES["desk_behind"]("any", 3).depth[0]
    rays = conditions.rays(CAMERA)
    np.testing.assert_allclose(rays[30, 90 - 40], [0.1, 0.0, 1.0])
    hand = np.abs(depth - conditions.USUAL) < 1e-6
    assert hand.sum() == 400
    # The reading of the hand that is farthest along the normal: its lowest row.
    furthest = conditions.USUAL * (0.5 * (39 - 30) / 100 + math.sqrt(0.75))
    plane = (depth[..., None] * rays) @ normal
    behind = ~hand & (depth < WALL_M - 0.05)
    assert behind.mean() > 0.5
    np.testing.assert_allclose(plane[behind], furthest + margin, atol=6 * 0.0015 + 0.001)
    wall = conditions.CASES["wall_behind"]("any", 3).depth[0]
    np.testing.assert_allclose(wall[~hand], conditions.USUAL + 0.04, atol=6 * 0.0015 + 0.001)
    level = conditions.CASES["desk_nearer"]("any", 3).depth[0]
    np.testing.assert_allclose(level[-1], (0.5 * 0.09 + 0.02) / 0.29, atol=6 * 0.0015 + 0.001)  # height over slope
    np.testing.assert_allclose(level[:20], WALL_M)


def test_a_body_is_a_cylinder_beside_the_hand_and_nearer(square):
    depth = conditions.beside_body("any", 2).depth[0]
    body = depth < conditions.BESIDE_BODY - 0.02
    columns = np.flatnonzero(body.any(axis=0))
    assert columns[-1] in (30 - conditions.BODY_GAP_PX - 1, 30 - conditions.BODY_GAP_PX)
    z = depth[body]
    x = (conditions.rays(CAMERA)[..., 0] * depth)[body]
    # Of a circle through three of its points, whatever the benchmark calculates: all others lie on it.
    middle = math.atan(-0.3) - math.asin(conditions.BODY_RADIUS / conditions.BODY_DISTANCE)
    away = np.hypot(x - conditions.BODY_DISTANCE * math.sin(middle), z - conditions.BODY_DISTANCE * math.cos(middle))
    np.testing.assert_allclose(away, conditions.BODY_RADIUS, atol=6 * 0.0015 + 0.001)
    assert (depth[20:40, 30:50] == np.float32(conditions.BESIDE_BODY)).all()


def test_holes_and_dropped_frames_leave_what_they_say(square):
    missing = np.isnan(conditions.with_holes("any", 24).depth)
    assert missing.mean() == pytest.approx(1 - (1 - conditions.HOLES) ** 17, abs=0.01)  # a disc has 17 pixels
    assert (missing[0] != missing[1]).any()
    dropped = conditions.with_dropped_frames("any", 24)
    frames = np.rint(dropped.times_s * 15).astype(int)
    assert len(frames) == 24 == len(dropped.depth) == len(dropped.joints)
    assert set(frames) < set(range(36))
    assert (np.diff(frames) > 0).all()
    assert np.diff(frames).max() > 1


def test_a_hand_that_leaves_is_out_of_the_image_for_a_while_and_comes_back(square):
    found = conditions.leaving("any", conditions.NUM_FRAMES)
    aside = found.joints[:, 0, 0]
    assert len(aside) == conditions.LEAVING_NUM_FRAMES
    assert (aside[0], aside[22], aside[-1]) == pytest.approx((0.0, 0.5, 0.0))
    count = conditions.num_in_image(CAMERA, found.joints)  # 0.5 m are 100 pixels
    np.testing.assert_array_equal(count, np.where(100 * aside / 0.5 + 40 < 79.5, 21, 0))
    assert 12 < np.sum(count == 0) < 26


def test_what_is_far_off_without_a_doubt_is_wrong_and_so_is_a_hand_that_is_not_there():
    error = np.array([5.0, 30.0, 30.0, np.nan, np.nan, np.nan, np.nan])
    status = np.array([TRACKING, TRACKING, DOUBTFUL, SEARCHING, TRACKING, LOST, TRACKING])
    joints = np.array([21, 21, 21, 21, 0, 0, 7])  # the last frame shows a part of the hand and does not count
    found = conditions.metrics_of([conditions.Outcome(error, status, joints)], "case")
    assert found["error_mm_case"].value == pytest.approx((5 + 30 + 30 + conditions.MISSING_MM) / 4)
    assert found["wrong_case"].value == pytest.approx(100 * 2 / 6)


@pytest.mark.data
def test_a_motion_is_moved_as_a_whole_to_where_its_palm_is_to_be(data_dir):
    del data_dir
    plain, moved = load("03_R", 2), conditions.at_distance(0.9, "03_R", 2)
    offset = moved.joints - plain.joints
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0, 0], offset.shape), atol=1e-9)
    palm = moved.joints[:, [0, 5, 9, 17]].mean(axis=(0, 1))
    np.testing.assert_allclose(palm, [0.0, 0.0, 0.9], atol=1e-9)
    # The skin that is rendered moves with the joints: as much nearer than the middle of the palm as before.
    nearest = [each.depth.min(axis=(1, 2)) - each.joints[..., 2].mean(axis=1) for each in (plain, moved)]
    np.testing.assert_allclose(nearest[0], nearest[1], atol=0.006)
