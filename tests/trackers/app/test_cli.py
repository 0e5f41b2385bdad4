import csv
import json
import os

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.devices import available_cores, use_all_cores
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.hand_depth import command as hand_command
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.tracker import CHUNK

OUTPUTS = {"track.csv", "track.npz", "report.json", "summary.png", "overlay.mp4", "checkpoint"}


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(*arguments):
    return main([str(argument) for argument in arguments])


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_track_writes_all_results(npz_file, tmp_path, depth_mm, capsys):
    out = tmp_path / "out"
    assert run("track", "hand-depth", npz_file, "--out", out, "--particles", 100, "--seed", 5) == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS
    with np.load(out / "track.npz") as track:
        assert track["joints"].shape == (len(depth_mm), 21, 3)
    with (out / "track.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == len(depth_mm)
    report = json.loads((out / "report.json").read_text())
    assert report["frames"] == len(depth_mm)
    assert report["config"]["num_particles"] == 100
    assert report["config"]["seed"] == 5
    assert report["status"] == {"searching": 1, "tracking": 39, "lost": 0, "doubtful": 0}
    assert report["mean_joint_error_m"] is None
    assert report["frames_per_second"] > 0
    captured = capsys.readouterr()
    assert "40 frames in" in captured.out
    assert "tracking 40/40" in captured.err


@pytest.mark.usefixtures("fake_hand_depth")
def test_demo_follows_the_synthetic_recording_and_knows_its_error(tmp_path, recording, capsys):
    out = tmp_path / "demo"
    assert run("demo", "--out", out, "--no-video") == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS - {"overlay.mp4"}
    with np.load(out / "track.npz") as track:
        assert np.isnan(track["joints"][5]).all()
        error = np.nanmean(np.linalg.norm(track["joints"] - recording.joints, axis=-1))
    report = json.loads((out / "report.json").read_text())
    assert abs(report["mean_joint_error_m"] - error) < 1e-5
    assert f"mean joint error {1000 * report['mean_joint_error_m']:.1f} mm" in capsys.readouterr().out


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_a_recording_without_a_hand_has_empty_results_and_no_crash(tmp_path, recording, capsys):
    empty = np.zeros((20, *recording.camera.shape), np.uint16)
    truth = 1000 * recording.joints[:20]
    np.savez(tmp_path / "empty.npz", depth_mm=empty, K=recording.camera.matrix(), joints_mm=truth)
    out = tmp_path / "out"
    assert run("track", "hand-depth", tmp_path / "empty.npz", "--out", out) == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS
    report = json.loads((out / "report.json").read_text())
    assert report["status"] == {"searching": 20, "tracking": 0, "lost": 0, "doubtful": 0}
    assert report["mean_joint_error_m"] is None
    assert "20 searching" in capsys.readouterr().out
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 20


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_options_reach_the_tracker_and_the_rest_keeps_its_default(tmp_path, monkeypatch):
    configs = []
    build = hand_depth.build
    monkeypatch.setattr(hand_depth, "build", lambda camera, config: configs.append(config) or build(camera, config))
    given = "--filter pf --particles 64 --stride 3 --scale 0.9 --seed 4 --hand left --no-guide"
    given += " --missing unknown --surface mesh"
    assert run("demo", "--out", tmp_path / "a", "--no-video", *given.split()) == 0
    assert run("demo", "--out", tmp_path / "b", "--no-video") == 0
    assert configs == [
        HandDepthConfig("pf", 64, 3, 4, "left", 0.9, guide=False, missing="unknown", surface="mesh"),
        HandDepthConfig(),
    ]


def interrupt_at(monkeypatch, frames):
    """Press Ctrl-C when `frames` frames are done."""
    show = ProgressLine.show

    def show_and_interrupt(self, done, note=""):
        show(self, done, note)
        if done >= frames:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressLine, "show", show_and_interrupt)


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_interrupted_and_resumed_equals_uninterrupted(png_folder, tmp_path, monkeypatch, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run("track", "hand-depth", png_folder, "--out", whole) == 0
    with monkeypatch.context() as patch:
        interrupt_at(patch, 20)
        assert run("track", "hand-depth", png_folder, "--out", parts) == 130
    assert f"the first {CHUNK} frames are kept in {parts}/checkpoint; continue with --resume" in (
        capsys.readouterr().err
    )
    assert run("track", "hand-depth", png_folder, "--out", parts) == 2
    assert "holds an unfinished run of 16 frames: continue it with --resume" in capsys.readouterr().err
    assert run("track", "hand-depth", png_folder, "--out", parts, "--resume", "--seed", 9) == 2
    assert "cannot be resumed: config.seed was 0 and is 9" in capsys.readouterr().err
    assert run("track", "hand-depth", png_folder, "--out", parts, "--resume") == 0
    for name in ("track.csv", "summary.png"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_resume_starts_anew_where_there_is_nothing_and_redraws_what_is_finished(npz_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("track", "hand-depth", npz_file, "--out", out, "--resume", "--no-video") == 0
    assert "nothing to resume" in capsys.readouterr().err
    assert run("track", "hand-depth", npz_file, "--out", out, "--resume") == 0
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 40


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_a_truncated_image_says_what_is_kept_and_can_be_mended(png_folder, tmp_path, capfd):
    victim = sorted(png_folder.glob("*.png"))[20]
    content = victim.read_bytes()
    victim.write_bytes(content[:300])
    assert run("track", "hand-depth", png_folder, "--out", tmp_path / "out", "--no-video") == 2
    message = capfd.readouterr().err.splitlines()[-1]
    assert message.startswith(f"jaxfilters: error: {victim}: not a complete PNG image")
    assert "; the first 16 frames are kept" in message
    assert len((tmp_path / "out" / "track.csv").read_text().splitlines()) == 1 + 20
    victim.write_bytes(content)
    assert run("track", "hand-depth", png_folder, "--out", tmp_path / "out", "--no-video", "--resume") == 0


@pytest.mark.usefixtures("fake_hand_depth")
def test_an_unforeseen_error_is_one_line_and_its_traceback_lies_beside_the_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(hand_command, "write_summary", lambda *_: 1 / 0)
    assert run("demo", "--out", tmp_path / "out", "--no-video") == 70
    line = capsys.readouterr().err.splitlines()[-1]
    expected = "jaxfilters: error: unforeseen ZeroDivisionError: division by zero; please report it with "
    assert line == f"{expected}{tmp_path / 'out' / 'error.txt'}."
    assert "write_summary" in (tmp_path / "out" / "error.txt").read_text()
    with pytest.raises(ZeroDivisionError):
        run("--debug", "demo", "--out", tmp_path / "out", "--no-video")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "required: COMMAND"),
        ("track", "required: WHAT"),
        ("track hand-depth", "required: --out"),
        ("fly", "invalid choice: 'fly'"),
        ("demo --hand third", "--hand: invalid choice: 'third'"),
        ("demo --missing never", "--missing: invalid choice: 'never'"),
        ("demo --particles many", "--particles: invalid int value: 'many'"),
        ("demo --seed 4294967296", "--seed: a seed must be from 0 to 4294967295; got 4294967296"),
    ],
)
def test_wrong_arguments_exit_with_two(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(arguments.split())
    error = capsys.readouterr().err
    assert "usage: jaxfilters" in error
    assert message in error


def test_opencv_5_is_refused_with_the_way_to_install_the_right_version(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cv2, "__version__", "5.0.0")
    assert run("demo", "--out", tmp_path / "out") == 2
    line = capsys.readouterr().err
    assert line.startswith("jaxfilters: error: OpenCV 5.0.0 is installed, and OpenCV 4 is needed: ")
    assert "pip install --force-reinstall 'opencv-python-headless<5'" in line
    assert not (tmp_path / "out").exists()


def test_bench_is_passed_on(capsys):
    assert run("bench", "no-such-scenario") == 2
    assert "no-such-scenario" in capsys.readouterr().err


def test_every_core_is_a_device_unless_the_user_chose(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    use_all_cores()
    expected = f"--xla_cpu_enable_fast_math=false --xla_force_host_platform_device_count={available_cores()}"
    assert os.environ["XLA_FLAGS"] == expected
    use_all_cores()
    assert os.environ["XLA_FLAGS"] == expected
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=7")
    use_all_cores()
    assert os.environ["XLA_FLAGS"] == "--xla_force_host_platform_device_count=7"
