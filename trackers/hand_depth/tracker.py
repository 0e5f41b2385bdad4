"""Hand pose from a depth camera: a particle filter on the pose, its velocity integrated out, guided by registration.

`filtering` holds the filter, `search` what finds the hand and doubts the track.
"""

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import gibbs_abs
from jaxfilters.models.hand.observation import HandLikelihood, hidden_digits, union
from jaxfilters.models.hand.skeleton import DIGITS, HandGeometry, anatomical_hand, forward_kinematics, local, open_palm
from jaxfilters.models.hand.surface import CapsuleHand, triangle_hand
from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.detect import check_unit
from jaxfilters.trackers.hand_depth.filtering import (
    FEWEST_PIXELS,
    FRAME_INTERVAL,
    LOST_COST,
    MAX_ERROR,
    PATIENCE,
    SIGMA,
    SUDDEN,
    Setup,
    TrackState,
    build_filter,
    filled,
    look,
    particles_of,
    placed,
    pose_moments,
    standard_deviations,
)
from jaxfilters.trackers.hand_depth.recording import DepthSequence, from_array, with_nan_for_nothing
from jaxfilters.trackers.hand_depth.search import race, search
from jaxfilters.trackers.innovations import correction_counts
from jaxfilters.trackers.tracker import HandTrack, Tracker, track_frames

SEARCHING, TRACKING, LOST, DOUBTFUL = range(4)
SIDES = {"right": 1.0, "left": -1.0}


def build(camera: Pinhole, config: HandDepthConfig | None = None, average: HandGeometry | None = None) -> Tracker:
    """A hand tracker for the frames of one depth camera.

    Args:
        camera: The depth camera.
        config: Options of the tracker.
        average: The hand of scale 1 (default: `anatomical_hand`); its side is that of the configuration.
    """
    setup = set_up(camera, config or HandDepthConfig(), average)
    return Tracker(partial(_start, setup), partial(_advance, setup))


def set_up(camera: Pinhole, config: HandDepthConfig, average: HandGeometry | None = None) -> Setup:
    """What the tracker of `build` with the same arguments is made of."""
    geometry = replace(average or anatomical_hand(), side=jnp.asarray(SIDES.get(config.hand, 1.0), dtype=float))
    surface = CapsuleHand(geometry) if config.surface == "capsules" else triangle_hand(geometry)
    likelihood = HandLikelihood(surface, jnp.asarray(SIGMA, dtype=float), MAX_ERROR, union, gibbs_abs)
    return Setup(camera, likelihood, config, config.stride)


def track(
    frames: Iterable[np.ndarray], times_s: np.ndarray, camera: Pinhole, config: HandDepthConfig | None = None
) -> HandTrack:
    """The hand in every frame of a depth recording, equal to that of `jaxfilters track hand-depth` with the same seed.

    Args:
        frames: (rows, cols) metres each, as the camera's shape says; NaN, 0 or inf where there is no reading.
        times_s: (frames,) seconds, strictly increasing.
        camera: The depth camera.
        config: Options of the tracker.

    Returns:
        The track as NumPy arrays, the frame axis first.

    Raises:
        ValueError: There are no frames, or more or fewer than times, or their size is not that of the camera's images,
            or their unit cannot be metres.
    """
    config = config or HandDepthConfig()
    source = map(with_nan_for_nothing, map(np.asarray, frames))
    first = list(islice(source, 1))
    if first and (warning := check_unit(np.asarray(first[0]))):
        warnings.warn(warning, stacklevel=2)
    return track_frames(build(camera, config), jax.random.key(config.seed), chain(first, source), times_s)


def _start(setup: Setup, key: Array, frame: np.ndarray) -> TrackState:
    """State before the first frame, placed by what that frame shows; searching where it shows no hand."""
    if np.shape(frame) != setup.camera.shape:
        raise ValueError(f"frame: expected the camera's {setup.camera.shape} rows and columns; got {np.shape(frame)}.")
    share_missing = float(np.mean(~np.isfinite(frame)))
    background = {"auto": share_missing > 0.5, "background": True, "unknown": False}[setup.config.missing]
    key, place_key = jax.random.split(key)
    scale = jnp.asarray(setup.config.scale or math.nan, dtype=float)
    side = jnp.asarray(SIDES.get(setup.config.hand, math.nan), dtype=float)
    state = TrackState(
        ensemble=None,
        scale=scale,
        side=side,
        doubt=jnp.asarray(False),
        race_time=jnp.asarray(0.0, dtype=float),
        least_cost=jnp.asarray(math.inf, dtype=float),
        missing_is_background=jnp.asarray(background),
        time=jnp.asarray(-FRAME_INTERVAL, dtype=float),
        hidden=jnp.zeros(len(DIGITS), bool),
        misses=jnp.asarray(PATIENCE, jnp.int32),
        key=key,
    )
    nowhere = open_palm(jnp.array([0.0, 0.09, 0.7]))
    state = state._replace(ensemble=placed(place_key, setup.compiled(), nowhere, scale, side))
    return search(setup, state, frame, 0.0)


def _advance(setup: Setup, state: TrackState, frames: np.ndarray, times: np.ndarray) -> tuple[TrackState, HandTrack]:
    """Track a chunk of frames; where the hand is gone, search it frame by frame.

    The search runs OpenCV on the host, so a chunk in which the hand is lost takes more than one compiled scan.
    """
    if frames.shape[1:] != setup.camera.shape:
        raise ValueError(f"frames: expected {setup.camera.shape} rows and columns each; got {frames.shape[1:]}.")
    pieces, first = [], 0
    while first < len(frames):
        due = float(state.race_time) <= float(times[first])
        if due and int(state.misses):
            state = _searched(setup, state, frames[first], float(times[first]))
        elif due:
            state = race(setup, state, frames[first], float(times[first]))
            state = state._replace(least_cost=jnp.asarray(math.inf, dtype=float))
        if int(state.misses) >= PATIENCE:
            pieces.append(_nothing_found())
            first += 1
            continue
        state, (track, done) = _scan(setup.compiled(), _through_the_host(state), frames, times, first)
        state = _through_the_host(state)
        end = first + int(np.sum(done))
        if int(state.misses) in (1, PATIENCE):
            state = state._replace(race_time=jnp.asarray(times[end - 1], dtype=float))
        pieces.append(jax.tree.map(lambda rows: np.asarray(rows)[first:end], track))  # noqa: B023
        first = end
    return state, HandTrack(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def _searched(setup: Setup, state: TrackState, frame: np.ndarray, time: float) -> TrackState:
    """The state after a search on a frame for the hand that was missed, about a new start where one is found.

    As long as the hand may be where the track is, in front of which something passes, a doubtful start does not count.
    """
    found = search(setup, state, frame, time)
    if int(found.misses) or (bool(found.doubt) and int(state.misses) < PATIENCE):
        return state._replace(race_time=found.race_time)
    before = jnp.asarray(time - FRAME_INTERVAL, dtype=float)
    return found._replace(time=before, least_cost=jnp.asarray(math.inf, dtype=float))


def _through_the_host(state: TrackState) -> TrackState:
    """The state on no device in particular.

    What has been on several devices would have `_scan` compile a second time, and what is on one cannot be divided.
    """
    data = state._replace(key=jax.random.key_data(state.key))
    data = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), data)
    return data._replace(key=jax.random.wrap_key_data(data.key, impl=jax.random.key_impl(state.key)))


@compiled_fully
def _scan(
    setup: Setup, state: TrackState, frames: Array, times: Array, first: Array
) -> tuple[TrackState, tuple[HandTrack, Array]]:
    """Track from frame `first` until the hand was missed or a race is due; the state then stands still."""

    def skip(state: TrackState, frame: Array, time: Array) -> tuple[TrackState, HandTrack]:
        _, track = jax.eval_shape(partial(_step, setup), state, frame, time)
        return state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), track)

    def body(state: TrackState, inputs: tuple) -> tuple[TrackState, tuple[HandTrack, Array]]:
        frame, time, index = inputs
        goes_on = (index > first) & (state.misses == 0) & (time < state.race_time)
        active = (index == first) | goes_on
        state, track = jax.lax.cond(active, partial(_step, setup), skip, state, frame, time)
        return state, (track, active)

    return jax.lax.scan(body, state, (frames, times, jnp.arange(frames.shape[0])))


@jax.jit  # traced once for its shapes and its program
def _step(setup: Setup, state: TrackState, frame: Array, time: Array) -> tuple[TrackState, HandTrack]:
    """One frame: predict, cut the window about the prediction, update, and judge whether the hand was there."""
    key, predict_key, update_key = jax.random.split(state.key, 3)
    likelihood = setup.hand(state)
    filter = build_filter(setup, open_palm(jnp.zeros(3)), likelihood, state.doubt, state.hidden)
    elapsed = time - state.time
    predicted = filter.predict(filter.params, predict_key, state.ensemble, elapsed)
    expected, spread = pose_moments(*particles_of(predicted))
    image = look(setup, state, filled(frame, state.missing_is_background), expected)

    @jax.jit  # traced once for its shapes and its program
    def update(ensemble: Any) -> tuple[Any, ParticleInfo]:
        return filter.update(filter.params, update_key, ensemble, image, elapsed)

    def coast(ensemble: Any) -> tuple[Any, ParticleInfo]:
        _, info = jax.eval_shape(update, ensemble)
        return ensemble, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), info)

    something = image.observed_count >= FEWEST_PIXELS
    ensemble, info = jax.lax.cond(something, update, coast, predicted)
    pose, covariance = pose_moments(*particles_of(ensemble))
    cost = likelihood.cost(pose, image)
    observed = something & (cost < LOST_COST)
    sudden = observed & (cost > SUDDEN * state.least_cost)
    race_time = jnp.where(sudden, time, state.race_time)
    least_cost = jnp.where(observed, jnp.minimum(cost, state.least_cost), state.least_cost)
    misses = jnp.where(observed, 0, state.misses + 1)
    joints = forward_kinematics(pose, likelihood.geometry).joints
    corrections = correction_counts(local(expected, pose), jnp.diagonal(spread), jnp.diagonal(covariance))
    track = HandTrack(
        pose=pose,
        pose_std=standard_deviations(pose, covariance),
        joints=joints,
        innovations=jnp.where(observed, corrections, 0),
        effective_sample_size=info.effective_sample_size,
        log_evidence=info.log_evidence,
        status=jnp.where(observed, jnp.where(state.doubt | sudden, DOUBTFUL, TRACKING), LOST).astype(jnp.int32),
    )
    following = state._replace(
        ensemble=ensemble,
        time=time,
        hidden=hidden_digits(image, joints),
        misses=misses,
        key=key,
        race_time=race_time,
        least_cost=least_cost,
    )
    return following, track


def _nothing_found() -> HandTrack:
    """The row of a frame in which no hand was found: nothing but its status."""
    nan = partial(np.full, fill_value=np.nan, dtype=np.float32)
    none = np.zeros((1, 2), np.int32)
    return HandTrack(nan((1, 22)), nan((1, 21)), nan((1, 21, 3)), none, nan(1), nan(1), np.full(1, SEARCHING, np.int32))


def synthetic_sequence(seed: int) -> tuple[DepthSequence, np.ndarray]:
    """The default input: a hand on a random walk of its velocity (data B), 150 frames of a second Kinect with noise.

    Returns the recording and the true joints (T, 21, 3) in metres.
    """
    made = simulate_sequence(jax.random.key(seed), "B", geometry=anatomical_hand())
    times = FRAME_INTERVAL * np.arange(len(made.poses))
    depth = np.asarray(made.depth_mm, np.float32) / 1000
    return from_array(kinect_v2(), times, depth, "synthetic hand"), np.asarray(made.joints)
