"""What a stroke looks like, whoever drew it, where, how large and how fast: features at even steps along it."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.math.linalg import safe_norm

NUM_POINTS = 40
"""Of a resampled stroke, by default."""
Drawn = tuple[Sequence[Float[np.ndarray, "_ d"]], int | float]
"""A symbol: the pieces of its stroke, positions in time, and how many fingers drew it."""
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


def features(
    pieces: Sequence[Float[np.ndarray, "_ d"]], fingers: int | float = 1, *, num_points: int = NUM_POINTS
) -> Float[Array, "p three_d_and_2"]:
    """What a symbol looks like: its shape, where there is ink, and the number of fingers that drew it.

    Pieces, as a pen draws them, are joined in the order in which they were drawn. The feature before the last is 1 on
    ink and 0 between pieces; the last one is `fingers` at every point.

    Raises:
        ValueError: If there is no sample, or one is not finite.
    """
    return stacked([(pieces, fingers)], num_points=num_points)[0]


def stacked(strokes: Sequence[Drawn], *, num_points: int = NUM_POINTS) -> Float[Array, "n p three_d_and_2"]:
    """`features` of many symbols, each its pieces and its number of fingers.

    Raises:
        ValueError: As `features`, or if there is no symbol.
    """
    if not strokes:
        raise ValueError("strokes must be at least one; got none.")
    joined = [_joined(pieces, num_points) for pieces, _ in strokes]
    shapes = _shapes(jnp.asarray(np.stack([points for points, _ in joined]), dtype=float))
    ink = jnp.asarray(np.stack([ink for _, ink in joined]), shapes.dtype)
    fingers = jnp.asarray([count for _, count in strokes], shapes.dtype)
    return jnp.concatenate([shapes, ink[..., None], jnp.broadcast_to(fingers[:, None, None], (*ink.shape, 1))], axis=2)


def to_judge(
    strokes: Sequence[Drawn], dimensions: int, *, num_points: int = NUM_POINTS
) -> Float[np.ndarray, "p three_d_and_2 n"]:
    """`features` of strokes that may be none, the strokes last: NaN, which is rejected, where they are none.

    That is without a sample, with one that is not finite, or where all of them are in one place.

    Raises:
        ValueError: If a stroke has samples of other than that many dimensions.
    """
    found = np.full((num_points, 3 * dimensions + 2, len(strokes)), np.nan, np.float32)
    usable = []
    for i, (pieces, _) in enumerate(strokes):
        pieces = [np.asarray(piece, float) for piece in pieces if len(piece)]
        if any(piece.shape[1:] != (dimensions,) for piece in pieces):
            shapes = [piece.shape for piece in pieces]
            raise ValueError(f"strokes must have positions of {dimensions} dimensions; number {i} has {shapes}.")
        points = np.concatenate(pieces) if pieces else np.zeros((1, dimensions))
        if np.all(np.isfinite(points)) and np.any(points != points[0]):
            usable.append(i)
    if usable:
        found[..., usable] = np.moveaxis(
            np.asarray(stacked([strokes[i] for i in usable], num_points=num_points)), 0, -1
        )
    return found


def turned(features: Float[Array, "*n p 8"], angle: float | Float[Array, ""]) -> Float[Array, "*n p 8"]:
    """Features of strokes in the plane after a turn by `angle` in radians, from the first axis to the second."""
    turn = jnp.array([[jnp.cos(angle), jnp.sin(angle)], [-jnp.sin(angle), jnp.cos(angle)]])
    shape = features[..., :6].reshape(*features.shape[:-1], 3, 2)
    moved = jnp.matmul(shape, turn, precision="highest").reshape(*features.shape[:-1], 6)
    return jnp.concatenate([moved, features[..., 6:]], axis=-1)


@jax.jit
def _shapes(points: Float[Array, "n p d"]) -> Float[Array, "n p three_d"]:
    return jax.vmap(shape_features)(points)


def _joined(pieces, num_points):
    """Points at even distances along all pieces, and which of them are on ink."""
    pieces = [np.asarray(piece, float) for piece in pieces if len(piece)]
    if not pieces:
        raise ValueError("pieces must hold at least one sample; got none.")
    points = np.concatenate(pieces)
    # Of the segment that ends in each point.
    inked = np.concatenate([np.arange(len(piece)) > 0 for piece in pieces])
    places = resampled(points, num_points)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    segment = np.minimum(np.searchsorted(along, np.linspace(0.0, along[-1], num_points)), len(along) - 1)
    return places, np.where(segment == 0, True, inked[segment])
