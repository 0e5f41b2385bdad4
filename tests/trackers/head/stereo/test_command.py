"""`jaxfilters track head-stereo` from end to end, with something quick in the place of the tracker."""

import csv
import json

import cv2
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.trackers.app import stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.head.common import input as head_input
from jaxfilters.trackers.head.stereo import command as head_command
from jaxfilters.trackers.io.cameras import write_camera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.landmarks import read_landmarks
from jaxfilters.trackers.io.rigs import RigCamera, write_rig
from jaxfilters.trackers.io.video_input import ImageFolder, LiveCamera

ROWS, COLS, FRAMES = 48, 64, 20
K = np.array([[80.0, 0, 31.5], [0, 80, 23.5], [0, 0, 1]])
OUTPUTS = {"track.csv", "track.npz", "report.json", "summary.png", "overlay.mp4", "checkpoint"}


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(*arguments):
    return main(["track", "head-stereo", *map(str, arguments)])


def folder(path, greys, names=None):
    """Flat pictures, one grey each."""
    path.mkdir()
    for i, grey in enumerate(greys):
        name = f"{i:03d}" if names is None else names[i]
        cv2.imwrite(str(path / f"{name}.png"), np.full((ROWS, COLS, 3), grey, np.uint8))
    return path


def rig_file(path, size=(COLS, ROWS), lens=0.0):
    distortion = np.array([lens, 0, 0, 0, 0])
    poses = ((np.eye(3), np.zeros(3)), (np.eye(3), np.array([-120.0, 0, 0])))
    write_rig(path, [RigCamera(name, size, K, distortion, *pose) for name, pose in zip("ab", poses, strict=True)])
    return path


@pytest.fixture
def stereo(tmp_path):
    """Arguments for two folders and their rig; frames 10 and 11 are too dark for the stand-in."""
    greys = 100 + np.arange(FRAMES)
    greys[10:12] = 5
    left, right = folder(tmp_path / "left", greys), folder(tmp_path / "right", 2 * (100 + np.arange(FRAMES)) - 80)
    return left, right, "--rig", rig_file(tmp_path / "rig.json")


def test_the_same_images_from_both_cameras_are_an_error(fake_head, tmp_path, capsys):
    """The same folder twice, or a copy of it."""
    rig, grey = rig_file(tmp_path / "rig.json"), np.random.default_rng(0).integers(0, 255, (ROWS, COLS, 3))
    for name in ("left", "copy", "right"):
        folder(tmp_path / name, [100] * 4)
        for i in range(4):
            cv2.imwrite(str(tmp_path / name / f"{i:03d}.png"), np.roll(grey, 3 if name == "right" else 0, axis=1))
    for other in ("left", "copy"):
        assert run(tmp_path / "left", tmp_path / other, "--rig", rig, "--out", tmp_path / "out") == 2
        assert "sources 1 and 2 have the same images" in capsys.readouterr().err
    assert run(tmp_path / "left", tmp_path / "right", "--rig", rig, "--out", tmp_path / "out") == 0


def rows_of(out):
    with (out / "track.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_track_writes_all_results(stereo, fake_head, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(*stereo, "--out", out, "--seed", 3, "--num-particles", 50, "--variant", "published") == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS
    rows = rows_of(out)
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))
    words = ["searching"] * 2 + ["tracking"] * 8 + ["lost"] * 2 + ["tracking"] * 8
    assert [row["status"] for row in rows] == words
    deformable = [i for i, row in enumerate(rows) if row["is_deformable"] == "1"]
    assert deformable == [i for i in range(6, FRAMES) if i not in (10, 11)]
    # Every image went to the session once, in its place: the stand-in says what it saw.
    observed = [
        tuple(1000 * float(row[name]) for name in ("x_m", "y_m", "z_m")) for row in rows if row["status"] == "tracking"
    ]
    expected = [(100 + i, 120 + 2 * i, 1000 * i / 30) for i in range(2, FRAMES) if i not in (10, 11)]
    np.testing.assert_allclose(observed, expected, rtol=1e-5)
    assert all(np.isnan(float(rows[i]["x_m"])) for i in (0, 1, 10, 11))
    assert float(rows[5]["pitch_rad"]) == pytest.approx(0.3, rel=1e-5)
    assert fake_head[0].sizes == [8, 8, 4]
    options = fake_head[0].options
    assert (options.seed, options.num_particles, options.variant) == (3, 50, "published")
    with np.load(out / "track.npz") as track:
        assert track["image_points"].shape == (FRAMES, 2, 10, 2)
        assert track["status_names"][int(track["status"][10])] == "lost"
        assert track["model_basis"].shape == (30, 5)
        # Millimetres in the session.
        np.testing.assert_allclose(track["model_mean"], 1e-3 * np.asarray(fake_head[0].model.mean), rtol=1e-6)
        np.testing.assert_allclose(track["model_deviation"], 1e-3 * np.asarray(fake_head[0].model.deviation), rtol=1e-6)
        np.testing.assert_allclose(track["times_s"], np.arange(FRAMES) / 30)
    report = json.loads((out / "report.json").read_text())
    assert report["status"] == {"searching": 2, "tracking": 16, "lost": 2, "doubtful": 0, "skipped": 0}
    assert report["frames_deformable"] == 12
    assert report["innovations"]["count"] == 16 * 6
    assert report["longest_stretch_frames"] == 8
    assert report["events"] == [{"frame": 2, "what": "registered"}, {"frame": 12, "what": "learnt"}]
    assert report["explained_contribution"] == 0.75
    assert report["errors"] == {}
    assert report["trouble"] == []
    assert report["frames_per_second"] > 0
    assert report["options"]["rig"].endswith("rig.json")
    video = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FRAME_WIDTH)) == (FRAMES, 2 * COLS)
    assert cv2.imread(str(out / "summary.png")).std() > 5
    captured = capsys.readouterr()
    assert "20 frames at" in captured.out
    assert "80 % tracked" in captured.out
    assert "tracking 20/20" in captured.err


def test_a_dropped_frame_is_a_row_without_a_pose(stereo, fake_head, tmp_path, capsys):
    (stereo[1] / "007.png").unlink()
    out = tmp_path / "out"
    assert run(*stereo, "--out", out) == 0
    rows = rows_of(out)
    assert [row["status"] for row in rows[6:9]] == ["tracking", "skipped", "tracking"]
    assert np.isnan([float(rows[7][name]) for name in ("x_m", "yaw_rad", "deformation_1_m", "score")]).all()
    # The frames after it still come in pairs of one moment.
    assert (float(rows[8]["x_m"]), float(rows[8]["y_m"])) == pytest.approx((0.108, 0.136), rel=1e-6)
    assert "1 of 20 moments skipped" in capsys.readouterr().err
    report = json.loads((out / "report.json").read_text())
    assert "the first at 0.23 s" in report["trouble"][0]
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES


def test_events_name_frames_of_the_recording(stereo, fake_head, tmp_path):
    """The session counts what it is given; the report counts moments."""
    (stereo[1] / "001.png").unlink()
    assert run(*stereo, "--out", tmp_path / "out", "--no-video") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["events"] == [{"frame": 3, "what": "registered"}, {"frame": 13, "what": "learnt"}]
    assert report["status"]["skipped"] == 1


def test_a_source_that_ends_early_is_named(stereo, fake_head, tmp_path, capsys):
    for i in range(12, FRAMES):
        (stereo[1] / f"{i:03d}.png").unlink()
    assert run(*stereo, "--out", tmp_path / "out", "--no-video") == 0
    assert f"{stereo[1]}: over after 12 moments, before {stereo[0]}" in capsys.readouterr().err
    assert len(rows_of(tmp_path / "out")) == 12


def test_a_damaged_image_loses_nothing_before_it(stereo, fake_head, tmp_path, capsys):
    (stereo[0] / "013.png").write_bytes(b"no picture")
    out = tmp_path / "out"
    assert run(*stereo, "--out", out) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith(f"jaxfilters: error: {stereo[0] / '013.png'}: not a complete image")
    assert message.endswith(f"the first 13 frames are in {out / 'track.csv'}.")
    assert {file.name for file in out.iterdir()} == OUTPUTS - {"checkpoint"}
    assert len(rows_of(out)) == 13


def test_ctrl_c_writes_what_there_is(stereo, fake_head, tmp_path, monkeypatch, capsys):
    show = ProgressLine.show

    def show_and_interrupt(self, done, note=""):
        show(self, done, note)
        if done >= 16:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(ProgressLine, "show", show_and_interrupt)
        assert run(*stereo, "--out", out) == 130
    assert "interrupted; " in (message := capsys.readouterr().err)
    assert f"results in {out}" in message
    assert len(rows_of(out)) == 16
    assert {file.name for file in out.iterdir()} == OUTPUTS - {"checkpoint"}
    assert json.loads((out / "report.json").read_text())["interrupted"] is True
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 16
    assert run(*stereo, "--out", out) == 2
    assert "holds the track of another run" in capsys.readouterr().err
    assert len(rows_of(out)) == 16


def fail_from(monkeypatch, frames):
    """Let sessions end by an error that nobody foresaw, after so many frames."""
    process = head_command.HeadSession.process

    def fail(self, images, times):
        if self.frames >= frames:
            raise RuntimeError("killed")
        return process(self, images, times)

    monkeypatch.setattr(head_command.HeadSession, "process", fail)


@pytest.mark.parametrize("kept_until", [8, 16])
def test_an_interrupted_run_is_resumed_bit_for_bit(stereo, fake_head, tmp_path, monkeypatch, capsys, kept_until):
    """Ended by an error that nobody foresaw in the frames after the last checkpoint."""
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert run(*stereo, "--out", whole) == 0
    with monkeypatch.context() as patch:
        fail_from(patch, kept_until)
        assert run(*stereo, "--out", out) == 70
    assert len(rows_of(out)) == kept_until
    assert run(*stereo, "--out", out) == 2
    assert "choose another --out, or --resume" in capsys.readouterr().err
    assert run(*stereo, "--out", out, "--seed", 5, "--resume") == 2
    assert "config.seed was 0 and is 5" in capsys.readouterr().err
    assert run(*stereo, "--out", out, "--resume") == 0
    assert rows_of(out) == rows_of(whole)
    report, expected = (json.loads((folder / "report.json").read_text()) for folder in (out, whole))
    assert report["events"] == expected["events"]
    assert (out / f"overlay_from_{kept_until}.mp4").exists()


@pytest.mark.parametrize("again", [(), ("--resume",)])
def test_a_run_that_ends_before_its_first_frame_leaves_its_folder_to_another_one(
    stereo, fake_head, tmp_path, monkeypatch, again
):
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert run(*stereo, "--out", whole) == 0
    with monkeypatch.context() as patch:
        fail_from(patch, 0)
        assert run(*stereo, "--out", out) == 70
    assert not (out / "track.csv").exists()
    assert run(*stereo, "--out", out, *again) == 0
    assert rows_of(out) == rows_of(whole)


def test_ctrl_c_before_anything_was_tracked(stereo, fake_head, tmp_path, monkeypatch, capsys):
    def interrupt(self, images, times):
        raise KeyboardInterrupt

    monkeypatch.setattr(head_command.HeadSession, "process", interrupt)
    assert run(*stereo, "--out", tmp_path / "out") == 130
    assert "nothing was kept" in capsys.readouterr().err


def test_one_camera_is_followed_with_an_assumed_focal_length(stereo, fake_head, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(stereo[0], "--out", out, "--no-video", "--fps", 10, "--seconds", 1) == 0
    assert "an assumed focal length of 55 px" in capsys.readouterr().err
    np.testing.assert_allclose(fake_head[0].rig.focal, [[55.4701, 55.4701]], rtol=1e-5)
    np.testing.assert_allclose(fake_head[0].rig.center, [[31.5, 23.5]])
    assert fake_head[0].focal_log_std == 0.25
    assert [float(row["time_s"]) for row in rows_of(out)] == pytest.approx(np.arange(11) / 10)
    assert "assumed" in json.loads((out / "report.json").read_text())["note"]
    write_camera(tmp_path / "camera.json", (COLS, ROWS), K=K, distortion=np.array([0.1, 0, 0, 0, 0]))
    assert run(stereo[0], "--out", tmp_path / "b", "--camera", tmp_path / "camera.json", "--no-video") == 0
    np.testing.assert_allclose(fake_head[1].rig.focal, [[80, 80]])
    assert fake_head[1].focal_log_std == 0
    assert "assumed" not in capsys.readouterr().err


def test_images_and_points_lose_the_lens_distortion(stereo, fake_head, tmp_path, monkeypatch):
    """A point off the centre: r' = r (1 + k r^2) solved for r, with r' = 24/80 and k = 0.5."""
    observed = []
    points = "\n".join(["name,u,v", *(f"{name},{31.5 + 24},{23.5}" for name in NAMES)])
    (tmp_path / "points.csv").write_text(points)
    process = head_command.HeadSession.process
    remember = lambda self, images, times: observed.append(images) or process(self, images, times)
    monkeypatch.setattr(head_command.HeadSession, "process", remember)
    rig = rig_file(tmp_path / "bent.json", lens=0.5)
    options = ("--rig", rig, "--points", tmp_path / "points.csv", "--no-video")
    assert run(*stereo[:2], *options, "--out", tmp_path / "out") == 0
    found = (fake_head[0].points - [31.5, 23.5]) / 80
    np.testing.assert_allclose(found[:, 1], 0, atol=1e-9)
    r = found[:, 0]
    np.testing.assert_allclose(r * (1 + 0.5 * r**2), 24 / 80, rtol=1e-6)
    # Pincushion distortion taken away: the corners of the straightened image saw nothing.
    assert observed[0][0, 0, 0, 0] == 0
    assert observed[0][0, 0, ROWS // 2, COLS // 2] == 100


@pytest.mark.system
def test_without_a_recording_the_synthetic_face_is_followed(fake_head, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(head_input, "_SYNTHETIC_FRAMES", 9)
    out = tmp_path / "out"
    assert run("--out", out, "--seed", 2) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"] == 9
    assert report["errors"]["rmse"]["x_m"] > 0
    assert set(report["errors"]["within_2_sigma"]) == set(report["errors"]["rmse"])
    assert "errors, root mean square: x in mm" in capsys.readouterr().out
    session = fake_head[0]
    assert (session.options.seed, session.points.shape) == (2, (10, 2))
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_WIDTH) == 1280
    assert run("--out", tmp_path / "b", "--points", "a.csv", "--fps", 3) == 2
    assert "--points, --fps: of no use without a recording" in capsys.readouterr().err


def test_live_cameras_are_followed_image_by_image(stereo, fake_head, tmp_path, monkeypatch, capsys):
    """A folder poses as a camera that stops: each pair is tracked at once, the stop is said, results are there."""

    class Live(LiveCamera):
        def __init__(self, number):
            self._folder = ImageFolder(stereo[number], 30.0)
            self.name, self.fps, self.image_size = f"camera {number}", 30.0, self._folder.image_size

        def images(self):
            yield from self._folder.images()

        def trouble(self):
            return f"{self.name}: no image since 1 s after the start"

    monkeypatch.setattr(head_input, "open_video", lambda place, fps: Live(int(place)))
    assert run(0, 1, *stereo[2:], "--out", tmp_path / "out") == 0
    assert fake_head[0].sizes == [1] * FRAMES
    assert "camera 1: no image since" in capsys.readouterr().err
    assert len(rows_of(tmp_path / "out")) == FRAMES


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("{left} {right}", "--rig: missing; `jaxfilters calibrate stereo` makes"),
        ("{left} {right} --rig {rig} --camera a.json", "--camera: for one source alone"),
        ("{left} --rig {rig}", "--rig: for two sources or more"),
        ("{left} {right} {left} --rig {rig}", "rig.json: 2 cameras; got 3 sources"),
        ("{left} {right} --rig {other}", "other.json: a: calibrated for images of 32x24; {left} has 64x48"),
        ("{left} --camera {camera}", "camera.json: calibrated for images of 32x24; {left} has 64x48"),
        ("{left} {left}x --rig {rig}", "leftx: no such file or folder"),
        ("{left} {right} --rig {left}", "left: a folder"),
        ("{left} {right} --rig {rig} --points {left}x", "leftx: cannot be read"),
        ("{left} {right} --rig {rig} --num-particles 0", "num_particles must be"),
    ],
)
def test_wrong_input_is_named(stereo, fake_head, tmp_path, capsys, arguments, message):
    write_camera(tmp_path / "camera.json", (32, 24), K=K)
    places = {"left": stereo[0], "right": stereo[1], "rig": stereo[3], "camera": tmp_path / "camera.json"}
    places["other"] = rig_file(tmp_path / "other.json", (32, 24))
    assert run(*arguments.format(**places).split(), "--out", tmp_path / "out") == 2
    assert message.format(**places) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_wrong_arguments_exit_with_two(capsys):
    for arguments, message in (
        ("a b", "required: --out"),
        ("--out a --variant fast", "--variant: invalid choice: 'fast'"),
    ):
        with pytest.raises(SystemExit, match="2"):
            run(*arguments.split())
        assert message in capsys.readouterr().err


GOOD = [[name, 10 + i, 20 + i] for i, name in enumerate(NAMES)]


def written(path, rows, header="name,u,v"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]))
    return path


def test_landmarks_may_come_in_any_order(tmp_path):
    points = read_landmarks(written(tmp_path / "p.csv", GOOD[::-1], "name, u, v"), (COLS, ROWS))
    np.testing.assert_array_equal(points, [row[1:] for row in GOOD])


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        (GOOD, "name,x,y", "the header is 'name,x,y'"),
        (GOOD[:9], "name,u,v", "without left brow inner; expected"),
        ([*GOOD, GOOD[0]], "name,u,v", "line 12: right eye outer comes twice"),
        ([["nose", 1, 2]], "name,u,v", "line 2: expected a header name,u,v and one row each for right eye outer"),
        ([["left mouth", 1]], "name,u,v", r"line 2 has 2 entries, its header 3 \(truncated\?\): left mouth,1"),
        ([["left mouth", "a", 2]], "name,u,v", "line 2: u must be a number; got 'a'"),
        ([["left mouth", "nan", 2]], "name,u,v", "line 2: u must be a finite number of at most"),
        ([["left mouth", 64, 2]], "name,u,v", r"\(64, 2\) lies outside an image of 64x48"),
    ],
)
def test_wrong_landmarks_are_named(tmp_path, rows, header, message):
    with pytest.raises(InputError, match=message):
        read_landmarks(written(tmp_path / "p.csv", rows, header), (COLS, ROWS))
