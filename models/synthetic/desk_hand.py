"""A hand that moves over a desk with things projected on it, rendered from above, with the truth about its fingers.

The hand is a disc, a forearm and five fingers of constant width; lengths are pixels of an image with `LAYOUT_ROWS` rows
and grow with the image. Finger 0 is the thumb.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.synthetic.desk import Desk, infrared_desk
from jaxfilters.typing import AnyKey

LAYOUT_ROWS = 240
NUM_FINGERS = 5
FINGER_ANGLES = np.deg2rad([58.0, 20.0, 0.0, -18.0, -38.0])
"""From the arm's axis to the side of the thumb."""
FINGER_RADII = np.array([7.0, 6.5, 6.5, 6.5, 6.0])
TIP_DISTANCES = np.array([50.0, 68.0, 74.0, 68.0, 56.0])
BASE_DISTANCES = np.array([24.0, 30.0, 31.0, 30.0, 28.0])
"""From the middle of the palm, as the tips."""
PALM_RADIUS, FOREARM_RADIUS, FOREARM_BEGINS = 27.0, 19.0, 22.0
PALM_X, PALM_Y = (90.0, 230.0), (95.0, 150.0)
MAX_LEAN = math.radians(30.0)
"""Of the arm's axis from straight up."""
LENGTH_JITTER = 0.04
SHOWN = 0.5
"""Share of its length from which on a finger counts as extended."""
EXPOSURE = 0.5
"""Of the time between two frames."""
SUBFRAMES = 5
MOVE_FRAMES = 4
"""For a finger to come out or to fold."""


@dataclass(frozen=True)
class HandPose:
    """Where a hand is; places in pixels of the layout."""

    palm: Float[np.ndarray, "2"]
    angle: float
    """Of the axis from the image's x axis to its y axis (down), radians: `-pi / 2` is up."""
    lengths: Float[np.ndarray, "5"]
    """Of each finger, from 0 folded to about 1 stretched."""
    handedness: int = 1
    """1: the thumb is counter-clockwise of the arm's axis, as of a right hand from its back; -1: the other way."""


@dataclass(frozen=True)
class DeskFrame:
    """A frame and what is true of it; pixels of the image (x right, y down, centres at integers)."""

    image: UInt8[np.ndarray, "rows cols"] | UInt8[np.ndarray, "rows cols 3"]
    tips: Float[np.ndarray, "5 2"]
    """Middles of the discs that end the fingers, the thumb first; of folded fingers where they would begin."""
    extended: Bool[np.ndarray, "5"]
    bases: Float[np.ndarray, "5 2"]
    palm: Float[np.ndarray, "2"]
    axis: Float[np.ndarray, "2"]
    """Unit vector along the forearm, towards the hand."""
    coverage: Float[np.ndarray, "rows cols"]
    """Share of each pixel that the hand covered while the shutter was open."""


def random_frame(
    key: AnyKey, num_fingers: int, *, shape: tuple[int, int] = (240, 320), blur: float = 1.0, desk: Desk | None = None
) -> DeskFrame:
    """A hand with that many extended fingers somewhere over a desk (section 4.1, image level).

    Args:
        key: Decides about fingers, place, desk and noise.
        num_fingers: From 0 to 5.
        shape: Rows and columns, in the proportion 3 : 4.
        blur: Standard deviation, pixels of the image.
        desk: What lies below the hand, of the same shape; the infrared one with new clutter by default.

    Raises:
        ValueError: a number of fingers out of range, or a shape of another proportion.
    """
    if not 0 <= num_fingers <= NUM_FINGERS:
        raise ValueError(f"num_fingers must be from 0 to {NUM_FINGERS}; got {num_fingers}.")
    rng = _generator(key)
    fingers = np.zeros(NUM_FINGERS, bool)
    fingers[rng.permutation(NUM_FINGERS)[:num_fingers]] = True
    pose = HandPose(
        palm=np.array([rng.uniform(*PALM_X), rng.uniform(*PALM_Y)]),
        angle=-math.pi / 2 + rng.uniform(-MAX_LEAN, MAX_LEAN),
        lengths=np.where(fingers, 1 + LENGTH_JITTER * rng.normal(size=NUM_FINGERS), 0.0),
        handedness=int(rng.choice([-1, 1])),
    )
    return frame_of(rng, [pose], desk or infrared_desk(rng, shape), blur=blur)


def desk_video(
    key: AnyKey,
    fingers: Bool[np.ndarray, "frames 5"],
    *,
    shape: tuple[int, int] = (240, 320),
    blur: float = 1.0,
    speed: float = 1.0,
    desk: Desk | None = None,
    poses: Float[np.ndarray, "frames 3"] | None = None,
) -> Iterator[DeskFrame]:
    """Frames of a right hand that moves, blurred by its motion while the shutter is open.

    Args:
        key: Decides about path, desk and noise.
        fingers: Which fingers are to be out in each frame, the thumb first; they take `MOVE_FRAMES` to get there.
        shape: Rows and columns, in the proportion 3 : 4.
        blur: Standard deviation of the lens, pixels of the image.
        speed: 1 for up to about 3 % of the image's height per frame.
        desk: What lies below the hand, of the same shape; the infrared one by default.
        poses: Palm (x, y) in pixels of an image with 240 rows and lean of the arm in radians; a Lissajous path without.

    Raises:
        ValueError: a shape of another proportion.
    """
    rng = _generator(key)
    desk = desk or infrared_desk(rng, shape)
    phases, jitter = rng.uniform(0, 2 * math.pi, 5), 1 + LENGTH_JITTER * rng.normal(size=NUM_FINGERS)
    wanted = np.pad(fingers.astype(float), ((MOVE_FRAMES, MOVE_FRAMES), (0, 0)), mode="edge")
    kernel = np.ones(MOVE_FRAMES) / MOVE_FRAMES
    out = np.stack([np.convolve(w, kernel, mode="same") for w in wanted.T], axis=1)[MOVE_FRAMES:]
    times = np.arange(len(out))
    for frame in range(len(fingers)):
        during = []
        for time in frame + EXPOSURE * (np.arange(SUBFRAMES) / (SUBFRAMES - 1) - 0.5):
            lengths = jitter * np.array([np.interp(time, times, share) for share in out.T])
            palm, lean = _lissajous(speed * time, phases) if poses is None else _between(poses, time)
            during.append(HandPose(palm, -math.pi / 2 + lean, lengths))
        yield frame_of(rng, during, desk, blur=blur, time=float(frame))


def frame_of(
    rng: np.random.Generator, poses: list[HandPose], desk: Desk, *, blur: float, time: float = 0.0
) -> DeskFrame:
    """A frame during which the hand went through poses; the truth is of the one in the middle.

    Raises:
        ValueError: a shape of the desk that is not 3 : 4.
    """
    rows, cols = desk.shape
    if rows * 4 != cols * 3:
        raise ValueError(f"shape must be rows : columns = 3 : 4; got {desk.shape}.")
    coverage, of_pose = np.zeros(desk.shape), np.empty(desk.shape)
    for pose in poses:
        coverage += hand_coverage(pose, desk.shape, out=of_pose)
    coverage /= len(poses)
    middle = poses[len(poses) // 2]
    scale = rows / LAYOUT_ROWS
    bases, tips = _finger_ends(middle)
    return DeskFrame(
        image=desk.image(rng, coverage, blur, time),
        tips=_placed(tips, scale),
        extended=middle.lengths > SHOWN,
        bases=_placed(bases, scale),
        palm=_placed(middle.palm, scale),
        axis=_direction(middle, 0.0),
        coverage=coverage,
    )


def hand_coverage(
    pose: HandPose, shape: tuple[int, int], *, out: Float[np.ndarray, "rows cols"] | None = None
) -> Float[np.ndarray, "rows cols"]:
    """Share of each pixel that the hand covers, from 0 to 1; written into `out` where that is given."""
    scale = shape[0] / LAYOUT_ROWS
    coverage = np.empty(shape) if out is None else out
    coverage.fill(0.0)
    axis = _direction(pose, 0.0)
    bases, tips = _finger_ends(pose)
    shown = pose.lengths > 0.05
    starts = np.concatenate([[pose.palm, pose.palm - FOREARM_BEGINS * axis], bases[shown]])
    ends = np.concatenate([[pose.palm, pose.palm - 2 * LAYOUT_ROWS * axis], tips[shown]])
    radii = np.concatenate([[PALM_RADIUS, FOREARM_RADIUS], FINGER_RADII[shown]])
    for start, end, radius in zip(_placed(starts, scale), _placed(ends, scale), scale * radii, strict=True):
        _add_capsule(coverage, start, end, radius)
    return coverage


def _add_capsule(coverage: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float) -> None:
    """The larger of what is there and of the capsule, whose edges are one pixel wide."""
    low = np.maximum(np.floor(np.minimum(start, end) - radius - 1), 0).astype(int)
    high = np.minimum(np.ceil(np.maximum(start, end) + radius + 2), coverage.shape[::-1]).astype(int)
    if (high <= low).any():
        return
    x, y = np.arange(low[0], high[0])[None] - start[0], np.arange(low[1], high[1])[:, None] - start[1]
    along = end - start
    share = np.clip((x * along[0] + y * along[1]) / max(float(along @ along), 1e-12), 0, 1)
    distance = np.sqrt((x - share * along[0]) ** 2 + (y - share * along[1]) ** 2)
    window = coverage[low[1] : high[1], low[0] : high[0]]
    np.maximum(window, np.minimum(radius + 0.5 - distance, 1), out=window)


def _finger_ends(pose: HandPose) -> tuple[np.ndarray, np.ndarray]:
    """Bases and tips (5, 2) in the layout."""
    directions = np.stack([_direction(pose, angle) for angle in FINGER_ANGLES])
    reach = BASE_DISTANCES + pose.lengths * (TIP_DISTANCES - BASE_DISTANCES)
    return pose.palm + BASE_DISTANCES[:, None] * directions, pose.palm + reach[:, None] * directions


def _direction(pose: HandPose, angle: float) -> np.ndarray:
    """Unit vector at an angle from the axis; with y down, counter-clockwise angles are subtracted."""
    turned = pose.angle - pose.handedness * angle
    return np.array([math.cos(turned), math.sin(turned)])


def _placed(points: np.ndarray, scale: float) -> np.ndarray:
    """Pixels of the image, whose centres are at integers at every scale."""
    return scale * (points + 0.5) - 0.5


def _lissajous(time: float, phases: np.ndarray) -> tuple[np.ndarray, float]:
    """Palm in the layout and lean of the axis."""
    wave = np.sin(np.array([0.071, 0.183, 0.113, 0.227, 0.047]) * time + phases)
    (left, right), (top, bottom) = PALM_X, PALM_Y
    x = (left + right) / 2 + (right - left) / 2 * (0.8 * wave[0] + 0.2 * wave[1])
    y = (top + bottom) / 2 + (bottom - top) / 2 * (0.7 * wave[2] + 0.3 * wave[3])
    return np.array([x, y]), 0.8 * MAX_LEAN * float(wave[4])


def _between(poses: Float[np.ndarray, "frames 3"], time: float) -> tuple[np.ndarray, float]:
    """Palm and lean at a time between frames."""
    x, y, lean = (float(np.interp(time, np.arange(len(poses)), numbers)) for numbers in poses.T)
    return np.array([x, y]), lean


def _generator(key: AnyKey) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
