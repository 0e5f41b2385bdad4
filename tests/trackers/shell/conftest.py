import json
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.depth_sequence import from_array
from jaxfilters.trackers.tracker import HandTrack, SequenceTracker

ROWS, COLS, FRAMES = 24, 32, 40


@pytest.fixture
def camera():
    return Pinhole.from_matrix([[30.0, 0, 15.25], [0, 31.0, 11.5], [0, 0, 1]], (ROWS, COLS))


@pytest.fixture
def depth_mm():
    """(FRAMES, ROWS, COLS) uint16 with a hand-sized blob, holes, and one frame without any reading."""
    rng = np.random.default_rng(3)
    depth = rng.integers(400, 900, (FRAMES, ROWS, COLS)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    depth[5] = 0
    return depth


@pytest.fixture
def times_us():
    steps = np.random.default_rng(4).integers(20_000, 60_000, FRAMES)
    return 790_154_000 + np.cumsum(steps)


@pytest.fixture
def recording(camera, depth_mm, times_us):
    """The recording in memory, with a made-up truth."""
    sequence = from_array(camera, times_us * 1e-6, depth_mm / np.float32(1000))
    return replace(sequence, joints=_joints(FRAMES))


@pytest.fixture
def png_folder(tmp_path, depth_mm, times_us):
    """The recording as PNG files named by their time in microseconds, with `camera.json`."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for time_us, image in zip(times_us, depth_mm, strict=True):
        assert cv2.imwrite(str(folder / f"{time_us}.png"), image)
    (folder / "camera.json").write_text(json.dumps({"fx": 30.0, "fy": 31.0, "cx": 15.25, "cy": 11.5}))
    return folder


@pytest.fixture
def npz_file(tmp_path, depth_mm, times_us, camera):
    file = tmp_path / "recording.npz"
    np.savez_compressed(file, depth_mm=depth_mm, t_us=times_us, K=np.asarray(camera.matrix(), np.float64))
    return file


class FakeState(NamedTuple):
    """Everything a real state has: a random key, integers, floats."""

    key: jax.Array
    frames: jax.Array
    wrist: jax.Array


@pytest.fixture
def fake_tracker():
    return build_fake(None, None)


@pytest.fixture
def fake_hand_depth(monkeypatch, recording):
    """Puts a random walk in the place of the hand tracker, so that the shell is tested without its cost."""
    from jaxfilters.trackers import hand_depth

    monkeypatch.setattr(hand_depth, "build", build_fake)
    monkeypatch.setattr(hand_depth, "synthetic_sequence", lambda seed: (recording, _joints(FRAMES)))


def build_fake(camera, config):
    """A tracker whose every row depends on the random key, the frame, the time and all rows before it.

    A frame without any reading has a row of NaN and the status `searching`.
    """
    del camera, config

    def start(key, frame):
        return FakeState(key, jnp.zeros((), jnp.int32), jnp.asarray([0.0, 0.0, _mean(frame)], jnp.float32))

    def step(state, inputs):
        frame, time_s = inputs
        key, noise_key = jax.random.split(state.key)
        walk = 0.01 * jax.random.normal(noise_key, (3,), jnp.float32)
        wrist = (0.5 * (state.wrist + jnp.asarray([0.0, 0.0, _mean(frame)])) + walk).astype(jnp.float32)
        angles = jnp.full(15, jnp.sin(time_s), jnp.float32)
        row = HandTrack(
            pose=jnp.concatenate([wrist, jnp.asarray([1.0, 0.0, 0.0, 0.0], jnp.float32), angles]),
            pose_std=jnp.full(21, 0.01, jnp.float32),
            joints=wrist + _joints(1)[0] - _joints(1)[0, 0],
            ess=jnp.asarray(32.0, jnp.float32),
            log_evidence=-jnp.abs(walk[0]),
            status=jnp.asarray(1, jnp.int32),
        )
        nothing = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), row._replace(status=0.0))
        nothing = nothing._replace(status=jnp.asarray(0, jnp.int32))
        seen = jnp.isfinite(frame).any()
        return FakeState(key, state.frames + 1, wrist), jax.tree.map(partial(jnp.where, seen), row, nothing)

    advance = jax.jit(lambda state, frames, times: jax.lax.scan(step, state, (frames, times)))
    return SequenceTracker(start, advance)


def _mean(frame):
    seen = jnp.isfinite(frame)
    return jnp.where(seen, frame, 0.0).sum() / jnp.maximum(seen.sum(), 1)


def _joints(frames):
    """(frames, 21, 3): five straight fingers that spread upwards from the wrist, 0.6 m in front of the camera."""
    directions = np.stack([np.linspace(-0.5, 0.5, 5), -np.ones(5), np.zeros(5)], axis=-1)
    fingers = directions[:, None] * np.asarray([0.08, 0.12, 0.14, 0.16])[None, :, None]
    joints = np.asarray([0.0, 0.08, 0.6]) + np.concatenate([np.zeros((1, 3)), fingers.reshape(20, 3)])
    return np.repeat(joints[None], frames, axis=0).astype(np.float32)
