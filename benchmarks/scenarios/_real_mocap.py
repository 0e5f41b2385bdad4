"""Motion capture of a hand observed by a virtual camera: lengths between markers on the fingers, from one view.

A triangle of markers is fixed to the back of the hand; its measured sides set the scale. A finger's chain begins at a
marker of the triangle: one link inside the hand that hardly moves, to a joint that nobody sees; from it one to the
marker in the middle of the finger; and one to that on its tip, whose length is what is judged.
"""

import dataclasses
import math
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.scenarios._real_markers import MarkedHand, Marker, marked_hand
from jaxfilters.models.articulated.filters import Inequalities, inequalities
from jaxfilters.models.articulated.hand import articulated_hand, with_lasting_errors
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.articulated.limits import LimitRows, limit_rows, within
from jaxfilters.models.articulated.motion import MOVEMENT_TIME, AboutEase, about_ease
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.recording import FeatureFrame, Start
from jaxfilters.trackers.articulated.tracker import tracker_of

FINGERS = ("thumb", "index", "middle", "ring", "little")
TRIANGLE = ("hand_top", "hand_left", "hand_right")
FOCAL, DISTANCE = 3000.0, 3.0
"""Pixels, metres: about one pixel a millimetre."""
NOISE = 1.0
"""Pixels."""
SOFT_TISSUE_STD, SOFT_TISSUE_TIME = 7.0, 15.0
"""Pixels, about millimetres, and frames: how far a marker on a finger is from where a chain of hinges has it, as skin
slides over bone and joints are no hinges, and how long that lasts. From the views of `DEVELOPMENT_VIEWS`."""
EVERY = 4
"""Frames of the recording from one to the next that is used."""
RATE = 100.0
"""Frames of the recording in a second."""
VIEWS = {
    "above": (0.0, 1.0, 0.0),
    "wrist": (1.0, 1.0, 0.0),
    "tips": (-1.0, 1.0, 0.0),
    "thumb": (0.0, 1.0, -1.0),
    "little": (0.0, 1.0, 1.0),
    "side": (0.0, 0.0, -1.0),
}
"""Where the camera looks in the first frame, along the fingers, into the palm, to the thumb: straight down on the back
of the hand, with the palm turned by 45 degrees from the optical axis in four directions, and from the thumb's side."""
DEVELOPMENT_VIEWS = ("above", "tips", "little")
"""What constants are chosen on; the others are reported on their own, too."""
START_ERROR, START_STD = math.radians(8.0), math.radians(15.0)
"""Of the hand's rotation in the first frame, as in the paper's experiment."""
_BEGINS = (1, 1, 1, 2, 2)
"""Marker of the triangle where each finger's chain begins."""
_ROLLS = np.radians((45.0, 15.0, 20.0, 30.0, 35.0))
"""By which the planes that the fingers bend in are turned about the hand's long axis, the arch of the palm: from this
recording's true points, rounded."""
_EASE = np.radians([(0.0, 75.0, 0.0, 0.0), *([(-10.0, 15.0, 10.0, 20.0)] * 4)])
_EASE_STD = np.radians((15.0, 15.0, 25.0, 25.0))
"""What is believed of the first frame's angles."""
_LENGTHS = 1e-3 * np.array([(60.0, 40.0, 35.0), *([(85.0, 40.0, 50.0)] * 4)])
_LENGTHS_STD = 1e-3 * np.array((20.0, 15.0, 15.0))
"""Metres."""
_RANGES = ((-100.0, 40.0), (-30.0, 100.0), (-30.0, 100.0), (-15.0, 110.0))
"""Degrees."""
_JOINT_TIME = (MOVEMENT_TIME, 100 * MOVEMENT_TIME, MOVEMENT_TIME, MOVEMENT_TIME)
"""Frames: the second angle of a chain is that of a bone inside the hand, which hardly moves."""


class Capture(NamedTuple):
    """A recording as the camera sees it."""

    points: np.ndarray
    """(frames, 13, 3) metres in the camera frame: triangle, then middle and tip of each finger; NaN missing."""
    triangle: np.ndarray
    """(3, 3) metres: its markers in the frame of the hand."""
    rotation: np.ndarray
    """(3, 3) camera from hand in the first frame."""


class EstimatedLengths(NamedTuple):
    """What is known of the five lengths at the end of a view."""

    lengths: np.ndarray
    """(5,) metres."""
    std: np.ndarray
    """(5,) metres."""
    observed: np.ndarray
    """(5,) bool, whether the link has lain near the image plane, as the tracker says."""
    rate: float
    """Frames a second without compilation."""


def mocap_metrics(path: Path, quick: bool) -> dict[str, Metric]:
    """Errors of the five lengths after 30 s, and whether they lie within their own 2 sigma, over all views.

    Errors are of the links that the tracker calls observed; `unobserved` is of the others. `quick` takes 10 s of the
    first view.
    """
    errors, deviations, observed, rates = [], [], [], []
    for number, view in enumerate(list(VIEWS.values())[: 1 if quick else None]):
        capture = load_capture(path, 1000 if quick else 3000, view)
        found = track_lengths(capture, (0, number))
        errors.append(1e3 * np.abs(found.lengths - true_lengths(capture)))
        deviations.append(1e3 * found.std)
        observed.append(found.observed)
        rates.append(found.rate)
    error, deviation, known = np.array(errors), np.array(deviations), np.array(observed)
    rows = {f"_view_{view}": known & (np.arange(len(error)) == i)[:, None] for i, view in enumerate(VIEWS)}
    rows |= {f"_finger_{name}": known & (np.arange(len(FINGERS)) == i) for i, name in enumerate(FINGERS)}
    held = np.array([view not in DEVELOPMENT_VIEWS for view in VIEWS])[: len(error)]
    rows = {"": known, "_held": known & held[:, None], "_unobserved": ~known, **rows}
    metrics = {
        "dfki_lengths_observed": Metric(float(known.mean()), "", "higher"),
        "dfki_length_error_mm_max": Metric(float(error.max()), "mm", "lower"),
        "dfki_length_sigma_mm_max": Metric(float(deviation.max()), "mm", "lower"),
        "dfki_frames_per_second": Metric(float(np.median(rates)), "frames/s", "higher"),
    }
    for name, some in rows.items():
        if some.any():
            metrics[f"dfki_length_error_mm_median{name}"] = Metric(float(np.median(error[some])), "mm", "lower")
            inside = float(np.mean(error[some] <= 2 * deviation[some]))
            metrics[f"dfki_lengths_within_2sigma{name}"] = Metric(inside, "", WITHIN_TWO_SIGMA)
    return metrics


def load_capture(path: Path, frames: int, view: tuple[float, float, float]) -> Capture:
    """The first frames of the recording before a camera that looks at the hand of the first of them."""
    data = np.load(path)
    names = [str(name) for name in data["markers"]]
    wanted = [*TRIANGLE, *(f"{finger}_{part}" for finger in FINGERS for part in ("middle", "tip"))]
    xyz = 1e-3 * data["xyz_mm"][:frames:EVERY][:, [names.index(name) for name in wanted]].astype(float)
    hand = hand_axes(xyz[0, :3])
    z = hand @ np.array(view) / np.linalg.norm(view)
    x = np.cross(hand[:, 0], z)
    x /= np.linalg.norm(x)
    camera = np.stack([x, np.cross(z, x), z])
    points = (xyz - np.nanmean(xyz[:, 0], axis=0)) @ camera.T + np.array([0.0, 0.0, DISTANCE])
    sides = [np.median(np.linalg.norm(xyz[:, i] - xyz[:, j], axis=1)) for i, j in ((0, 1), (0, 2), (1, 2))]
    return Capture(points, triangle_from_sides(*sides), camera @ hand)


def hand_axes(triangle: np.ndarray) -> np.ndarray:
    """(3, 3) columns: along the fingers, into the palm, to the thumb, of the markers top, left, right."""
    top, left, right = triangle
    x = top - 0.5 * (left + right)
    x = x / np.linalg.norm(x)
    z = left - right
    z = z - (z @ x) * x
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def triangle_from_sides(top_left: float, top_right: float, left_right: float) -> np.ndarray:
    """(3, 3): top, left and right in the hand's axes, top in the origin."""
    # The median from top has a known length; its angle to the side from left to right follows by the law of cosines.
    middle = math.sqrt(0.5 * (top_left**2 + top_right**2) - 0.25 * left_right**2)
    lean = (top_left**2 - middle**2 - 0.25 * left_right**2) / (middle * left_right)
    along, across = 0.5 * left_right * lean, 0.5 * left_right * math.sqrt(1 - lean**2)
    return np.array([(0.0, 0.0, 0.0), (-middle - along, 0.0, across), (-middle + along, 0.0, -across)])


def true_lengths(capture: Capture) -> np.ndarray:
    """(5,) metres between the markers of each finger, the median over the frames."""
    return np.nanmedian(np.linalg.norm(capture.points[:, 4::2] - capture.points[:, 3::2], axis=-1), axis=0)


def chain_model(capture: Capture) -> tuple[MarkedHand, Inequalities]:
    """Five chains from the triangle, and their limits."""
    shares = capture.triangle / 0.1
    bases = tuple((float(shares[i, 0]), float(shares[i, 2])) for i in _BEGINS)
    layout = Layout(5, 3, bases, tuple((float(roll), 0.0, 0.0) for roll in _ROLLS))
    camera = Pinhole.from_intrinsics(FOCAL, np.zeros(2), (1000, 1000))
    hand = articulated_hand(layout, projection=Perspective(camera), motion=chain_motion(layout), point_std=NOISE)
    markers = [
        Marker(name, palm=(float(share[0]), float(share[1]), float(share[2])))
        for name, share in zip(TRIANGLE, shares, strict=True)
    ]
    markers += [
        Marker(f"{name}_{part}", finger=finger, along=along)
        for finger, name in enumerate(FINGERS)
        for part, along in (("middle", 2.0), ("tip", 3.0))
    ]
    limits = [
        within(f"theta_{finger}{joint}", math.radians(low), math.radians(high))
        for finger in range(1, 6)
        for joint, (low, high) in enumerate(_RANGES)
    ]
    limits += [within(f"r_{finger}{link}", 0.01, 0.12) for finger in range(1, 6) for link in (1, 2, 3)]
    marked = with_lasting_errors(marked_hand(hand, markers), soft_tissue())
    rows: LimitRows = limit_rows(marked.layout, limits)
    return marked, inequalities(rows)


def soft_tissue() -> jf.GaussMarkov:
    """Errors of the rows that last; the triangle is rigid, and its markers are where they are taken to be."""
    std = np.repeat([0.0] * len(TRIANGLE) + [SOFT_TISSUE_STD] * 2 * len(FINGERS), 2)
    return jf.GaussMarkov(jnp.asarray(SOFT_TISSUE_TIME, dtype=float), jnp.asarray(std**2, dtype=float))


def chain_motion(layout: Layout) -> AboutEase:
    """How chains move: as hands do, about the angles believed at first, but for the bones inside the hand."""
    motion = about_ease(layout, _EASE.ravel())
    decay = motion.time.at[layout.angles].set(jnp.asarray(np.tile(_JOINT_TIME, 5), dtype=float))
    spread = jnp.asarray(np.tile(_EASE_STD, 5), dtype=float)
    speed = motion.speed_std.at[layout.angles].set(spread / decay[layout.angles])
    return dataclasses.replace(motion, time=decay, speed_std=speed)


def first_belief(capture: Capture, layout: Layout, rng: np.random.Generator) -> Start:
    """The hand's place and rotation in the first frame, with an error; angles and lengths of a hand as such."""
    axis = rng.normal(size=3)
    wrong = Rotation.from_rotvec(START_ERROR * axis / np.linalg.norm(axis)).as_matrix()
    x, y, z, w = Rotation.from_matrix(wrong @ capture.rotation).as_quat()
    q = np.array([w, x, y, z])
    mean = np.zeros(layout.size)
    mean[layout.position], mean[layout.quaternion] = capture.points[0, 0], q
    mean[layout.angles], mean[layout.lengths], mean[layout.palm] = _EASE.ravel(), _LENGTHS.ravel(), 0.1
    std = np.zeros(layout.size)
    std[layout.position], std[layout.angles] = 0.02, np.tile(_EASE_STD, 5)
    std[layout.rates] = np.asarray(layout.per_moving(0.01, 0.02, 0.05))
    std[layout.lengths] = np.tile(_LENGTHS_STD, 5)
    std[layout.errors] = np.sqrt(np.asarray(soft_tissue().covariance))
    # The two joints that hardly move have no rates to speak of.
    std[layout.angle_rates] *= np.tile((0.05, 0.05, 1.0, 1.0), 5)
    covariance = np.diag(std**2)
    covariance[layout.quaternion, layout.quaternion] = (0.5 * START_STD) ** 2 * (np.eye(4) - np.outer(q, q))
    return Start(mean, covariance)


def track_lengths(capture: Capture, seed: tuple[int, int]) -> EstimatedLengths:
    """The lengths at the end of a view, with noise and a wrong start drawn from the seed and the number of the view."""
    rng = np.random.default_rng(seed)
    hand, limits = chain_model(capture)
    start = first_belief(capture, hand.layout, rng)
    pixels = FOCAL * capture.points[..., :2] / capture.points[..., 2:]
    y = (pixels + NOISE * rng.normal(size=pixels.shape)).reshape(len(pixels), -1)
    observed = np.isfinite(y)
    frames = FeatureFrame(np.where(observed, y, 0.0).astype(np.float32), observed, np.full(y.shape, NOISE, np.float32))
    start = Start(*(jnp.asarray(part, dtype=float) for part in start))
    tracker = tracker_of(hand, limits, start, ArticulatedConfig(hypotheses=4))
    state = tracker.init(jax.random.key(seed[0]), jax.tree.map(lambda leaf: leaf[0], frames))
    times = EVERY / RATE * np.arange(len(y))
    jax.block_until_ready(tracker.step(state, frames, times))
    begin = time.perf_counter()
    _, track = jax.block_until_ready(tracker.step(state, frames, times))
    rate = len(y) / (time.perf_counter() - begin)
    link = np.arange(2, 15, 3)
    last = hand.layout.lengths.start + link
    mean, std, observed = (np.asarray(values)[-1] for values in (track.mean, track.std, track.length_observed))
    return EstimatedLengths(mean[last], std[last], observed[link], rate)
