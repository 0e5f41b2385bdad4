"""Tsai's camera model, as the calibrations of surveillance recordings have it, as a pinhole with distortion."""

from typing import NamedTuple

import numpy as np

from jaxfilters.models.calibration import Calibration, distort

MOST_FOLDED = 0.02
"""Share of the pixels beyond the fold of Tsai's model, above which a camera is refused.

A calibration from points in the middle of an image may extrapolate wrongly to its corners: that of PETS 2009's view 7
folds 0.5 % of the pixels. Parameters that fold more than the corners describe no lens.
"""
LEAST_SLOPE = 0.2
"""Derivative of the undistorted radius by the distorted one, below which pixels are left out of a fit.

One undistorted pixel is five recorded ones there. At the fold the slope is zero and the inverse, which OpenCV's
polynomial approximates, has the slope of a square root at zero. On PETS 2009's view 7 the largest error of the
undistorted pixels is 2.2 with this value (3.8 % of the pixels left out), and 4.3 and 7.1 with 0.1 and zero.
"""
_CELLS = 256
"""Columns and rows of the grid on which shares of an image are counted."""


class TsaiCamera(NamedTuple):
    """Parameters of Tsai 1987, lengths in millimetres, as in the XML files of PETS 2009."""

    image_size: tuple[int, int]
    """Columns and rows."""
    focal: float
    """Millimetres."""
    kappa1: float
    """Radial distortion, 1 / mm^2, of distorted sensor coordinates."""
    center: tuple[float, float]
    """Pixels."""
    sx: float
    """Horizontal scale; one for an ideal frame grabber."""
    pixel: tuple[float, float]
    """Width and height of a pixel on the sensor in millimetres (dpx, dpy)."""
    translation: tuple[float, float, float]
    """The world's origin in the camera, millimetres."""
    rotation: tuple[float, float, float]
    """Angles about x, y and z in radians: R = Rz Ry Rx."""


class TsaiFit(NamedTuple):
    """A camera of Tsai's model in OpenCV's, and how well it is the same."""

    calibration: Calibration
    worst_px: float
    """Largest error of the distortion over the fitted part, in pixels of the image with distortion."""
    fitted_share: float
    """Share of the image over which the distortion was fitted; one for most lenses, see `LEAST_SLOPE`."""


def calibration_of_tsai(camera: TsaiCamera, image_size: tuple[int, int]) -> TsaiFit:
    r"""The same camera, imaged at `image_size`, with OpenCV's distortion.

    Tsai's distortion gives undistorted coordinates, $x_u = x_d (1 + \kappa_1 f^2 r_d^2)$; OpenCV's gives distorted
    ones. Its k1, k2, k3 are fitted over the image, by linear least squares in pixels. A pixel u of the original is
    $(u + 1/2) s - 1/2$ of an image s times as wide.

    With a negative $\kappa_1$, $r_u$ has its maximum at $r_d^2 = -1 / (3 \kappa_1 f^2)$, and beyond it the model folds
    the image onto itself. What lies beyond it, or so near that the slope of $r_u$ is below `LEAST_SLOPE`, is left out
    of the fit.

    Raises:
        ValueError: sizes, focal length or pixels that are not positive, or a distortion that folds more of the image
            than `MOST_FOLDED`.
    """
    if min(*camera.image_size, *image_size, camera.focal, camera.sx, *camera.pixel) <= 0:
        raise ValueError(f"sizes, focal length, pixels and sx must be positive; got {camera}, {image_size}.")
    focal = np.array([camera.sx * camera.focal / camera.pixel[0], camera.focal / camera.pixel[1]])
    folded, fitted_share = _shares(camera, focal)
    if folded > MOST_FOLDED:
        raise ValueError(
            f"kappa1 = {camera.kappa1:g} folds {folded:.1%} of the image onto the rest of it, expected at most "
            f"{MOST_FOLDED:.0%}: no lens does, and a calibration does so only in the corners."
        )
    u, v = np.meshgrid(np.linspace(0, camera.image_size[0] - 1, 49), np.linspace(0, camera.image_size[1] - 1, 49))
    distorted = (np.stack([u.ravel(), v.ravel()], axis=-1) - camera.center) / focal
    distorted = distorted[_slope(camera, distorted) >= LEAST_SLOPE]
    undistorted = distorted * (1 + camera.kappa1 * camera.focal**2 * (distorted**2).sum(axis=-1, keepdims=True))
    r2 = (undistorted**2).sum(axis=-1)
    # x_d - x_u = x_u (k1 r^2 + k2 r^4 + k3 r^6), in pixels.
    columns = [(undistorted * focal * r2[:, None] ** power).ravel() for power in (1, 2, 3)]
    k1, k2, k3 = np.linalg.lstsq(np.column_stack(columns), ((distorted - undistorted) * focal).ravel(), rcond=None)[0]
    coefficients = np.array([k1, k2, 0.0, 0.0, k3])
    scale = np.asarray(image_size, float) / camera.image_size
    errors = (distort(undistorted, coefficients) - distorted) * focal * scale
    center = (np.asarray(camera.center) + 0.5) * scale - 0.5
    K = np.array([[focal[0] * scale[0], 0, center[0]], [0, focal[1] * scale[1], center[1]], [0, 0, 1]])
    R, t = _rotation(*camera.rotation), np.asarray(camera.translation) / 1000
    worst_px = float(np.linalg.norm(errors, axis=-1).max())
    return TsaiFit(Calibration(K, coefficients, R, t, 0.0), worst_px, fitted_share)


def _shares(camera: TsaiCamera, focal: np.ndarray) -> tuple[float, float]:
    """Shares of the image beyond the fold, and where the slope is at least `LEAST_SLOPE`."""
    middles = (np.arange(_CELLS) + 0.5) / _CELLS
    u, v = np.meshgrid(*(middles * size - 0.5 for size in camera.image_size))
    slope = _slope(camera, (np.stack([u, v], axis=-1) - camera.center) / focal)
    return float((slope <= 0).mean()), float((slope >= LEAST_SLOPE).mean())


def _slope(camera: TsaiCamera, distorted: np.ndarray) -> np.ndarray:
    """Derivative of the undistorted radius by the distorted one, at points (..., 2) of the image plane at z = 1."""
    return 1 + 3 * camera.kappa1 * camera.focal**2 * (distorted**2).sum(axis=-1)


def _rotation(x: float, y: float, z: float) -> np.ndarray:
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
