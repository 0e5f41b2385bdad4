"""Gathering detections: spaced in time, of one face, symmetric, not stale."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxfilters.models.face.landmarks import FROM_68, MEAN_SHAPE
from jaxfilters.trackers.head.mono import detectors as module
from jaxfilters.trackers.head.mono.detections import APART_S, STALE_S, Collector
from jaxfilters.trackers.head.mono.detectors import CHIN, MESH_SHARE, DetectedFace
from jaxfilters.trackers.head.mono.start import is_symmetric
from jaxfilters.trackers.head.mono.state import NUM_FRAMES
from jaxfilters.trackers.head.stereo.session import check_points

IMAGE = np.zeros((480, 640), np.uint8)
FACE = 320 + MEAN_SHAPE[:, :2]


@pytest.fixture
def observed(monkeypatch):
    """What the detector says; changed by tests."""
    says = SimpleNamespace(points=FACE, completed=True, faces=1)

    def detect(image, near=None):
        says.near = near
        return None if says.points is None else SimpleNamespace(points=says.points[:6], num_faces=says.faces)

    monkeypatch.setattr(module, "detect", detect)
    monkeypatch.setattr(module, "complete", lambda image, six: says.points if says.completed else None)
    return says


def gather(collector, times):
    return [collector.update(IMAGE, time) for time in times]


def test_enough_detections_apart_in_time_make_a_start(observed):
    collector = Collector()
    found = gather(collector, np.arange(60) / 30)
    first = next(i for i, one in enumerate(found) if one is not None)
    assert first / 30 == pytest.approx((NUM_FRAMES - 1) * APART_S, abs=0.05)
    assert found[first].points.shape == (NUM_FRAMES, 10, 2)
    assert found[first].images.shape == (NUM_FRAMES, 480, 640)
    assert found[first].time == first / 30
    # And then anew.
    assert all(one is None for one in found[first + 1 : 2 * first])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (dict(points=None), "no face"),
        (dict(completed=False), "nostrils or brows"),
        (dict(points=FACE + np.where(np.arange(10) == 7, 25.0, 0)[:, None] * [0, 1]), "left and right"),
    ],
)
def test_what_is_wrong_is_said(observed, change, reason):
    observed.__dict__.update(change)
    collector = Collector()
    assert collector.update(IMAGE, 0.0) is None
    assert reason in collector.reason


def test_several_faces_are_counted_and_the_one_of_before_is_asked_for(observed):
    observed.faces = 3
    collector = Collector()
    collector.update(IMAGE, 0.0)
    assert collector.several == 3
    assert collector.reason == ""
    collector.update(IMAGE, 1.0)
    np.testing.assert_allclose(observed.near, FACE.mean(axis=0))


def test_another_face_begins_anew(observed):
    collector = Collector()
    gather(collector, np.arange(NUM_FRAMES - 1) * APART_S * 1.01)
    observed.points = FACE + np.array([250.0, 0.0])
    assert collector.update(IMAGE, 2.0) is None
    found = gather(collector, 2.0 + np.arange(1, NUM_FRAMES) * APART_S * 1.01)
    assert found[-1] is not None
    np.testing.assert_allclose(found[-1].points, np.tile(observed.points, (NUM_FRAMES, 1, 1)))


def test_old_detections_do_not_count(observed):
    collector = Collector()
    gather(collector, np.arange(NUM_FRAMES - 1) * APART_S * 1.01)
    assert collector.update(IMAGE, STALE_S + 10) is None


class Mesh:
    """A detector that sees the face where it is told, 68 landmarks and irises with it."""

    errors = None
    is_averaged = True
    facing_std = None

    def __init__(self, dense):
        self.dense = dense

    def detect(self, image, near, apart_px=None):
        return DetectedFace(FACE, 1, self.dense, np.array([11.0, 12.0]))


def test_more_landmarks_are_kept_with_what_is_not_seen_of_them():
    dense = np.tile(FACE.mean(axis=0), (68, 1))
    dense[list(FROM_68)] = FACE
    dense[:8] = np.nan
    found = gather(Collector(Mesh(dense)), np.arange(NUM_FRAMES) * 1.01 * APART_S)[-1]
    np.testing.assert_array_equal(found.dense.observed, np.tile(np.arange(68) >= 8, (NUM_FRAMES, 1)))
    np.testing.assert_array_equal(found.dense.uv[:, 8:], np.tile(dense[8:], (NUM_FRAMES, 1, 1)))
    apart = np.linalg.norm(FACE[2:4].mean(axis=0) - FACE[:2].mean(axis=0))
    std_px = np.sqrt(found.dense.covariance[:, :, [0, 1], [0, 1]])
    np.testing.assert_allclose(
        std_px[:, [20, CHIN]], np.array([1, 2])[:, None] * MESH_SHARE * apart * np.ones((5, 2, 2))
    )
    np.testing.assert_array_equal(found.iris_px, np.tile([11.0, 12.0], (NUM_FRAMES, 1)))


def test_68_given_points_are_the_ten_and_all():
    points = np.random.default_rng(0).uniform(100, 300, (68, 2))
    found = Collector().given(points, IMAGE, 3.0)
    np.testing.assert_array_equal(found.points[2], points[list(FROM_68)])
    np.testing.assert_array_equal(found.dense.uv[4], points)
    # The same frame five times tells as much as once.
    np.testing.assert_allclose(found.dense.covariance, NUM_FRAMES * np.tile(np.eye(2), (NUM_FRAMES, 68, 1, 1)))
    assert found.dense.misplaced_mm == 0


def test_given_points_are_a_start_of_their_own():
    found = Collector().given(FACE, IMAGE, 3.0)
    np.testing.assert_array_equal(found.points[0], FACE)
    assert found.time == 3.0
    assert len(found.points) == NUM_FRAMES
    assert found.std_px == pytest.approx(np.sqrt(NUM_FRAMES))


@pytest.mark.parametrize("points", [np.zeros((9, 2)), np.full((10, 2), np.nan)])
def test_points_that_are_none_are_refused(points):
    with pytest.raises(ValueError, match="points must be"):
        check_points(points)


def test_a_turned_or_tilted_face_is_symmetric_and_a_mistaken_one_is_not():
    from scipy.spatial.transform import Rotation

    for angles in [(0, 25, 0), (20, 0, 0), (10, 20, 10)]:
        turned = MEAN_SHAPE @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix().T + [0, 0, 650]
        assert is_symmetric(800 * turned[:, :2] / turned[:, 2:])
    wrong = FACE.copy()
    wrong[5] += [0, 15]
    assert not is_symmetric(wrong)
