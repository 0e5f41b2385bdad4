"""Finders of the landmarks, on a drawn face and on what a face mesh might say."""

import numpy as np
import pytest

from jaxfilters.trackers.configuration import settings_of
from jaxfilters.trackers.head.common import finders as module
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.detect import STABLE_FRAMES
from jaxfilters.trackers.head.common.finders import FINDERS, MOST_MOVED_PX, CascadeFinder, MeshFinder


@pytest.fixture
def mesh(monkeypatch):
    """A finder whose mesh gives the answers of a list, one after another."""
    answers = []

    class FrameInformation:
        def detect(self, image):
            return answers.pop(0)

    monkeypatch.setattr(module, "MeshDetector", FrameInformation)
    return MeshFinder(), answers


IMAGE = np.zeros((480, 640), np.uint8)


def test_every_choice_has_a_finder():
    assert tuple(FINDERS) == settings_of(HeadConfig)["detector"].choices


def test_the_cascades_wait_for_a_face_that_holds_still_and_complete_it(draw_face):
    image, points = draw_face((330, 220), 70.0)
    finder = CascadeFinder()
    found = [finder.find(image) for _ in range(STABLE_FRAMES)]
    assert all(one is None for one in found[:-1])
    assert finder.complaints == []
    assert np.linalg.norm(found[-1] - points, axis=1).max() < 0.15 * 70
    finder.reset()
    assert finder.find(image) is None
    assert finder.find(IMAGE) is None
    assert finder.complaints == ["no face"]


def test_a_glance_does_not_wait(mesh, draw_face):
    image, points = draw_face((330, 220), 70.0)
    found = CascadeFinder().glance(image, points.mean(axis=0))
    assert np.linalg.norm(found - points, axis=1).max() < 0.15 * 70
    assert CascadeFinder().glance(IMAGE, points.mean(axis=0)) is None
    both = np.maximum(image, draw_face((110, 330), 50.0)[0])
    assert np.linalg.norm(CascadeFinder().glance(both, np.array([110.0, 330.0])).mean(axis=0) - [110, 330]) < 40
    finder, answers = mesh
    answers += [points, None]
    np.testing.assert_array_equal(finder.glance(IMAGE, np.zeros(2)), points)
    assert finder.glance(IMAGE, np.zeros(2)) is None


def test_the_mesh_waits_for_a_face_that_holds_still(mesh, draw_face):
    finder, answers = mesh
    points = draw_face((330, 220), 70.0)[1]
    step = np.array([0.9 * MOST_MOVED_PX, 0.0])
    answers += [points + i * step for i in range(STABLE_FRAMES)]
    found = [finder.find(IMAGE) for _ in range(STABLE_FRAMES)]
    assert all(one is None for one in found[:-1])
    np.testing.assert_array_equal(found[-1], points + (STABLE_FRAMES - 1) * step)
    answers += [points + 50, None, points]
    assert [finder.find(IMAGE) for _ in range(3)] == [None] * 3


def test_a_near_face_may_move_by_as_large_a_share_of_itself(mesh, draw_face):
    """Noise of a mesh grows with the face: 3 px of 160 between the eyes are stillness, 3 px of 70 are none."""
    finder, answers = mesh
    for distance, is_found in ((160.0, True), (70.0, False)):
        points = draw_face((330, 220), distance)[1]
        answers += [points + np.array([3.0 * (i % 2), 0.0]) for i in range(STABLE_FRAMES)]
        found = [finder.find(IMAGE) for _ in range(STABLE_FRAMES)]
        assert (found[-1] is not None) is is_found
        finder.reset()


def test_the_mesh_says_why_there_is_no_face(mesh, draw_face):
    finder, answers = mesh
    answers += [None, draw_face((330, 220), 70.0, roll=np.radians(17))[1]]
    assert finder.find(IMAGE) is None
    assert finder.complaints == ["no face"]
    assert finder.find(IMAGE) is None
    assert finder.complaints == ["the head is tilted"]
