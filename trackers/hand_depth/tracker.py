"""Hand pose from a depth camera: a particle filter on the pose, its velocity integrated out, guided by registration.

The filter is `rao_blackwell_shared` on the 22-number hand with `HandMotion`; its likelihood renders every particle
(Kajihara and Tanaka, with the union cost); its proposal looks at the image first (`guided`, `registration`).
"""

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.lie import quaternion_mean
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import gibbs_abs
from jaxfilters.models.hand.motion import HandMotion, per_coordinate
from jaxfilters.models.hand.observation import (
    HandImage,
    HandLikelihood,
    crop,
    hand_image,
    isolate,
    union,
    window_stride,
)
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, register, target_from_image
from jaxfilters.models.hand.skeleton import (
    TANGENT_SIZE,
    HandGeometry,
    forward_kinematics,
    hand_center,
    hand_geometry,
    local,
    open_palm,
    retract,
)
from jaxfilters.models.hand.start import BATCH, SCALES, Start, find_starts, registered
from jaxfilters.models.hand.surface import CapsuleHand, triangle_hand
from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.particle.guided_rao_blackwell import Guidance, GuidedState, guided_rao_blackwell
from jaxfilters.particle.rao_blackwell import RaoBlackwellState, rao_blackwell_shared
from jaxfilters.particle.tempering import AdaptiveTempering
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.trackers.hand_depth.detect import NEAREST, check_unit, hand_sightings
from jaxfilters.trackers.hand_depth.recording import DepthSequence, from_array
from jaxfilters.trackers.tracker import HandTrack, Tracker, track_frames

SEARCHING, TRACKING, LOST, DOUBTFUL = range(4)


@dataclass(frozen=True)
class HandDepthConfig:
    """Options of the tracker."""

    filter: str = "rbpf"
    """`rbpf` carries the velocity of each particle in a Kalman filter, `pf` has none."""
    num_particles: int = 512
    stride: int | None = None
    """Every how many pixels one is compared; `None` lets the hand fill the window at any distance."""
    seed: int = 0
    hand: str = "right"
    """`right`, `left`, or `auto`, which decides between them by what they explain."""
    scale: float | None = None
    """Size of the hand relative to the average adult's; `None` fits it to the first frame."""
    guide: bool = True
    """Draw particles around what registration finds; otherwise from the motion model alone."""
    missing: str = "auto"
    """Pixels without a reading: `background`, `unknown`, or `auto`, background if they are half of the first frame."""
    surface: str = "capsules"
    """What particles are rendered as: `capsules`, or the triangle `mesh`, three times slower."""

    def __post_init__(self) -> None:
        choices = {
            "filter": ("rbpf", "pf"),
            "hand": ("right", "left", "auto"),
            "surface": ("capsules", "mesh"),
            "missing": ("auto", "background", "unknown"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}; got {getattr(self, name)!r}.")
        if self.hand == "auto" and self.surface == "mesh":
            raise ValueError("hand must be right or left where surface is mesh; got auto.")
        if self.num_particles < 1:
            raise ValueError(f"num_particles must be at least 1; got {self.num_particles}.")
        if self.stride is not None and self.stride < 1:
            raise ValueError(f"stride must be at least 1; got {self.stride}.")
        if self.scale is not None and not 0.5 <= self.scale <= 2:
            raise ValueError(f"scale must be between 0.5 and 2 (1 is the average adult); got {self.scale}.")


WINDOW = (128, 128)
REGISTRATION_STRIDE = 4
"""Of the pixels of the window: a thousand residuals fix 21 numbers."""
MAX_ERROR = 0.1
"""c_max of the paper, metres."""
SIGMA = 3e-4
"""Scale of the cost, metres: of a mean over thousands of pixels, far below that of one pixel."""
TEMPERED_SHARE = 0.02
FEWEST_PIXELS = 50
"""Hand pixels in the window below which nothing is there."""
LOST_COST = 0.07
"""Metres: of the best pose above which the hand counts as not there; 0.1 is no overlap at all."""
PATIENCE = 5
"""Frames in a row without the hand before it is searched anew."""
FRAME_INTERVAL = 1 / 30
"""Seconds before the first frame."""
SECOND_CHANCE, RACE_INTERVAL, QUIET_INTERVAL = 0.3, 1.0, 3.0
"""Seconds from a start to the first race of new starts against the track, between races while it is doubtful, and
while it is not."""
NUM_RACING = BATCH
"""Hypotheses that are registered for a race."""
BETTER = 0.85
"""Share of the cost of the track, or of the hand that was asked for, below which another explanation is better."""
AS_GOOD = 1.1
"""Share of the cost of the track up to which another explanation puts it in doubt."""
DIFFERENT = 0.025
"""Metres between the joints of two explanations, in the mean, from which on they are different."""
DOUBTFUL_COST = 0.03
"""Metres, as `Start.cost`, above which a start explains the frame too badly to be believed."""
WORST_START = 0.04
"""Metres, likewise, above which nothing is believed to be a hand."""
SIDES = {"right": 1.0, "left": -1.0}

MOTION = HandMotion(
    per_coordinate(0.008, 0.064, math.radians(12)) ** 2 * 30,
    per_coordinate(0.04, 0.2, math.radians(24)) ** 2 * 30,
    per_coordinate(0.0, 0.0, 1 / 0.3),
)
"""A real hand: a joint may move 35 mm from one frame to the next; joint velocities are damped over 0.3 s."""
START_STD = per_coordinate(0.005, 0.04, math.radians(5))
START_VELOCITY_STD = per_coordinate(0.08, 0.3, math.radians(25))
"""Per second."""


class TrackState(NamedTuple):
    """Everything the next frame needs."""

    ensemble: Any
    """Of the filter."""
    scale: Float[Array, ""]
    """Size of the hand relative to the average one; NaN until it was fitted to a frame."""
    side: Float[Array, ""]
    """+1 for a right hand, -1 for a left hand; NaN until it was decided."""
    doubt: Array
    """Whether another explanation is as good, or this one is bad."""
    race_time: Float[Array, ""]
    """Seconds: from when on the next frame has new starts compete with the track."""
    missing_is_background: Array
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    misses: Array
    """Frames in a row in which the hand was not visible."""
    key: Array


@pytree_dataclass
class _Setup:
    """What one tracker is made of, as data: the compiled functions below take it as an argument."""

    camera: Pinhole
    likelihood: HandLikelihood
    """Of the hand of scale 1."""
    config: HandDepthConfig = field(metadata={"static": True})
    stride: int | None = field(metadata={"static": True})

    def spacing(self, depth: Float[Array, ""]) -> float | Float[Array, ""]:
        """Pixels of the frame for one of the window about a hand at `depth` metres."""
        return window_stride(self.camera, depth, WINDOW[1]) if self.stride is None else self.stride

    def hand(self, state: "TrackState") -> HandLikelihood:
        """The likelihood of the hand that is tracked."""
        scaled = self.likelihood.scaled(state.scale)
        geometry = replace(scaled.geometry, side=state.side)
        return replace(scaled, surface=replace(scaled.surface, geometry=geometry))


def build(camera: Pinhole, config: HandDepthConfig | None = None) -> Tracker:
    """A hand tracker for the frames of one depth camera."""
    config = config or HandDepthConfig()
    geometry = replace(hand_geometry(), side=jnp.asarray(SIDES.get(config.hand, 1.0), dtype=float))
    surface = CapsuleHand(geometry) if config.surface == "capsules" else triangle_hand(geometry)
    likelihood = HandLikelihood(surface, jnp.asarray(SIGMA, dtype=float), MAX_ERROR, union, gibbs_abs)
    setup = _Setup(camera, likelihood, config, config.stride)
    return Tracker(partial(_start, setup), partial(_advance, setup))


def track(
    frames: Iterable[np.ndarray], times_s: np.ndarray, camera: Pinhole, config: HandDepthConfig | None = None
) -> HandTrack:
    """The hand in every frame of a depth recording, equal to that of `jaxfilters track hand-depth` with the same seed.

    Args:
        frames: (rows, cols) metres each, NaN where there is no reading.
        times_s: (frames,) seconds, strictly increasing.
        camera: The depth camera.
        config: Options of the tracker.

    Returns:
        The track as NumPy arrays, the frame axis first.

    Raises:
        ValueError: There are no frames, or more or fewer than times, or their unit cannot be metres.
    """
    config = config or HandDepthConfig()
    source = iter(frames)
    first = list(islice(source, 1))
    if first and (warning := check_unit(np.asarray(first[0]))):
        warnings.warn(warning, stacklevel=2)
    return track_frames(build(camera, config), jax.random.key(config.seed), chain(first, source), times_s)


def _start(setup: _Setup, key: Array, frame: np.ndarray) -> TrackState:
    """State before the first frame, placed by what that frame shows; searching where it shows no hand."""
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
        race_time=jnp.asarray(math.inf, dtype=float),
        missing_is_background=jnp.asarray(background),
        time=jnp.asarray(-FRAME_INTERVAL, dtype=float),
        misses=jnp.asarray(PATIENCE, jnp.int32),
        key=key,
    )
    nowhere = open_palm(jnp.array([0.0, 0.09, 0.7]))
    state = state._replace(ensemble=_placed(setup, place_key, nowhere, state))
    return _search(setup, state, frame, 0.0)


def _search(setup: _Setup, state: TrackState, frame: np.ndarray, time: float) -> TrackState:
    """Place the ensemble anew where the frame shows a hand, of the known size if any; unchanged where it shows none."""
    starts = []
    for sighting in hand_sightings(setup.camera, np.asarray(frame)):
        window = _window(setup, state, sighting.frame, sighting.center)
        starts += find_starts(*window, sighting.center, setup.likelihood.geometry, _sizes(state), (1.0, -1.0))
    wanted = [start for start in starts if not start.side * float(state.side) < 0]
    if not wanted:
        return state
    found = min(wanted, key=lambda start: start.cost)
    if not found.cost < WORST_START:
        return state
    doubt = found.cost > DOUBTFUL_COST or _is_rivalled(setup, found, starts)
    return _begun(setup, state, found, time, doubt)


def _race(setup: _Setup, state: TrackState, frame: np.ndarray, time: float) -> TrackState:
    """Let new starts compete with the track on one frame: the better one goes on, in doubt if they differ in vain.

    They look where the track is. A track that lost the hand altogether is lost by its own cost, and searched for.
    """
    pose, _ = pose_moments(*_particles(state.ensemble))
    scale, side = float(state.scale), float(state.side)
    palm = np.asarray(hand_center(pose, 0.6 * scale))
    if not (np.isfinite(palm).all() and palm[2] > NEAREST):
        return state._replace(race_time=jnp.asarray(time + RACE_INTERVAL, dtype=float))
    window = _window(setup, state, np.asarray(frame), palm)
    average = setup.likelihood.geometry
    track = registered(*window, palm, average, Start(np.asarray(pose), scale, side, math.nan))
    sides = (1.0, -1.0) if setup.config.hand == "auto" else (side,)
    sizes = (scale,) if setup.config.scale else (0.92 * scale, scale, 1.08 * scale)
    starts = find_starts(*window, palm, average, sizes, sides, NUM_RACING)
    rival = starts[0] if starts else track
    if rival.cost < BETTER * track.cost:
        return _begun(setup, state, rival, time, rival.cost > DOUBTFUL_COST or _is_rivalled(setup, rival, starts))
    doubt = track.cost > DOUBTFUL_COST or _is_rivalled(setup, track, starts)
    pause = RACE_INTERVAL if doubt else QUIET_INTERVAL
    return state._replace(doubt=jnp.asarray(doubt), race_time=jnp.asarray(time + pause, dtype=float))


def _is_rivalled(setup: _Setup, found: Start, starts: list[Start]) -> bool:
    """Whether a different explanation of the same frame is about as good as the one found."""
    rivals = [start for start in starts if start.cost < AS_GOOD * found.cost]
    return any(_distance(setup.likelihood.geometry, start, found) > DIFFERENT for start in rivals)


def _begun(setup: _Setup, state: TrackState, found: Start, time: float, doubt: bool) -> TrackState:
    """The state with an ensemble about a start."""
    key, place_key = jax.random.split(state.key)
    state = state._replace(
        scale=jnp.asarray(found.scale, dtype=float),
        side=jnp.asarray(found.side, dtype=float),
        doubt=jnp.asarray(doubt),
        race_time=jnp.asarray(time + SECOND_CHANCE, dtype=float),
        misses=jnp.zeros_like(state.misses),
        key=key,
    )
    return state._replace(ensemble=_placed(setup, place_key, jnp.asarray(found.pose), state))


def _sizes(state: TrackState) -> tuple[float, ...]:
    scale = float(state.scale)
    return SCALES if math.isnan(scale) else (scale,)


def _window(setup: _Setup, state: TrackState, frame: np.ndarray, center: np.ndarray) -> tuple[Pinhole, Array]:
    return _cropped(setup, jnp.asarray(frame), jnp.asarray(center), state.missing_is_background)


@jax.jit
def _cropped(setup: _Setup, frame: Array, center: Array, missing_is_background: Array) -> tuple[Pinhole, Array]:
    return crop(setup.camera, _filled(frame, missing_is_background), center, WINDOW, setup.spacing(center[2]))


def _distance(average: HandGeometry, one: Start, other: Start) -> float:
    """Between the joints of two hands, metres, in the mean."""
    joints = [
        _joints(jnp.asarray(each.pose), replace(average.scaled(each.scale), side=jnp.asarray(each.side, dtype=float)))
        for each in (one, other)
    ]
    return float(jnp.linalg.norm(joints[0] - joints[1], axis=-1).mean())


@jax.jit
def _joints(pose: Array, geometry: HandGeometry) -> Array:
    return forward_kinematics(pose, geometry).joints


@jax.jit
def _placed(setup: _Setup, key: Array, pose: Array, state: TrackState) -> Any:
    """An ensemble about a pose."""
    filter = _filter(setup, pose, setup.hand(state))
    return filter.init(filter.params, key)


def _filter(setup: _Setup, pose: Array, likelihood: HandLikelihood) -> Filter:
    """The filter of a hand that starts about `pose`."""
    with_velocity = setup.config.filter == "rbpf"
    velocity = START_VELOCITY_STD if with_velocity else START_VELOCITY_STD[:0]
    inner = rao_blackwell_shared(
        jax.tree_util.Partial(_sample_about, pose),
        Gaussian(jnp.zeros_like(velocity), jnp.diag(velocity**2)),
        MOTION.dynamics if with_velocity else MOTION.walk,
        likelihood.log_likelihood,
        num_particles=setup.config.num_particles,
        noise_dim=TANGENT_SIZE,
        retract=retract,
        ess_threshold=1.0,
        temper=AdaptiveTempering(TEMPERED_SHARE),
    )
    if not setup.config.guide:
        return inner
    return guided_rao_blackwell(inner, jax.tree_util.Partial(_look, likelihood.geometry), local=local, prior_share=0.1)


def _sample_about(pose: Array, key: Array) -> Array:
    return retract(pose, START_STD * jax.random.normal(key, (TANGENT_SIZE,)))


def _look(geometry: HandGeometry, particles: Array, log_weights: Array, image: HandImage) -> Guidance:
    """Register the predicted hand onto the image."""
    mean, covariance = pose_moments(particles, log_weights)
    # A thousandth more on the diagonal: few effective particles leave the covariance without full rank.
    root = jnp.linalg.cholesky(covariance + jnp.diag(1e-3 * jnp.diagonal(covariance) + 1e-10))
    shape = tuple(size // REGISTRATION_STRIDE for size in WINDOW)
    camera = image.camera.crop(jnp.zeros(2), shape, REGISTRATION_STRIDE)
    target = target_from_image(camera, image.observed[::REGISTRATION_STRIDE, ::REGISTRATION_STRIDE])
    found = register(camera, target, geometry, mean, PosePrior(mean, root), RegistrationConfig())
    return Guidance(found.pose, found.information)


def pose_moments(
    particles: Float[Array, "22 n"], log_weights: Float[Array, " n"]
) -> tuple[Float[Array, " 22"], Float[Array, "21 21"]]:
    """Mean pose on the manifold, and the covariance in its tangent space."""
    mean = weights.mean(particles, log_weights)
    mean = jnp.concatenate([mean[:3], quaternion_mean(particles[3:7], log_weights), mean[7:]])
    offsets = jax.vmap(local, in_axes=(None, -1), out_axes=-1)(mean, particles)
    return mean, weights.covariance(offsets, log_weights)


def _filled(frame: Array, missing_is_background: Array) -> Array:
    return jnp.where(jnp.isnan(frame) & missing_is_background, jnp.inf, frame)


def _advance(setup: _Setup, state: TrackState, frames: np.ndarray, times: np.ndarray) -> tuple[TrackState, HandTrack]:
    """Track a chunk of frames; where the hand is gone, search it frame by frame.

    The search runs OpenCV on the host, so a chunk in which the hand is lost takes more than one compiled scan.
    """
    pieces, first = [], 0
    while first < len(frames):
        if int(state.misses) >= PATIENCE:
            state = _search(setup, state, frames[first], float(times[first]))
            state = state._replace(time=jnp.asarray(times[first] - FRAME_INTERVAL, dtype=float))
        elif float(state.race_time) <= float(times[first]):
            state = _race(setup, state, frames[first], float(times[first]))
        if int(state.misses) >= PATIENCE:
            pieces.append(_nothing_found())
            first += 1
            continue
        state, (track, done) = _scan(setup, state, frames, times, first)
        state = _through_the_host(state)
        end = first + int(np.sum(done))
        pieces.append(jax.tree.map(lambda rows: np.asarray(rows)[first:end], track))  # noqa: B023
        first = end
    return state, HandTrack(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def _through_the_host(state: TrackState) -> TrackState:
    """The state as `_start` leaves it: what has been on several devices would have `_scan` compile a second time."""
    data = state._replace(key=jax.random.key_data(state.key))
    data = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), data)
    return data._replace(key=jax.random.wrap_key_data(data.key, impl=jax.random.key_impl(state.key)))


@jax.jit
def _scan(
    setup: _Setup, state: TrackState, frames: Array, times: Array, first: Array
) -> tuple[TrackState, tuple[HandTrack, Array]]:
    """Track from frame `first` until the hand was missed too often or a race is due; the state then stands still."""

    def skip(state: TrackState, frame: Array, time: Array) -> tuple[TrackState, HandTrack]:
        _, track = jax.eval_shape(partial(_step, setup), state, frame, time)
        return state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), track)

    def body(state: TrackState, inputs: tuple) -> tuple[TrackState, tuple[HandTrack, Array]]:
        frame, time, index = inputs
        active = (index >= first) & (state.misses < PATIENCE) & ((index == first) | (time < state.race_time))
        state, track = jax.lax.cond(active, partial(_step, setup), skip, state, frame, time)
        return state, (track, active)

    return jax.lax.scan(body, state, (frames, times, jnp.arange(frames.shape[0])))


@jax.jit  # traced once for its shapes and its program
def _step(setup: _Setup, state: TrackState, frame: Array, time: Array) -> tuple[TrackState, HandTrack]:
    """One frame: predict, cut the window about the prediction, update, and judge whether the hand was there."""
    key, predict_key, update_key = jax.random.split(state.key, 3)
    likelihood = setup.hand(state)
    filter = _filter(setup, open_palm(jnp.zeros(3)), likelihood)
    elapsed = time - state.time
    predicted = filter.predict(filter.params, predict_key, state.ensemble, elapsed)
    expected, _ = pose_moments(*_particles(predicted))
    image = look(setup, _filled(frame, state.missing_is_background), expected, state.scale)

    def update(ensemble: Any) -> tuple[Any, ParticleInfo]:
        return filter.update(filter.params, update_key, ensemble, image, elapsed)

    def coast(ensemble: Any) -> tuple[Any, ParticleInfo]:
        _, info = jax.eval_shape(update, ensemble)
        return ensemble, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), info)

    something = image.observed_count >= FEWEST_PIXELS
    ensemble, info = jax.lax.cond(something, update, coast, predicted)
    pose, covariance = pose_moments(*_particles(ensemble))
    seen = something & (likelihood.cost(pose, image) < LOST_COST)
    misses = jnp.where(seen, 0, state.misses + 1)
    track = HandTrack(
        pose=pose,
        pose_std=jnp.sqrt(jnp.diagonal(covariance)),
        joints=forward_kinematics(pose, likelihood.geometry).joints,
        effective_sample_size=info.effective_sample_size,
        log_evidence=info.log_evidence,
        status=jnp.where(seen, jnp.where(state.doubt, DOUBTFUL, TRACKING), LOST).astype(jnp.int32),
    )
    return state._replace(ensemble=ensemble, time=time, misses=misses, key=key), track


def look(setup: _Setup, frame: Array, expected: Float[Array, " 22"], scale: Float[Array, ""]) -> HandImage:
    """The window of a frame in which a hand is expected, with everything else taken out."""
    center = hand_center(expected, scale)
    center = center.at[2].set(jnp.maximum(center[2], 0.1))  # a lost hand may be predicted behind the camera
    window, observed = crop(setup.camera, frame, center, WINDOW, setup.spacing(center[2]))
    return hand_image(window, isolate(window, observed, expected, scale))


def _particles(state: RaoBlackwellState | GuidedState) -> tuple[Array, Array]:
    ensemble = state.ensemble if isinstance(state, GuidedState) else state
    return ensemble.particles, ensemble.log_weights


def _nothing_found() -> HandTrack:
    """The row of a frame in which no hand was found: nothing but its status."""
    nan = partial(np.full, fill_value=np.nan, dtype=np.float32)
    return HandTrack(nan((1, 22)), nan((1, 21)), nan((1, 21, 3)), nan(1), nan(1), np.full(1, SEARCHING, np.int32))


def synthetic_sequence(seed: int) -> tuple[DepthSequence, np.ndarray]:
    """The default input: a hand on a random walk of its velocity (data B), 150 frames of a second Kinect with noise.

    Returns the recording and the true joints (T, 21, 3) in metres.
    """
    made = simulate_sequence(jax.random.key(seed), "B")
    times = FRAME_INTERVAL * np.arange(len(made.poses))
    depth = np.asarray(made.depth_mm, np.float32) / 1000
    return from_array(kinect_v2(), times, depth, "synthetic hand"), np.asarray(made.joints)
