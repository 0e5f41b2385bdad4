import json
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.articulated.features import FULL
from jaxfilters.models.articulated.layout import LINKS, Layout
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.synthetic.articulated import paper_hand, simulate_paper
from jaxfilters.trackers.articulated.recording import FeatureSequence, Start
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack
from jaxfilters.trackers.hand_depth.recording import from_array
from jaxfilters.trackers.tracker import HandTrack, Tracker

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
    """Puts a random walk in the place of the hand tracker, so that the application is tested quickly."""
    from jaxfilters.trackers.hand_depth import tracker as hand_depth

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
            innovations=jnp.asarray([20, 19], jnp.int32),
            effective_sample_size=jnp.asarray(32.0, jnp.float32),
            log_evidence=-jnp.abs(walk[0]),
            status=jnp.asarray(1, jnp.int32),
        )
        nothing = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), row._replace(innovations=0.0, status=0.0))
        nothing = nothing._replace(innovations=jnp.zeros(2, jnp.int32), status=jnp.asarray(0, jnp.int32))
        observed = jnp.isfinite(frame).any()
        return FakeState(key, state.frames + 1, wrist), jax.tree.map(partial(jnp.where, observed), row, nothing)

    step_all = jax.jit(lambda state, frames, times: jax.lax.scan(step, state, (frames, times)))
    return Tracker(start, step_all)


def _mean(frame):
    observed = jnp.isfinite(frame)
    return jnp.where(observed, frame, 0.0).sum() / jnp.maximum(observed.sum(), 1)


def _joints(frames):
    """(frames, 21, 3): five straight fingers that spread upwards from the wrist, 0.6 m in front of the camera."""
    directions = np.stack([np.linspace(-0.5, 0.5, 5), -np.ones(5), np.zeros(5)], axis=-1)
    fingers = directions[:, None] * np.asarray([0.08, 0.12, 0.14, 0.16])[None, :, None]
    joints = np.asarray([0.0, 0.08, 0.6]) + np.concatenate([np.zeros((1, 3)), fingers.reshape(20, 3)])
    return np.repeat(joints[None], frames, axis=0).astype(np.float32)


@pytest.fixture(scope="session")
def features():
    """A hand with two fingers in FRAMES frames, with start and truth; nothing was measured in frame 5."""
    made = simulate_paper(jax.random.key(2), num_frames=FRAMES)
    y = np.where(np.asarray(made.masks), np.asarray(made.features, float), np.nan)
    y[5] = np.nan
    return FeatureSequence(
        num_fingers=2,
        features=FULL,
        times_s=2.0 + np.arange(FRAMES) / 25,
        y=y,
        std=np.tile(np.asarray(made.noise_std, float), (FRAMES, 1)),
        name="features",
        start=Start(np.asarray(made.initial_mean, float), np.asarray(made.initial_covariance, float)),
        truth=np.asarray(made.states, float),
    )


@pytest.fixture(scope="session")
def perfect_track(features):
    """The truth of the features, as an estimate."""
    hand = paper_hand()
    states = jnp.asarray(features.truth)
    points = np.asarray(jax.jit(jax.vmap(hand.points))(states))
    ones = np.ones(FRAMES, np.float32)
    return TimedArticulatedTrack(
        times_s=features.times_s,
        mean=features.truth.astype(np.float32),
        std=np.full(features.truth.shape, 0.1, np.float32),
        points=points,
        points_std=np.full_like(points, 0.5),
        points_from_wrist_std=np.full_like(points, 0.25),
        image_points=points[..., :2],
        scale=(features.truth[:, hand.layout.quaternion] ** 2).sum(axis=1).astype(np.float32),
        weight=ones,
        num_hypotheses=np.arange(FRAMES, dtype=np.int32) % 3,
        is_new_view=np.zeros(FRAMES, bool),
        nis_per_row=ones,
        innovations=np.full((FRAMES, 2), (20, 19), np.int32),
        least_distance=ones,
        log_evidence=-ones,
        length_observed=np.arange(FRAMES)[:, None] > np.arange(hand.layout.lengths.stop - hand.layout.lengths.start),
        status=np.arange(FRAMES, dtype=np.int32) % 3,
    )


@pytest.fixture(scope="session")
def nothing_tracked():
    """`(layout, frames) -> track` of an articulated hand, with zeros in every field."""

    def made(layout, frames):
        joints, one = (frames, layout.num_fingers, LINKS + 1), np.zeros(frames, np.float32)
        return TimedArticulatedTrack(
            times_s=np.zeros(frames),
            mean=np.zeros((frames, layout.size), np.float32),
            std=np.zeros((frames, layout.size), np.float32),
            points=np.zeros((*joints, 3), np.float32),
            points_std=np.zeros((*joints, 3), np.float32),
            points_from_wrist_std=np.zeros((*joints, 3), np.float32),
            image_points=np.zeros((*joints, 2), np.float32),
            scale=one,
            weight=one,
            num_hypotheses=np.zeros(frames, np.int32),
            is_new_view=np.zeros(frames, bool),
            nis_per_row=one,
            innovations=np.zeros((frames, 2), np.int32),
            least_distance=one,
            log_evidence=one,
            length_observed=np.zeros((frames, LINKS * layout.num_fingers), bool),
            status=np.zeros(frames, np.int32),
        )

    return made


@pytest.fixture
def fake_articulated(monkeypatch, features):
    """Puts a random walk in the place of the articulated tracker, so that the application is tested quickly."""
    from jaxfilters.trackers.articulated import tracker as articulated_hand

    monkeypatch.setattr(articulated_hand, "build", build_fake_articulated)
    monkeypatch.setattr(articulated_hand, "synthetic_sequence", lambda seed: features)


def build_fake_articulated(sequence, config):
    """A tracker whose every row depends on the random key, the frame, the time and all rows before it.

    A frame without any measurement has a row of NaN and the status `searching`.
    """
    from jaxfilters.trackers.articulated.state import ArticulatedTrack

    del config
    layout = Layout(sequence.num_fingers)
    first = jnp.zeros(layout.size).at[layout.quaternion].set(jnp.asarray([1.0, 0.0, 0.0, 0.0]))
    first = first if sequence.start is None else jnp.asarray(sequence.start.mean, jnp.float32)
    fan = 10.0 * jnp.arange(1.0, 5.0)[None, :, None] * jnp.asarray([1.0, -2.0, 0.5])
    fan = jnp.tile(fan, (layout.num_fingers, 1, 1)) + 15.0 * jnp.arange(layout.num_fingers)[:, None, None]

    def start(key, frame):
        return FakeState(key, jnp.zeros((), jnp.int32), first + jnp.mean(frame.y))

    def step(state, inputs):
        frame, time_s = inputs
        key, noise_key = jax.random.split(state.key)
        walk = 0.1 * jax.random.normal(noise_key, (layout.size,), jnp.float32)
        mean = 0.9 * state.wrist + 0.1 * first + walk + 0.01 * jnp.mean(frame.y) + 0.01 * jnp.sin(time_s)
        points = fan + jnp.concatenate([mean[layout.position], jnp.zeros(1)])
        one = jnp.ones((), jnp.float32)
        row = ArticulatedTrack(
            mean=mean,
            std=jnp.full(layout.size, 0.5, jnp.float32),
            points=points,
            points_std=jnp.full_like(points, 0.5),
            points_from_wrist_std=jnp.full_like(points, 0.25),
            image_points=points[..., :2],
            scale=jnp.sum(mean[layout.quaternion] ** 2),
            weight=0.75 * one,
            num_hypotheses=jnp.asarray(2, jnp.int32),
            is_new_view=state.frames % 2 == 0,
            nis_per_row=one,
            innovations=jnp.asarray([20, 19], jnp.int32),
            least_distance=-one,
            log_evidence=walk[0],
            length_observed=jnp.zeros(LINKS * layout.num_fingers, bool),
            status=jnp.asarray(1, jnp.int32),
        )
        whole = {"num_hypotheses": 0, "innovations": 0, "is_new_view": False, "length_observed": False, "status": 0}
        nothing = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), row._replace(**dict.fromkeys(whole, 0.0)))
        nothing = nothing._replace(**{name: jnp.full_like(getattr(row, name), x) for name, x in whole.items()})
        row = jax.tree.map(partial(jnp.where, frame.mask.any()), row, nothing)
        return FakeState(key, state.frames + 1, mean), row

    step_all = jax.jit(lambda state, frames, times: jax.lax.scan(step, state, (frames, times)))
    return Tracker(start, step_all)


@pytest.fixture(scope="session")
def face_model():
    """A face with room for five modes, of which two are learnt: mouth corners outwards, and brows with the mouth."""
    from jaxfilters.models.face.landmarks import BROWS, MEAN_SHAPE, MOUTH
    from jaxfilters.models.face.shape_model import FaceModel

    smile, brows = np.zeros((10, 3)), np.zeros((10, 3))
    smile[list(MOUTH)] = [[-1, -0.3, 0.3], [1, -0.3, 0.3]]
    brows[list(BROWS)] = [[0, -1, 0.2]] * 2
    brows[list(MOUTH)] = [[0.2, 1, 0.2], [-0.2, 1, 0.2]]
    basis = np.zeros((30, 5), np.float32)
    basis[:, :2] = np.stack([mode.ravel() / np.linalg.norm(mode) for mode in (smile, brows)], axis=1)
    templates = np.random.default_rng(0).uniform(0, 255, (2, 10, 16, 16)).astype(np.float32)
    deviation = np.array([5.0, 3, 0, 0, 0])
    return FaceModel(*(jnp.asarray(array, jnp.float32) for array in (MEAN_SHAPE, basis, deviation, templates)))


@pytest.fixture(scope="session")
def face_track(face_model):
    """`(track, truth)` of FRAMES frames before the nominal rig: two initialise, frame 20 is skipped, 30 to 32 lost."""
    from jaxfilters.models.face.rig import nominal, project_shape
    from jaxfilters.models.face.shape_model import shape
    from jaxfilters.models.synthetic.face_motion import motion
    from jaxfilters.trackers.head.common.report import HeadTruth
    from jaxfilters.trackers.head.common.table import TimedHeadTrack

    rng = np.random.default_rng(1)
    poses = motion("mix", FRAMES, 1)
    a = np.zeros((FRAMES, 5), np.float32)
    a[15:, :2] = 5 * np.sin(np.arange(FRAMES - 15) / 4)[:, None] * [1, 0.5]
    shapes = jax.vmap(shape, in_axes=(None, 0))(face_model, jnp.asarray(a))
    project = jax.vmap(partial(project_shape, nominal()))
    std = np.array([0.5, 0.5, 2.0, 0.01, 0.02, 0.02])
    pose = (poses + rng.normal(0, std, poses.shape)).astype(np.float32)
    status = np.repeat([0, 1, 2, 5, 2, 3, 2], [2, 13, 5, 1, 9, 3, FRAMES - 33]).astype(np.int32)
    tracked = (status == 1) | (status == 2)

    def known(values, where=tracked):
        values = np.asarray(values, np.float32)
        return np.where(where.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)

    metres = np.array([1e-3, 1e-3, 1e-3, 1, 1, 1])
    track = TimedHeadTrack(
        times_s=np.arange(FRAMES) / 30,
        pose=known(metres * pose),
        pose_std=known(np.tile(metres * std, (FRAMES, 1))),
        deformation=known(1e-3 * a),
        shape=known(1e-3 * shapes),
        image_points=known(project(shapes, jnp.asarray(pose))[0]),
        score=known(0.85 - 0.1 * rng.random(FRAMES), status != 5),
        effective_sample_size=known(np.full(FRAMES, 300.0), status != 5),
        innovations=known(np.full((FRAMES, 2), (6.0, 5.0))),
        status=status,
    )
    return track, HeadTruth(metres * poses, np.asarray(project(shapes, jnp.asarray(poses, jnp.float32))[0]))


@pytest.fixture
def fake_head(monkeypatch, face_model):
    """Puts something quick in the place of the head tracker; what it was made with and fed is in the list returned.

    A pose tells of its images: x is the mean grey of the first camera and y that of the last in thousandths, z the
    time. The first two frames initialise; a frame darker than 10 is lost, with a pose that nobody should see.
    """
    from jaxfilters.trackers.head.common.state import HeadTrack
    from jaxfilters.trackers.head.common.table import in_metres
    from jaxfilters.trackers.head.stereo import command as head_command

    made = []

    class FakeSession(head_command.HeadSession):
        model, contribution, events = None, 0.0, ()

        def __init__(self, rig, options, points, *, focal_log_std=0.0):
            self.rig, self.options, self.points, self.frames = rig, options, points, 0
            self.focal_log_std = focal_log_std
            self.events, self.sizes = [], []
            made.append(self)

        def saved(self):
            is_lost = self.frames in (11, 12)
            return None if is_lost or self.model is None else {"frames": self.frames, "events": self.events}

        def restore(self, saved):
            self.frames, self.events = saved["frames"], saved["events"]
            self.model, self.contribution = face_model, 0.75

        def process(self, images, times):
            assert images.dtype == np.uint8
            assert images.shape[1:] == (self.rig.num_cameras, *self.rig.shape)
            b = len(images)
            means = images.mean(axis=(2, 3))
            index = self.frames + np.arange(b)
            self.frames += b
            self.sizes.append(b)
            status = np.where(index < 2, 0, np.where(means[:, 0] < 10, 3, np.where(index < 6, 1, 2))).astype(np.int32)
            if self.frames > 2 and self.model is None:
                self.model, self.contribution = face_model, 0.75
                self.events += [(2, "registered"), (12, "learnt")]
            zero = np.zeros(b)
            track = HeadTrack(
                pose=np.stack([means[:, 0], means[:, -1], 1000 * times, zero + 0.1, zero + 0.2, zero + 0.3], axis=-1),
                pose_std=np.full((b, 6), 0.5),
                deformation=np.ones((b, 2)),
                shape=np.tile(face_model.mean, (b, 1, 1)),
                image_points=np.full((b, self.rig.num_cameras, 10, 2), 5.0),
                score=np.full(b, 0.75),
                effective_sample_size=np.full(b, 100.0),
                innovations=np.full((b, 2), (6, 5)),
                status=status,
            )
            return in_metres(track)

    monkeypatch.setattr(head_command, "HeadSession", FakeSession)
    return made
