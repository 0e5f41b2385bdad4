from itertools import pairwise

import cv2
import numpy as np
import pytest

from jaxfilters.models.face.rig import nominal
from jaxfilters.trackers.head.common.drawing import AXIS_COLORS, HEAD_STATUS_COLORS, draw_frame
from jaxfilters.trackers.head.common.summary import draw_modes, draw_summary, status_shades, write_summary
from jaxfilters.trackers.head.common.table import TABLE_STATUS
from jaxfilters.trackers.io.errors import OutputError

RIG = nominal()
PAPER = np.full((480, 640, 3), 90, np.uint8)


def count(picture, color, distance=40):
    """Pixels of about a colour."""
    return int((np.abs(picture.astype(int) - color).sum(axis=-1) < distance).sum())


@pytest.mark.system
def test_both_cameras_show_axes_and_landmarks_where_they_are(face_track):
    track, _ = face_track
    picture = draw_frame([PAPER, PAPER], RIG, track, 10)
    assert picture.shape == (480, 1280, 3)
    for camera in range(2):
        half = picture[:, 640 * camera : 640 * (camera + 1)]
        for u, v in track.image_points[10, camera]:
            assert half[round(v), round(u)].min() > 200
        place = RIG.project(1000 * track.pose[10:11, :3] + np.float32([[25, 0, 0]]))[0]
        for color in AXIS_COLORS:
            assert count(half, color) > 30
        # The face is turned by a few degrees: half of the first axis is where it points in the image, to 5 px.
        u, v = np.asarray(place)[camera, 0].round().astype(int)
        assert count(half[v - 6 : v + 7, u - 6 : u + 7], AXIS_COLORS[0]) > 0
    assert (PAPER == 90).all()


def test_nothing_is_drawn_of_a_head_that_is_not_tracked(face_track):
    track, _ = face_track
    for i in (0, 20, 31):
        picture = draw_frame([PAPER, PAPER], RIG, track, i)
        assert (picture[100:] == 90).all()
        assert count(picture, HEAD_STATUS_COLORS[track.status[i]]) > 20


def test_an_angle_that_rounds_to_zero_has_no_sign(face_track):
    track, _ = face_track
    texts = []
    for angle in (1e-5, -1e-5):
        pose = track.pose.copy()
        pose[10, 3:] = angle
        texts.append(draw_frame([PAPER, PAPER], RIG, track._replace(pose=pose), 10)[:100])
    np.testing.assert_array_equal(texts[0], texts[1])
    assert (texts[0] != 90).any()


def test_a_missing_image_is_said(face_track):
    track, _ = face_track
    picture = draw_frame([PAPER, None], RIG, track, 20)
    assert (picture[200:, :640] == 90).all()
    assert (picture[200:, 640:] == 40).all()
    assert count(picture[:, 640:], (190, 190, 190)) > 20


def test_points_behind_a_camera_or_far_off_do_no_harm(face_track):
    track, _ = face_track
    pose = track.pose.copy()
    pose[10, 2] = -0.5
    points = track.image_points.copy()
    points[10, 0, 3] = np.nan
    points[10, 0, 4] = 1e9
    picture = draw_frame([PAPER, PAPER], RIG, track._replace(pose=pose, image_points=points), 10)
    assert sum(count(picture, color) for color in AXIS_COLORS) == 0


def test_the_status_is_the_paper_of_the_charts(face_track):
    track, _ = face_track
    shades = status_shades(track.times_s, track.status)
    assert len(shades) == 7
    assert shades[0].start == 0
    assert shades[-1].end == track.times_s[-1]
    assert all(a.end == b.start for a, b in pairwise(shades))
    np.testing.assert_allclose([shade.start for shade in shades[3:5]], (np.array([20, 21]) - 0.5) / 30)
    assert len({shade.color for shade in shades}) == len(np.unique(track.status)) == len(TABLE_STATUS) - 1
    assert status_shades(np.zeros(1), np.ones(1, int))[0].color == shades[1].color


def test_the_summary_shows_truth_and_modes(face_track, face_model, tmp_path):
    track, truth = face_track
    with_truth, without = draw_summary(track, face_model, truth.poses), draw_summary(track, face_model, None)
    assert with_truth.shape == without.shape == (34 + 4 * 190 + 250, 1200, 3)
    grey = [count(picture[34:600], (150, 150, 150), 12) for picture in (with_truth, without)]
    assert grey[0] > grey[1] + 200
    assert count(without, status_shades(track.times_s, track.status)[2].color, 1) > 100_000
    write_summary(tmp_path / "s.png", track, face_model, truth.poses)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "s.png")), with_truth)
    with pytest.raises(OutputError, match="cannot write"):
        write_summary(tmp_path / "none" / "s.png", track, face_model, None)


def test_modes_are_drawn_as_far_apart_as_they_are(face_model):
    """Two of five modes are learnt: three cells stay empty; with twice the deviation the faces are farther apart."""
    sheet = draw_modes(face_model)
    assert (sheet[60:, 480:] == 255).all()
    red = np.nonzero(np.abs(sheet[60:, :150].astype(int) - (70, 70, 215)).sum(axis=-1) < 40)
    wider = np.asarray(draw_modes(type(face_model)(face_model.mean, face_model.basis, 2 * face_model.deviation, None)))
    red_wider = np.nonzero(np.abs(wider[60:, :150].astype(int) - (70, 70, 215)).sum(axis=-1) < 40)
    # The mouth's corners move outwards by 2 x 5 mm / sqrt(2.36) each, at 1.35 px/mm.
    assert np.ptp(red_wider[1]) - np.ptp(red[1]) == pytest.approx(2 * 10 / np.sqrt(2.36) * 1.35, abs=3)
    for model in (None, type(face_model)(face_model.mean, face_model.basis[:, :0], face_model.deviation[:0], None)):
        assert (draw_modes(model)[60:] == 255).all()


def test_a_run_in_which_nothing_was_followed_can_be_drawn(face_track):
    track, _ = face_track
    nothing = {
        name: np.full_like(getattr(track, name), np.nan) for name in ("pose", "pose_std", "deformation", "score")
    }
    picture = draw_summary(track._replace(status=np.zeros_like(track.status), **nothing), None, None)
    assert picture.shape[1] == 1200
    one = type(track)(*(field[:1] for field in track))
    assert draw_summary(one, None, None).shape == picture.shape
