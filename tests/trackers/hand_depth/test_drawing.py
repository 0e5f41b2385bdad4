from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.hand_depth.drawing import (
    BONES,
    FINGER_COLORS,
    color_depth,
    depth_range,
    draw_frame,
    draw_skeleton,
    write_overlay,
)
from jaxfilters.trackers.hand_depth.table import TimedHandTrack
from jaxfilters.trackers.io.errors import OutputError


@pytest.fixture
def results(recording):
    """The truth of the recording, as an estimate."""
    frames = len(recording)
    pose = np.concatenate([recording.joints[:, 0], np.ones((frames, 1)), np.zeros((frames, 18))], axis=1)
    return TimedHandTrack(
        recording.times_s,
        pose.astype(np.float32),
        np.full((frames, 21), 0.003, np.float32),
        recording.joints,
        np.zeros((frames, 2), np.int32),
        np.linspace(100, 300, frames, dtype=np.float32),
        np.zeros(frames, np.float32),
        np.arange(frames, dtype=np.int32) % 3,
    )


def test_bones_are_five_chains_from_the_wrist():
    parents = dict((tip, base) for base, tip in BONES)
    assert sorted(parents) == list(range(1, 21))
    for finger in range(5):
        chain = [4 * finger + 4]
        while chain[-1]:
            chain.append(parents[chain[-1]])
        assert chain == [4 * finger + i for i in (4, 3, 2, 1)] + [0]


def test_nearer_is_brighter_and_no_reading_is_black():
    gray = color_depth(np.float32([[0.4, 0.5, 0.6, 5.0, np.nan]]), 0.4, 0.7).sum(axis=-1)[0]
    assert gray[0] > gray[1] > gray[2] > gray[3] > gray[4] == 0


def test_depth_range_holds_the_hand_and_ignores_outliers():
    joints = np.full((100, 21, 3), 0.5)
    joints[0, 0, 2] = 40.0
    joints[1, :, 2] = np.nan
    near, far = depth_range(joints)
    assert near < 0.5 < far < 1


def colored(image):
    """(u, v) of the painted pixels of a picture that was black, weighted by their brightness."""
    weights = image.sum(axis=-1).astype(float)
    v, u = np.indices(weights.shape)
    return np.asarray([(weights * u).sum(), (weights * v).sum()]) / weights.sum()


def test_a_joint_is_drawn_where_the_camera_sees_it(camera):
    """With every joint in one place, the centroid of what is drawn is its projection, in pixels of the large image."""
    scale, point = 20, np.float32([0.12, -0.08, 0.6])
    image = np.zeros((24 * scale, 32 * scale, 3), np.uint8)
    draw_skeleton(image, camera, np.tile(point, (21, 1)), scale)
    u, v = 30 * point[0] / point[2] + 15.25, 31 * point[1] / point[2] + 11.5
    # Pixel (u, v) covers the rows and columns from scale * u to scale * u + scale - 1. The drawing grid is 1/16 pixel.
    np.testing.assert_allclose(colored(image), np.asarray([u, v]) * scale + (scale - 1) / 2, atol=0.2)


def test_fingers_have_their_colours(camera, recording):
    scale = 30
    image = np.zeros((24 * scale, 32 * scale, 3), np.uint8)
    draw_skeleton(image, camera, recording.joints[0], scale)
    for finger, color in enumerate(FINGER_COLORS):
        middle = recording.joints[0, [4 * finger + 3, 4 * finger + 4]].mean(axis=0)
        u, v = (np.asarray(camera.project(middle)) + 0.5) * scale - 0.5
        np.testing.assert_array_equal(image[round(float(v)), round(float(u))], color)


@pytest.mark.parametrize("joint", [(np.nan, 0, 0.5), (0, 0, -0.5), (0, 0, 0), (1e9, 0, 0.5)])
def test_joints_that_cannot_be_seen_are_left_out(camera, recording, joint):
    joints = recording.joints[0].copy()
    joints[8] = joint
    image, without = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640, 3), np.uint8)
    draw_skeleton(image, camera, joints, 20)
    joints[8] = np.nan
    draw_skeleton(without, camera, joints, 20)
    np.testing.assert_array_equal(image, without)
    assert image.any()


def test_the_video_has_every_frame_at_the_pace_of_the_recording(tmp_path, recording, results):
    done = []
    write_overlay(tmp_path / "o.mp4", recording, results, 50.0, done.append)
    assert done == list(range(1, len(recording) + 1))
    video = cv2.VideoCapture(str(tmp_path / "o.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(recording)
    pace = 1 / np.median(np.diff(recording.times_s))
    assert abs(video.get(cv2.CAP_PROP_FPS) - pace) < 0.01 * pace
    _, image = video.read()
    video.release()
    # Lossy coding leaves the picture recognisable: a few grey levels from what was drawn.
    drawn = draw_frame(recording, results, 0, depth_range(results.joints))
    assert image.shape == drawn.shape
    below_the_text = slice(80, None)
    assert np.abs(image[below_the_text].astype(int) - drawn[below_the_text]).mean() < 20


def test_one_frame_is_enough_for_a_video(tmp_path, recording, results):
    one = replace(recording, times_s=recording.times_s[:1], joints=None)
    first = TimedHandTrack(*(field[:1] for field in results))
    write_overlay(tmp_path / "o.mp4", one, first, float("nan"), lambda done: None)
    assert (tmp_path / "o.mp4").stat().st_size > 0


def test_a_video_that_cannot_be_written_is_named(tmp_path, recording, results):
    with pytest.raises(OutputError, match=r"missing/o.mp4"):
        write_overlay(tmp_path / "missing" / "o.mp4", recording, results, 50.0, lambda done: None)
