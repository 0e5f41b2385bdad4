"""Edges in a depth image within the mask of a hand: where one finger lies before another one, or before the palm."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.fingertip.segmentation import check_floats, is_reading

FINGER_RADIUS_M = 0.0075
"""Half the width of a finger, by which pixels become metres without a camera."""
LEAST_JUMP_M, NOISE_FACTOR = 0.008, 5.0
"""Metres between two surfaces, at least, and standard deviations of the noise of a reading."""
STEEPEST = 1.5
"""Depth over width of one surface."""
REACH = 2
"""Pixels over which depths jump: at edges, sensors have a reading in between."""
HOLE = 2
"""Pixels from the border of a hole in the depth image to its middle, at most, for it to be filled."""
AHEAD = (1.2, 1.6, 2.0)
"""Tip radii from the middle of a tip to what lies ahead of it."""
WINDOW, MARGIN = 3.0, 1.0
"""Tip radii from a place to the side of its window, and between two windows."""
NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Of a hand before a depth camera."""
UNIT_STEP = 8
"""Every such row and column of an image shows the unit of its readings."""


def check_depth(depth: np.ndarray, mask: np.ndarray) -> None:
    """Refuse a depth image that does not belong to the mask, or is not in metres.

    Only every few pixels are looked at here; `readings` takes the rest where hands are found.

    Args:
        depth: (rows, cols) metres along the optical axis; what is not finite or not positive is no reading.
        mask: (rows, cols) of the hands, in the same pixels.

    Raises:
        ValueError: depth that is not (rows, cols) of floats, has another shape than the mask, or is not in metres.
    """
    check_floats("depth", depth)
    if depth.shape != mask.shape:
        raise ValueError(f"depth must have the shape of mask, {mask.shape}, and its pixels; got {depth.shape}.")
    thinned = depth[::UNIT_STEP, ::UNIT_STEP]
    inside = thinned[is_reading(thinned) & (mask[::UNIT_STEP, ::UNIT_STEP] > 0)]
    median = float(np.median(inside)) if inside.size else NEAREST_M
    if not NEAREST_M <= median <= FARTHEST_M:
        raise ValueError(f"depth must be in metres; got a median of {median:.3g} in the mask of the hands.")


def readings(
    depth: Float[np.ndarray, "rows cols"], corner: tuple[int, int], shape: tuple[int, ...], step: tuple[float, float]
) -> Float[np.ndarray, "small_rows small_cols"]:
    """A part of a depth image with fewer pixels, whose readings are not mixed, single precision, 0 without one.

    Args:
        depth: Metres; what is not finite or not positive is no reading.
        corner: Column and row at which the part begins, its own pixels.
        shape: Of the part.
        step: Columns and rows of `depth` to a pixel of the part.
    """
    for axis in (0, 1):
        places = corner[1 - axis] + np.arange(shape[axis])
        depth = depth.take((places * step[1 - axis]).astype(int), axis)
    return np.where(is_reading(depth), depth, 0).astype(np.float32)


class DepthEdges(NamedTuple):
    """Where surfaces of a hand end before or behind each other."""

    is_behind: Bool[np.ndarray, "rows cols"]
    """Pixels that lie behind a surface beside them, so that what is in front keeps its outline."""
    depth: Float[np.ndarray, "rows cols"]
    """Metres, small holes filled; 0 beside the hand and without a reading."""
    jump: float
    """Metres between two surfaces, at least."""


def depth_edges(
    depth: Float[np.ndarray, "rows cols"], inside: UInt8[np.ndarray, "rows cols"], radius: float
) -> DepthEdges:
    """Jumps of depth within a hand.

    A jump is larger than the noise of the readings in this image, than `LEAST_JUMP_M`, and than a slope makes it.

    Args:
        depth: Metres, 0 without a reading.
        inside: 0 beside the hand.
        radius: Half the width of a finger, pixels.
    """
    part = inside > 0
    filled = _filled(depth, part)
    known = (filled > 0) & part
    jump = max(LEAST_JUMP_M, NOISE_FACTOR * reading_noise(filled, known)) + STEEPEST * REACH * FINGER_RADIUS_M / radius
    near = cv2.erode(np.where(known, filled, np.float32(np.inf)), np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8))
    return DepthEdges(known & (filled > near + np.float32(jump)), np.where(known, filled, np.float32(0)), jump)


def goes_behind(
    edges: DepthEdges, tips: Float[np.ndarray, "n 2"], towards: Float[np.ndarray, "n 2"], radius: float
) -> Bool[np.ndarray, " n"]:
    """Whether what ends at each place does so behind something nearer, where it is covered and does not end.

    Args:
        edges: Of the hand.
        tips: Middles of the discs in which fingers end, pixels.
        towards: Vectors along the fingers to their ends, of any length.
        radius: Of tips, pixels.
    """
    along = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    ahead = tips[:, None] + radius * np.array(AHEAD)[:, None] * along[:, None]
    here, there = _at(edges.depth, tips), _at(edges.depth, ahead)
    return np.any((there > 0) & (there < here[:, None] - edges.jump / 2), axis=1) & (here > 0)


def _at(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values at the pixels nearest to points (..., 2), 0 beyond the image."""
    x, y = np.moveaxis(np.rint(points).astype(int), -1, 0)
    rows, cols = image.shape
    is_there = (x >= 0) & (y >= 0) & (x < cols) & (y < rows)
    return np.where(is_there, image[np.clip(y, 0, rows - 1), np.clip(x, 0, cols - 1)], 0)


def reading_noise(depth: Float[np.ndarray, "rows cols"], known: Bool[np.ndarray, "rows cols"]) -> float:
    """Standard deviation of a reading, metres: of second differences along rows, robustly (median); 0 without any.

    Second differences of a smooth surface are small, and have six times the variance of independent noise.
    """
    second = depth[:, 2:] - 2 * depth[:, 1:-1] + depth[:, :-2]
    values = np.abs(second[known[:, 2:] & known[:, 1:-1] & known[:, :-2]])
    return 1.4826 * float(np.median(values)) / math.sqrt(6) if values.size else 0.0


def with_edges_near(edges: DepthEdges, points: Float[np.ndarray, "n 2"], radius: float) -> Float[np.ndarray, "kept 2"]:
    """The points (pixels) whose windows hold an edge: elsewhere the outline of the hand shows all there is."""
    reach = math.ceil(WINDOW * radius)
    low, high = (np.maximum(np.rint(points).astype(int) + aside, 0) for aside in (-reach, reach + 1))
    corners = zip(low.tolist(), high.tolist(), strict=True)
    is_near = [edges.is_behind[top:bottom, left:right].any() for (left, top), (right, bottom) in corners]
    return points[np.array(is_near, bool)]


class Windows(NamedTuple):
    """Places of an image, each in a window of its own, one beneath the other."""

    image: UInt8[np.ndarray, "rows cols"]
    points: Float[np.ndarray, "n 2"]
    """The places in that image."""


def own_surfaces(image: UInt8[np.ndarray, "rows cols"], points: Float[np.ndarray, "n 2"], radius: float) -> Windows:
    """What is connected to each place within `WINDOW` tip radii, without crossing an edge; the rest is 0.

    A finger before a palm is connected to it through the knuckle alone, which is farther away.

    Args:
        image: 0 at edges and beside the hand, more than 127 in it.
        points: Pixels.
        radius: Of tips, pixels.
    """
    reach, margin = math.ceil(WINDOW * radius), math.ceil(MARGIN * radius)
    side = 2 * reach + 1
    padded = cv2.copyMakeBorder(image, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    height = side + 2 * margin
    stacked = np.zeros((max(1, len(points)) * height, height), np.uint8)
    whole = np.rint(points).astype(int)
    for i, (x, y) in enumerate(whole):
        window = padded[y : y + side, x : x + side]
        own = cv2.threshold(window, 127, 1, cv2.THRESH_BINARY)[1]
        if not own[reach, reach]:
            # Beside a place on an edge is the surface that it belongs to.
            rows, columns = np.nonzero(own[reach - 1 : reach + 2, reach - 1 : reach + 2])
            seeds = [(int(columns[-1]) + reach - 1, int(rows[-1]) + reach - 1)] if len(rows) else []
        else:
            seeds = [(reach, reach)]
        for seed in seeds:
            cv2.floodFill(own, None, seed, (2,), flags=4)
        is_own = cv2.threshold(own, 1, 1, cv2.THRESH_BINARY)[1]
        part = stacked[i * height + margin : i * height + margin + side, margin : margin + side]
        cv2.copyTo(window, is_own, part)
    middles = margin + reach + np.stack([np.zeros(len(points)), height * np.arange(len(points))], axis=1)
    return Windows(stacked, points - whole + middles)


def _filled(
    depth: Float[np.ndarray, "rows cols"], inside: Bool[np.ndarray, "rows cols"]
) -> Float[np.ndarray, "rows cols"]:
    """With small holes in the hand filled by the farthest reading beside them: the shadow of what is in front."""
    for _ in range(HOLE if (depth[inside] <= 0).any() else 0):
        depth = np.where(depth > 0, depth, cv2.dilate(depth, np.ones((3, 3), np.uint8)))
    return depth
