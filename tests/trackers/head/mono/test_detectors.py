"""Landmarks of MediaPipe's mesh as the 68, on a mesh that is told and, where it is installed, on a face."""

import importlib.util

import cv2
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import EYES, FROM_68
from jaxfilters.models.face.mirroring import PAIRS_68
from jaxfilters.trackers.head.common.corners import eye_centers
from jaxfilters.trackers.head.common.mesh import MeshDetector
from jaxfilters.trackers.head.mono import detectors as module
from jaxfilters.trackers.head.mono.detectors import (
    CHIN,
    DETECTORS,
    IRISES,
    LOOKS,
    MESH_68,
    CascadeDetector,
    MeshLandmarks,
    best_detector,
)

IMAGE = np.zeros((480, 640), np.uint8)
SHIFTS = np.array([(0, 0), (11, 5), (-17, 9), (23, -14), (-30, -21), (37, 26)])
"""Pixels, u and v."""


def test_vertices_become_landmarks(monkeypatch):
    mesh = np.random.default_rng(0).uniform(0, 400, (478, 2))

    detector = detector_of(monkeypatch, lambda image: [solid(mesh)] if image.any() else [])
    assert detector.detect(IMAGE, None) == "no face"
    observed = detector.detect(IMAGE + np.uint8(1), None)
    assert observed.num_faces == 1
    assert np.flatnonzero(np.isnan(observed.dense[:, 0])).tolist() == [k for k in range(17) if k != CHIN]
    np.testing.assert_array_equal(observed.dense[30], mesh[4])
    np.testing.assert_allclose(observed.dense[31], (mesh[97] + mesh[98]) / 2)
    np.testing.assert_array_equal(observed.points, observed.dense[list(FROM_68)])
    assert observed.iris_px[1] == np.linalg.norm(mesh[474] - mesh[476])


def test_of_two_faces_the_nearest_or_largest_is_taken(monkeypatch):
    small = np.random.default_rng(0).uniform(0, 100, (478, 2))
    large = np.random.default_rng(1).uniform(200, 400, (478, 2))
    looked = []
    detector = detector_of(monkeypatch, lambda image: [solid(small), solid(large)], looked)
    alone, beside = detector.detect(IMAGE, None), detector.detect(IMAGE, np.array([60.0, 60.0]))
    assert alone.num_faces == beside.num_faces == 2
    np.testing.assert_array_equal(alone.dense[30], large[4])
    np.testing.assert_array_equal(beside.dense[30], small[4])
    np.testing.assert_array_equal(beside.solid, solid(small))
    np.testing.assert_array_equal(detector.glance(IMAGE, np.array([60.0, 60.0]), 200.0), solid(small))
    assert looked == [LOOKS, LOOKS, 1]
    assert detector_of(monkeypatch, lambda image: []).glance(IMAGE, np.zeros(2), 200.0) is None


def test_the_mesh_is_the_default_where_it_can_be_loaded(monkeypatch):
    detector_of(monkeypatch, lambda image: [])
    assert isinstance(best_detector()[1], MeshLandmarks)
    assert best_detector()[0] == "mediapipe"

    def missing(**options):
        raise ImportError("not installed")

    monkeypatch.setattr(module, "MeshDetector", missing)
    assert isinstance(best_detector()[1], CascadeDetector)
    assert best_detector()[0] == "cascades"


def detector_of(monkeypatch, solids, looked=None):
    """The detector on a mesh whose faces in an image are those of a function; `looked` has the looks at each image."""
    looked = [] if looked is None else looked

    class FakeMesh:
        def __init__(self, *, refined, most_faces, looks=1):
            assert refined
            assert most_faces > 1
            self.looks = looks

        def solids(self, image):
            looked.append(self.looks)
            return solids(image)

    monkeypatch.setattr(module, "MeshDetector", FakeMesh)
    return DETECTORS["mediapipe"]()


def solid(mesh):
    """The mesh in a plane."""
    return np.pad(mesh, ((0, 0), (0, 1)))


def test_no_vertex_is_two_landmarks_of_one_side():
    assert len(MESH_68) == 68
    for right, left in PAIRS_68:
        assert len(MESH_68[right]) == len(MESH_68[left])
        assert not set(MESH_68[right]) & set(MESH_68[left])
    single = [vertices for vertices in MESH_68 if len(vertices) == 1]
    assert len(set(single)) == len(single)
    assert all(0 <= vertex < 478 for vertices in (*MESH_68, *IRISES) for vertex in vertices)


@pytest.mark.system
def test_landmarks_move_with_the_image(data_dir):
    """Of an image that is shifted by whole pixels: one look's are wrong with the box, which is not shifted alike."""
    if importlib.util.find_spec("mediapipe") is None:
        pytest.skip("mediapipe is not installed: `pip install jaxfilters[mediapipe]`")
    read, image = cv2.VideoCapture(str(data_dir / "talking_face_video" / "franck.mp4")).read()
    if not read:
        pytest.skip("JAXFILTERS_DATA has no talking_face_video")
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    rows, cols = grey.shape

    def apart(detector):
        """By how much landmarks of shifted images differ from shifted landmarks, pixels, root mean square."""
        padded = np.pad(grey, 40, mode="edge")
        shifted = [padded[40 - v :, 40 - u :][:rows, :cols] for u, v in SHIFTS]
        found = np.stack([detector.solid(np.ascontiguousarray(one))[:, :2] for one in shifted])
        return np.sqrt(np.mean(np.var(found - SHIFTS[:, None], axis=0)))

    once, again = (apart(MeshDetector(refined=True, looks=looks)) for looks in (1, LOOKS))
    assert again < 0.6 * once


@pytest.mark.system
def test_the_mesh_is_where_the_cascades_see_a_face(data_dir):
    if importlib.util.find_spec("mediapipe") is None:
        pytest.skip("mediapipe is not installed: `pip install jaxfilters[mediapipe]`")
    video = cv2.VideoCapture(str(data_dir / "talking_face_video" / "franck.mp4"))
    read, image = video.read()
    if not read:
        pytest.skip("JAXFILTERS_DATA has no talking_face_video")
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    mesh, corners = MeshLandmarks().detect(grey, None), CascadeDetector().detect(grey, None)
    right, left = eye_centers(corners.points[:6])
    apart = np.linalg.norm(left - right)
    # Corners of eyes and mouth are the same in both; people's irises are a fifth of the way between their eyes wide.
    np.testing.assert_allclose(mesh.points[list(EYES)], corners.points[list(EYES)], atol=0.12 * apart)
    assert np.all((mesh.iris_px > 0.14 * apart) & (mesh.iris_px < 0.24 * apart))
    middle, up = (right + left) / 2, np.array([0.0, -1.0])
    across = (left - right) / apart
    for k, other in PAIRS_68:
        if np.isfinite(mesh.dense[[k, other]]).all():
            assert (mesh.dense[other] - mesh.dense[k]) @ across > 0
    assert (mesh.dense[CHIN] - middle) @ up < -1.2 * apart
