"""Gestures found in streams of hands: a network of frames with explicit durations, beside a nearest neighbour.

`sfinge3d_gestures` of JAXFILTERS_DATA: 13 gestures, poses and movements, in streams at 20 frames a second. Sequences
are left out in six folds and searched by a model of the others and of the dictionary of single gestures; with
`--truth FILE.npz`, other sequences in the format of `sequences.npz`, a model of everything in the folder searches that
file. `found` is the share of gestures of which more than half is in a detection of its own,
`false_per_minute` what is detected beside them, `jaccard` the mean overlap over gestures and false alarms;
`latency_s` is the median time from the last frame of a gesture to the last frame that its report needs. The share of a
frame's posterior that counts and the margins were chosen on the 36 sequences of the folder.

`_nearest`: windows of three lengths slide over the stream, and each is what the nearest window in training is, a
gesture or background; detections do not overlap, nearest first. `_dtw` compares the same windows by dynamic time
warping with the 30 that are nearest.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.hmm import Segment
from jaxfilters.models.gesture import poses
from jaxfilters.models.gesture.frame_classifier import NUM_STEPS
from jaxfilters.models.gesture.poses import PoseTemplate
from jaxfilters.models.gesture.spotting_score import Score, scored, shared_frames, total
from jaxfilters.models.gesture.streams import Spotted, Stream, learn_streams, leave_streams_out, spot
from jaxfilters.trackers.io.gesture_streams import StreamSet, read_streams

FOLDS, QUICK_FOLDS, QUICK_STEPS = 6, 2, 40
WINDOWS, STRIDE, NUM_PLACES = (28, 40, 56), 4, 16
"""Lengths of windows in frames, frames from one to the next, and places in a window that are compared."""
DTW_EVERY, SHORTLIST, BAND = 2, 30, 2
"""One place in so many is compared by time warping, with so many neighbours, within so many places of the diagonal."""


class Neighbours(NamedTuple):
    """Windows of training."""

    windows: Float[np.ndarray, "n p f"]
    labels: Int[np.ndarray, " n"]
    """Background is the number of gestures."""


def run(*, quick: bool, seed: int, out: Path | None, truth: Path | None = None) -> dict[str, Metric]:
    """Find the gestures of sequences that were left out, or of those in the file `truth`; `out` is not used."""
    del out
    folder = recording_folder("sfinge3d_gestures")
    if missing := [name for name in ("dictionary.npz", "sequences.npz") if not (folder / name).is_file()]:
        raise RecordingError(f"{folder} holds no {missing[0]}.")
    key = jax.random.key(seed)
    known, steps = read_streams(folder), QUICK_STEPS if quick else NUM_STEPS
    if truth is None:
        folds = QUICK_FOLDS if quick else FOLDS
        found = leave_streams_out(key, known.streams, known.names, num_folds=folds, num_steps=steps)
        searched = [stream for stream in known.streams if not stream.is_example]
        pairs = [own for own in found if own is not None]
    else:
        other = read_streams(truth)
        searched = list(_renamed(other, known.names))
        model = learn_streams(key, known.streams, known.names, num_steps=steps)
        pairs = [spot(model, stream) for stream in searched]
    metrics = _metrics("", [[one.segment for one in own] for own in pairs], searched)
    metrics |= _latency(pairs, searched)
    for suffix, warped in (("_nearest", False), ("_dtw", True)):
        if truth is None:
            simple = _by_neighbours_left_out(known, FOLDS, warped=warped)
        else:
            simple = _by_neighbours(list(known.streams), searched, len(known.names), warped=warped)
        metrics |= _metrics(suffix, simple, searched)
    return metrics


def _renamed(other: StreamSet, names: tuple[str, ...]) -> list[Stream]:
    """Streams with the labels of other names.

    Raises:
        RecordingError: if they show a gesture of another name.
    """
    if unknown := sorted(set(other.names) - set(names)):
        raise RecordingError(f"--truth: the sequences of the folder show no gesture {unknown[0]}.")
    return [
        stream._replace(
            segments=tuple(one._replace(label=names.index(other.names[one.label])) for one in stream.segments)
        )
        for stream in other.streams
    ]


def _metrics(suffix: str, found: list[list[Segment]], streams: list[Stream]) -> dict[str, Metric]:
    score: Score = total([scored(own, stream.segments) for own, stream in zip(found, streams, strict=True)])
    minutes = sum(len(stream.points) / stream.rate_hz for stream in streams) / 60
    return {
        f"found{suffix}": Metric(100 * score.detected / score.total, "%", "higher"),
        f"false_per_minute{suffix}": Metric(score.false_positives / minutes, "1/min", "lower"),
        f"jaccard{suffix}": Metric(float(np.mean(score.jaccard)), "", "higher"),
    }


def _latency(found: list[list[Spotted]], streams: list[Stream]) -> dict[str, Metric]:
    """Of gestures that have a detection of their label with more than half of their frames."""
    delays = []
    for own, stream in zip(found, streams, strict=True):
        for gesture in stream.segments:
            half = (gesture.end - gesture.start + 1) / 2
            hits = [
                one for one in own if one.segment.label == gesture.label and shared_frames(one.segment, gesture) > half
            ]
            delays += [(one.reported - gesture.end) / stream.rate_hz for one in hits[:1]]
    if not delays:
        return {}
    return {
        "latency_s": Metric(float(np.median(delays)), "s", "lower"),
        "latency_s_95": Metric(float(np.percentile(delays, 95)), "s", "lower"),
    }


def _by_neighbours_left_out(known: StreamSet, folds: int, *, warped: bool) -> list[list[Segment]]:
    whole = [i for i, stream in enumerate(known.streams) if not stream.is_example]
    found: dict[int, list[Segment]] = {}
    for fold in range(folds):
        left_out = whole[fold::folds]
        others = [stream for i, stream in enumerate(known.streams) if i not in left_out]
        searched = [known.streams[i] for i in left_out]
        found |= dict(zip(left_out, _by_neighbours(others, searched, len(known.names), warped=warped), strict=True))
    return [found[i] for i in whole]


def _by_neighbours(
    training: list[Stream], searched: list[Stream], background: int, *, warped: bool
) -> list[list[Segment]]:
    """Segments in each of the streams that are searched, in frames of the stream."""
    template = poses.fit_template([poses.resampled(stream.points, stream.rate_hz)[0] for stream in training])
    known = _neighbours(template, training, background)
    found = [_nearest(known, _features(template, stream), background, warped=warped) for stream in searched]
    return [_at_rate(stream.rate_hz, own) for stream, own in zip(searched, found, strict=True)]


def _at_rate(rate_hz: float, segments: list[Segment]) -> list[Segment]:
    """Segments in frames of the features as segments in frames of a stream of another rate."""
    scale = rate_hz / poses.RATE_HZ
    return [one._replace(start=round(one.start * scale), end=round(one.end * scale)) for one in segments]


def _features(template: PoseTemplate, stream: Stream) -> Float[np.ndarray, "t f"]:
    return poses.pose_features(template, poses.resampled(stream.points, stream.rate_hz)[0])


def _neighbours(template: PoseTemplate, training: list[Stream], background: int) -> Neighbours:
    """The gestures, from their first to their last frame, and windows of background that touch no half of one."""
    windows, labels = [], []
    for stream in training:
        features = _features(template, stream)
        scale = poses.RATE_HZ / stream.rate_hz
        segments = [Segment(s.label, round(s.start * scale), round(s.end * scale)) for s in stream.segments]
        for segment in segments:
            windows.append(_placed(features, segment.start, segment.end))
            labels.append(segment.label)
        if stream.is_example:
            continue
        for length in WINDOWS:
            for start in range(0, len(features) - length, STRIDE):
                own = Segment(background, start, start + length - 1)
                if all(shared_frames(own, one) < 0.5 * length for one in segments):
                    windows.append(_placed(features, own.start, own.end))
                    labels.append(background)
    return Neighbours(np.stack(windows), np.array(labels))


def _nearest(known: Neighbours, features: np.ndarray, background: int, *, warped: bool) -> list[Segment]:
    candidates = [
        Segment(-1, start, start + length - 1)
        for length in WINDOWS
        for start in range(0, len(features) - length + 1, STRIDE)
    ]
    if not candidates:
        return []
    windows = np.stack([_placed(features, one.start, one.end) for one in candidates])
    flat, trained = (values.reshape(len(values), -1) for values in (windows, known.windows))
    squares = np.sum(flat**2, axis=1)[:, None] - 2 * flat @ trained.T + np.sum(trained**2, axis=1)
    best, distance = np.argmin(squares, axis=1), np.min(squares, axis=1)
    if warped:
        short = np.argsort(squares, axis=1)[:, :SHORTLIST]
        costs = _warped(windows[:, None, ::DTW_EVERY], known.windows[short][:, :, ::DTW_EVERY])
        best, distance = np.take_along_axis(short, np.argmin(costs, axis=1)[:, None], axis=1)[:, 0], costs.min(axis=1)
    labels = known.labels[best]
    found: list[Segment] = []
    for i in np.argsort(distance, kind="stable"):
        own = candidates[i]._replace(label=int(labels[i]))
        if all(shared_frames(own, one) == 0 for one in found):
            found.append(own)
    return sorted((one for one in found if one.label != background), key=lambda one: one.start)


def _warped(windows: Float[np.ndarray, "n 1 p f"], others: Float[np.ndarray, "n k p f"]) -> Float[np.ndarray, "n k"]:
    """Costs of dynamic time warping between each window and its neighbours."""
    places = windows.shape[2]
    total_cost = np.full((places + 1, places + 1, *others.shape[:2]), np.inf)
    total_cost[0, 0] = 0.0
    for i in range(places):
        for j in range(max(0, i - BAND), min(places, i + BAND + 1)):
            cost = np.sum((windows[:, :, i] - others[:, :, j]) ** 2, axis=-1)
            before = np.minimum(np.minimum(total_cost[i, j], total_cost[i, j + 1]), total_cost[i + 1, j])
            total_cost[i + 1, j + 1] = cost + before
    return total_cost[-1, -1]


def _placed(features: np.ndarray, start: int, end: int) -> Float[np.ndarray, "p f"]:
    """Features at even places from the first to the last frame."""
    return features[np.rint(np.linspace(start, min(end, len(features) - 1), NUM_PLACES)).astype(int)]
