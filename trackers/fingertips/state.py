"""The options of the fingertip tracker, its state between two frames, and its report of each tip."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.fingertip.motion import STATE
from jaxfilters.models.fingertip.observation import MAX_TIPS
from jaxfilters.models.fingertip.thumb import POSTURE, Posture

FREE, TENTATIVE, CONFIRMED = range(3)
"""Slots: unused; what may be a mistake; a fingertip."""
ABSENT, SYMBOLIC, MANIPULATION = range(3)
MODE_NAMES = ("absent", "symbolic", "manipulation")
"""What a hand does: nothing, for want of fingertips; it draws; with its thumb out, it handles something."""
NEVER = 10**6
"""Frames since what has not happened."""


@dataclass(frozen=True)
class FingertipConfig:
    """Constants of the tracker; Python values that are read when it is compiled.

    Pixels are those of a 640x480 image, and durations are in frames of 1/30 s; `scaled` converts both. Numbers of
    detections are not converted: errors of detection differ from image to image, so that it takes as many images to
    confirm something at any frame rate.

    The defaults are for the modern method; `tracker.PUBLISHED_CONFIG` has the published ones.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    capacity: int = 10
    """Tracks at a time, the tentative ones included."""
    frame: float = 1.0
    """Time between two frames, in thirtieths of a second; velocities are pixels in such a time."""
    measurement_sd: float = 1.5
    """Of a coordinate of a tip, pixels (sigma_v)."""
    misplacement_sd: float = 1.2
    """Of a coordinate, pixels: of the end of a finger's silhouette from where a person marks the tip. It lasts, so that
    no filter reduces it, and is part of reported standard deviations alone. Chosen so that they agree with the errors
    in `desk_hand_video`."""
    drive_sd: float = 3.0
    """Of the change of a velocity in a frame of 1/30 s, pixels a frame (sigma_w)."""
    max_speed: float = 60.0
    """Of a finger that was observed once, pixels a frame."""
    lost: float = 75.0
    """Uncertainty U of a prediction from which on a finger is gone (theta): after six misses while the palm is visible;
    of predictions without the palm, 300 is after four. Greater in frames longer than 1/30 s, as the gates are wider."""
    min_hits: int = 3
    """Detections in a row that make a fingertip; a number of images at any frame rate."""
    gate: float = 40.0
    """Farthest from its prediction that a fingertip is looked for, pixels; farther in frames longer than 1/30 s."""
    tentative_gate: float = 80.0
    """The same of what was observed once or twice."""
    surprise: float = 13.8
    """Squared distance in standard deviations from which on a detection is not that finger's: chi-square, 99.9 %."""
    apart: float = 16.0
    """Nearer to a fingertip than this, pixels, nothing new begins."""
    carried_sd: float = 4.0
    """Of a fingertip's velocity beside the palm's, mean over a frame of 1/30 s, pixels a frame."""
    disorder: float = 4.0
    """Cost of the best matching in order, by that of the best in any, from which on the order is in doubt."""
    disordered_frames: int = 3
    """Frames of doubt after which fingers are matched in any order; a number of images at any frame rate."""
    empty_frames: int = 15
    """Frames of 1/30 s without a tip after which the hand is forgotten."""
    angle_sd: float = math.radians(10.0)
    """Of the direction of a fingertip from the palm, around that of its name, radians."""
    length_sd: float = 0.5
    """Of its distance from the palm, palm radii."""
    axis_frames: int = 10
    """Frames of 1/30 s for which the arm's last axis stands in for one that is not visible."""
    posture: Posture = POSTURE

    def __post_init__(self) -> None:
        whole = ("capacity", "min_hits", "disordered_frames", "empty_frames", "axis_frames")
        for name in [entry.name for entry in fields(self) if entry.name != "posture"]:
            value = getattr(self, name)
            if name in whole and not (isinstance(value, int) and value >= 1):
                raise ValueError(f"{name} must be a positive integer; got {value!r}.")
            if not (isinstance(value, int | float) and 0 < value < np.inf):
                raise ValueError(f"{name} must be positive; got {value!r}.")
        if self.capacity < MAX_TIPS:
            raise ValueError(f"capacity must be at least {MAX_TIPS}, the tips of a hand; got {self.capacity}.")

    @property
    def drive(self) -> float:
        """q: variance of the drive in a frame by that of a measurement."""
        return self.frame * (self.drive_sd / self.measurement_sd) ** 2


Config = TypeVar("Config")


def rescaled(config: Config, *, pixels: Sequence[str], durations: Sequence[str], height: float, fps: float) -> Config:
    """A dataclass of constants for images of another height in pixels, and another number of frames a second.

    Args:
        config: Constants for images of 480 rows and 30 frames a second.
        pixels: Names of its lengths.
        durations: Names of its numbers of frames that are durations; they stay whole, and at least one frame.
        height: Rows of the images.
        fps: Frames a second.
    """
    lengths = {name: getattr(config, name) * height / 480.0 for name in pixels}
    # Counters of frames stop at `NEVER`.
    frames = {name: max(round(min(getattr(config, name) * fps / 30.0, NEVER - 1)), 1) for name in durations}
    return replace(config, **lengths, **frames)  # type: ignore[type-var]


def scaled(config: FingertipConfig, *, height: float = 480.0, fps: float = 30.0) -> FingertipConfig:
    """The same for images of another height in pixels, and another number of frames a second."""
    in_pixels = (
        *("measurement_sd", "misplacement_sd", "drive_sd", "carried_sd"),
        *("max_speed", "gate", "tentative_gate", "apart"),
    )
    found = rescaled(config, pixels=in_pixels, durations=("empty_frames", "axis_frames"), height=height, fps=fps)
    longer = 30.0 / fps
    # In a longer frame a finger gets farther from its prediction; the errors of detection stay in a shorter one.
    wider = max(1.0, longer)
    posture = config.posture
    return replace(
        found,
        frame=config.frame * longer,
        gate=wider * found.gate,
        tentative_gate=wider * found.tentative_gate,
        lost=wider**2 * config.lost,
        posture=posture._replace(correlation=posture.correlation**longer, exchange=min(longer * posture.exchange, 0.5)),
    )


class Tracks(NamedTuple):
    """Fingertips and what may become some, one slot each."""

    belief: Gaussian
    """Mean (slots, 4) and covariance (slots, 4, 4) in the next frame, as in `models.fingertip.motion`."""
    mode: Int32[Array, " slots"]
    identity: Int32[Array, " slots"]
    """-1 until it is confirmed; then 0, the thumb, to 4, or in the published way a number of its own."""
    hits: Int32[Array, " slots"]
    """Detections so far."""
    missed: Int32[Array, " slots"]
    """Frames since the last of them."""
    thumb: Any
    """What the thumb test remembers, slots first."""
    is_thumb: Bool[Array, " slots"]


class Fingers(NamedTuple):
    """Where the fingers of a hand are about its palm, by their names."""

    angle: Float[Array, " names"]
    """From the arm's axis, radians."""
    length: Float[Array, " names"]
    """From the palm, palm radii."""


class HandState(NamedTuple):
    """One hand between two frames."""

    tracks: Tracks
    fingers: Fingers
    palm: Float[Array, "2"]
    """Where it was observed last, pixels."""
    palm_velocity: Float[Array, "2"]
    """Between the last two frames in which it was observed, pixels a frame."""
    unseen: Int32[Array, ""]
    """Frames since it was observed."""
    axis: Float[Array, "2"]
    """Of the forearm, when it was observed last."""
    axis_unseen: Int32[Array, ""]
    """Frames since then."""
    empty: Int32[Array, ""]
    """Frames in a row without a tip."""
    disordered: Int32[Array, ""]
    """Frames in a row in which the order of the fingers was in doubt."""
    turned: Bool[Array, ""]
    """Whether the thumb is on the side other than the given one."""
    side_odds: Float[Array, ""]
    """Log odds that it is on the given one."""
    next_identity: Int32[Array, ""]


class HandReport(NamedTuple):
    """What is known of one hand after a frame; tips one row a slot."""

    identity: Int32[Array, " slots"]
    """-1 where there is no fingertip, and all else of the row is 0."""
    is_tip: Bool[Array, " slots"]
    is_observed: Bool[Array, " slots"]
    """Otherwise the position is predicted."""
    position: Float[Array, "slots 2"]
    """Pixels."""
    sd: Float[Array, " slots"]
    """Of a coordinate, pixels, misplacement included."""
    innovations: Int32[Array, "slots 2"]
    """How many coordinates were compared with their prediction, and how many of these lie within its 95 % band."""
    velocity: Float[Array, "slots 2"]
    """Pixels a frame of 1/30 s."""
    is_thumb: Bool[Array, " slots"]
    thumb_probability: Float[Array, " slots"]
    palm: Float[Array, "2"]
    has_palm: Bool[Array, ""]
    """Whether it was observed in this frame."""
    axis: Float[Array, "2"]
    has_axis: Bool[Array, ""]
    """Whether it was observed, now or a few frames ago; without it the estimate of the thumb does not change."""
    mode: Int32[Array, ""]
    """Place in `MODE_NAMES`."""
    num_tips: Int32[Array, ""]


class ThumbTest(NamedTuple):
    """How a track becomes the thumb; functions of one track but for the last, whose arrays are slots first."""

    start: Callable[..., Any]
    """`(config, angles) -> memory` of a track that begins."""
    observe: Callable[..., Any]
    """`(config, angles, memory, angle, observed) -> memory` with the angle of one more frame, where it was
    `observed`."""
    judge: Callable[..., tuple[Array, Array]]
    """`(memories, was_thumb, there) -> (probability, is_thumb)` over the fingers of a hand that are `there`."""


class Method(NamedTuple):
    """The strategies of which a tracker is made."""

    hint: Callable[..., Gaussian]
    """`(config, state, observed) -> beliefs`, with what else than tips tells where fingers are in this frame."""
    side: Callable[..., tuple[Array, Array]]
    """`(config, state, observed, side) -> (turned, side_odds)`: whether the thumb is on the side other than `side`."""
    associate: Callable[..., tuple[Array, Array]]
    """`(config, state, beliefs, observed) -> (tip of every slot or -1, whether the order was in doubt)`."""
    may_begin: Callable[..., Array]
    """`(config, tracks, positions, observed) -> which tips without a track may begin one`."""
    name: Callable[..., tuple[Array, Any]]
    """`(config, state, tracks, ready, places, observed, side) -> (identity of every slot, fingers)`: which the tracks
    are that become fingertips in this frame."""
    report: Callable[..., Array]
    """`(detected, filtered) -> position` that is reported where a tip was detected."""
    may_coast: Callable[..., Array]
    """`(positions, observed) -> which predictions may be reported` where no tip was detected."""
    thumb: ThumbTest


def no_tracks(config: FingertipConfig, memory: Any) -> Tracks:
    """Nothing yet; `memory` is that of the thumb test for a track that begins."""
    n = config.capacity
    whole = jnp.zeros(n, jnp.int32)
    return Tracks(
        Gaussian(jnp.zeros((n, STATE)), jnp.broadcast_to(jnp.eye(STATE), (n, STATE, STATE))),
        whole + FREE,
        whole - 1,
        whole,
        whole,
        repeated(memory, n),
        whole > 0,
    )


def repeated(tree: Any, n: int) -> Any:
    """The same n times, leaf by leaf."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *jnp.shape(leaf))), tree)


def chosen(mask: Bool[Array, " slots"], yes: Any, no: Any) -> Any:
    """`yes` in the slots of the mask, `no` elsewhere, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (jnp.ndim(b) - 1)), a, b), yes, no)
