"""What a stroke looks like, whoever drew it, where, how large and how fast: features at even steps along it."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.linalg import safe_norm

SMOOTHING = 5
"""Samples in the running mean that takes off what the sensor adds."""
TURN_SCALE = 12.0
"""Parts of a stroke to which its turning refers."""


def resampled(points: Float[np.ndarray, "t d"], num_points: int) -> Float[np.ndarray, "p d"]:
    """`num_points` points at even distances along a stroke, first and last included.

    Any number of samples will do: of one point, or several in one place, come copies of it.

    Raises:
        ValueError: If there is no sample, one is not finite, or `num_points < 2`.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or not len(points) or not np.all(np.isfinite(points)):
        raise ValueError(f"points must be (t, d), finite, with at least one sample; got shape {points.shape}.")
    if num_points < 2:
        raise ValueError(f"num_points must be at least 2; got {num_points}.")
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    moved = np.concatenate([[True], np.diff(along) > 0])
    places = np.linspace(0.0, along[-1], num_points)
    return np.stack([np.interp(places, along[moved], points[moved, k]) for k in range(points.shape[1])], axis=1)


def smoothed(points: Float[np.ndarray, "t d"]) -> Float[np.ndarray, "t d"]:
    """Running mean over `SMOOTHING` samples; at the ends over copies of the last sample."""
    half = SMOOTHING // 2
    padded = np.pad(np.asarray(points, float), ((half, half), (0, 0)), mode="edge")
    return np.mean([padded[i : i + len(points)] for i in range(SMOOTHING)], axis=0)


@jax.jit
def shape_features(points: Float[Array, "p d"]) -> Float[Array, "p three_d"]:
    """Position, direction and turning at each point of a resampled stroke.

    Positions are from the centroid, in twice the root of the mean square distance from it; directions have length 1;
    turning is the change of direction in a `TURN_SCALE`-th of the stroke, halved. A stroke that does not move
    has zeros.
    """
    centred = points - jnp.mean(points, axis=0)
    size = 2 * safe_norm(jnp.sqrt(jnp.mean(jnp.square(centred), axis=0) + 1e-12))
    tangent = jnp.asarray(jnp.gradient(points, axis=0))
    length = safe_norm(tangent)[:, None]
    moves = length > 1e-6 * size
    direction = jnp.where(moves, tangent / jnp.where(moves, length, 1.0), 0.0)
    turning = jnp.asarray(jnp.gradient(direction, axis=0)) * (len(points) / TURN_SCALE)
    return jnp.concatenate([2 * centred / size, direction, 0.5 * turning], axis=1)


def features(points: Float[np.ndarray, "t d"], *, num_points: int = 40) -> Float[Array, "p three_d"]:
    """Features of a stroke as it comes: smoothed, resampled, described.

    Raises:
        ValueError: If there is no sample, or one is not finite.
    """
    stroke = resampled(points, num_points)
    if len(points) >= SMOOTHING:
        stroke = resampled(smoothed(points), num_points)
    return shape_features(jnp.asarray(stroke, dtype=float))


def pen_features(
    strokes: Sequence[Float[np.ndarray, "_ d"]], *, num_points: int = 32
) -> Float[Array, "p three_d_and_1"]:
    """Features of a symbol that was drawn with one or more strokes of a pen: as of one stroke, and where there is ink.

    The strokes are joined in the order in which they were drawn; the last feature is 1 on ink and 0 in between.

    Raises:
        ValueError: If there is no sample, or one is not finite.
    """
    strokes = [np.asarray(stroke, float) for stroke in strokes if len(stroke)]
    if not strokes:
        raise ValueError("strokes must hold at least one sample; got none.")
    points = np.concatenate(strokes)
    # Of the segment that ends in each point.
    inked = np.concatenate([np.arange(len(stroke)) > 0 for stroke in strokes])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    segment = np.minimum(np.searchsorted(along, np.linspace(0.0, along[-1], num_points)), len(along) - 1)
    ink = np.where(segment == 0, True, inked[segment])
    shape = shape_features(jnp.asarray(resampled(points, num_points), dtype=float))
    return jnp.concatenate([shape, jnp.asarray(ink, shape.dtype)[:, None]], axis=1)
