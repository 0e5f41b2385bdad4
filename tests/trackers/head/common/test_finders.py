"""Finders of the landmarks, on a drawn face and on what a face mesh might say."""

import numpy as np
import pytest

from jaxfilters.trackers.configuration import settings_of
from jaxfilters.trackers.head.common import finders as module
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.detect import STABLE_FRAMES
from jaxfilters.trackers.head.common.finders import FINDERS, MOST_MOVED_PX, CascadeFinder, MeshFinder
from jaxfilters.trackers.head.common.mesh import VERTICES

IMAGE = np.zeros((480, 640), np.uint8)


@pytest.fixture
def mesh(monkeypatch):
    """A finder, and a function that makes an image in which its mesh has the faces with these landmarks."""
    faces = {0: []}

    class Mesh:
        def __init__(self, *, most_faces):
            assert most_faces > 1

        def solids(self, image):
            return faces[int(image[0, 0])] if image.shape == IMAGE.shape else []

    def shows(*landmarks):
        level = len(faces)
        faces[level] = [solid(points) for points in landmarks]
        return IMAGE + np.uint8(level)

    monkeypatch.setattr(module, "MeshDetector", Mesh)
    return MeshFinder(), shows


def solid(points):
    """A mesh with these landmarks."""
    vertices = np.pad(np.tile(points.mean(axis=0), (478, 1)), ((0, 0), (0, 1)))
    for point, of_landmark in zip(points, VERTICES, strict=True):
        vertices[list(of_landmark), :2] = point
    return vertices


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
    found = CascadeFinder().glance(image, points.mean(axis=0), 70.0)
    assert np.linalg.norm(found - points, axis=1).max() < 0.15 * 70
    assert CascadeFinder().glance(IMAGE, points.mean(axis=0), 70.0) is None
    both = np.maximum(image, draw_face((110, 330), 50.0)[0])
    found = CascadeFinder().glance(both, np.array([110.0, 330.0]), 50.0)
    assert np.linalg.norm(found.mean(axis=0) - [110, 330]) < 40
    finder, shows = mesh
    other = points - np.array([200.0, 0.0])
    for first, second in ((points, other), (other, points)):
        found = finder.glance(shows(first, second), other.mean(axis=0), 70.0)
        np.testing.assert_allclose(found, other)
    assert finder.glance(IMAGE, np.zeros(2), 70.0) is None


def test_the_mesh_waits_for_a_face_that_holds_still(mesh, draw_face):
    finder, shows = mesh
    points = draw_face((330, 220), 70.0)[1]
    step = np.array([0.9 * MOST_MOVED_PX, 0.0])
    found = [finder.find(shows(points + i * step)) for i in range(STABLE_FRAMES)]
    assert all(one is None for one in found[:-1])
    np.testing.assert_allclose(found[-1], points + (STABLE_FRAMES - 1) * step)
    assert [finder.find(image) for image in (shows(points + 50), IMAGE, shows(points))] == [None] * 3


def test_of_several_meshes_the_largest_is_waited_for_and_followed(mesh, draw_face):
    finder, shows = mesh
    large, small = draw_face((430, 220), 90.0)[1], draw_face((130, 220), 60.0)[1]
    finder.find(shows(small, large))
    assert finder.complaints == ["2 faces; the largest is taken"]
    # The other one comes nearer.
    grown = draw_face((130, 220), 120.0)[1]
    found = [finder.find(shows(grown, large)) for _ in range(STABLE_FRAMES - 1)]
    np.testing.assert_allclose(found[-1], large)


def test_a_near_face_may_move_by_as_large_a_share_of_itself(mesh, draw_face):
    """Noise of a mesh grows with the face: 3 px of 160 between the eyes are stillness, 3 px of 70 are none."""
    finder, shows = mesh
    for distance, is_found in ((160.0, True), (70.0, False)):
        points = draw_face((330, 220), distance)[1]
        found = [finder.find(shows(points + np.array([3.0 * (i % 2), 0.0]))) for i in range(STABLE_FRAMES)]
        assert (found[-1] is not None) is is_found
        finder.reset()


def test_the_mesh_says_why_there_is_no_face(mesh, draw_face):
    finder, shows = mesh
    assert finder.find(IMAGE) is None
    assert finder.complaints == ["no face"]
    assert finder.find(shows(draw_face((330, 220), 70.0, roll=np.radians(17))[1])) is None
    assert finder.complaints == ["the head is tilted"]
