"""Hand masks from grey images in which skin is brightest, and from depth."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

SMOOTHING = 1.2
"""Standard deviation in pixels of the Gaussian before a threshold."""
DESK_ITERATIONS = 30
DESK_TOLERANCE_M = 0.004
"""Scale of the residuals of a desk: what stands higher loses its weight in the fit."""
LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.008, 0.40
"""Above the desk, of hands."""
FEWEST_READINGS = 100


def otsu_threshold(image: np.ndarray) -> float:
    """The grey value in the middle between the two classes that part the smoothed image best (Otsu 1979).

    Raises:
        ValueError: an image that is not (rows, cols) of uint8.
    """
    smooth = smoothed(image)
    level, _ = cv2.threshold(smooth, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    counts = np.bincount(smooth.ravel(), minlength=256).astype(float)
    grey, is_bright = np.arange(256), np.arange(256) > level
    means = [float(counts[part] @ grey[part]) / max(float(counts[part].sum()), 1.0) for part in (is_bright, ~is_bright)]
    # Otsu's own threshold lies nearer to the class that spreads less, and there moves the outline.
    return sum(means) / 2 if counts[is_bright].sum() else float(level)


def bright_mask(image: np.ndarray, threshold: float) -> Bool[np.ndarray, "rows cols"]:
    """Where the smoothed image is brighter than a threshold: skin in thermal infrared, or on a dark desk.

    Raises:
        ValueError: an image that is not (rows, cols) of uint8, or a threshold that is not a grey value.
    """
    if not 0 <= threshold <= 255:
        raise ValueError(f"threshold must be from 0 to 255; got {threshold}.")
    return cv2.threshold(smoothed(image), threshold, 1, cv2.THRESH_BINARY)[1].view(bool)


def smoothed(image: np.ndarray) -> UInt8[np.ndarray, "rows cols"]:
    """The image after the Gaussian that stands before every threshold.

    Raises:
        ValueError: an image that is not (rows, cols) of uint8.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 2 or image.size == 0:
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"image must be a uint8 array (rows, cols) with pixels; got {got}.")
    return cv2.GaussianBlur(image, (0, 0), SMOOTHING)


def fit_desk(depth: np.ndarray) -> Float[np.ndarray, "rows cols"]:
    """Depth of the desk at every pixel of a pinhole camera, metres, by a robust plane; hands may already be there.

    The inverse of the depth of a plane is linear in the pixel. Readings that are not finite or not positive are left
    out; iteratively reweighted least squares with Cauchy weights, started from the median.

    Args:
        depth: (rows, cols) metres along the optical axis.

    Raises:
        ValueError: depth that is not (rows, cols) of floats, or that has fewer than `FEWEST_READINGS` readings.
    """
    check_floats("depth", depth)
    y, x = np.nonzero(is_reading(depth))
    if len(x) < FEWEST_READINGS:
        raise ValueError(f"depth must have at least {FEWEST_READINGS} finite, positive readings; got {len(x)}.")
    every = max(1, len(x) // 20_000)
    x, y = x[::every], y[::every]
    z = depth[y, x].astype(float)
    rows, cols = depth.shape
    design = np.stack([x / cols, y / rows, np.ones(len(x))], axis=1)
    plane = np.array([0.0, 0.0, 1 / np.median(z)])
    for _ in range(DESK_ITERATIONS):
        residual = z * z * (1 / z - design @ plane)  # of the depth, to first order
        scale = max(DESK_TOLERANCE_M, 1.4826 * float(np.median(np.abs(residual))))
        weight = z**4 / (1 + (residual / scale) ** 2)
        plane = np.linalg.lstsq(np.sqrt(weight)[:, None] * design, np.sqrt(weight) / z, rcond=None)[0]
    v, u = np.meshgrid(np.arange(rows) / rows, np.arange(cols) / cols, indexing="ij")
    inverse = plane[0] * u + plane[1] * v + plane[2]
    return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.inf).astype(np.float32)


def depth_mask(
    depth: np.ndarray,
    desk: np.ndarray,
    *,
    least_height: float = LEAST_HEIGHT_M,
    most_height: float = MOST_HEIGHT_M,
) -> Bool[np.ndarray, "rows cols"]:
    """Where something lies nearer to the camera than the desk, by as much as hands do.

    Args:
        depth: (rows, cols) metres along the optical axis; what is not finite or not positive is no hand.
        desk: Likewise of the empty desk: measured, or of `fit_desk`.
        least_height: Metres.
        most_height: Metres.

    Raises:
        ValueError: depth or desk that are not (rows, cols) of floats, or that differ in shape.
    """
    check_floats("depth", depth)
    check_floats("desk", desk)
    if depth.shape != desk.shape:
        raise ValueError(f"desk must have the shape of depth, {depth.shape}; got {desk.shape}.")
    known = is_reading(depth)
    height = np.where(known, desk - np.where(known, depth, 0.0), 0.0)
    mask = ((height > least_height) & (height < most_height)).astype(np.uint8)
    # Single readings at edges and on the desk are wrong by as much as a finger is thick.
    return cv2.medianBlur(mask, 3).view(bool)


def reading_mask(depth: np.ndarray) -> Bool[np.ndarray, "rows cols"]:
    """Where an image of depths has readings at all: the hand, where what is behind it was removed or is too far away.

    Args:
        depth: (rows, cols) metres along the optical axis; what is not finite or not positive is no reading.

    Raises:
        ValueError: depth that is not (rows, cols) of floats.
    """
    check_floats("depth", depth)
    return cv2.medianBlur(is_reading(depth).astype(np.uint8), 3).view(bool)


def is_reading(depth: np.ndarray) -> Bool[np.ndarray, "rows cols"]:
    """Where a depth image has a reading: a finite, positive number.

    Raises:
        ValueError: depth that is not (rows, cols) of floats.
    """
    check_floats("depth", depth)
    return np.isfinite(depth) & (depth > 0)


def check_floats(name: str, array: np.ndarray) -> None:
    """Refuse what is no image of floats.

    Raises:
        ValueError: an array that is not (rows, cols) of floats, called by the name of the argument.
    """
    if not isinstance(array, np.ndarray) or array.ndim != 2 or not np.issubdtype(array.dtype, np.floating):
        got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} must be an array (rows, cols) of floats; got {got}.")
