"""Faces in parts of an image, by a mesh that finds only faces that are large and whole in what it is given."""

import importlib.util

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.head.common.image_position import EYES_APART_MM
from jaxfilters.trackers.head.common.mesh_crops import eyes_px, nearest, solids_about, solids_anywhere
from jaxfilters.trackers.head.mono.detectors import MeshLandmarks

ROWS, COLS = 480, 640
LEAST_SHARE = 0.07
"""Of the width of an image, which the eyes of a face that is found are apart."""
CORNERS = np.array([(33, -45.0), (133, -17.0), (362, 17.0), (263, 45.0)])
"""Vertices at the corners of the eyes, and their places across a face, millimetres: 62 between the eyes."""


class Faces:
    """A detector of faces whose images are one bright pixel each in their middle, of grey level 100 + eyes' distance.

    It finds a face that is large enough, and half of one, at a wrong place, where the border of the image cuts it.
    """

    def __init__(self):
        self.num_images = 0

    def solids(self, image):
        self.num_images += 1
        found = []
        for v, u in np.argwhere(image > 0):
            apart = float(image[v, u]) - 100
            if apart < LEAST_SHARE * image.shape[1]:
                continue
            is_cut = min(u, v, image.shape[1] - u, image.shape[0] - v) < apart
            found.append(face(u + (apart if is_cut else 0.0), v, apart))
        return found


def face(u, v, apart):
    solid = np.tile([u, v, 0.0], (468, 1))
    solid[CORNERS[:, 0].astype(int), 0] = u + apart / EYES_APART_MM * CORNERS[:, 1]
    return solid


def image_of(*faces):
    image = np.zeros((ROWS, COLS), np.uint8)
    for u, v, apart in faces:
        image[v, u] = 100 + apart
    return image


def test_a_small_face_is_found_wherever_it_is_and_once():
    places = [(u, v, 25) for u in range(30, COLS - 30, 45) for v in range(30, ROWS - 30, 41)]
    assert not any(Faces().solids(image_of(one)) for one in places)
    for u, v, apart in places:
        found = solids_anywhere(Faces(), image_of((u, v, apart)))
        assert len(found) == 1
        np.testing.assert_allclose(found[0], face(u, v, apart))
    assert eyes_px(face(100.0, 100.0, 25)) == pytest.approx(25)
    both = solids_anywhere(Faces(), image_of((100, 100, 25), (400, 300, 40)))
    assert [round(eyes_px(one)) for one in both] == [40, 25]


def test_an_image_with_a_large_face_or_none_has_no_more_of_them_for_its_parts():
    meshes = Faces()
    large = (300, 200, 90)
    np.testing.assert_array_equal(solids_anywhere(meshes, image_of(large, (100, 100, 25))), [face(*large)])
    assert meshes.num_images == 1
    assert solids_anywhere(meshes, image_of()) == []

    class Imagining(Faces):
        """One in the middle of each part of half the size, which is not there in other parts."""

        def solids(self, image):
            return [face(160, 120, 30)] if image.shape == (ROWS // 2, COLS // 2) else super().solids(image)

    assert solids_anywhere(Imagining(), image_of()) == []


def test_about_its_place_a_face_is_large_and_another_one_is_left_out():
    image = image_of((600, 240, 12), (300, 240, 50))
    alone = solids_about(Faces(), image, np.array([595.0, 243.0]), 12.5)
    np.testing.assert_array_equal(alone, [face(600, 240, 12)])
    # The whole image is taken once, where the part would be most of it, has no place, no face or no size.
    elsewhere = (([595.0, 243.0], 80.0), ([np.nan, np.nan], 12.5), ([100.0, 100.0], 12.5), ([595.0, 243.0], None))
    for middle, apart in elsewhere:
        meshes = Faces()
        np.testing.assert_array_equal(solids_about(meshes, image, np.array(middle), apart), [face(300, 240, 50)])
        assert meshes.num_images == 1 + (middle[0] == 100.0)
    faces = [face(100, 100, 60), face(200, 100, 20)]
    assert nearest(faces, np.array([160.0, 100.0])) is faces[1]


@pytest.mark.system
@pytest.mark.data
def test_a_real_face_is_found_that_is_too_small_in_the_whole_image(data_dir):
    """A photograph made smaller on a plain image; its landmarks are those of the large one, made smaller."""
    if importlib.util.find_spec("mediapipe") is None:
        pytest.skip("mediapipe is not installed: `pip install jaxfilters[mediapipe]`")
    grey = cv2.cvtColor(cv2.VideoCapture(str(data_dir / "talking_face_video" / "franck.mp4")).read()[1], 6)
    detector = MeshLandmarks()
    truth = detector.detect(grey, None)
    scale = 20 / eyes_px(truth.solid)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    corner = np.array([380, 310])
    beyond = (COLS - corner[0] - small.shape[1], ROWS - corner[1] - small.shape[0])
    image = cv2.copyMakeBorder(small, corner[1], beyond[1], corner[0], beyond[0], cv2.BORDER_REPLICATE)
    due = (truth.points + 0.5) * scale - 0.5 + corner
    for found in (detector.detect(image, None), detector.detect(image, due.mean(axis=0), 22.0)):
        assert np.median(np.linalg.norm(found.points - due, axis=1)) < 0.05 * 20
    assert not detector.detect(image, None).num_faces > 1
