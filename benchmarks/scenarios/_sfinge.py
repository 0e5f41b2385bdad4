"""Thirteen gestures of a hand with 20 joints, estimated from single recordings and found in streams of several.

SFINGE 3D (F. M. Caputo et al., Computers & Graphics 2020): 20 frames a second, poses such as "three", and movements
such as a circle. Models are trained on the dictionary alone; what hands do between gestures is in no example, and the
threshold model stands for it. A gesture counts as detected if more than half of its annotated frames are in a detection
with its label that no other gesture has; a detection that serves no gesture is a false positive. The Jaccard index is
the mean over gestures and false positives of the frames that annotation and detections of a label share, over those of
either.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxfilters import hmm, run
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.hmm import Network, Segment
from jaxfilters.models.gesture.spotting_score import scored
from jaxfilters.models.gesture.symbols import trained

FPS = 20.0
NUM_GESTURES = 13
FINGERTIPS = (3, 7, 11, 15, 19)
HAND_M, SPEED_M_S, BEND_PER_S = 0.08, 0.2, 8.0
"""What features are given in: positions of fingertips from the palm, speeds of the palm, and changes of the former."""
NUM_STATES, MIN_VARIANCE = 16, 0.05
TEMPER = 0.3
"""Share of a frame's log-likelihood that counts: neighbouring frames say nearly the same."""
MARGIN, PATIENCE, SHORTEST = 0.0, 10, 15
_LONGEST, _AFTER = 600, 40
_SETTLED_FRAMES = 1.0


class Streams(NamedTuple):
    """Recordings of hands."""

    clips: list[Float[np.ndarray, "_ 20 7"]]
    """Of one gesture each: positions in metres and quaternions (x, y, z, w) of the joints, the palm first."""
    gestures: Int[np.ndarray, " clips"]
    """From 0."""
    sequences: list[Float[np.ndarray, "_ 20 7"]]
    truth: list[list[Segment]]
    """Of every sequence."""


def read_sfinge(folder: Path) -> Streams:
    """The dictionary and the annotated sequences.

    Raises:
        RecordingError: if a file is missing or is another one.
    """
    try:
        with np.load(folder / "dictionary.npz") as archive:
            dictionary = dict(archive)
        with np.load(folder / "sequences.npz") as archive:
            streams = dict(archive)
        clips, sequences = (
            [np.cumsum(part, axis=0) * 1e-5 for part in np.split(moved, np.cumsum(lengths)[:-1])]
            for moved, lengths in (
                (archive["delta_1e5"].transpose(2, 0, 1), archive["length"]) for archive in (dictionary, streams)
            )
        )
        truth = [
            [
                Segment(int(label) - 1, int(first), min(int(last), len(sequence) - 1))
                for number, label, first, last in streams["annotations"]
                if number == own
            ]
            for own, sequence in zip(streams["seq_id"], sequences, strict=True)
        ]
    except (OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{folder} does not hold the recordings of SFINGE 3D ({error}).") from None
    return Streams(clips, dictionary["gesture"].astype(int) - 1, sequences, truth)


def hand_features(joints: Float[np.ndarray, "t 20 7"]) -> Float[np.ndarray, "t 33"]:
    """Fingertips in the palm's frame, how they move in it, and the velocity of the palm, which saturates."""
    palm = joints[:, 0, :3]
    turns = Rotation.from_quat(joints[:, 0, 3:]).as_matrix()
    tips = np.einsum("tji,tkj->tki", turns, joints[:, FINGERTIPS, :3] - palm[:, None]) / HAND_M
    velocity = _speeds(palm) / SPEED_M_S
    # Twice as fast is not twice as different.
    velocity /= np.sqrt(1 + np.sum(velocity**2, axis=1, keepdims=True) / 9)
    bending = _speeds(tips.reshape(len(joints), -1)) / BEND_PER_S
    return np.concatenate([tips.reshape(len(joints), -1), velocity, bending], axis=1).astype(np.float32)


def _speeds(positions: Float[np.ndarray, "t d"]) -> Float[np.ndarray, "t d"]:
    return gaussian_filter1d(np.gradient(positions, axis=0) * FPS, _SETTLED_FRAMES, axis=0, mode="nearest")


def learned(streams: Streams) -> Network:
    """A left-right model of each gesture, side by side."""
    features, lengths = hmm.pad([hand_features(clip) for clip in streams.clips])
    size = (NUM_STATES, features.shape[1])
    blank = hmm.DiagonalGaussian(jnp.zeros(size), jnp.ones(size), MIN_VARIANCE)
    groups = [(f"{label:02}", np.flatnonzero(streams.gestures == label)) for label in range(NUM_GESTURES)]
    models = trained(blank, features, np.asarray(lengths), groups).models
    return hmm.parallel_composition([jax.tree.map(lambda leaf, i=i: leaf[i], models) for i in range(NUM_GESTURES)])


def spotted(network: Network, sequences: list[Float[np.ndarray, "_ 20 7"]]) -> list[list[Segment]]:
    """Gestures found in each sequence, frame by frame."""
    # The filter is given what the frames say, tempered.
    bare = replace(network, model=replace(network.model, emission=None))
    filter = hmm.spotter(bare, margin=MARGIN, patience=PATIENCE, min_frames=SHORTEST)
    found = []
    for sequence in sequences:
        features = hand_features(sequence)
        # Few lengths, few programs; frames that say nothing after the last one let what is held be reported.
        num_frames = -(-(len(features) + _AFTER) // _LONGEST) * _LONGEST
        padded = np.pad(features, ((0, num_frames - len(features)), (0, 0)), constant_values=np.nan)
        scores = TEMPER * _scores(network, jnp.asarray(padded))
        _, (reports, segments) = run(filter, jax.random.key(0), scores, collect=_reported)
        rows = [np.asarray(leaf)[np.asarray(reports)] for leaf in (segments.label, segments.start, segments.end)]
        found.append([Segment(*map(int, row)) for row in zip(*rows, strict=True)])
    return found


@jax.jit
def _scores(network: Network, features: Float[Array, "t f"]) -> Float[Array, "t q"]:
    return network.model.log_likelihoods(features)


def _reported(state: Any, info: Any) -> tuple:
    del state
    return info.reports, info.found


def sfinge_metrics(folder: Path, *, most: int | None = None) -> dict[str, Metric]:
    """Detection rate, false positives and Jaccard index over the first `most` sequences.

    Raises:
        RecordingError: if the recordings cannot be read.
    """
    streams = read_sfinge(folder)
    sequences = streams.sequences[:most]
    found = spotted(learned(streams), sequences)
    scores = [scored(own, truth) for own, truth in zip(found, streams.truth, strict=False)]
    detected, false = sum(score.detected for score in scores), sum(score.false_positives for score in scores)
    total = sum(score.total for score in scores)
    minutes = sum(map(len, sequences)) / FPS / 60
    return {
        "sfinge_detection_rate": Metric(100 * detected / total, "%", "higher"),
        "sfinge_false_positives_per_minute": Metric(false / minutes, "1/min", "lower"),
        "sfinge_false_positives_per_gesture": Metric(100 * false / total, "%", "lower"),
        "sfinge_jaccard": Metric(float(np.mean([j for score in scores for j in score.jaccard])), "", "higher"),
    }
