"""Features of a stream of points, such as the joints of a hand, that do not depend on its place, size and units.

Each frame is turned onto a template by weighted least squares (W. Kabsch, Acta Crystallographica A32, 1976). Points
weigh by how little they move relative to the others (generalised Procrustes analysis, J. Gower, Psychometrika 40,
1975): of a hand it is mostly the joints of the palm that count. Features are where all points are in that body's frame,
how those that move most do so in it, how the body moves in the world and in its own frame, and how it is turned.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

RATE_HZ = 20.0
"""To which all streams are resampled."""
SETTLED_FRAMES = 1.0
"""Standard deviation of the smoothing of speeds."""
REACH = 5
"""Frames before and after one that its features depend on."""
SATURATION = 3.0
"""Root mean square speeds at which speeds begin to saturate: twice as fast is not twice as different."""
MOVING = 4
"""One in so many points, those that move most in the body's frame, has its speed among the features."""
_MOST_FRAMES, _ROUNDS = 3000, 6
_LEAST_SPREAD = 0.15


class PoseTemplate(NamedTuple):
    """What streams of points are compared with."""

    shape: Float[np.ndarray, "j d"]
    """Mean of the points, in the body's frame, in the unit of the data."""
    weights: Float[np.ndarray, " j"]
    """Of points in the alignment, summing to 1."""
    moving: Int[np.ndarray, " m"]
    """Points whose speeds are features: those of the smallest weights, the tips of a hand's fingers."""
    size: float
    """Root mean square distance of the points from their centre, in the unit of the data; 1 for a single point."""
    speed: float
    """Root mean square speed of the centre, units a second."""
    bending: float
    """Root mean square speed of points in the body's frame, sizes a second."""


class Poses(NamedTuple):
    """Points of frames in the frame of the body."""

    local: Float[np.ndarray, "t j d"]
    turns: Float[np.ndarray, "t d d"]
    """Rotations from the body's frame to the world's."""
    centers: Float[np.ndarray, "t d"]


def fit_template(streams: list[Float[np.ndarray, "_ j d"]]) -> PoseTemplate:
    """The template of streams at `RATE_HZ` without missing points.

    Raises:
        ValueError: If there is no frame, or the points do not move.
    """
    if not streams or not sum(map(len, streams)):
        raise ValueError("streams must hold a frame; got none.")
    frames = np.concatenate(streams)
    frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
    num_points = frames.shape[1]
    weights, shape = np.full(num_points, 1 / num_points), frames[len(frames) // 2]
    shape = shape - shape.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum(shape**2, axis=1)))) if num_points > 1 else 1.0
    template = PoseTemplate(shape, weights, np.arange(num_points), size or 1.0, 1.0, 1.0)
    for _ in range(_ROUNDS):
        local = aligned(template, frames).local
        spread = np.mean(np.sum((local - local.mean(axis=0)) ** 2, axis=2), axis=0) / template.size**2
        weights = 1 / (spread + _LEAST_SPREAD**2)
        weights /= weights.sum()
        shape = local.mean(axis=0)
        shape = shape - weights @ shape
        template = template._replace(shape=shape, weights=weights)
    moving = np.sort(np.argsort(weights, kind="stable")[: -(-num_points // MOVING)])
    template = template._replace(moving=moving)
    poses = [aligned(template, stream) for stream in streams if len(stream) > 1]
    speed, bending = (
        float(np.sqrt(np.mean(np.concatenate([np.sum(_speeds(values) ** 2, axis=-1).ravel() for values in own]))))
        for own in ([pose.centers for pose in poses], [pose.local[:, moving] / template.size for pose in poses])
    )
    if not np.isfinite(speed) or speed <= 0:
        raise ValueError("streams must hold points that move; these rest in all frames.")
    return template._replace(speed=speed, bending=bending or 1.0)


def aligned(template: PoseTemplate, points: Float[np.ndarray, "t j d"]) -> Poses:
    """Frames turned onto the template; fewer points than span a body are only shifted."""
    num_points, dimensions = points.shape[1:]
    centers = np.einsum("j,tjd->td", template.weights, points)
    local = points - centers[:, None]
    if num_points <= dimensions:
        return Poses(local, np.broadcast_to(np.eye(dimensions), (len(points), dimensions, dimensions)), centers)
    covariance = np.einsum("j,tjd,je->tde", template.weights, local, template.shape)
    left, _, right = np.linalg.svd(covariance)
    # Of the nearest matrices only a rotation is wanted, not a reflection.
    sign = np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)
    left = left.copy()
    left[..., -1] *= sign[:, None]
    turns = left @ right
    return Poses(np.einsum("tde,tjd->tje", turns, local), turns, centers)


def pose_features(template: PoseTemplate, points: Float[np.ndarray, "t j d"]) -> Float[np.ndarray, "t f"]:
    """Features of every frame of a stream at `RATE_HZ`; frame t depends on those within `REACH` of it."""
    poses = aligned(template, points)
    local = poses.local / template.size
    bending = _speeds(local[:, template.moving]) / template.bending
    velocity = _speeds(poses.centers) / template.speed
    velocity = velocity / np.sqrt(1 + np.sum(velocity**2, axis=1, keepdims=True) / SATURATION**2)
    own = np.einsum("tde,td->te", poses.turns, velocity)
    flat = [values.reshape(len(points), -1) for values in (local, bending, velocity, own, poses.turns)]
    return np.concatenate(flat, axis=1).astype(np.float32)


def num_features(template: PoseTemplate) -> int:
    """Of `pose_features` of a frame."""
    num_points, d = template.shape.shape
    # Places, speeds of points, velocity of the body in two frames, rotation.
    return num_points * d + len(template.moving) * d + 2 * d + d * d


def resampled(
    points: Float[np.ndarray, "t j d"], rate_hz: float, speed: float = 1.0
) -> tuple[Float[np.ndarray, "n j d"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """A stream at `RATE_HZ`, linearly interpolated, also where frames are missing (NaN).

    Args:
        points: Of frames at even times.
        rate_hz: Frames a second.
        speed: By which the stream is played faster.

    Returns:
        Points, the frame of `points` that each is at, with fractions, and whether that was observed.

    Raises:
        ValueError: If no frame is observed.
    """
    present = np.isfinite(points).all(axis=(1, 2))
    if not present.any():
        raise ValueError("points must hold a frame without NaN; got none.")
    places = np.arange(0.0, len(points) - 1 + 1e-6, speed * rate_hz / RATE_HZ)
    known = np.flatnonzero(present)
    after = np.clip(np.searchsorted(known, places), 0, len(known) - 1)
    before = np.maximum(after - (known[after] > places), 0)
    span = np.maximum(known[after] - known[before], 1)
    share = np.clip((places - known[before]) / span, 0, 1)[:, None, None]
    found = (1 - share) * points[known[before]] + share * points[known[after]]
    return found, places, present[np.rint(places).astype(int)]


def _speeds(values: Float[np.ndarray, "t ..."]) -> Float[np.ndarray, "t ..."]:
    if len(values) < 2:
        return np.zeros_like(values)
    return gaussian_filter1d(np.gradient(values, axis=0) * RATE_HZ, SETTLED_FRAMES, axis=0, mode="nearest")
