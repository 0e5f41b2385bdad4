"""`jaxfilters track head-mono` from end to end, with something quick in the place of the tracker."""

import csv
import dataclasses
import json
from functools import partial

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxfilters.models.face.gallery import Gallery
from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.models.face.person_prior import Person
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.head.common import input as head_input
from jaxfilters.trackers.head.common.table import SKIPPED, with_gaps
from jaxfilters.trackers.head.mono import command as mono_command
from jaxfilters.trackers.head.mono.focal import FocalLength
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.head.mono.table import empty_mono_rows, mono_in_metres
from jaxfilters.trackers.io.cameras import write_camera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.face_models import default_face_model, save_face_model

ROWS, COLS, FRAMES = 48, 64, 20
FILM_MM = np.hypot(36, 24)
"""Diagonal."""
OUTPUTS = {"person.npz", "track.csv", "track.npz", "report.json", "summary.png", "overlay.mp4"}


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(*arguments):
    return main(["track", "head-mono", *map(str, arguments)])


def made_track(means, times, status, face):
    b, zero = len(means), np.zeros(len(means))
    return MonoTrack(
        pose=np.stack([means, means, 1000 * times, zero + 0.1, zero + 0.2, zero + 0.3], axis=-1),
        pose_std=np.full((b, 6), 0.5),
        deformation=np.full((b, face.num_expressions), 0.25),
        shape=np.tile(np.asarray(face.mean), (b, 1, 1)),
        image_points=np.full((b, 1, 10, 2), 5.0),
        score=np.full(b, 0.75),
        effective_sample_size=np.full(b, 100.0),
        innovations=np.full((b, 2), (6, 5)),
        identity=np.full((b, face.num_identities), 1.5),
        offset=np.zeros((b, 10, 3)),
        person_index=np.where(np.arange(b) < b // 2, -1, 0),
        is_adjusted=np.arange(b) % 2 == 0,
        status=status,
    )


@pytest.fixture
def fake(monkeypatch):
    """Stands in for the session: two frames without a face, then a pose that tells of the images."""
    made = []

    class FakeSession(mono_command.MonoSession):
        events, model, person, gallery = (), None, None, None

        def __init__(self, rig, face, options, points, *, detector, gallery=None, focal_log_std=0.0):
            self.known, self.focal_log_std = gallery, focal_log_std
            self.rig, self.face, self.options, self.points, self.frames = rig, face, options, points, 0
            self.events = []
            made.append(self)

        def saved(self):
            return None

        def focal_length(self):
            return FocalLength(np.float32(1.1), np.float32(0.1))

        def process(self, images, times):
            assert images.shape[1:] == (1, *self.rig.shape)
            index = self.frames + np.arange(len(images))
            self.frames += len(images)
            if self.person is None:
                # A detector that puts the outer corner of an eye 10 mm too far out: the face is the mean one.
                self.person = Person(self.face.identity_mean, jnp.zeros((10, 3)).at[3, 0].set(10.0))
                who = (self.face.identity_mean, self.face.identity_covariance, jnp.zeros((10, 3)))
                self.gallery = Gallery(*(leaf[None] for leaf in who))
                self.events.append((2, "registered"))
            status = np.where(index < 2, 0, 2).astype(np.int32)
            return mono_in_metres(made_track(images.mean(axis=(1, 2, 3)), times, status, self.face))

    monkeypatch.setattr(mono_command, "MonoSession", FakeSession)
    return made


@pytest.fixture
def pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((ROWS, COLS, 3), 100 + i, np.uint8))
    return folder


@pytest.mark.system
def test_track_writes_all_results_with_identity(pictures, fake, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(pictures, "--out", out, "--seed", 4, "--num-particles", 60, "--eyes-apart-mm", 64.5) == 0
    assert {file.name for file in out.iterdir()} == OUTPUTS
    with (out / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["searching"] * 2 + ["tracking"] * (FRAMES - 2)
    assert float(rows[7]["x_m"]) == pytest.approx(0.107, rel=1e-5)
    assert float(rows[7]["pitch_rad"]) == pytest.approx(0.3, rel=1e-5)
    assert (float(rows[7]["expression_5"]), float(rows[7]["identity_16"])) == (0.25, 1.5)
    assert np.isnan(float(rows[0]["identity_1"]))
    options = fake[0].options
    assert (options.seed, options.num_particles, options.eyes_apart_mm) == (4, 60, 64.5)
    # Those of the package, and the size.
    assert fake[0].face.num_identities == 15 + 1
    report = json.loads((out / "report.json").read_text())
    assert report["is_focal_length_assumed"] is True
    assert report["detector"] in ("cascades", "mediapipe")
    # A lens of 30 mm, of which the diagonal of film is 43.27.
    assert report["focal_length_px"][0] == pytest.approx(30 / FILM_MM * np.hypot(COLS, ROWS))
    assert report["focal_length_log_std"] == fake[0].focal_log_std == 0.25
    # Of the mean face of people.
    assert report["eyes_apart_mm"] == pytest.approx(63.1, abs=0.01)
    assert report["events"] == [{"frame": 2, "what": "registered"}]
    assert report["adjusted_frames"] > 0
    assert "generator" in report["face_model"]["source"]
    with np.load(out / "track.npz") as track:
        assert track["identity"].shape == (FRAMES, 16)
        assert track["person_identity"].shape == (16,)
        assert track["person_offset"][3, 0] == pytest.approx(0.01)
        assert track["status_names"][int(track["status"][5])] == "tracking"
    captured = capsys.readouterr()
    assert "assumed focal length" in captured.err
    assert "90 % tracked" in captured.out


def test_whom_one_run_followed_the_next_may_know(pictures, fake, tmp_path, capsys):
    assert run(pictures, "--out", tmp_path / "ann", "--no-video") == 0
    assert run(pictures, "--out", tmp_path / "again", "--known", tmp_path / "ann" / "person.npz", "--no-video") == 0
    assert fake[0].known is None
    np.testing.assert_allclose(fake[1].known.identity[0], fake[1].face.identity_mean)
    reports = [json.loads((tmp_path / name / "report.json").read_text()) for name in ("ann", "again")]
    assert reports[0]["taken_for"] == {}
    assert reports[1]["taken_for"] == {"ann": FRAMES // 2}
    assert reports[1]["options"]["known"] == [str(tmp_path / "ann" / "person.npz")]
    with (tmp_path / "again" / "track.csv").open(newline="") as file:
        assert [float(row["person_index"]) for row in csv.DictReader(file)][3:5] == [-1, 0]
    file = default_face_model()
    other = dataclasses.replace(file.model, mean=1.01 * file.model.mean)
    save_face_model(tmp_path / "other.npz", file._replace(model=other))
    wrong = ("--model", tmp_path / "other.npz", "--known", tmp_path / "ann" / "person.npz")
    assert run(pictures, "--out", tmp_path / "wrong", *wrong) == 2
    assert "people of another model of the face" in capsys.readouterr().err


def test_the_focal_length_is_said_if_asked_for(pictures, fake, tmp_path, capsys):
    assert run(pictures, "--out", tmp_path / "out", "--estimate-focal", "--no-video") == 0
    estimate = json.loads((tmp_path / "out" / "report.json").read_text())["focal_length_estimate"]
    assumed = 30 / FILM_MM * np.hypot(COLS, ROWS)
    assert estimate["px"] == pytest.approx(1.1 * assumed, rel=1e-4)
    assert estimate["std_px"] == pytest.approx(0.1 * 1.1 * assumed, rel=1e-4)
    assert "the focal length looks like 61 px, give or take 6" in capsys.readouterr().out
    assert run(pictures, "--out", tmp_path / "again", "--no-video") == 0
    assert json.loads((tmp_path / "again" / "report.json").read_text())["focal_length_estimate"] is None


def test_the_focal_length_is_that_of_the_metadata_or_of_the_camera_file(fake, tmp_path, capsys):
    folder = tmp_path / "pictures"
    folder.mkdir()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    for i in range(FRAMES):
        Image.fromarray(np.full((ROWS, COLS, 3), 100 + i, np.uint8)).save(folder / f"{i:03d}.jpg", exif=exif)
    assert run(folder, "--out", tmp_path / "a", "--no-video") == 0
    focal = 26 / FILM_MM * np.hypot(COLS, ROWS)
    np.testing.assert_allclose(fake[0].rig.focal, [[focal, focal]], rtol=1e-5)
    assert fake[0].focal_log_std == 0.1
    assert f"a focal length of {focal:.0f} px from the file's metadata (26 mm on film)" in capsys.readouterr().err
    write_camera(tmp_path / "camera.json", (COLS, ROWS), K=np.array([[80.0, 0, 31], [0, 80, 23], [0, 0, 1]]))
    assert run(folder, "--out", tmp_path / "b", "--camera", tmp_path / "camera.json", "--no-video") == 0
    assert (float(fake[1].rig.focal[0, 0]), fake[1].focal_log_std) == (80.0, 0.0)
    report = json.loads((tmp_path / "b" / "report.json").read_text())
    assert report["is_focal_length_assumed"] is False


def test_marked_landmarks_reach_the_session(pictures, fake, tmp_path):
    marks = tmp_path / "marks.csv"
    lines = [f"{name},{10 + i},{20 + i}" for i, name in enumerate(NAMES)]
    marks.write_text("\n".join(["name,u,v", *lines]) + "\n")
    assert run(pictures, "--out", tmp_path / "out", "--points", marks, "--no-video") == 0
    np.testing.assert_allclose(fake[0].points[3], (13, 23))
    assert fake[0].options.landmarks == "aligned"


@pytest.mark.system
@pytest.mark.parametrize("num_expressions", [3, 8])
def test_models_of_any_number_of_expressions_make_tables(pictures, fake, tmp_path, num_expressions):
    file = default_face_model()
    tensor = np.random.default_rng(0).normal(size=(10, 3, 15, num_expressions))
    model = dataclasses.replace(
        file.model,
        tensor=jnp.asarray(tensor, float),
        expression_mean=jnp.zeros(num_expressions),
        expression_covariance=jnp.eye(num_expressions),
    )
    save_face_model(tmp_path / "other.npz", file._replace(model=model))
    assert run(pictures, "--out", tmp_path / "out", "--model", tmp_path / "other.npz", "--no-video") == 0
    with np.load(tmp_path / "out" / "track.npz") as track:
        assert track["deformation"].shape == (FRAMES, num_expressions)


def test_another_model_is_used_and_recorded(pictures, fake, tmp_path):
    file = default_face_model()
    save_face_model(tmp_path / "mine.npz", file._replace(source="my friends"))
    assert run(pictures, "--out", tmp_path / "out", "--model", tmp_path / "mine.npz", "--no-video") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["face_model"]["source"] == "my friends"
    assert not (tmp_path / "out" / "overlay.mp4").exists()


def test_what_cannot_be_used_is_said(pictures, fake, tmp_path, capsys):
    assert run(pictures, "--out", tmp_path / "a", "--eyes-apart-mm", 6) == 2
    assert "eyes_apart_mm must be within 40 and 80" in capsys.readouterr().err
    assert run(pictures, "--out", tmp_path / "b", "--model", tmp_path / "none.npz") == 2
    assert "none.npz" in capsys.readouterr().err
    assert run(tmp_path / "no_video.mp4", "--out", tmp_path / "c") == 2
    assert run("--out", tmp_path / "d", "--camera", tmp_path / "camera.json") == 2
    assert "--camera: of no use without a recording" in capsys.readouterr().err
    assert not any(tmp_path.glob("[a-d]/track.csv"))


def test_a_track_of_another_run_is_not_overwritten(pictures, fake, tmp_path, capsys):
    assert run(pictures, "--out", tmp_path / "out") == 0
    assert run(pictures, "--out", tmp_path / "out") == 2
    assert "holds the track of another run" in capsys.readouterr().err


def test_a_model_of_other_landmarks_is_refused(monkeypatch, tmp_path):
    file = default_face_model()
    other = file._replace(names=tuple(f"point {i}" for i in range(10)))
    monkeypatch.setattr(mono_command, "load_face_model", lambda path: other)
    with pytest.raises(InputError, match="which differ in right eye outer; the tracker follows the 10"):
        mono_command.track(mono_options(model=tmp_path / "m.npz", out=tmp_path))


def mono_options(**given):
    from argparse import Namespace

    usual = dict(video_source=None, camera=None, points=None, fps=None, seed=None, num_particles=None, video=False)
    usual |= dict(resume=False, variant="recommended")
    return Namespace(**usual | dict(eyes_apart_mm=None, seconds=None, estimate_focal=False, known=None) | given)


def test_the_synthetic_face_is_one_camera_with_truth(monkeypatch, tmp_path):
    monkeypatch.setattr(head_input, "_SYNTHETIC_FRAMES", 5)
    place = head_input.setup_of_one(None, head_input.Places(), 0)
    assert place.rig.num_cameras == 1
    assert place.points.shape == (10, 2)
    assert place.truth.poses.shape == (5, 6)
    assert place.sources[0].image_size == (640, 480)


def test_rows_of_lost_and_skipped_frames_are_empty():
    face = default_face_model().model
    track = made_track(np.full(2, 7.0), np.zeros(2), np.array([3, 2], np.int32), face)
    rows = with_gaps(track, np.arange(3.0), [True, False, True], partial(empty_mono_rows, face))
    assert np.isnan(rows.pose[:2]).all()
    assert np.isnan(rows.identity[:2]).all()
    assert rows.identity[2, 0] == 1.5
    np.testing.assert_array_equal(rows.status, [3, SKIPPED, 2])
