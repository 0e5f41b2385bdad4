"""The hand tracker with either filter, and registration alone, on recordings of real hands.

All three begin from the same search of the first frame. Registration alone is six Gauss-Newton steps from the pose of
the frame before, with the motion model as the prior, which widens with the time between frames. A recording's error is
the mean distance of the 21 joints over its frames and seeds; the p-value is that of a one-sided paired Wilcoxon
signed-rank test over the recordings.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import _real_hands
from jaxfilters.benchmarks.scenarios._accuracy import p_value_better
from jaxfilters.benchmarks.scenarios._real_hands import CLOSE_MM, HandRecording
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, register, target_from_image
from jaxfilters.models.hand.skeleton import forward_kinematics
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.filtering import (
    FRAME_INTERVAL,
    REGISTRATION_STRIDE,
    UNGUIDED_MOTION,
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
EVERY, QUICK_EVERY = (4, 6), (6,)
"""One of so many frames is taken. On the motions of the development (two seeds) the three ways differ by less than 1 mm
up to every third frame; registration alone, plain and Rao-Blackwellized filter have 8.3, 9.5 and 7.1 mm with every
fourth, 14.2, 13.1 and 10.1 mm with every sixth."""
LOW_RATE_NUM_FRAMES = 24
"""Frames that are taken: even the shortest motion has nearly as many at the lowest rate."""
HIDDEN = ((10, 20), (32, 42))
"""Frames of a motion, from and to, in which the fingers are hidden: a third of a second each."""
MISSING_MM = 100.0
"""Error of a frame without an estimate: that of a hand that is lost."""
HIDDEN_MARGIN_PX = 12
"""Of the hidden rectangle about the joints of the fingers beyond the first."""
SIX_STEPS = RegistrationConfig(widths=(0.03,) * 2 + (0.015,) * 4)


class RunErrors(NamedTuple):
    """What one way makes of a recording."""

    mm: float
    """Mean joint error in millimetres."""
    wrong: int
    """Frames whose mean joint error is `CLOSE_MM` or more under the status `tracking`; 0 of a way without a status."""


Follow = Callable[[HandRecording, int], RunErrors]
"""`(recording, seed) -> RunErrors`."""


def real_metrics(num_particles: int, quick: bool, kept: Finished) -> dict[str, Metric]:
    """Errors on the motions that nothing was chosen on, and on that of a camera; nothing where they are not there.

    Args:
        num_particles: Of both filters.
        quick: Whether few recordings, seeds and frames are enough.
        kept: Where the errors on each recording are kept.
    """
    try:
        recordings = _recordings(quick)
    except RecordingError as error:
        sys.stderr.write(f"real hands left out: {error}\n")
        return {}
    seeds = range(1 if quick else NUM_SEEDS)
    of_cases = {"": recordings}
    of_cases |= {f"_every_{every}": _recordings(quick, every) for every in (QUICK_EVERY if quick else EVERY)}
    of_cases["_hidden"] = _hidden(quick)
    results = {case: _results_of_all(num_particles, of_case, seeds, case, kept) for case, of_case in of_cases.items()}
    cases = {case: {name: each["mm"] for name, each in of_ways.items()} for case, of_ways in results.items()}
    found: dict[str, Metric] = {}
    for case, errors in (cases | {"_all_cases": _over_all(cases)}).items():
        found |= _metrics(errors, case)
    for case, of_ways in results.items():
        found |= _extreme_metrics(of_ways, case)
    for count in QUICK_COUNTS if quick else COUNTS:
        follow = partial(tracker_error, "rbpf", count)
        name = f"rbpf_n{count}"
        each = cases[""]["rbpf"] if count == num_particles else _results(follow, recordings, seeds, name, kept)["mm"]
        found[f"errors_by_n_real_rbpf_n{count}"] = Metric(float(each.mean()), "mm", "lower")
    return found


def _over_all(cases: dict[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Of each recording that all cases have, the mean error over the cases; the first ones are the same in all."""
    count = min(len(each) for errors in cases.values() for each in errors.values())
    ways = cases[""]
    return {name: np.mean([errors[name][:count] for errors in cases.values()], axis=0) for name in ways}


def _hidden(quick: bool) -> list[HandRecording]:
    """The motions with hidden fingers; the camera's recording is too short for two spells."""
    return [
        with_hidden_fingers(_real_hands.load(name)) for name in _real_hands.HELD[: QUICK_RECORDINGS if quick else None]
    ]


def with_hidden_fingers(recording: HandRecording) -> HandRecording:
    """A motion without readings about the fingers in two spells; its joints are NaN where they are not hidden."""
    depth, hidden = recording.depth.copy(), np.zeros(len(recording.depth), bool)
    fingers = recording.joints[:, 5:].reshape(-1, 4, 4, 3)[:, :, 1:].reshape(-1, 12, 3)
    pixels = np.asarray(recording.camera.project(jnp.asarray(fingers, dtype=float)))
    for first, end in HIDDEN:
        hidden[first:end] = True
        for frame in range(first, min(end, len(depth))):
            left, top = np.maximum(np.floor(pixels[frame].min(axis=0)).astype(int) - HIDDEN_MARGIN_PX, 0)
            right, bottom = np.ceil(pixels[frame].max(axis=0)).astype(int) + HIDDEN_MARGIN_PX
            depth[frame, top:bottom, left:right] = np.nan
    return recording._replace(depth=depth, joints=np.where(hidden[:, None, None], recording.joints, np.nan))


def _results_of_all(
    num_particles: int, recordings: list[HandRecording], seeds: range, case: str, kept: Finished
) -> dict[str, dict[str, np.ndarray]]:
    ways: dict[str, Follow] = {
        "rbpf": partial(tracker_error, "rbpf", num_particles),
        "pf": partial(tracker_error, "pf", num_particles),
        "registration": registration_error,
    }
    return {name: _results(follow, recordings, seeds, f"{name}{case}", kept) for name, follow in ways.items()}


def _metrics(errors: dict[str, np.ndarray], case: str) -> dict[str, Metric]:
    """Means over the recordings, and the paired tests, of names that end with the case."""
    for name, each in errors.items():
        sys.stdout.write(f"real hands{case}, {name}, mm: {np.round(each, 1)}\n")
    found = {
        f"joint_error_mm_real{case}_{name}": Metric(float(each.mean()), "mm", "lower") for name, each in errors.items()
    }
    for rival, better in (("pf", "better"), ("registration", "better_than_registration")):
        p = p_value_better(errors["rbpf"], errors[rival])
        found[f"p_value_rbpf_{better}_real{case}"] = Metric(p, "", "lower")
    return found


def _extreme_metrics(results: dict[str, dict[str, np.ndarray]], case: str) -> dict[str, Metric]:
    """Median and largest error over the recordings, and frames with a wrong status, the mean over the seeds."""
    found: dict[str, Metric] = {}
    for name, each in results.items():
        found[f"median_joint_error_mm_real{case}_{name}"] = Metric(float(np.median(each["mm"])), "mm", "lower")
        found[f"largest_joint_error_mm_real{case}_{name}"] = Metric(float(np.max(each["mm"])), "mm", "lower")
        if name != "registration":
            found[f"wrong_frames_real{case}_{name}"] = Metric(float(np.sum(each["wrong"])), "frames", "lower")
    return found


def _results(
    follow: Follow, recordings: list[HandRecording], seeds: range, name: str, kept: Finished
) -> dict[str, np.ndarray]:
    """`mm` and `wrong`, (recordings,) each, the mean over the seeds; kept with the name and the recording's number."""

    def of_seeds(recording: HandRecording) -> dict[str, np.ndarray]:
        followed = [follow(recording, seed) for seed in seeds]
        return {part: np.array([getattr(one, part) for one in followed], float) for part in RunErrors._fields}

    each = [kept.arrays(f"real_{name}_{i}", partial(of_seeds, one)) for i, one in enumerate(recordings)]
    return {part: np.array([found[part].mean() for found in each]) for part in RunErrors._fields}


def tracker_error(filter: str, num_particles: int, recording: HandRecording, seed: int) -> RunErrors:
    """Of the tracker as users run it, given nothing but the recording."""
    config = HandDepthConfig(filter=filter, num_particles=num_particles, seed=seed)
    track = hand_depth.track(iter(recording.depth), recording.times_s, recording.camera, config)
    errors = _joint_errors(np.asarray(track.joints), recording)
    return RunErrors(float(np.nanmean(errors)), num_wrong(errors, np.asarray(track.status)))


def num_wrong(errors: Float[np.ndarray, "t j"], status: Int[np.ndarray, " t"]) -> int:
    """Frames whose joints with a known truth are `CLOSE_MM` or more off in the mean under the status `tracking`."""
    known = np.isfinite(errors).any(axis=1)
    far = np.nanmean(errors[known], axis=1) >= CLOSE_MM
    return int(np.sum(far & (status[known] == hand_depth.TRACKING)))


def registration_error(recording: HandRecording, seed: int) -> RunErrors:
    """Of registration alone, from the start that the tracker finds."""
    config = HandDepthConfig(num_particles=64, seed=seed, guide=False)  # particles near the start that is found
    state = hand_depth.build(recording.camera, config).init(jax.random.key(seed), recording.depth[0])
    setup = hand_depth.set_up(recording.camera, config).compiled()  # one program for all seeds
    elapsed = np.diff(recording.times_s, prepend=recording.times_s[0] - np.float32(FRAME_INTERVAL))
    _, joints = registered(setup, state, jnp.asarray(recording.depth), jnp.asarray(elapsed))
    return RunErrors(float(np.nanmean(_joint_errors(np.asarray(joints), recording))), 0)


@jax.jit
def registered(setup: Setup, state: TrackState, frames: Array, elapsed: Array) -> tuple[Array, Array]:
    """(t, 22) poses and (t, 21, 3) joints, metres, by registration alone from the start that a state holds.

    Frame by frame, each `elapsed` (t,) seconds after the one before.
    """
    geometry = setup.hand(state).geometry
    shape = tuple(size // REGISTRATION_STRIDE for size in WINDOW)

    def follow(pose: Array, inputs: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        frame, dt = inputs
        root = jnp.diag(jnp.sqrt(UNGUIDED_MOTION.pose_variance_rate * dt))
        image = look(setup, state, filled(frame, state.missing_is_background), pose)
        camera = image.camera.crop(jnp.zeros(2), shape, REGISTRATION_STRIDE)
        target = target_from_image(camera, image.observed[::REGISTRATION_STRIDE, ::REGISTRATION_STRIDE])
        found = register(camera, target, geometry, pose, PosePrior(pose, root), SIX_STEPS).pose
        return found, (found, forward_kinematics(found, geometry).joints)

    start, _ = pose_moments(*particles_of(state.ensemble))
    return jax.lax.scan(follow, start, (frames, elapsed))[1]


def _joint_errors(joints: np.ndarray, recording: HandRecording) -> Float[np.ndarray, "t j"]:
    """Millimetres, `MISSING_MM` where there is no estimate, NaN where the truth is not known."""
    apart = 1e3 * np.linalg.norm(joints - recording.joints, axis=-1)
    known = np.isfinite(recording.joints).all(axis=-1)
    return np.where(known, np.where(np.isfinite(apart), apart, MISSING_MM), np.nan)


def _recordings(quick: bool, every: int = 1) -> list[HandRecording]:
    names = (*_real_hands.HELD, "hpx")[: QUICK_RECORDINGS if quick else None]
    count = QUICK_NUM_FRAMES if quick else _real_hands.NUM_FRAMES if every == 1 else LOW_RATE_NUM_FRAMES
    return [_real_hands.load(name, count, every=every) for name in names]
