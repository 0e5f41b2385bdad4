"""Length and pose of an articulated hand from one camera: Gaussians with limits, several hypotheses about depth.

After N. Shimada, Y. Shirai, Y. Kuno, J. Miura, "Shape and Pose Estimation of An Articulated Object from A Monocular
Image Sequence Based on Loose Constraints". The filters are those of `jaxfilters.models.articulated.filters`.
"""

import math
from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.gaussian_sum import GaussianSumState, gaussian_sum, map_component
from jaxfilters.models.articulated.ambiguity import shows_length
from jaxfilters.models.articulated.anatomy import five_finger_limits, motion_about_ease
from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.filters import (
    FeatureObservation,
    Inequalities,
    Report,
    belief_of,
    hypotheses,
    inequalities,
    literal,
    recommended,
    report_of,
    standard_deviations,
    unconstrained,
)
from jaxfilters.models.articulated.hand import ArticulatedHand, articulated_hand
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.limits import limit_rows, table_1
from jaxfilters.models.articulated.motion import FRAME_INTERVAL
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.synthetic.articulated import paper_hand, simulate_paper
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.recording import (
    NOISE_SHARE,
    FeatureFrame,
    FeatureSequence,
    Start,
    camera_of,
    from_keypoints,
    keypoint_noise,
)
from jaxfilters.trackers.articulated.start import NUM_STARTS, HandSize, Starts, size_of, starts_from_points
from jaxfilters.trackers.articulated.state import LOST, SEARCHING, TRACKING, ArticulatedTrack, TrackState
from jaxfilters.trackers.innovations import innovation_counts
from jaxfilters.trackers.tracker import Tracker, checked_times, track_frames

LOST_NIS = 25.0
"""Normalised innovation squared, per measured row, above which the hand counts as not there: 5 deviations each."""
HAND_DIAGONAL = 0.19
"""Metres: of the box around the keypoints of an average hand; what a hand's speed in the image is measured by."""
PATIENCE = 10
"""Frames in a row without the hand before it is searched anew, where keypoints allow it."""


@pytree_dataclass
class _Setup:
    """What one tracker is made of, as data."""

    hand: ArticulatedHand
    limits: Inequalities
    start: Start | None
    size: HandSize
    config: ArticulatedConfig = field(metadata={"static": True})

    def compiled(self) -> "_Setup":
        """The same for compiled functions, which serve all seeds and sizes."""
        return replace(self, config=replace(self.config, seed=0, palm_width=None))


def hand_model(sequence: FeatureSequence, config: ArticulatedConfig) -> ArticulatedHand:
    """The model of the hand that the features are of: five fingers move about their angles at ease.

    Other hands move with constant velocity, as in the paper.

    Raises:
        ValueError: where neither a start is given nor keypoints of five fingers, from which one is found; or the
            configuration has a focal length, and the recording no size of the image, or other features, a start or
            true states.
    """
    if sequence.features == KEYPOINTS and sequence.num_fingers == 5:
        camera = None if config.focal is None else camera_of(sequence, config.focal)
        layout = five_fingers(2 if camera is None else 3, side=1.0 if config.hand == "right" else -1.0)
        diagonal = keypoint_noise(sequence.y.reshape(len(sequence), -1, 2)) / NOISE_SHARE
        motion = motion_about_ease(layout, diagonal / HAND_DIAGONAL if camera is None else 1.0)
        # Views differ by what a detector errs by in one frame, however long its errors last.
        noise = sequence.noise_px or float(np.median(sequence.std[np.isfinite(sequence.y)]))
        projection = None if camera is None else Perspective(camera)
        return articulated_hand(layout, projection=projection, features=KEYPOINTS, motion=motion, point_std=noise)
    if config.focal is not None:
        raise ValueError(f"{sequence.name}: focal is of use with the 21 keypoints of a hand only.")
    if sequence.start is None:
        raise ValueError(
            f"{sequence.name}: a start (mean and covariance of the state before the first frame) is needed for "
            f"features other than the 21 keypoints of a hand."
        )
    return articulated_hand(Layout(sequence.num_fingers), features=sequence.features)


def build(sequence: FeatureSequence, config: ArticulatedConfig | None = None) -> Tracker:
    """A tracker of the hand in a recording of features; limits are table 1 for two fingers, anatomy for five.

    What keypoints do not say of themselves, their noise and how large a hand is in the image, follows from all frames.

    Raises:
        ValueError: the start does not fit the layout, or see `hand_model`.
    """
    config = config or ArticulatedConfig()
    hand = hand_model(sequence, config)
    n = hand.layout.size
    if sequence.start is not None and np.shape(sequence.start.covariance) != (n, n):
        raise ValueError(f"{sequence.name}: start must be ({n},) and ({n}, {n}); got {np.shape(sequence.start.mean)}.")
    start = None if sequence.start is None else Start(*(jnp.asarray(part, dtype=float) for part in sequence.start))
    return tracker_of(hand, _limits(hand.layout), start, config)


def track(
    keypoints: Float[np.ndarray, "frames 21 2"],
    times_s: Float[np.ndarray, " frames"],
    image_shape: tuple[int, int] | None = None,
    config: ArticulatedConfig | None = None,
    *,
    confidence: Float[np.ndarray, "frames 21"] | None = None,
) -> ArticulatedTrack:
    """The hand in every frame of keypoints, equal to that of `jaxfilters track articulated` with the same seed.

    Args:
        keypoints: Pixels, wrist, thumb, index, middle, ring, little, base to tip; NaN where nothing was observed.
        times_s: Seconds, strictly increasing.
        image_shape: Rows and columns of the camera's image, where known.
        config: Options of the tracker.
        confidence: Of the keypoints, 0 or more; 1 for all unless given.

    Returns:
        The track as NumPy arrays, the frame axis first.

    Raises:
        ValueError: as for `checked_times`, `from_keypoints` and `build`.
    """
    points = np.asarray(keypoints, float)
    seconds = checked_times(times_s, len(points))
    sequence = from_keypoints(seconds, points, "keypoints", confidence=confidence, image_shape=image_shape)
    return track_sequence(sequence, config)


def track_sequence(sequence: FeatureSequence, config: ArticulatedConfig | None = None) -> ArticulatedTrack:
    """The hand in every frame of a recording of features, equal to that of `jaxfilters track articulated`.

    Args:
        sequence: The features, as `from_keypoints` or `jaxfilters.trackers.io.features.open_features` make them.
        config: Options of the tracker.

    Returns:
        The track as NumPy arrays, the frame axis first.

    Raises:
        ValueError: as for `build`.
    """
    config = config or ArticulatedConfig()
    frames = (sequence[i] for i in range(len(sequence)))
    return track_frames(build(sequence, config), jax.random.key(config.seed), frames, sequence.times_s)


def tracker_of(hand: ArticulatedHand, limits: Inequalities, start: Start | None, config: ArticulatedConfig) -> Tracker:
    """A tracker of any hand; without a start, one of five fingers whose features are points finds its own."""
    size = jax.tree.map(lambda value: jnp.asarray(value, dtype=float), size_of(config.palm_width))
    setup = _Setup(hand, limits, start, size, config)
    return Tracker(partial(_start, setup), partial(_advance, setup))


def _limits(layout: Layout) -> Inequalities:
    if layout.num_fingers not in (2, 5):
        raise ValueError(f"limits are known for two and for five fingers; got {layout.num_fingers}.")
    return inequalities(limit_rows(layout, table_1() if layout.num_fingers == 2 else five_finger_limits(layout)))


def _filter(setup: _Setup, prior: Gaussian) -> Filter:
    make: Callable[..., Filter] = {
        "recommended": recommended,
        "published": literal,
        "unconstrained": unconstrained,
    }[setup.config.variant]
    gate = math.inf if setup.config.variant == "published" else setup.config.gate or math.inf
    return make(setup.hand, prior, setup.limits, gate=gate)


def _bank(setup: _Setup, prior: Gaussian, capacity: int, start: GaussianSumState | None) -> Filter:
    """The filter of a bank of hypotheses; that of the paper is one filter without branches."""
    inner = _filter(setup, prior)
    if setup.config.variant == "published":
        return gaussian_sum(inner, capacity=capacity, start=start)
    return hypotheses(inner, setup.hand, capacity=capacity, start=start)


def _starting_bank(setup: _Setup, starts: Starts) -> GaussianSumState:
    def state(mean: Array, covariance: Array) -> Any:
        filter = _filter(setup, Gaussian(mean, covariance))
        return filter.init(filter.params, jax.random.key(0))

    components = jax.vmap(state)(starts.means, starts.covariances)
    return GaussianSumState(components, jax.nn.log_softmax(-starts.costs))


def _start(setup: _Setup, key: Array, frame: FeatureFrame) -> TrackState:
    """State before the first frame: what is given, or hypotheses from its keypoints; searching where it has too few."""
    bank, found = _first_bank(setup.compiled(), jax.tree.map(jnp.asarray, frame))
    misses = jnp.where(found, 0, PATIENCE + 1).astype(jnp.int32)
    return TrackState(bank, jnp.zeros((), dtype=float), misses, _none_observed(setup), key)


@compiled_fully
def _first_bank(setup: _Setup, frame: FeatureFrame) -> tuple[GaussianSumState, Array]:
    """The hypotheses before the first frame, and whether there is any."""
    if setup.start is not None:
        starts = Starts(setup.start.mean[None], setup.start.covariance[None], jnp.zeros(1), jnp.ones((), bool))
    else:
        starts = _keypoint_starts(setup, frame)
    least = 1 if setup.start is not None or setup.config.variant == "published" else NUM_STARTS
    return _with_slots(setup, _starting_bank(setup, starts), max(_most(setup), least)), starts.found


def _with_slots(setup: _Setup, start: GaussianSumState, capacity: int) -> GaussianSumState:
    if setup.config.variant == "published":
        best = jnp.argmax(start.log_weights)
        start = GaussianSumState(jax.tree.map(lambda leaf: leaf[best][None], start.components), jnp.zeros(1))
    filter = _bank(setup, _first_belief(start), capacity, start)
    return filter.init(filter.params, jax.random.key(0))


def _first_belief(bank: GaussianSumState) -> Gaussian:
    return belief_of(jax.tree.map(lambda leaf: leaf[0], bank.components))


def _keypoint_starts(setup: _Setup, frame: FeatureFrame) -> Starts:
    limits = None if setup.config.variant == "unconstrained" else setup.limits.constraints
    return starts_from_points(setup.hand, limits, frame.y, frame.mask, frame.std, setup.size)


def _advance(
    setup: _Setup, state: TrackState, frames: FeatureFrame, times: np.ndarray
) -> tuple[TrackState, ArticulatedTrack]:
    """Track a chunk of frames."""
    return _scan(setup.compiled(), state, jax.tree.map(jnp.asarray, frames), jnp.asarray(times, dtype=float))


@compiled_fully
def _scan(setup: _Setup, state: TrackState, frames: FeatureFrame, times: Array) -> tuple[TrackState, ArticulatedTrack]:
    def body(state: TrackState, inputs: tuple) -> tuple[TrackState, ArticulatedTrack]:
        return _step(setup, _found_again(setup, state, *inputs), *inputs)

    return jax.lax.scan(body, state, (frames, times))


def _found_again(setup: _Setup, state: TrackState, frame: FeatureFrame, time: Array) -> TrackState:
    """The state with a new start where the hand has been missed for long and its keypoints are visible."""
    if setup.start is not None:
        return state
    capacity = state.bank.log_weights.shape[0]

    def search() -> TrackState:
        starts = _keypoint_starts(setup, frame)
        bank = _with_slots(setup, _starting_bank(setup, starts), capacity)
        found = TrackState(bank, time, jnp.zeros_like(state.misses), _none_observed(setup), state.key)
        return _select(starts.found, found, state)

    return jax.lax.cond(state.misses > PATIENCE, search, lambda: state)


def _select(condition: Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _step(setup: _Setup, state: TrackState, frame: FeatureFrame, time: Array) -> tuple[TrackState, ArticulatedTrack]:
    """One frame: predict and update every hypothesis, and judge whether the hand was there."""
    key, predict_key, update_key = jax.random.split(state.key, 3)
    capacity = state.bank.log_weights.shape[0]
    filter = _bank(setup, _first_belief(state.bank), capacity, None)
    elapsed = (time - state.time) / FRAME_INTERVAL
    predicted = filter.predict(filter.params, predict_key, state.bank, elapsed)
    bank, info = filter.update(
        filter.params, update_key, predicted, FeatureObservation(frame.y, frame.mask, frame.std), elapsed
    )
    measured = jnp.any(frame.mask)
    reported = report_of(jax.tree.map(lambda leaf: leaf[jnp.argmax(bank.log_weights)], info.components))
    nis = reported.kalman.nis / jnp.maximum(reported.kalman.rank, 1)
    # With the gate, what is left of a hand that is not there fits well: too few rows count as a miss, too.
    rows = jnp.sum(frame.mask)
    observed = measured & (nis < LOST_NIS) & (2 * reported.kalman.rank >= rows) & jnp.isfinite(info.log_evidence)
    bank = _pruned(_select(measured & jnp.isfinite(info.log_evidence), bank, predicted), _most(setup))
    # Only keypoints are searched for. With a given start the hypotheses go on, and fit again when the hand is back.
    searching = (state.misses > PATIENCE) if setup.start is None else jnp.zeros((), bool)
    status = jnp.where(searching, SEARCHING, jnp.where(observed, TRACKING, LOST)).astype(jnp.int32)
    misses = jnp.where(searching, state.misses, jnp.where(observed, 0, state.misses + 1)).astype(jnp.int32)
    shown = shows_length(belief_of(map_component(bank)).mean, setup.hand).ravel()
    shown = state.length_observed | (shown & observed & (status == TRACKING))
    log_evidence = jnp.where(measured, info.log_evidence, jnp.nan)
    track = _unknown_where(searching, _report(setup, bank, reported, nis, log_evidence, status, shown))
    return TrackState(bank, time, misses, shown, key), track


def _none_observed(setup: _Setup) -> Bool[Array, " lengths"]:
    lengths = setup.hand.layout.lengths
    return jnp.zeros(lengths.stop - lengths.start, bool)


def _most(setup: _Setup) -> int:
    """Hypotheses that are followed at a time; there may be more at the start."""
    return setup.config.hypotheses if setup.config.variant == "recommended" else 1


def _pruned(bank: GaussianSumState, most: int) -> GaussianSumState:
    """The bank with `most` hypotheses or fewer: they are in descending order of their weights."""
    kept = jnp.arange(len(bank.log_weights)) < most
    return bank._replace(log_weights=jax.nn.log_softmax(jnp.where(kept, bank.log_weights, -jnp.inf)))


def _unknown_where(searching: Bool[Array, ""], track: ArticulatedTrack) -> ArticulatedTrack:
    """The row, with nothing but its status in a frame in which the hand is searched for."""

    def unknown(leaf: Array) -> Array:
        return jnp.where(searching, jnp.asarray(np.nan if leaf.dtype.kind == "f" else 0, leaf.dtype), leaf)

    return jax.tree.map(unknown, track)._replace(status=track.status)


def _report(
    setup: _Setup,
    bank: GaussianSumState,
    reported: Report,
    nis: Array,
    log_evidence: Array,
    status: Array,
    length_observed: Array,
) -> ArticulatedTrack:
    belief = belief_of(map_component(bank))
    hand, q = setup.hand, belief.mean[setup.hand.layout.quaternion]
    nothing, body = jnp.isnan(log_evidence), hand.layout.body.size
    return ArticulatedTrack(
        mean=belief.mean[:body],
        std=jnp.sqrt(jnp.maximum(jnp.diagonal(belief.covariance)[:body], 0.0)),
        points=hand.points(belief.mean),
        points_std=standard_deviations(hand.points, belief),
        points_from_wrist_std=standard_deviations(lambda x: hand.points(x) - hand.wrist(x), belief),
        image_points=hand.image_points(belief.mean),
        scale=jnp.sum(q * q),
        weight=jnp.exp(jnp.max(bank.log_weights)),
        num_hypotheses=jnp.sum(bank.log_weights > -jnp.inf, dtype=jnp.int32),
        is_new_view=reported.is_new_view & ~nothing,
        nis_per_row=jnp.where(nothing, jnp.nan, nis),
        innovations=jnp.where(nothing, 0, innovation_counts(reported.kalman)),
        least_distance=jnp.where(nothing, jnp.nan, reported.least_distance),
        log_evidence=log_evidence,
        length_observed=length_observed,
        status=status,
    )


def synthetic_sequence(seed: int) -> FeatureSequence:
    """The default input: the paper's sequence of the first hand, 55 frames, with truth and start."""
    made = simulate_paper(jax.random.key(seed))
    y = np.where(np.asarray(made.masks), np.asarray(made.features, float), np.nan)
    hand = paper_hand()
    return FeatureSequence(
        num_fingers=hand.layout.num_fingers,
        features=hand.features,
        times_s=FRAME_INTERVAL * np.arange(len(y)),
        y=y,
        std=np.broadcast_to(np.asarray(made.noise_std, float), y.shape).copy(),
        name="synthetic articulated hand",
        start=Start(np.asarray(made.initial_mean, float), np.asarray(made.initial_covariance, float)),
        truth=np.asarray(made.states, float),
    )
