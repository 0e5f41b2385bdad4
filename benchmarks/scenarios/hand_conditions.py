"""The hand tracker under conditions that differ from those of its development: distance, surroundings, missing data.

Two of the motions of real hands that were not part of the development (`MOTIONS`), 32 consecutive frames of each at 30
frames/s, with the middle of the palm on the optical axis at 0.5 m (`_as_recorded`: where it was recorded). The tracker
is given the depth frames, their times and the camera. `error_mm_` is the mean distance of the 21 joints over all frames
in which all of them are in the image, where a frame without an estimate counts as `MISSING_MM`. `wrong_` is the share
of frames whose joints are 25 mm or more off in the mean under the status `tracking`, or in which no joint is in the
image under this status. Surroundings have the noise of the hand's readings, which does not grow with the distance.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._real_comparison import MISSING_MM
from jaxfilters.benchmarks.scenarios._real_hands import CLOSE_MM, NOISE_M, WALL_M, HandRecording, load
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig

MOTIONS = ("02_L", "03_R")
"""Of `_real_hands.HELD`: the first one of each hand that are not the same movement."""
NUM_FRAMES, LEAVING_NUM_FRAMES, QUICK_NUM_FRAMES = 32, 48, 4
DISTANCES = (0.3, 0.5, 0.9, 1.2, 1.5)
"""Metres of the middle of the palm, mean over the frames."""
USUAL, BESIDE_BODY = 0.5, 0.6
"""Metres likewise, in the other cases and beside a body."""
BEHIND = 0.8
"""Metres from a distant hand to what is behind it; at least `WALL_M` from the camera."""
BODY_RADIUS, BODY_DISTANCE, BODY_GAP_PX = 0.12, 0.45, 20
"""Metres of an upright cylinder and from the camera to its axis, and pixels between it and the hand."""
HOLE_PX, HOLES = 2, 1 / 200
"""Radius of a hole in the readings, and holes a pixel: 8 % of the readings are missing."""
LEAVING = ((0, 10, 16, 30, 36, 47), (0.0, 0.0, 0.5, 0.5, 0.0, 0.0))
"""Frames, and metres by which the hand has then moved aside; at 0.5 m it is out of the image from 0.4 m on."""
NUM_JOINTS = 21
STATUS = ("searching", "tracking", "lost", "doubtful")

Case = Callable[[str, int], HandRecording]
"""`(motion, number of frames) -> recording`; joints are NaN in frames that do not count."""


class Outcome(NamedTuple):
    """Of one recording, frame by frame."""

    error_mm: Float[np.ndarray, " t"]
    """Mean over the joints; NaN where there is no estimate or the frame does not count."""
    status: np.ndarray
    num_joints: np.ndarray
    """True joints in the image, (t,)."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow the motions under each condition, print the errors and the statuses, return both."""
    kept = Finished(out, scenario="hand-conditions", quick=quick, seed=seed)
    found: dict[str, Metric] = {}
    for case, made in CASES.items():
        outcomes = []
        for motion in MOTIONS[: 1 if quick else None]:
            measure = partial(_measured, made, motion, quick, seed)
            outcomes.append(Outcome(**kept.arrays(f"{case}_{motion}", measure)))
            sys.stderr.write(f"  {case:16} {motion}: {described(outcomes[-1])}\n")
        found |= metrics_of(outcomes, case)
    return found


def _measured(made: Case, motion: str, quick: bool, seed: int) -> dict[str, np.ndarray]:
    return followed(made(motion, QUICK_NUM_FRAMES if quick else NUM_FRAMES), seed)._asdict()


def followed(recording: HandRecording, seed: int) -> Outcome:
    """What the tracker makes of a recording."""
    config = HandDepthConfig(seed=seed)
    track = hand_depth.track(iter(recording.depth), recording.times_s, recording.camera, config)
    count = num_in_image(recording.camera, recording.joints)
    error = 1e3 * np.linalg.norm(np.asarray(track.joints) - recording.joints, axis=-1).mean(axis=1)
    return Outcome(np.where(count == NUM_JOINTS, error, np.nan), np.asarray(track.status), count)


def num_in_image(camera: Pinhole, joints: Float[np.ndarray, "t j 3"]) -> np.ndarray:
    """(t,) joints that are in the image."""
    pixels = np.asarray(camera.project(jnp.asarray(joints, dtype=float)))
    rows, columns = camera.shape
    inside = (pixels >= -0.5) & (pixels < np.array([columns - 0.5, rows - 0.5]))
    return np.sum(inside.all(axis=-1), axis=1)


def metrics_of(outcomes: list[Outcome], case: str) -> dict[str, Metric]:
    """Mean error and share of frames with a wrong status, over all frames of the recordings that count."""
    errors = np.concatenate([_counted(each) for each in outcomes])
    wrong = [_is_wrong(each) for each in outcomes]
    judged = sum(int(np.sum((each.num_joints == NUM_JOINTS) | (each.num_joints == 0))) for each in outcomes)
    return {
        f"error_mm_{case}": Metric(float(np.mean(errors)), "mm", "lower"),
        f"wrong_{case}": Metric(100 * float(np.sum(np.concatenate(wrong))) / judged, "%", "lower"),
    }


def _counted(outcome: Outcome) -> Float[np.ndarray, " n"]:
    errors = outcome.error_mm[outcome.num_joints == NUM_JOINTS]
    return np.where(np.isfinite(errors), errors, MISSING_MM)


def _is_wrong(outcome: Outcome) -> np.ndarray:
    far = (outcome.num_joints == NUM_JOINTS) & ~(outcome.error_mm < CLOSE_MM)
    return (far | (outcome.num_joints == 0)) & (outcome.status == hand_depth.TRACKING)


def described(outcome: Outcome) -> str:
    """Errors and statuses of one recording in a line."""
    errors, frames = _counted(outcome), Counter(STATUS[int(status)] for status in outcome.status)
    return (
        f"mean {errors.mean():5.1f}, median {np.median(errors):5.1f}, largest {errors.max():5.1f} mm; "
        f"wrong {int(_is_wrong(outcome).sum())} of {len(outcome.status)}; "
        + ", ".join(f"{status} {count}" for status, count in sorted(frames.items()))
    )


def as_recorded(motion: str, num_frames: int) -> HandRecording:
    """The motion where it was recorded, before a distant wall."""
    return load(motion, num_frames)


def at_distance(metres: float, motion: str, num_frames: int, every: int = 1) -> HandRecording:
    """The motion with the middle of the palm, mean over the frames, on the optical axis."""
    moved = lambda palm: palm - palm.mean(axis=0) + np.array([0.0, 0.0, metres])
    return load(motion, num_frames, every=every, palm_at_m=moved, wall_m=max(WALL_M, metres + BEHIND))


def beside_plane(normal: tuple[float, float, float], margin: float, motion: str, num_frames: int) -> HandRecording:
    """The motion before a plane that no reading of the hand is nearer to than `margin` metres.

    Args:
        normal: Of the plane, of any length, from the hand to it; camera frame.
        margin: Metres from the nearest reading of the hand.
        motion: Its name.
        num_frames: How many.
    """
    recording = at_distance(USUAL, motion, num_frames)
    unit = np.array(normal) / np.linalg.norm(normal)
    along = rays(recording.camera) @ unit
    furthest = np.max((recording.depth * along)[_hand(recording)])
    with np.errstate(divide="ignore"):
        plane = (furthest + margin) / along
    return before(recording, np.where(along > 0, plane, np.inf))


def beside_body(motion: str, num_frames: int) -> HandRecording:
    """The motion beside an upright cylinder that is nearer to the camera than the hand, left of it in the image."""
    recording = at_distance(BESIDE_BODY, motion, num_frames)
    camera = recording.camera
    edge = np.flatnonzero(_hand(recording).any(axis=(0, 1)))[0] - BODY_GAP_PX
    focal, center = float(camera.focal[0]), float(camera.center[0])
    middle = math.atan((edge - center) / focal) - math.asin(BODY_RADIUS / BODY_DISTANCE)
    axis = BODY_DISTANCE * np.array([math.sin(middle), math.cos(middle)])
    x = rays(camera)[..., 0]
    # |z (x, 1) - axis| = radius in the plane across the cylinder: the smaller root z.
    square, half = x**2 + 1, x * axis[0] + axis[1]
    root = half**2 - square * (axis @ axis - BODY_RADIUS**2)
    nearest = (half - np.sqrt(np.maximum(root, 0.0))) / square
    return before(recording, np.where(root > 0, nearest, np.inf))


def with_holes(motion: str, num_frames: int) -> HandRecording:
    """The motion with small holes in the readings, other ones in each frame."""
    recording, rng = at_distance(USUAL, motion, num_frames), np.random.default_rng(0)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * HOLE_PX + 1, 2 * HOLE_PX + 1))
    centers = (rng.random(recording.depth.shape) < HOLES).astype(np.uint8)
    holes = np.stack([cv2.dilate(each, disc) for each in centers]).astype(bool)
    return recording._replace(depth=np.where(holes, np.float32(np.nan), recording.depth))


def with_dropped_frames(motion: str, num_frames: int) -> HandRecording:
    """The motion at 15 frames/s of which a third, drawn at random, is missing; the times are the true ones."""
    recording = at_distance(USUAL, motion, num_frames * 3 // 2, every=2)
    kept = np.sort(np.random.default_rng(0).permutation(len(recording.depth))[:num_frames])
    frames = {name: getattr(recording, name)[kept] for name in ("times_s", "depth", "joints")}
    return recording._replace(**frames)


def leaving(motion: str, num_frames: int) -> HandRecording:
    """The hand leaves the image at the side and returns; `num_frames` is raised so that it has time for it."""
    aside = lambda count: np.interp(np.arange(count), *LEAVING)[:, None] * np.array([1.0, 0.0, 0.0])
    path = lambda palm: palm - palm.mean(axis=0) + np.array([0.0, 0.0, USUAL]) + aside(len(palm))
    return load(motion, LEAVING_NUM_FRAMES if num_frames == NUM_FRAMES else num_frames, palm_at_m=path)


def rays(camera: Pinhole) -> Float[np.ndarray, "rows cols 3"]:
    """Directions of the pixels, with the z coordinate 1."""
    rows, columns = camera.shape
    v, u = np.mgrid[:rows, :columns]
    (fx, fy), (cx, cy) = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(camera.shape)], axis=-1)


def before(recording: HandRecording, surface: Float[np.ndarray, "rows cols"]) -> HandRecording:
    """The recording with a surface, depth in metres with noise, wherever it is the nearest."""
    noise = NOISE_M * np.random.default_rng(1).normal(size=recording.depth.shape)
    nearest = np.minimum(recording.depth, np.round(surface + noise, 3))
    return recording._replace(depth=nearest.astype(np.float32))


def _hand(recording: HandRecording) -> np.ndarray:
    """Readings of the hand: all that are nearer than the wall."""
    return recording.depth < WALL_M - 0.1


CASES: dict[str, Case] = {
    "as_recorded": as_recorded,
    **{f"at_{round(1e3 * metres)}mm": partial(at_distance, metres) for metres in DISTANCES},
    "desk_behind": partial(beside_plane, (0.0, 0.5, math.sqrt(0.75)), 0.06),
    "desk_nearer": partial(beside_plane, (0.0, 1.0, 0.0), 0.02),
    "body_nearer": beside_body,
    "wall_behind": partial(beside_plane, (0.0, 0.0, 1.0), 0.04),
    "holes": with_holes,
    "dropped_frames": with_dropped_frames,
    "leaving": leaving,
}
"""By name: a desk 60 mm behind the hand that rises towards its upper edge (60 degrees to the optical axis), a level
desk below the hand that begins nearer to the camera, a body beside the hand, a wall 40 mm behind the hand, and others
as their functions say."""
