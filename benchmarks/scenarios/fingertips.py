"""How many fingers, and which: figure 5 of Oka et al., with and without correspondence, in points and in images.

Seven synthetic subjects with one to five fingers out, 900 frames
each. `accuracy_with_<n>` is the percentage of frames, the first ones included, whose number of tips is right in that
frame, a mean over subjects; `least_with_<n>` the smallest over seven subjects, averaged over groups of seven. Names
without a suffix are the modern tracker's, with `_published` the paper's, with `_detected` those of single frames,
without correspondence. `_image` are rendered hands of 640x480 pixels, blurred by lens and motion, through detection.
`hand_video_` is the recording dexretarget_hand_video, where JAXFILTERS_DATA has it: tips beside key points.
`found_pct_`, `false_pct_` and `names_per_finger_` are of real videos beside tips marked by hand, see `_marked_tips`;
those with `_depth_` are of single depth images with true joints, see `_depth_tips`.
"""

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._depth_tips import depth_tip_metrics
from jaxfilters.benchmarks.scenarios._hand_video import (
    REDUCTION,
    STRETCHED,
    HandVideo,
    finger_reach,
    fit_frames,
    hand_video_metrics,
    load_hand_video,
)
from jaxfilters.benchmarks.scenarios._marked_tips import VIDEOS, marked_counts
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.models.fingertip import thumb
from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.fingertip.first_image import fit_hand_parameters
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.segmentation import bright_mask
from jaxfilters.models.synthetic import desk_hand, fingertip_points
from jaxfilters.trackers.fingertips import tracker
from jaxfilters.trackers.fingertips.session import FingertipSession
from jaxfilters.trackers.fingertips.state import FingertipConfig, HandReport, Method
from jaxfilters.trackers.fingertips.tracker import MODERN, PUBLISHED, PUBLISHED_CONFIG

SUBJECTS, NUM_GROUPS, QUICK_NUM_GROUPS = 7, 6, 1
FRAMES, QUICK_FRAMES = 900, 300
IMAGE_FRAMES, QUICK_IMAGE_FRAMES = 300, 12
SHAPE = (480, 640)
SPEED = 1.5
"""Of the rendered hand: up to 15 pixels a frame, so that its tips are blurred."""
ROUNDS, QUICK_ROUNDS = 60, 5
TRACK_GATE = 0.1
"""Image heights between a key point and the track that belongs to it, at most."""
USUAL = thumb.usual()
METHODS: Mapping[str, tuple[FingertipConfig, Method]] = {
    "": (FingertipConfig(), MODERN),
    "_published": (PUBLISHED_CONFIG, PUBLISHED),
}


class Truth(NamedTuple):
    """Of runs, runs first."""

    tips: np.ndarray
    """(runs, frames, 5, 2) pixels."""
    fingers: np.ndarray
    """(runs, 5) which are out."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow everything, return all figures."""
    key = jax.random.key(seed)
    metrics = point_metrics(key, QUICK_NUM_GROUPS if quick else NUM_GROUPS, QUICK_FRAMES if quick else FRAMES)
    rendered = [render(key, count, QUICK_IMAGE_FRAMES if quick else IMAGE_FRAMES) for count in range(1, MAX_TIPS + 1)]
    parameters = open_hand(key)
    metrics |= image_metrics(rendered, parameters)
    metrics |= time_metrics(rendered[-1], parameters, QUICK_ROUNDS if quick else ROUNDS)
    metrics |= video_metrics(out, 40 if quick else None)
    metrics |= depth_tip_metrics(quick=quick, seed=seed)
    return metrics if quick else metrics | marked_video_metrics()


def point_metrics(key: jax.Array, groups: int, frames: int) -> dict[str, Metric]:
    """Figure 5 at point level, identities and errors."""
    metrics: dict[str, Metric] = {}
    totals: dict[str, list[tuple[float, float, int]]] = {suffix: [] for suffix in METHODS}
    for count in range(1, MAX_TIPS + 1):
        keys = jax.random.split(jax.random.fold_in(key, count), groups * SUBJECTS)
        hands = simulated(keys, fingertip_points.fingers_out(count), frames)
        truth = Truth(np.asarray(hands.tips), np.asarray(hands.fingers))
        found = {"_detected": np.asarray(hands.observed.is_tip).sum(axis=-1)}
        for suffix, (config, method) in METHODS.items():
            report = follow(config, method, hands.observed)
            found[suffix] = report.num_tips
            totals[suffix].append((identities(report) / count, *squared_errors(report, truth)))
        for suffix, numbers in found.items():
            right = 100 * (numbers == count).mean(axis=1).reshape(groups, SUBJECTS)
            metrics[f"accuracy_with_{count}{suffix}"] = Metric(float(right.mean()), "%", "higher")
            metrics[f"least_with_{count}{suffix}"] = Metric(float(right.min(axis=1).mean()), "%", "higher")
        _say(f"{count} fingers", metrics)
    for suffix, counts in totals.items():
        named, squares, rows = (np.asarray(column) for column in zip(*counts, strict=True))
        metrics[f"identities_per_finger{suffix}"] = Metric(float(named.max()), "", "lower")
        metrics[f"rms_px{suffix}"] = Metric(float(np.sqrt(squares.sum() / rows.sum())), "px", "lower")
    return metrics


@partial(jax.jit, static_argnames="frames")
def simulated(keys: jax.Array, fingers: jax.Array, frames: int) -> fingertip_points.PointSequence:
    """Detections of everybody with these fingers out."""
    return jax.vmap(lambda key: fingertip_points.points(key, fingers, frames))(keys)


def follow(config: FingertipConfig, method: Method, observed: HandObservation) -> HandReport:
    """Reports (runs, frames, ...) of everybody, on the host."""
    return jax.tree.map(np.asarray, _follow(config, method, observed))


@partial(jax.jit, static_argnames=("config", "method"))
def _follow(config: FingertipConfig, method: Method, observed: HandObservation) -> HandReport:
    start = tracker.start(config, USUAL, method=method)
    return jax.vmap(lambda visible: tracker.run(config, USUAL, start, visible, method=method)[1])(observed)


def identities(report: HandReport) -> float:
    """How many names were given in a run, on average."""
    return float(np.mean([len(set(row[row >= 0].tolist())) for row in report.identity]))


def squared_errors(report: HandReport, truth: Truth) -> tuple[float, int]:
    """Sum of squared distances of reported tips from the nearest true ones, and how many there are."""
    apart = np.linalg.norm(report.position[:, :, :, None] - truth.tips[:, :, None], axis=-1)
    apart = np.where(truth.fingers[:, None, None], apart, np.inf).min(axis=-1)[report.is_tip]
    return float(np.square(apart).sum()), len(apart)


def render(key: jax.Array, count: int, frames: int) -> list[desk_hand.DeskFrame]:
    """A hand with so many fingers out."""
    fingers = np.broadcast_to(np.asarray(fingertip_points.fingers_out(count)), (frames, MAX_TIPS))
    video = desk_hand.desk_video(jax.random.fold_in(key, 100 + count), fingers, shape=SHAPE, speed=SPEED)
    return list(video)


def open_hand(key: jax.Array) -> HandParameters:
    """What detection is given of the user, from an open hand at rest."""
    (frame,) = desk_hand.desk_video(jax.random.fold_in(key, 99), np.ones((1, MAX_TIPS), bool), shape=SHAPE, speed=0.0)
    return fit_hand_parameters(frame.image)


def image_metrics(rendered: list[list[desk_hand.DeskFrame]], parameters: HandParameters) -> dict[str, Metric]:
    """Counts and errors of rendered hands, through detection."""
    metrics: dict[str, Metric] = {}
    squares: dict[str, list[tuple[float, int]]] = {suffix: [] for suffix in METHODS}
    for count, frames in enumerate(rendered, 1):
        observed = stacked([detected(frame.image, parameters) for frame in frames])
        truth = Truth(np.stack([[frame.tips for frame in frames]]), np.stack([frames[0].extended]))
        found = {"_detected": np.asarray(observed.is_tip).sum(axis=-1)}
        for suffix, (config, method) in METHODS.items():
            report = follow(config, method, jax.tree.map(lambda leaf: leaf[None], observed))
            found[suffix] = report.num_tips[0]
            squares[suffix].append(squared_errors(report, truth))
        for suffix, numbers in found.items():
            share = Metric(float(100 * (numbers == count).mean()), "%", "higher")
            metrics[f"accuracy_with_{count}_image{suffix}"] = share
    for suffix, sums in squares.items():
        total, rows = np.asarray(sums).sum(axis=0)
        metrics[f"rms_px_image{suffix}"] = Metric(float(np.sqrt(total / max(rows, 1))), "px", "lower")
    _say("images", metrics)
    return metrics


def detected(image: np.ndarray, parameters: HandParameters) -> HandObservation:
    """The hand in an image."""
    return detect_hand(bright_mask(image, parameters.threshold), parameters)


def stacked(observations: list[HandObservation]) -> HandObservation:
    """One after the other, frames first."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *observations)


def time_metrics(frames: list[desk_hand.DeskFrame], parameters: HandParameters, rounds: int) -> dict[str, Metric]:
    """Milliseconds a frame with five fingers, from the image to the tips and events, one frame at a time."""
    images = [frame.image for frame in frames]
    visible = [jax.tree.map(lambda leaf: np.asarray(leaf)[None, None], detected(i, parameters)) for i in images[:2]]
    session, tracking = (FingertipSession(USUAL, handedness=parameters.handedness) for _ in range(2))
    turn = {"whole": 0, "tracking": 0}

    def whole() -> Any:
        turn["whole"] += 1
        found = detected(images[turn["whole"] % len(images)], parameters)
        return session.process(jax.tree.map(lambda leaf: np.asarray(leaf)[None, None], found), np.zeros(1))

    def track() -> Any:
        turn["tracking"] += 1
        return tracking.process(visible[turn["tracking"] % 2], np.zeros(1))

    seconds = interleaved({"whole": whole, "tracking": track}, rounds)
    return {
        "frame_ms_640x480": Metric(1000 * seconds["whole"], "ms", "lower"),
        "tracking_ms": Metric(1000 * seconds["tracking"], "ms", "lower"),
    }


def video_metrics(out: Path | None, num_frames: int | None) -> dict[str, Metric]:
    """Of the recording of a real hand; nothing where it is not."""
    try:
        folder = recording_folder("dexretarget_hand_video")
    except RecordingError as error:
        sys.stderr.write(f"  without the real hand: {error}\n")
        return {}
    found = hand_video_metrics(folder, out, num_frames=num_frames)
    found |= tracked_video_metrics(load_hand_video(folder, num_frames=num_frames))
    return {f"hand_video_{name}": _with_unit(name, value) for name, value in found.items()}


def marked_video_metrics() -> dict[str, Metric]:
    """Of the videos with fingertips marked by hand that are there."""
    metrics: dict[str, Metric] = {}
    for name in VIDEOS:
        try:
            counts = marked_counts(name, recording_folder(name))
        except RecordingError as error:
            sys.stderr.write(f"  without {name}: {error}\n")
            continue
        for suffix, count in counts.items():
            metrics[f"found_pct_{name}{suffix}"] = Metric(count.metrics["found_pct"], "%", "higher")
            metrics[f"false_pct_{name}{suffix}"] = Metric(count.metrics["false_pct"], "%", "lower")
        metrics[f"names_per_finger_{name}"] = Metric(counts[""].metrics["names_per_finger"], "", "lower")
    return metrics


def tracked_video_metrics(video: HandVideo) -> dict[str, float]:
    """Of the recording with tracks: how many extended fingers have one, how near it is, how many names a finger had."""
    fits = list(fit_frames(video))
    rows = len(video.frames[0])
    person = thumb.calibrated(np.array([video.parameters.phi_thumb]), np.array([video.parameters.phi_index]))
    session = FingertipSession(person, handedness=video.parameters.handedness, height=float(rows))
    visible = stacked([fit.observation for fit in fits])
    report = session.process(jax.tree.map(lambda leaf: leaf[:, None], visible), np.arange(len(fits)) / 30)
    shown = finger_reach(video.joints)[: len(fits)] > STRETCHED
    tips = np.stack([fit.tips for fit in fits])
    there, place, name = (np.asarray(field)[:, 0] for field in (report.is_tip, report.position, report.identity))
    apart = np.linalg.norm(tips[:, :, None] - place[:, None], axis=-1)
    apart = np.where(there[:, None], apart, np.inf)
    nearest = apart.argmin(axis=-1)
    off = apart.min(axis=-1)
    has_track = off < TRACK_GATE * rows
    named = np.take_along_axis(name, nearest, axis=1)
    changes = [named[has_track[:, i] & shown[:, i], i] for i in range(MAX_TIPS)]
    return {
        "extended_with_track_percent": float(100 * has_track[shown].mean()),
        "track_distance_px": float(REDUCTION * off[has_track & shown].mean()),
        "name_changes_per_finger": float(np.mean([np.count_nonzero(np.diff(names)) for names in changes])),
        "thumb_right_percent": float(100 * _thumb_is_right(report, nearest, has_track & shown)),
    }


def _thumb_is_right(report: HandReport, nearest: np.ndarray, usable: np.ndarray) -> float:
    """Share of the extended fingers with a track that are given for what they are."""
    called = np.take_along_axis(np.asarray(report.is_thumb)[:, 0], nearest, axis=1)
    return float((called == (np.arange(MAX_TIPS) == 0))[usable].mean())


def _with_unit(name: str, value: float) -> Metric:
    if name.endswith("_px"):
        return Metric(value, "px", "lower")
    if name.endswith("_percent") or "_percent_" in name:
        return Metric(value, "%", "higher" if name.startswith(("extended", "thumb")) else "lower")
    return Metric(value, "", "lower")


def _say(text: str, metrics: Mapping[str, Metric]) -> None:
    numbers = "  ".join(f"{name} {metric.value:.2f}" for name, metric in list(metrics.items())[-6:])
    sys.stderr.write(f"  {text}: {numbers}\n")
