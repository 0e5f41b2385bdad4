import csv
import json
import re

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.articulated import tracker as articulated_hand
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.table import articulated_table
from jaxfilters.trackers.tracker import CHUNK

OUTPUTS = {"track.csv", "track.npz", "report.json", "summary.png", "overlay.mp4", "checkpoint"}
ERRORS = ("mean_angle_error_rad", "mean_length_error_px", "lengths_within_2_sigma_percent")


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(*arguments):
    return main(["track", "articulated", *(str(argument) for argument in arguments)])


def arrays_of(features):
    return {
        "features": features.y,
        "names": np.asarray(features.features.names(features.num_fingers)),
        "noise_std": features.std[0],
        "t_s": features.times_s,
        "start_mean": features.start.mean,
        "start_covariance": features.start.covariance,
        "truth_states": features.truth,
    }


@pytest.fixture
def npz(tmp_path, features):
    """Writes the recording with some arrays replaced, or left out where None."""

    def write(**changes):
        arrays = {name: array for name, array in (arrays_of(features) | changes).items() if array is not None}
        np.savez(tmp_path / "a.npz", **arrays)
        return tmp_path / "a.npz"

    return write


@pytest.mark.system
@pytest.mark.usefixtures("fake_articulated")
def test_track_writes_all_results(npz, tmp_path, features, capsys):
    out = tmp_path / "out"
    assert run(npz(), "--out", out, "--hypotheses", 3, "--seed", 5) == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS
    layout = articulated_hand.hand_model(features, ArticulatedConfig()).layout
    with np.load(out / "track.npz") as track:
        assert track.files == ["times_s", *articulated_hand.ArticulatedTrack._fields]
        mean = track["mean"]
        assert mean.shape == (len(features), layout.size)
        np.testing.assert_array_equal(track["times_s"], features.times_s)
        assert track["is_new_view"].dtype == bool
        assert not track["is_new_view"][5]
    with (out / "track.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == ("frame", "time_s", *articulated_table(layout).columns, "status")
    written = np.asarray([[float(entry) for entry in row[2 : 2 + layout.size]] for row in rows], np.float32)
    np.testing.assert_array_equal(written, mean)
    assert rows[5][-1] == "searching"
    report = json.loads((out / "report.json").read_text())
    assert report["frames"] == len(features)
    assert (report["config"]["hypotheses"], report["config"]["seed"]) == (3, 5)
    assert report["status"] == {"searching": 1, "tracking": len(features) - 1, "lost": 0, "doubtful": 0}
    lengths = np.abs(mean[-1] - features.truth[-1])[layout.lengths]
    assert report["mean_length_error_px"] == pytest.approx(lengths.mean(), abs=1e-3)
    assert report["lengths_within_2_sigma_percent"] == pytest.approx(100 * (lengths <= 1).mean(), abs=0.1)
    text = capsys.readouterr().out
    assert f"mean length error {report['mean_length_error_px']:.1f} px" in text
    assert "lengths within 2 sigma" in text
    assert cv2.imread(str(out / "summary.png")).shape[1] == 960
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == len(features)


@pytest.mark.usefixtures("fake_articulated")
def test_without_a_recording_the_synthetic_one_is_followed(tmp_path):
    out = tmp_path / "out"
    assert run("--out", out, "--no-video") == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS - {"overlay.mp4"}
    report = json.loads((out / "report.json").read_text())
    assert all(report[name] > 0 for name in ERRORS[:2])


@pytest.mark.system
@pytest.mark.usefixtures("fake_articulated")
def test_keypoints_of_any_detector_are_followed(tmp_path, capsys):
    points = np.random.default_rng(0).uniform(50, 300, (20, 21, 2))
    np.savez(tmp_path / "k.npz", keypoints=points, image_shape=(480, 640))
    assert run(tmp_path / "k.npz", "--out", tmp_path / "npz", "--noise", 2.5) == 0
    frames = [[{"x": x / 640, "y": y / 480, "z": 0.0} for x, y in hand] for hand in points.tolist()]
    (tmp_path / "k.json").write_text(json.dumps(frames))
    of_json = (tmp_path / "k.json", "--out", tmp_path / "json", "--noise", 2.5)
    assert run(*of_json) == 2
    assert "--image-size WIDTHxHEIGHT" in capsys.readouterr().err
    assert run(*of_json, "--image-size", "640x480") == 0
    with np.load(tmp_path / "npz" / "track.npz") as one, np.load(tmp_path / "json" / "track.npz") as other:
        assert one["image_points"].shape == (20, 5, 4, 2)
        np.testing.assert_allclose(one["mean"], other["mean"], rtol=1e-4, atol=1e-3)
    report = json.loads((tmp_path / "json" / "report.json").read_text())
    assert [report[name] for name in ERRORS] == [None, None, None]
    video = cv2.VideoCapture(str(tmp_path / "json" / "overlay.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_HEIGHT), video.get(cv2.CAP_PROP_FRAME_WIDTH)) == (480, 640)


@pytest.mark.system
@pytest.mark.usefixtures("fake_articulated")
def test_options_reach_the_tracker_and_the_rest_keeps_its_default(tmp_path, monkeypatch):
    configs, build = [], articulated_hand.build
    remember = lambda sequence, config: configs.append(config) or build(sequence, config)
    monkeypatch.setattr(articulated_hand, "build", remember)
    options = "--variant published --hypotheses 2 --hand left --gate 0 --seed 7"
    assert run("--out", tmp_path / "a", "--no-video", *options.split()) == 0
    assert run("--out", tmp_path / "b", "--no-video") == 0
    assert configs == [ArticulatedConfig("published", 2, "left", 0.0, 7), ArticulatedConfig()]


@pytest.mark.system
@pytest.mark.usefixtures("fake_articulated")
def test_interrupted_and_resumed_equals_uninterrupted(npz, tmp_path, monkeypatch, capsys):
    whole, parts, file = tmp_path / "whole", tmp_path / "parts", npz()
    assert run(file, "--out", whole) == 0
    show = ProgressLine.show

    def show_and_interrupt(self, done, note=""):
        show(self, done, note)
        if done >= 20:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ProgressLine, "show", show_and_interrupt)
        assert run(file, "--out", parts) == 130
    assert f"the first {CHUNK} frames are kept in {parts}/checkpoint" in capsys.readouterr().err
    assert run(file, "--out", parts, "--resume", "--gate", 3) == 2
    assert "cannot be resumed: config.gate was 5.0 and is 3.0" in capsys.readouterr().err
    assert run(npz(start_mean=arrays_mean(file) + 1), "--out", parts, "--resume") == 2
    assert "cannot be resumed: input was" in capsys.readouterr().err
    assert run(npz(), "--out", parts, "--resume") == 0
    for name in ("track.csv", "summary.png"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()


def arrays_mean(file):
    with np.load(file) as arrays:
        return arrays["start_mean"]


WRONG = {
    "no start": ({"start_mean": None, "start_covariance": None}, "a start .* is needed"),
    "unknown names": ({"names": np.asarray([f"f{i}" for i in range(29)])}, "names that are no feature: f0, f1, f2, f3"),
    "a wrong shape": ({"noise_std": np.ones(28)}, r"noise_std must be \(29,\) or \(40, 29\); got \(28,\)"),
    "times that go back": ({"t_s": -np.arange(40.0)}, "times must increase strictly; frame 0 is at"),
    "noise that is NaN": ({"noise_std": np.full(29, np.nan)}, "noise must be positive"),
    "negative noise": ({"noise_std": np.full(29, -1.0)}, "noise must be positive"),
}


@pytest.mark.usefixtures("fake_articulated")
@pytest.mark.parametrize("what", WRONG)
def test_wrong_recordings_are_one_clear_line(what, npz, tmp_path, capfd):
    changes, message = WRONG[what]
    assert run(npz(**changes), "--out", tmp_path / "out") == 2
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith(f"jaxfilters: error: {tmp_path / 'a.npz'}: ")
    assert re.search(message, line)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("fake_articulated")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--hypotheses 0", "hypotheses must be at least 1; got 0."),
        ("--gate -1", "gate must be at least 0; got -1.0."),
        ("--gate nan", "gate must be at least 0; got nan."),
        ("--noise 2 --fps 30", "--noise, --fps: of no use without a recording; the synthetic one has its own."),
    ],
)
def test_wrong_options_are_one_clear_line(options, message, tmp_path, capfd):
    assert run("--out", tmp_path / "out", *options.split()) == 2
    assert capfd.readouterr().err.splitlines()[-1] == f"jaxfilters: error: {message}"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "required: --out"),
        ("--out a --variant fast", "--variant: invalid choice: 'fast'"),
        ("--out a --hand third", "--hand: invalid choice: 'third'"),
        ("--out a --image-size 640", "--image-size: expected WIDTHxHEIGHT in pixels, such as 640x480; got 640"),
        ("--out a --image-size 640x0", "--image-size: expected WIDTHxHEIGHT in pixels, such as 640x480; got 640x0"),
        ("--out a --noise much", "--noise: expected a finite number above 0; got much"),
    ],
)
def test_wrong_arguments_exit_with_two(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(*arguments.split())
    assert message in capsys.readouterr().err
