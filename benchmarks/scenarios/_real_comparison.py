"""The hand tracker with either filter, and registration alone, on recordings of real hands.

All three begin from the same search of the first frame. Registration alone is six Gauss-Newton steps from the pose of
the frame before, with the motion model as the prior. A recording's error is the mean distance of the 21 joints over its
frames and seeds; the p-value is that of a one-sided paired Wilcoxon signed-rank test over the recordings.
"""

import sys
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import _real_hands
from jaxfilters.benchmarks.scenarios._accuracy import p_value_better
from jaxfilters.benchmarks.scenarios._real_hands import HandRecording
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, register, target_from_image
from jaxfilters.models.hand.skeleton import forward_kinematics
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.filtering import (
    FRAME_INTERVAL,
    MOTION,
    REGISTRATION_STRIDE,
    WINDOW,
    Setup,
    TrackState,
    filled,
    look,
    particles_of,
    pose_moments,
)

NUM_SEEDS = 4
QUICK_RECORDINGS, QUICK_NUM_FRAMES = 7, 12
COUNTS, QUICK_COUNTS = (8, 64, 512, 4096), (8, 64)
"""Numbers of particles."""
SIX_STEPS = RegistrationConfig(widths=(0.03,) * 2 + (0.015,) * 4)

Follow = Callable[[HandRecording, int], float]
"""`(recording, seed) -> mean joint error in millimetres`, NaN where nothing was estimated."""


def real_metrics(num_particles: int, quick: bool) -> dict[str, Metric]:
    """Errors on the motions that nothing was chosen on, and on that of a camera; nothing where they are not there."""
    try:
        recordings = _recordings(quick)
    except RecordingError as error:
        sys.stderr.write(f"real hands left out: {error}\n")
        return {}
    seeds = range(1 if quick else NUM_SEEDS)
    ways: dict[str, Follow] = {
        "rbpf": partial(tracker_error, "rbpf", num_particles),
        "pf": partial(tracker_error, "pf", num_particles),
        "registration": registration_error,
    }
    errors = {name: errors_of(follow, recordings, seeds) for name, follow in ways.items()}
    for name, each in errors.items():
        sys.stdout.write(f"real hands, {name}, mm: {np.round(each, 1)}\n")
    found = {f"joint_error_mm_real_{name}": Metric(float(each.mean()), "mm", "lower") for name, each in errors.items()}
    found["p_value_rbpf_better_real"] = Metric(p_value_better(errors["rbpf"], errors["pf"]), "", "lower")
    p = p_value_better(errors["rbpf"], errors["registration"])
    found["p_value_rbpf_better_than_registration_real"] = Metric(p, "", "lower")
    for count in QUICK_COUNTS if quick else COUNTS:
        follow = partial(tracker_error, "rbpf", count)
        each = errors["rbpf"] if count == num_particles else errors_of(follow, recordings, seeds)
        found[f"errors_by_n_real_rbpf_n{count}"] = Metric(float(each.mean()), "mm", "lower")
    return found


def errors_of(follow: Follow, recordings: list[HandRecording], seeds: range) -> np.ndarray:
    """(recordings,) millimetres, the mean over the seeds."""
    return np.array([np.mean([follow(recording, seed) for seed in seeds]) for recording in recordings])


def tracker_error(filter: str, num_particles: int, recording: HandRecording, seed: int) -> float:
    """Of the tracker as users run it, given nothing but the recording."""
    config = HandDepthConfig(filter=filter, num_particles=num_particles, seed=seed)
    track = hand_depth.track(iter(recording.depth), recording.times_s, recording.camera, config)
    return _joint_error(np.asarray(track.joints), recording)


def registration_error(recording: HandRecording, seed: int) -> float:
    """Of registration alone, from the start that the tracker finds."""
    config = HandDepthConfig(num_particles=64, seed=seed)
    state = hand_depth.build(recording.camera, config).init(jax.random.key(seed), recording.depth[0])
    setup = hand_depth.set_up(recording.camera, config)
    return _joint_error(np.asarray(_registered(setup, state, jnp.asarray(recording.depth))), recording)


@jax.jit
def _registered(setup: Setup, state: TrackState, frames: Array) -> Array:
    """(t, 21, 3) joints, metres."""
    geometry = setup.hand(state).geometry
    root = jnp.diag(jnp.sqrt(MOTION.pose_variance_rate * FRAME_INTERVAL))
    shape = tuple(size // REGISTRATION_STRIDE for size in WINDOW)

    def follow(pose: Array, frame: Array) -> tuple[Array, Array]:
        image = look(setup, state, filled(frame, state.missing_is_background), pose)
        camera = image.camera.crop(jnp.zeros(2), shape, REGISTRATION_STRIDE)
        target = target_from_image(camera, image.observed[::REGISTRATION_STRIDE, ::REGISTRATION_STRIDE])
        found = register(camera, target, geometry, pose, PosePrior(pose, root), SIX_STEPS).pose
        return found, forward_kinematics(found, geometry).joints

    start, _ = pose_moments(*particles_of(state.ensemble))
    return jax.lax.scan(follow, start, frames)[1]


def _joint_error(joints: np.ndarray, recording: HandRecording) -> float:
    return float(1e3 * np.nanmean(np.linalg.norm(joints - recording.joints, axis=-1)))


def _recordings(quick: bool) -> list[HandRecording]:
    names = (*_real_hands.HELD, "hpx")[: QUICK_RECORDINGS if quick else None]
    return [_real_hands.load(name, QUICK_NUM_FRAMES if quick else _real_hands.NUM_FRAMES) for name in names]
