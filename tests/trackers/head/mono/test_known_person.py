"""A person of one run of `track head-mono` in a later one, by the file that the first run writes."""

import json

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM, motion, speech_schedule
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io.cameras import write_camera

FIRST_FRAMES, LATER_FRAMES = 120, 40


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


@pytest.fixture
def followed(rig, tmp_path):
    """`(name, person, frames, seed) -> report`: a run on images of a synthetic person who moves and speaks."""
    K = np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]])
    write_camera(tmp_path / "camera.json", (640, 480), K=K)

    def follow(name, person, frames, seed, *options):
        poses = motion("mix", frames, seed, place_mm=MONOCULAR_PLACE_MM)
        made = face_sequence(jax.random.key(person), poses, rig=rig, expressions=speech_schedule(frames, start=20))
        folder = tmp_path / f"{name}_images"
        folder.mkdir()
        for i, image in enumerate(made.frames(0, frames)[:, 0]):
            cv2.imwrite(str(folder / f"{i:03d}.png"), image)
        lines = [f"{landmark},{u},{v}" for landmark, (u, v) in zip(NAMES, np.asarray(made.uv[0, 0]), strict=True)]
        marks = tmp_path / f"{name}.csv"
        marks.write_text("\n".join(["name,u,v", *lines]) + "\n")
        given = ["--camera", tmp_path / "camera.json", "--points", marks, "--out", tmp_path / name, "--no-video"]
        assert main(["track", "head-mono", *map(str, [folder, *given, *options])]) == 0
        return json.loads((tmp_path / name / "report.json").read_text())

    return follow


@pytest.mark.system
def test_the_file_of_a_run_is_read_by_the_next_which_recognises_the_person_and_nobody_else(followed, tmp_path):
    """The information of a hundred frames in single precision is not symmetric to the last digit when inverted."""
    first = followed("ann", 33, FIRST_FRAMES, 3)
    assert first["adjusted_frames"] > 10
    known = ("--known", tmp_path / "ann" / "person.npz")
    assert followed("again", 33, LATER_FRAMES, 5, *known)["taken_for"]["ann"] > LATER_FRAMES / 2
    assert followed("other", 34, LATER_FRAMES, 5, *known)["taken_for"] == {}
