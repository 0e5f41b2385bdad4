"""Rendered heads followed by several trackers at once, and how far what they say is from the truth."""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxfilters.benchmarks.scenarios._poses import DISPLAY, in_millimetres, pose_errors
from jaxfilters.models.face.pose import place
from jaxfilters.models.face.rig import project_shape
from jaxfilters.models.synthetic.face_sequence import FaceSequence
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.state import HeadTrack
from jaxfilters.trackers.head.stereo.session import HeadSession

AXES = ("x", "y", "z", "roll", "yaw", "pitch")
AXIS_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
BLOCK = 40
"""Frames in memory at once."""
ASTRAY_PX = 8.0
"""Root mean square of the landmarks' errors from which on a tracker follows something else: half a window."""


class HeadRun(NamedTuple):
    """What one tracker says of a sequence, from its second frame on: in the first the face is registered."""

    track: HeadTrack
    truth: FaceSequence
    contributions: Float[np.ndarray, " blocks"]
    """Cumulative contribution of the modes after every `BLOCK` frames."""

    @property
    def errors(self) -> Float[np.ndarray, "t 6"]:
        """Of the pose, millimetres and degrees; NaN where there is none."""
        return pose_errors(self.track.pose, self.truth.poses[1:])

    @property
    def deviations(self) -> Float[np.ndarray, "t 6"]:
        """Standard deviations that the tracker claims, millimetres and degrees."""
        return np.asarray(self.track.pose_std, float) * DISPLAY

    @property
    def is_tracked(self) -> Bool[np.ndarray, " t"]:
        """Whether there is a pose, and a face of the true shape that had it would be visible where the face is."""
        at_pose = _projected(self.truth.rig, self.truth.shapes[1:], np.asarray(self.track.pose, np.float32))
        off = np.asarray(at_pose, float) - self.truth.uv[1:]
        return np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=(1, 2))) < ASTRAY_PX

    @property
    def shape_errors(self) -> Float[np.ndarray, " t"]:
        """Root mean square over the landmarks of the shape, aligned with the true one; millimetres."""
        return apart_after_alignment(np.asarray(self.track.shape, float), self.truth.shapes[1:])

    @property
    def landmark_errors(self) -> Float[np.ndarray, " t"]:
        """Root mean square over the landmarks of their places in the world, millimetres."""
        off = _placed(self.track.shape, self.track.pose) - _placed(self.truth.shapes[1:], self.truth.poses[1:])
        return np.sqrt(np.mean(np.sum(np.asarray(off, float) ** 2, axis=-1), axis=-1))


def follow(sequence: FaceSequence, trackers: Mapping[str, HeadConfig]) -> dict[str, HeadRun]:
    """Runs of all trackers over one sequence, which is rendered once.

    They are given where the landmarks are in the first image of the first camera, and nothing else.
    """
    points = np.asarray(sequence.uv[0, 0], float)
    sessions = {name: HeadSession(sequence.rig, options, points) for name, options in trackers.items()}
    tracks: dict[str, list[HeadTrack]] = {name: [] for name in trackers}
    contributions: dict[str, list[float]] = {name: [] for name in trackers}
    bounds = [0, *range(1, len(sequence), BLOCK), len(sequence)]
    for start, stop in pairwise(bounds):
        images, times = sequence.frames(start, stop), sequence.times[start:stop]
        for name, session in sessions.items():
            track = session.process(images, times)
            if start:
                tracks[name].append(track)
                contributions[name].append(session.contribution)
    joined = {name: jax.tree.map(lambda *rows: np.concatenate(rows), *parts) for name, parts in tracks.items()}
    return {
        name: HeadRun(in_millimetres(track), sequence, np.array(contributions[name])) for name, track in joined.items()
    }


def rmse(run: HeadRun, frames: slice = slice(None)) -> Float[np.ndarray, " 6"]:
    """Root mean square errors of the pose where the head is tracked; infinite if it never is."""
    errors = run.errors[frames][run.is_tracked[frames]]
    return np.sqrt(np.mean(errors**2, axis=0)) if len(errors) else np.full(6, np.inf)


def coverage(run: HeadRun, frames: slice = slice(None)) -> Float[np.ndarray, " 6"]:
    """Share of the frames in which the true pose is within two of the claimed standard deviations."""
    return np.mean(np.abs(run.errors[frames]) <= 2 * run.deviations[frames], axis=0)


def lost_share(run: HeadRun) -> float:
    """Share of the frames in which the tracker has no face, or is elsewhere."""
    return float(np.mean(~run.is_tracked))


def apart_after_alignment(
    shapes: Float[np.ndarray, "t K 3"], truth: Float[np.ndarray, "t K 3"]
) -> Float[np.ndarray, " t"]:
    """Root mean square distance of points after the rotation and translation that make it least; NaN where unknown."""
    known = np.all(np.isfinite(shapes), axis=(1, 2))
    a, b = (points - points.mean(axis=1, keepdims=True) for points in (shapes[known], truth[known]))
    U, _, V = np.linalg.svd(np.einsum("tki,tkj->tij", a, b))
    U[..., -1] *= np.linalg.det(U @ V)[:, None]
    apart = np.full(len(shapes), np.nan)
    apart[known] = np.sqrt(np.mean(np.sum((a @ (U @ V) - b) ** 2, axis=-1), axis=-1))
    return apart


_placed = jax.jit(jax.vmap(place))


@jax.jit
def _projected(rig, shapes, poses):
    return jax.vmap(project_shape, in_axes=(None, 0, 0))(rig, shapes, poses)[0]
