"""What every system of the registry keeps where frames of a recording are missing, come twice, or come late."""

import csv
import json
import random
import shutil
from itertools import islice

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import FPS
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.trackers import articulated
from jaxfilters.trackers.app import results, stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.fingertips.input import DemoHand
from jaxfilters.trackers.io.cameras import write_camera
from jaxfilters.trackers.io.rigs import RigCamera, write_rig
from jaxfilters.trackers.io.video_input import VideoFile
from jaxfilters.trackers.people.demo_room import demo_room
from jaxfilters.trackers.registry import SYSTEMS

NAMES_OF_SYSTEMS = [system.name for system in SYSTEMS]
NUM_FRAMES = {"hand-depth": 36, "articulated": 54} | dict.fromkeys(("people", "head-stereo", "head-mono"), 48)
"""Of a recording before a third of its frames is dropped; 60 of other systems."""
FLOOR = np.array([[1, 0, 0, 0], [0, -0.4, -0.9, 0.7], [0, 0.9, -0.4, 5.7]])
"""Of a camera 3 m high, 5 m before the origin."""
CAMERA = Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640))


def images_in(folder, images):
    """A folder of numbered pictures, of `(number, image)`; the folder as an argument."""
    folder.mkdir()
    for number, image in images:
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return str(folder)


def face_files(folder, made, kept):
    """Arguments for the pictures of every camera before a face, and for its landmarks in the first image."""
    images = np.asarray(made.frames(0, len(made)))
    rows = "".join(f"{name},{u},{v}\n" for name, (u, v) in zip(NAMES, np.asarray(made.uv[0, 0]), strict=True))
    (folder / "points.csv").write_text("name,u,v\n" + rows)
    views = [images_in(folder / str(i), [(k, images[k, i]) for k in kept]) for i in range(images.shape[1])]
    return [*views, "--points", str(folder / "points.csv")]


def hand_depth_files(folder, kept):
    made = simulate_sequence(jax.random.key(0), "B", num_frames=int(kept[-1]) + 1)
    times = {"t_us": np.rint(1e6 * kept / 30)}
    depth = np.asarray(made.depth_mm)[kept]
    np.savez(folder / "hand.npz", depth_mm=depth, K=np.asarray(kinect_v2().matrix(), float), **times)
    return [str(folder / "hand.npz"), "--particles", "64"], 30.0


def articulated_files(folder, kept):
    made = articulated.synthetic_sequence(0)
    arrays = {"features": made.y[kept], "noise_std": made.std[kept], "t_s": made.times_s[kept]}
    names = np.asarray(made.features.names(made.num_fingers))
    start = {"start_mean": made.start.mean, "start_covariance": made.start.covariance}
    np.savez(folder / "hand.npz", names=names, **arrays, **start)
    return [str(folder / "hand.npz")], 1 / float(made.times_s[1] - made.times_s[0])


def people_files(folder, kept):
    room = demo_room(0, frames=int(kept[-1]) + 1)
    write_camera(folder / "camera.json", room.cameras[0].shape[::-1], P=np.asarray(room.cameras[0].P, float))
    (folder / "scene.json").write_text(json.dumps({"floor": room.floor.tolist()}))
    images = images_in(folder / "room", ((k, room.image(0, int(k))) for k in kept))
    places = ["--camera", str(folder / "camera.json"), "--scene", str(folder / "scene.json")]
    return [images, *places, "--fps", f"{room.fps}"], room.fps


def head_stereo_files(folder, kept):
    made = sequence(jax.random.key(0), "slow", int(kept[-1]) + 1, 0)
    K, poses = np.asarray(CAMERA.matrix(), float), (np.asarray(made.rig.rotation), np.asarray(made.rig.translation))
    write_rig(
        folder / "rig.json", [RigCamera("", (640, 480), K, np.zeros(5), *pose) for pose in zip(*poses, strict=True)]
    )
    return [*face_files(folder, made, kept), "--rig", str(folder / "rig.json")], FPS


def head_mono_files(folder, kept):
    made = sequence(jax.random.key(0), "slow", int(kept[-1]) + 1, 0, rig=monocular(CAMERA))
    write_camera(folder / "camera.json", (640, 480), K=np.asarray(CAMERA.matrix(), float))
    return [*face_files(folder, made, kept), "--camera", str(folder / "camera.json"), "--detector", "cascades"], FPS


def fingertip_files(folder, kept):
    images = [image for _, image in islice(DemoHand(0).images(), int(kept[-1]) + 1)]
    return [images_in(folder / "desk", [(k, images[k]) for k in kept])], 30.0


FILES = {
    "hand-depth": hand_depth_files,
    "articulated": articulated_files,
    "people": people_files,
    "head-stereo": head_stereo_files,
    "head-mono": head_mono_files,
    "fingertips": fingertip_files,
}
"""`(folder, frames kept) -> (arguments, frames per second)` of a recording of each system."""


def rows_of(out):
    with (out / "track.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.system
@pytest.mark.parametrize("name", NAMES_OF_SYSTEMS)
def test_a_recording_without_a_third_of_its_frames_is_followed_at_its_own_times(name, tmp_path, monkeypatch):
    """Rows are of the frames that are there, at their times; a run that was cut off half-way goes on to the same."""
    monkeypatch.setenv("XLA_FLAGS", "")  # `main` sets it
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)
    num_frames = NUM_FRAMES.get(name, 60)
    dropped = random.Random(name).sample(range(1, num_frames - 1), num_frames // 3)
    kept = np.setdiff1d(np.arange(num_frames), dropped)
    arguments, fps = FILES[name](tmp_path, kept)
    command = ["track", name, *arguments, "--no-video", "--out"]
    save, whole, part = results.TrackWriter.checkpoint, tmp_path / "whole", tmp_path / "part"

    def save_and_copy(self, *state, **more):
        save(self, *state, **more)
        if self.frames >= len(kept) // 2 and not part.exists():
            shutil.copytree(whole, part)

    with monkeypatch.context() as patch:
        patch.setattr(results.TrackWriter, "checkpoint", save_and_copy)
        assert main([*command, str(whole)]) == 0

    rows = rows_of(whole)
    frames = np.array([int(row["frame"]) for row in rows])
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], kept[frames] / fps, atol=2e-6)
    assert json.loads((whole / "report.json").read_text())["frames"] == len(kept)
    if name not in ("people", "fingertips"):  # which have a row for each of what is followed, if anything is
        np.testing.assert_array_equal(frames, np.arange(len(kept)))
    tracked = [row for row in rows if row["status"] == "tracking"]
    assert len({row["frame"] for row in tracked}) > len(kept) // 4
    assert not [(row["frame"], column) for row in tracked for column, cell in row.items() if cell in ("", "nan")]

    assert len(rows_of(part)) < len(rows)
    assert main([*command, str(part), "--resume"]) == 0
    assert (part / "track.csv").read_bytes() == (whole / "track.csv").read_bytes()


BLANK = np.full((48, 64, 3), 100, np.uint8)


class Capture:
    """A video of given images and stamps, as OpenCV reads it."""

    def __init__(self, times_s, images):
        self.stamps, self.images, self.done = 1000 * np.asarray(times_s), images, 0

    def get(self, what):
        rows, cols = self.images[0].shape[:2]
        known = {cv2.CAP_PROP_FPS: 10.0, cv2.CAP_PROP_FRAME_WIDTH: cols, cv2.CAP_PROP_FRAME_HEIGHT: rows}
        known[cv2.CAP_PROP_FRAME_COUNT] = len(self.images)
        return known.get(what, self.stamps[max(self.done - 1, 0)])

    def read(self):
        self.done += 1
        return (True, self.images[self.done - 1]) if self.done <= len(self.images) else (False, None)

    def release(self):
        pass


def blank_files(name, folder, times_s, monkeypatch):
    """The file, and the options that its command needs, of a recording that shows next to nothing but has times."""
    camera, file = folder / "camera.json", folder / "blank.npz"
    points = np.random.default_rng(0).uniform(0, 99, (21, 2))
    K = np.array([[75, 0, 31.5], [0, 75, 23.5], [0, 0, 1.0]])
    if name == "hand-depth":
        np.savez(file, depth_mm=np.full((len(times_s), 48, 64), 800, np.uint16), K=K, t_us=1e6 * np.asarray(times_s))
        return [file]
    if name == "articulated":
        np.savez(file, keypoints=np.tile(points, (len(times_s), 1, 1)), t_s=times_s)
        return [file]
    file = folder / "blank.mp4"
    file.touch()
    images = [BLANK] * len(times_s)
    if name == "fingertips":  # which need a hand to know its colour and its size
        images = [image for _, image in islice(DemoHand(0).images(), len(times_s))]
    monkeypatch.setattr(VideoFile, "_open", lambda self: Capture(times_s, images))
    write_camera(camera, (64, 48), **({"P": K @ FLOOR} if name == "people" else {"K": K}))
    (folder / "scene.json").write_text('{"floor": [[-1, 0], [1, 0], [1, 2], [-1, 2]]}')
    options = {"people": ["--camera", camera, "--scene", folder / "scene.json"], "fingertips": []}
    return [file, *options.get(name, ["--camera", camera])]


TIMES = {"repeated": 0.2, "late": 0.15}
"""Seconds of the fourth frame, after one at 0.2 s."""


@pytest.mark.system
@pytest.mark.parametrize("how", TIMES)
@pytest.mark.parametrize("name", NAMES_OF_SYSTEMS)
def test_a_frame_that_comes_twice_or_late_is_announced_in_one_line(name, how, tmp_path, monkeypatch, capsys):
    """Times in a file of arrays must increase; the frames of a video are in order, whatever their stamps."""
    monkeypatch.setenv("XLA_FLAGS", "")  # `main` sets it
    file, *options = map(str, blank_files(name, tmp_path, [0.0, 0.1, 0.2, TIMES[how], 0.3], monkeypatch))
    code = main(["track", name, file, *options, "--no-video", "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    if file.endswith(".npz"):
        assert code == 2
        expected = f"{file}: times must increase strictly; frame 2 is at 0.200000 s, frame 3 at {TIMES[how]:.6f} s"
        assert f"jaxfilters: error: {expected}" in said
        return
    assert code == 0, said
    expected = "1 time stamps do not increase; these frames were taken to follow the one before by 1/10 s"
    assert file in said
    assert expected in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"] == 5
    assert expected in " ".join(report["trouble"])
