"""Tsai's camera model, as the calibrations of surveillance recordings have it, as a pinhole with distortion."""

from typing import NamedTuple

import numpy as np

from jaxfilters.models.calibration import Calibration, distort


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


def calibration_of_tsai(camera: TsaiCamera, image_size: tuple[int, int]) -> tuple[Calibration, float]:
    r"""`(calibration, worst_px)`: the same camera, imaged at `image_size`, and what the distortion differs by.

    Tsai's distortion gives undistorted coordinates, $x_u = x_d (1 + \kappa_1 f^2 r_d^2)$; OpenCV's gives distorted
    ones. Its k1, k2, k3 are fitted over the image, by linear least squares in pixels, and `worst_px` is the largest
    error that remains. A pixel u of the original is $(u + 1/2) s - 1/2$ of an image s times as wide.

    Raises:
        ValueError: sizes, focal length or pixels that are not positive, or a distortion that folds the image.
    """
    if min(*camera.image_size, *image_size, camera.focal, camera.sx, *camera.pixel) <= 0:
        raise ValueError(f"sizes, focal length, pixels and sx must be positive; got {camera}, {image_size}.")
    focal = np.array([camera.sx * camera.focal / camera.pixel[0], camera.focal / camera.pixel[1]])
    u, v = np.meshgrid(np.linspace(0, camera.image_size[0] - 1, 49), np.linspace(0, camera.image_size[1] - 1, 49))
    distorted = (np.stack([u.ravel(), v.ravel()], axis=-1) - camera.center) / focal
    undistorted = distorted * (1 + camera.kappa1 * camera.focal**2 * (distorted**2).sum(axis=-1, keepdims=True))
    r2 = (undistorted**2).sum(axis=-1)
    if (1 + 3 * camera.kappa1 * camera.focal**2 * (distorted**2).sum(axis=-1) <= 0).any():
        raise ValueError(f"kappa1 = {camera.kappa1:g} folds the image onto itself: no lens does.")
    # x_d - x_u = x_u (k1 r^2 + k2 r^4 + k3 r^6), in pixels.
    columns = [(undistorted * focal * r2[:, None] ** power).ravel() for power in (1, 2, 3)]
    k1, k2, k3 = np.linalg.lstsq(np.column_stack(columns), ((distorted - undistorted) * focal).ravel(), rcond=None)[0]
    coefficients = np.array([k1, k2, 0.0, 0.0, k3])
    scale = np.asarray(image_size, float) / camera.image_size
    errors = (distort(undistorted, coefficients) - distorted) * focal * scale
    center = (np.asarray(camera.center) + 0.5) * scale - 0.5
    K = np.array([[focal[0] * scale[0], 0, center[0]], [0, focal[1] * scale[1], center[1]], [0, 0, 1]])
    R, t = _rotation(*camera.rotation), np.asarray(camera.translation) / 1000
    return Calibration(K, coefficients, R, t, 0.0), float(np.linalg.norm(errors, axis=-1).max())


def _rotation(x: float, y: float, z: float) -> np.ndarray:
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
