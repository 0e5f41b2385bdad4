"""Faces found by cascades: corners where they are drawn, reasons where there is no start, real video."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import EYES
from jaxfilters.trackers.head.common import corners, detect, mesh
from jaxfilters.trackers.head.common.detect import Detection, StableDetector, complete

ROLLS = [0.0, 0.1, -0.15]


def noisy(image, seed=0):
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("roll", ROLLS)
@pytest.mark.parametrize("distance", [45.0, 70.0])
def test_landmarks_are_where_they_are_drawn(draw_face, roll, distance):
    """Corner strength is largest a little inside the tip of a corner: 3 % of the eyes' distance, 2 mm of a face."""
    image, truth = draw_face((330, 220), distance, roll)
    image = noisy(image)
    found = detect.detect(image)
    assert found is not None
    assert found.num_faces == 1
    ten = complete(image, found.points)
    np.testing.assert_array_equal(ten[:6], found.points)
    assert np.linalg.norm(ten - truth, axis=1).max() < 0.035 * distance


def test_points_move_with_the_face_by_parts_of_a_pixel(draw_face):
    """All but the ends of the brows, which are blunt."""
    steps = np.array([0.0, 0.25, 0.5, 0.75])
    points = []
    for step in steps:
        image, _ = draw_face((330 + step, 220), 60.0)
        points.append(complete(image, detect.detect(image).points)[:8])
    moved = np.array(points) - points[0]
    truth = np.stack([np.tile(steps[:, None], (1, 8)), np.zeros((4, 8))], axis=-1)
    np.testing.assert_allclose(moved, truth, atol=0.4)
    np.testing.assert_allclose(moved.mean(axis=1), truth.mean(axis=1), atol=0.1)


def test_irises_are_no_corners(draw_face):
    """Where their rims are nearer than the corners to the place expected, the corners are found all the same."""
    image, truth = draw_face((330, 220), 70.0)
    to_upright = corners.upright_from(corners.eye_centers(truth))
    upright = corners.warped(image, to_upright, corners.SHAPE)
    strength = corners.corner_strength(upright)
    off = strength * corners.off_the_irises(upright, corners.apply(to_upright, corners.eye_centers(truth)))
    for corner in corners.apply(to_upright, truth[list(EYES)]):
        middle = np.array([72.0 if corner[0] < 120 else 168.0, 80.0])
        due = middle + 0.55 * (corner - middle)
        rim, found = (corners.strongest(s, due, (0.06, 0.04)) for s in (strength, off))
        assert np.linalg.norm(rim - middle) < 0.18 * corners.EYE_DISTANCE
        assert np.linalg.norm(found - corner) < 0.05 * corners.EYE_DISTANCE


def test_of_two_faces_the_larger_one_is_taken_or_the_nearer_one(draw_face):
    image, small = draw_face((480, 220), 45.0)
    large, truth = draw_face((180, 220), 65.0)
    image[:, :320] = large[:, :320]
    found = detect.detect(image)
    assert found.num_faces == 2
    assert np.linalg.norm(found.points - truth[:6], axis=1).max() < 3
    found = detect.detect(image, near=np.array([470.0, 200.0]))
    assert np.linalg.norm(found.points - small[:6], axis=1).max() < 3


def test_what_is_missing_is_named(draw_face):
    waiting = StableDetector()
    assert waiting.update(noisy(np.full((480, 640), 120, np.uint8))) is None
    assert waiting.reason == "no face"
    image, truth = draw_face((330, 220), 70.0)
    image[250:, :] = image[245, 330]
    assert waiting.update(image) is None
    assert waiting.reason != "no frame yet"
    assert detect.detect(image) is None
    assert complete(np.full((480, 640), 120, np.uint8), truth[:6]) is None


def test_a_small_image_holds_no_face():
    assert detect.detect(np.zeros((12, 20), np.uint8)) is None


@pytest.mark.parametrize("image", [np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64))])
def test_only_grey_images_are_taken(image):
    with pytest.raises(ValueError, match="grey"):
        detect._check_grey(image)


def test_six_points_are_needed(draw_face):
    image, truth = draw_face((330, 220), 70.0)
    wrong = truth[:6].copy()
    wrong[0, 0] = np.nan
    with pytest.raises(ValueError, match="six"):
        complete(image, wrong)


def observed(points):
    nothing = np.zeros(4)
    return Detection(points, np.array([100.0, 100, 200, 200]), np.zeros((2, 4)), nothing, 1)


def turned(points, degrees):
    a = math.radians(degrees)
    return points @ np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])


@pytest.fixture
def watch(monkeypatch):
    """A detector that is shown points instead of images."""

    def reasons(sequence):
        waiting, message = StableDetector(), []
        for shown in sequence:
            monkeypatch.setattr(detect, "_search", lambda image, near, shown=shown: shown)
            done = waiting.update(np.zeros((48, 64), np.uint8))
            assert (done is None) == bool(waiting.reason)
            message.append(waiting.reason)
        return message

    return reasons


def test_five_frames_must_agree(draw_face, watch):
    points = draw_face((330, 220), 70.0)[1][:6]
    frames = [points + 1.3 * i for i in range(5)]  # 1.84 px a frame
    assert [bool(reason) for reason in watch(map(observed, frames))] == [True] * 4 + [False]
    frames[3:] = [frame + 2.1 for frame in frames[3:]]
    assert [bool(reason) for reason in watch(map(observed, [*frames, *frames[-1:] * 3]))] == [True] * 7 + [False]
    larger = [3 * frame for frame in [points + 1.3 * i for i in range(5)]]  # eyes 210 px apart: 5.5 px a frame
    assert watch(map(observed, [points + 3.8 * i for i in range(5)]))[-1] != ""
    assert watch(map(observed, larger))[-1] != ""
    assert watch(map(observed, [3 * points + 3.8 * i for i in range(5)]))[-1] == ""


def test_a_face_lost_or_tilted_starts_the_wait_anew(draw_face, watch):
    points = draw_face((330, 220), 70.0)[1][:6]
    still = [observed(points)] * 5
    assert watch([*still[:4], "no face", *still])[4:] == ["no face", *watch(still)]
    assert watch(still)[-1] == ""
    assert "tilted" in watch([observed(turned(points, 15.5))] * 6)[-1]
    assert "tilted" in watch([observed(turned(points, -15.5))] * 6)[-1]
    assert watch([observed(turned(points, 14.5))] * 5)[-1] == ""


def test_the_mesh_says_what_it_needs(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(mesh, "import_module", missing)
    with pytest.raises(ImportError, match="mediapipe"):
        mesh.MeshDetector()


def test_each_look_at_an_image_begins_where_the_last_one_ended_and_none_with_another_image(monkeypatch):
    """A mesh whose landmarks halve their distance from the truth with every look, from 0.4 on in a first one."""

    class Halving:
        def __init__(self, *, static_image_mode, max_num_faces, refine_landmarks):
            self.is_static, self.off = static_image_mode, None

        def reset(self):
            self.off = None

        def process(self, image):
            self.off = 0.4 if self.off is None or self.is_static else self.off / 2
            point = SimpleNamespace(x=0.5 + self.off, y=0.5, z=0.0)
            return SimpleNamespace(multi_face_landmarks=[SimpleNamespace(landmark=[point])] if image.any() else None)

    solutions = SimpleNamespace(face_mesh=SimpleNamespace(FaceMesh=Halving))
    monkeypatch.setattr(mesh, "import_module", lambda name: SimpleNamespace(solutions=solutions))
    image = np.ones((100, 200), np.uint8)
    for looks, off in ((1, 0.4), (2, 0.2), (3, 0.1)):
        detector = mesh.MeshDetector(looks=looks)
        for _ in range(2):
            np.testing.assert_allclose(detector.solid(image), [[200 * (0.5 + off) - 0.5, 49.5, 0.0]])
        assert detector.solid(0 * image) is None


def first_frames(path, count, every):
    capture = cv2.VideoCapture(str(path))
    frames = []
    for _ in range(count * every):
        frames.append(cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2GRAY))
    return frames[::every]


@pytest.mark.system
@pytest.mark.data
@pytest.mark.parametrize(("name", "least"), [("franck", 55), ("cap12_edit", 50)])
def test_a_real_face_is_found_and_has_a_faces_proportions(data_dir, name, least):
    frames = first_frames(data_dir / "talking_face_video" / f"{name}.mp4", 60, 20)
    found = [(image, detect.detect(image)) for image in frames]
    tens = [complete(image, d.points) for image, d in found if d is not None]
    tens = np.array([ten for ten in tens if ten is not None])
    assert len(tens) >= least
    eyes = np.array([corners.eye_centers(ten) for ten in tens])
    distance = np.linalg.norm(eyes[:, 1] - eyes[:, 0], axis=-1)
    widths = np.linalg.norm(tens[:, [1, 3]] - tens[:, [0, 2]], axis=-1) / distance[:, None]
    assert np.all((widths > 0.3) & (widths < 0.6))
    upright = np.array([corners.apply(corners.upright_from(e), ten) for e, ten in zip(eyes, tens, strict=True)])
    down = (upright[:, 4:, 1] - corners.MIDDLE[1]) / corners.EYE_DISTANCE
    share = np.mean((down[:, :2] > 0.9) & (down[:, :2] < 1.6), axis=0)
    assert share.min() > 0.95  # mouth
    assert np.mean((down[:, 2:4] > 0.4) & (down[:, 2:4] < 0.9)) > 0.95  # nostrils
    assert np.mean((down[:, 4:] < -0.1) & (down[:, 4:] > -0.6)) > 0.95  # brows


@pytest.mark.system
@pytest.mark.data
def test_real_video_starts_by_itself(data_dir):
    frames = first_frames(data_dir / "talking_face_video" / "franck.mp4", 60, 1)
    waiting = StableDetector()
    assert any(waiting.update(image) is not None for image in frames)
