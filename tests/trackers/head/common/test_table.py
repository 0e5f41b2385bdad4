import csv
import json
from contextlib import closing
from functools import partial

import numpy as np
import pytest

from jaxfilters.trackers.app.results import begin
from jaxfilters.trackers.head.common.report import errors, shares
from jaxfilters.trackers.head.common.state import HeadTrack
from jaxfilters.trackers.head.common.table import (
    HEAD_TABLE,
    SKIPPED,
    TimedHeadTrack,
    displayed,
    empty_rows,
    in_metres,
    longest_stretch,
    with_gaps,
)

COLUMNS = (
    "frame,time_s,x_m,y_m,z_m,roll_rad,yaw_rad,pitch_rad,x_std_m,y_std_m,z_std_m,roll_std_rad,yaw_std_rad,"
    "pitch_std_rad,deformation_1_m,deformation_2_m,deformation_3_m,deformation_4_m,deformation_5_m,is_deformable,"
    "score,status"
)
TWO, ONE = partial(empty_rows, 2), partial(empty_rows, 1)


def chunk(status, modes=2, cameras=2):
    b = len(status)
    pose = np.tile([1.0, 2, 3, 0.1, 0.2, 0.3], (b, 1)) + np.arange(b)[:, None] * [1, 0, 0, 0, 0, 0]
    return HeadTrack(
        pose=pose,
        pose_std=np.tile([0.5, 0.6, 0.7, 0.01, 0.02, 0.03], (b, 1)),
        deformation=np.tile(np.arange(1.0, modes + 1), (b, 1)),
        shape=np.ones((b, 10, 3)),
        image_points=np.ones((b, cameras, 10, 2)),
        score=np.full(b, 0.75),
        effective_sample_size=np.full(b, 100.0),
        innovations=np.full((b, 2), (6, 5)),
        status=np.asarray(status, np.int32),
    )


def test_rows_are_in_metres_and_radians(tmp_path):
    times_s = np.array([0.0, 1 / 30])
    with closing(begin(tmp_path, {}, HEAD_TABLE)) as writer:
        writer.append(times_s, with_gaps(in_metres(chunk([1, 2])), times_s, [True, True], TWO)[1:])
    lines = (tmp_path / "track.csv").read_text().splitlines()
    assert lines[0] == COLUMNS
    row = next(csv.DictReader(lines))
    expected = {"x_m": 1e-3, "z_m": 3e-3, "roll_rad": 0.1, "pitch_rad": 0.3, "x_std_m": 5e-4, "yaw_rad": 0.2}
    expected |= {"pitch_std_rad": 0.03, "yaw_std_rad": 0.02, "deformation_1_m": 1e-3, "deformation_2_m": 2e-3}
    expected |= {"deformation_3_m": 0, "deformation_5_m": 0, "score": 0.75}
    assert {name: float(row[name]) for name in expected} == pytest.approx(expected, rel=1e-6)
    assert (row["frame"], row["time_s"], row["status"]) == ("0", "0.000000", "tracking")
    assert [one["is_deformable"] for one in csv.DictReader(lines)] == ["0", "1"]


def test_pictures_show_millimetres_and_degrees_with_pitch_before_yaw():
    shown = displayed(np.array([0.001, 0.002, 0.003, np.pi, np.pi / 2, np.pi / 4]))
    np.testing.assert_allclose(shown, [1, 2, 3, 180, 45, 90])


def test_what_is_not_tracked_has_no_numbers(tmp_path):
    """A frozen pose must not pass for a tracked one; the score, which says why, stays."""
    rows = with_gaps(chunk([0, 1, 3]), np.arange(5.0), [True, False, True, False, True], TWO)
    np.testing.assert_array_equal(rows.status, [0, SKIPPED, 1, SKIPPED, 3])
    np.testing.assert_array_equal(rows.times_s, np.arange(5))
    tracked = np.array([False, False, True, False, False])
    for name in ("pose", "pose_std", "deformation", "shape", "image_points"):
        values = getattr(rows, name).reshape(5, -1)
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), tracked)
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), ~tracked)
    np.testing.assert_array_equal(rows.pose[2], np.float32([2, 2, 3, 0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(rows.score, [0.75, np.nan, 0.75, np.nan, 0.75])
    nothing = with_gaps(None, np.arange(2.0), [False, False], ONE)
    np.testing.assert_array_equal(nothing.status, [SKIPPED] * 2)
    assert nothing.image_points.shape == (2, 1, 10, 2)


def test_faces_with_fewer_or_more_modes_fit():
    for modes in (0, 5, 7):
        deformation = with_gaps(chunk([2], modes), np.zeros(1), [True], TWO).deformation
        np.testing.assert_array_equal(deformation, [[i + 1 if i < modes else 0 for i in range(5)]])


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ([0, 0, 1, 2, 3, 2, 2, 2], slice(5, 8)),
        ([1, SKIPPED, 2, 2, 3, 2, 2, 3], slice(0, 4)),
        ([SKIPPED, 0, SKIPPED, 1, SKIPPED], slice(3, 4)),
        ([0, 3, SKIPPED], slice(0, 0)),
        ([], slice(0, 0)),
    ],
)
def test_the_longest_stretch_passes_over_skipped_moments(status, expected):
    assert longest_stretch(np.asarray(status, int)) == expected


def test_shares_of_a_run(face_track):
    track, _ = face_track
    message = shares(track)
    assert message["status"] == {"searching": 2, "tracking": 34, "lost": 3, "doubtful": 0, "skipped": 1}
    assert message["frames_deformable"] == 21
    assert message["share_tracked"] == pytest.approx(34 / 39, abs=1e-4)
    # Frames 2 to 29, without the skipped one.
    assert (message["longest_stretch_frames"], message["longest_stretch_s"]) == (27, pytest.approx(27 / 30, abs=1e-3))
    assert json.dumps(message, allow_nan=False)


def test_errors_are_those_of_the_tracked_frames(face_track):
    track, truth = face_track
    message = errors(track, truth)
    tracked = np.isfinite(track.pose[:, 0])
    offsets = track.pose[tracked] - truth.poses[tracked]
    assert message["rmse"]["x_m"] == pytest.approx(np.sqrt(np.mean(offsets[:, 0] ** 2)), abs=1e-6)
    assert message["rmse"]["yaw_rad"] == pytest.approx(np.sqrt(np.mean(offsets[:, 4] ** 2)), abs=1e-5)
    assert message["within_2_sigma"]["pitch_rad"] == pytest.approx(np.mean(np.abs(offsets[:, 5]) <= 0.04), abs=1e-4)
    assert 0.1 < message["landmark_rms_px"] < 10
    turned = track._replace(pose=track.pose + np.float32([0, 0, 0, 2 * np.pi, 0, 0]))
    assert errors(turned, truth)["rmse"] == pytest.approx(message["rmse"], abs=1e-5)
    assert errors(track, None) == {}
    lost = TimedHeadTrack(*track[:-1], np.full_like(track.status, 3))
    assert errors(lost, truth) == {}
    assert shares(lost)["mean_score"] is None
