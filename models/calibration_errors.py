"""How well a calibration is known: standard deviations of what a least-squares search found."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LEAST_NOISE_PX = 0.5
"""Standard deviation of a coordinate of a pixel that someone read off an image, at best."""
MOST_OPEN, MOST_OPEN_FLOOR = 0.05, 0.1
"""Standard deviations of the focal length and of the position, as shares, of a camera that is known: with points at
several heights; from a floor alone, where an error of both hardly moves positions on the floor."""
_STEP_PX = 1e-3
"""Over all points, of differences in place of derivatives."""
_SMALLEST = 1e-15
"""Extent of a direction that the errors do not depend on, as a share of the others."""


class Deviations(NamedTuple):
    """Standard deviations of a calibration, which follow from the noise of its pixels."""

    focal: float
    """Of the focal lengths, as a share of them; the larger one of the two."""
    position_m: Float[np.ndarray, " 3"]
    """Of the camera's position in the world, metres."""


def camera_deviations(
    described: Callable[[np.ndarray], np.ndarray],
    x: Float[np.ndarray, " unknowns"],
    slopes: Float[np.ndarray, "errors unknowns"],
    errors: Float[np.ndarray, " errors"],
) -> Deviations:
    """Standard deviations of a camera where the squared errors are least.

    Args:
        described: Logarithms of both focal lengths and the position in metres, of the unknowns.
        x: The unknowns that were found.
        slopes: Derivatives of the errors by the unknowns.
        errors: Pixels, of two coordinates of each point.
    """
    steps = _STEP_PX / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    wanted = [(described(x + h) - described(x - h)) / (2 * h.max()) for h in np.diag(steps)]
    found = standard_deviations(slopes, errors, np.asarray(wanted), least_noise_px=LEAST_NOISE_PX)
    return Deviations(float(found[:2].max()), found[2:])


def check_determined(focal: float, place: float, most: float) -> None:
    """Raise `ValueError` where points leave a camera open.

    Args:
        focal: Standard deviation of the focal length, as a share of it.
        place: Standard deviation of the position, as a share of the distance to the points.
        most: What is accepted of both.
    """
    # Comparisons with NaN are false, so that it is refused.
    if not (focal <= most and place <= most):
        raise ValueError(
            f"points_m and pixels leave the camera open: the focal length has a standard deviation of {focal:.2g} of "
            f"itself, the position one of {place:.2g} of the distance to the points; expected at most {most:g}. Give "
            "points at several heights, as on walls or poles up to 2 m, and all over the image, or calibrate the "
            "intrinsics with a board first."
        )


def standard_deviations(
    slopes: Float[np.ndarray, "errors unknowns"],
    errors: Float[np.ndarray, " errors"],
    wanted: Float[np.ndarray, "unknowns wanted"],
    *,
    least_noise_px: float,
) -> Float[np.ndarray, " wanted"]:
    """Standard deviations of functions of the unknowns, to first order, where the squared errors are least.

    Unlike those of `cv2.calibrateCameraExtended`, they are large where the errors leave a direction of the unknowns
    open: OpenCV's pseudo-inverse leaves such a direction out.

    Args:
        slopes: Derivatives of the errors by the unknowns.
        errors: Pixels, of two coordinates of each point.
        wanted: Derivatives of the functions by the unknowns.
        least_noise_px: The noise of the pixels is that of the errors, but never less than this: a handful of points may
            agree by chance.
    """
    noise_px = max(np.linalg.norm(errors) / np.sqrt(max(len(errors) - slopes.shape[1], 1)), least_noise_px)
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    _, extents, directions = np.linalg.svd(slopes / scale, full_matrices=False)
    inverse = directions / np.maximum(extents, _SMALLEST)[:, None]
    return noise_px * np.linalg.norm(inverse @ (wanted / scale[:, None]), axis=0)
