"""Turns of made meshes, whose mouths move, against those that made them; one real face where MediaPipe is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.scenarios._mesh_agreement import agreement, compared, turns
from jaxfilters.benchmarks.scenarios.head_real import read_video


def made(seed=0, frames=40):
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=(120, 3)) * (60, 80, 30)
    true = Rotation.from_euler("ZYX", rng.normal(0, [5, 15, 8], (frames, 3)), degrees=True)
    moved = np.repeat(shape[None], frames, axis=0)
    moved[:, :40] += rng.normal(0, 6, (frames, 1, 3))
    meshes = np.einsum("tij,tvj->tvi", true.as_matrix(), moved)
    return true, rng.uniform(0.8, 1.2, (frames, 1, 1)) * meshes + rng.normal(0, 50, (frames, 1, 3))


def test_turns_are_those_of_the_head_whatever_the_mouth_does():
    true, meshes = made()
    metrics = compared(true, turns(meshes))
    for axis in ("roll", "yaw", "pitch"):
        assert metrics[f"{axis}_rms"].value < 0.05
        assert metrics[f"{axis}_correlation"].value > 0.9999


def test_what_turns_otherwise_does_not_agree():
    true, meshes = made(1)
    other, _ = made(2)
    metrics = compared(other, turns(meshes))
    # 40 frames: the correlation of independent courses is beyond .6 once in ten thousand.
    assert abs(metrics["yaw_correlation"].value) < 0.6
    spread = np.std(np.degrees((true * true.mean().inv()).as_euler("ZYX"))[:, 1])
    assert metrics["yaw_rms"].value > spread


def test_a_constant_turn_between_the_two_is_no_difference():
    """About the camera's own axes, as another idea of what a face straight ahead is makes one of the head's."""
    true, meshes = made(3)
    tilted = true * Rotation.from_euler("ZYX", [3.0, -4, 7], degrees=True)
    metrics = compared(tilted, turns(meshes))
    assert metrics["pitch_rms"].value < 0.05


def test_the_slope_does_not_shrink_with_errors_of_either_course():
    """A course of 1.1 times the turns, errors of 5 degrees in both, and turns of 10: 0.88 by ordinary least squares."""
    rng = np.random.default_rng(4)
    turn = 10 * rng.standard_normal(4000)
    yaws = (scale * turn + 5 * rng.standard_normal(4000) for scale in (1.1, 1.0))
    one, other = (np.stack([rng.normal(0, 0.01, 4000), yaw, rng.normal(0, 0.01, 4000)], axis=-1) for yaw in yaws)
    metrics = compared(*(Rotation.from_euler("ZYX", angles, degrees=True) for angles in (one, other)))
    # Four times the standard deviation of the slope over a thousand other seeds, .012.
    assert metrics["yaw_slope"].value == pytest.approx(1.1, abs=0.05)
    assert metrics["yaw_slope"].better == 1.0


def test_a_mesh_is_found_in_the_tracked_frames_of_a_real_face(data_dir):
    """Beside a track that nods for itself."""
    pytest.importorskip("mediapipe")
    images, _ = read_video(data_dir / "talking_face_video" / "franck.mp4", 60)
    poses = 0.1 * np.sin(np.arange(60)[:, None] + np.arange(6))
    metrics = agreement("franck", images, poses, np.arange(60) > 10)
    assert metrics["franck_mesh_frames"].value == 13
    assert 0 < metrics["franck_mesh_yaw_range"].value < 30
