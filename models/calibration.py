"""Where a fixed camera stands and how it images, from points in the world whose pixels are known.

World coordinates are metres with Z up, pixels (u, v) with their centres at integers. Everything here runs on the host
in float64: it is done once for a camera. SciPy is imported by the functions that use it, since trackers need no more
than `Calibration`.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxfilters.models.calibration_checks import FLAT, check_in_front, check_spread, checked_points, is_flat
from jaxfilters.models.calibration_errors import (
    MOST_OPEN,
    MOST_OPEN_FLOOR,
    Deviations,
    camera_deviations,
    check_determined,
)
from jaxfilters.models.floor_camera import canonical

FEWEST_POINTS, FEWEST_FLOOR_POINTS = 6, 4
"""Of a projection matrix; of a camera over a plane with square pixels around the centre of its image."""
LEVEL = 0.05
"""Heights that differ by this share of the extent of a floor: the plane still tells about where the camera stands."""
MOST_OBLONG = 1.5
"""Ratio of the sides of a pixel, as wide films squeezed into narrow images have it."""
_COEFFICIENTS = 5
_MOST_STEPS = 200
"""Of a search: points that fix a camera need up to a hundred, others lead along a valley without an end."""
_UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


class Calibration(NamedTuple):
    """A camera with lens distortion. `x_cam = R x_world + t`; undistorted pixels are those of `K`."""

    K: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point in pixels, without skew."""
    distortion: Float[np.ndarray, " 5"]
    """k1, k2, p1, p2, k3 as in OpenCV; zeros for none."""
    R: Float[np.ndarray, "3 3"]
    """Rotation from world to camera: x right, y down, z forward."""
    t: Float[np.ndarray, " 3"]
    """The world's origin in the camera, metres."""
    rms_px: float
    """Root mean square distance of projected points and their pixels, in the image with distortion."""
    deviations: Deviations | None = None
    """Of cameras whose focal length was searched for; None for others."""

    @property
    def P(self) -> np.ndarray:
        """(3, 4): world to undistorted pixels, in canonical scale."""
        return self.K @ np.column_stack([self.R, self.t])

    @property
    def position(self) -> np.ndarray:
        """(3,) where the camera stands in the world, metres."""
        return -self.R.T @ self.t

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """(n, 2) pixels, in the image with distortion, of points (n, 3)."""
        x = points_m @ self.R.T + self.t
        return distort(x[:, :2] / x[:, 2:], self.distortion) * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """(n, 2) undistorted pixels of pixels (n, 2) in the image with distortion."""
        return undistort_pixels(pixels, self.K, self.distortion)


def undistort_pixels(pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) without lens distortion of pixels (n, 2) of an image with it.

    OpenCV's `undistortPoints` ends after five iterations, which leaves tens of pixels near the border of wide lenses.
    """
    raw = np.asarray(pixels, float).reshape(-1, 1, 2)
    return cv2.undistortPointsIter(raw, K, distortion, np.eye(3), K, _UNDISTORT_UNTIL).reshape(-1, 2)


def calibrate_dlt(points_m: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, float]:
    """`(P, rms_px)`: the projection matrix in canonical scale, by the direct linear transform.

    Each point gives two homogeneous equations in the twelve entries; the solution is their last right singular
    vector, of points and pixels moved to the origin and scaled to unit spread (Hartley & Zisserman 2004, algorithm
    7.1; Kato et al. 1999, section 2.1).

    Args:
        points_m: (n, 3) world points in metres, six or more, not in one plane.
        pixels: (n, 2) undistorted pixels.

    Raises:
        ValueError: wrong shapes, too few or coplanar points, pixels on a line, points for which there is no one camera,
            or points that would lie behind it, as those of a left-handed world.
    """
    points_m, pixels = checked_points(points_m, pixels, FEWEST_POINTS)
    if is_flat(points_m):
        raise ValueError(
            "points_m lie in one plane, or nearly: a projection matrix needs points at several heights above it "
            "(points on the floor alone need the camera's intrinsics, or those assumed by calibrate_floor)."
        )
    check_spread(pixels)
    X, to_world = _normalised(points_m)
    x, to_pixels = _normalised(pixels)
    X = np.column_stack([X, np.ones(len(X))])
    zero = np.zeros_like(X)
    equations = np.concatenate(
        [np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])],
    )
    _, spread, directions = np.linalg.svd(equations)
    if spread[10] < 1e-9 * spread[0]:
        raise ValueError(
            "points_m and pixels fit more than one camera: they lie on a curve or in two groups that leave a direction "
            "open; add points elsewhere in the view."
        )
    P = np.linalg.solve(to_pixels, directions[-1].reshape(3, 4) @ to_world)
    if abs(np.linalg.det(P[:, :3])) < 1e-12 * np.linalg.norm(P[:, :3]) ** 3:
        raise ValueError("points_m and pixels fit no camera at a finite place: the left 3 x 3 block of P is singular.")
    P = canonical(P)
    homogeneous = np.column_stack([points_m, np.ones(len(points_m))]) @ P.T
    check_in_front(homogeneous[:, 2])
    return P, _rms(homogeneous[:, :2] / homogeneous[:, 2:] - pixels)


def decompose(P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`(K, R, t)` with `P = K [R | t]` up to scale, K upper triangular with a positive diagonal and K[2, 2] = 1.

    Raises:
        ValueError: a matrix whose left block is singular.
    """
    from scipy.linalg import rq

    P = np.asarray(P, float)
    if P.shape != (3, 4) or not np.isfinite(P).all() or np.linalg.matrix_rank(P[:, :3]) < 3:
        raise ValueError(f"P must be a finite (3, 4) matrix with an invertible left block; got {P.tolist()}.")
    P = canonical(P)
    K, R = rq(P[:, :3])
    signs = np.where(np.diag(K) < 0, -1.0, 1.0)
    K, R = K * signs, signs[:, None] * R
    return K / K[2, 2], R, np.linalg.solve(K, P[:, 3])


def refine(points_m: np.ndarray, pixels: np.ndarray, start: Calibration, *, coefficients: int = 0) -> Calibration:
    """The camera without skew that reprojects best: least squares over intrinsics, distortion and pose.

    Args:
        points_m: (n, 3) world points in metres.
        pixels: (n, 2) pixels in the image with distortion.
        start: Where the search begins, such as `decompose` of `calibrate_dlt`.
        coefficients: How many of k1, k2, p1, p2, k3 are searched for; the others stay as in `start`.

    Raises:
        ValueError: fewer equations than unknowns, wrong shapes, or points behind the camera that was found.
    """
    if not 0 <= coefficients <= _COEFFICIENTS:
        raise ValueError(f"coefficients must be from 0 to {_COEFFICIENTS}; got {coefficients}.")
    unknowns = 10 + coefficients
    points_m, pixels = checked_points(points_m, pixels, (unknowns + 1) // 2)

    def intrinsics(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        K = np.array([[x[0], 0, x[2]], [0, x[1], x[3]], [0, 0, 1.0]])
        return K, np.concatenate([x[4:], start.distortion[coefficients:]])

    first = np.concatenate([start.K[[0, 1, 0, 1], [0, 1, 2, 2]], start.distortion[:coefficients]])
    return _nearest(points_m, pixels, start, intrinsics, first)


def calibrate_points(
    points_m: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int], *, coefficients: int = 0
) -> Calibration:
    """A camera from six or more points in space: direct linear transform, then `refine`.

    Args:
        points_m: (n, 3) world points in metres.
        pixels: (n, 2) pixels in the image with distortion.
        image_size: Columns and rows.
        coefficients: How many of k1, k2, p1, p2, k3 are searched for.

    Raises:
        ValueError: as `calibrate_dlt` and `refine`; points that leave the focal length or the position open, as those
            of a nearly level floor do; a principal point outside the image, or pixels that are far from square.
    """
    P, _ = calibrate_dlt(points_m, pixels)
    found = refine(points_m, pixels, _without_skew(P), coefficients=coefficients)
    check_determined(*_shares(found, points_m), MOST_OPEN)
    fx, fy = found.K[[0, 1], [0, 1]]
    is_inside = ((found.K[:2, 2] > -0.5) & (found.K[:2, 2] < np.asarray(image_size) - 0.5)).all()
    if not (is_inside and fx > 0 and 1 / MOST_OBLONG <= fy / fx <= MOST_OBLONG):
        raise ValueError(
            f"points_m and pixels fit only a camera with focal lengths of {fx:.4g} x {fy:.4g} px and its principal "
            f"point at ({found.K[0, 2]:.4g}, {found.K[1, 2]:.4g}); expected a ratio of at most {MOST_OBLONG:g}, and a "
            f"point in the image of {image_size[0]}x{image_size[1]}. Are the points in metres, and none exchanged?"
        )
    return found


def calibrate_floor(points_m: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int]) -> Calibration:
    r"""A camera from four or more points of one plane, with square pixels and the principal point in the middle.

    A plane fixes eight numbers: the pose and the focal length, with one to spare. With the homography
    $(h_1, h_2, h_3) = K (r_1, r_2, t)$ of the plane and pixels counted from the middle,
    $h_1^T \omega h_2 = 0$ and $h_1^T \omega h_1 = h_2^T \omega h_2$ with $\omega = \mathrm{diag}(1, 1, f^2)$ are
    linear in $f^2$ (Zhang 2000, equations 3 and 4).

    Args:
        points_m: (n, 3) at about one height, see `is_level`, or (n, 2) on the floor, metres.
        pixels: (n, 2) pixels, taken as undistorted.
        image_size: Columns and rows.

    Raises:
        ValueError: wrong shapes, too few points, points or pixels on a line, points of several heights, or a view that
            leaves the focal length open, as one straight down does.
    """
    points_m = np.asarray(points_m, float)
    if points_m.ndim == 2 and points_m.shape[1] == 2:
        points_m = np.column_stack([points_m, np.zeros(len(points_m))])
    points_m, pixels = checked_points(points_m, pixels, FEWEST_FLOOR_POINTS)
    if not is_level(points_m):
        raise ValueError("points_m must have one height; use calibrate_points for points at several heights.")
    if is_flat(points_m[:, :2]):
        raise ValueError("points_m lie on one line, or nearly: points to the sides of it are needed.")
    check_spread(pixels)
    middle = (np.asarray(image_size, float) - 1) / 2
    H, _ = cv2.findHomography(points_m[:, :2], pixels - middle)
    if H is None:
        raise ValueError(
            "points_m and pixels fit no view of a plane: four points are needed of which "
            "no three lie on one line, neither in the world nor in the image."
        )
    focal = _focal_of_homography(H, float(max(image_size)))
    K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    start = calibrate_pose(points_m, pixels, K, np.zeros(_COEFFICIENTS))

    def intrinsics(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[np.exp(x[0]), 0, middle[0]], [0, np.exp(x[0]), middle[1]], [0, 0, 1]]), start.distortion

    found = _nearest(points_m, pixels, start, intrinsics, np.log([focal]))
    check_determined(*_shares(found, points_m), MOST_OPEN_FLOOR)
    return found


def calibrate_pose(points_m: np.ndarray, pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> Calibration:
    """A camera of known intrinsics from four or more points, which may lie in one plane.

    Raises:
        ValueError: wrong shapes, too few points, points or pixels on a line, or no pose.
    """
    points_m, pixels = checked_points(points_m, pixels, FEWEST_FLOOR_POINTS)
    if np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)[1] < FLAT * np.ptp(points_m, axis=0).max():
        raise ValueError("points_m lie on one line, or nearly: points to the sides of it are needed.")
    check_spread(pixels)
    K, distortion = np.asarray(K, float), np.asarray(distortion, float)
    try:
        is_found, turn, t = cv2.solvePnP(points_m, pixels, K, distortion, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        is_found = False
    if not is_found:
        raise ValueError("points_m and pixels fit no pose of a camera with these intrinsics.")
    turn, t = cv2.solvePnPRefineLM(points_m, pixels, K, distortion, turn, t)
    found = Calibration(K, distortion, cv2.Rodrigues(turn)[0], t.ravel(), 0.0)
    check_in_front(points_m @ found.R[2] + found.t[2])
    return found._replace(rms_px=_rms(found.project(points_m) - pixels))


def floor_errors_m(calibration: Calibration, points_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) metres between points and where their pixels are visible in the horizontal plane of their height.

    For points on the floor this is what an error in their pixels does to a position; NaN where the ray through a
    pixel does not meet that plane.
    """
    points_m = np.asarray(points_m, float)
    uv = calibration.undistort(pixels)
    P = calibration.P
    directions = np.linalg.solve(P[:, :3], np.column_stack([uv, np.ones(len(uv))]).T).T
    center = -np.linalg.solve(P[:, :3], P[:, 3])
    slopes = np.where(np.abs(directions[:, 2]) > 1e-12, directions[:, 2], np.nan)
    depth = (points_m[:, 2] - center[2]) / slopes
    met = center[:2] + depth[:, None] * directions[:, :2]
    return np.where(depth > 0, np.linalg.norm(met - points_m[:, :2], axis=1), np.nan)


def distort(x: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, " 5"]) -> Float[np.ndarray, "n 2"]:
    """Distorted image coordinates, at focal length one, of undistorted ones (OpenCV's model)."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = (x**2).sum(axis=-1, keepdims=True)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = 2 * x[:, :1] * x[:, 1:] * [[p1, p2]] + (r2 + 2 * x**2) * [[p2, p1]]
    return x * radial + tangential


def is_level(points_m: np.ndarray) -> bool:
    """Whether the heights of points (n, 3) differ by little, `LEVEL`, next to their extent on the floor."""
    return bool(np.ptp(points_m[:, 2]) <= LEVEL * np.ptp(points_m[:, :2], axis=0).max())


def _without_skew(P: np.ndarray) -> Calibration:
    K, R, t = decompose(P)
    K[0, 1] = 0
    return Calibration(K, np.zeros(_COEFFICIENTS), R, t, 0.0)


def _nearest(
    points_m: np.ndarray,
    pixels: np.ndarray,
    start: Calibration,
    intrinsics: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    first: np.ndarray,
) -> Calibration:
    """The camera that reprojects best, by least squares over the pose and the unknowns of `intrinsics`.

    Args:
        points_m: (n, 3) world points in metres.
        pixels: (n, 2) pixels in the image with distortion.
        start: The pose that the search begins with.
        intrinsics: K and distortion, of the unknowns (k,).
        first: (k,) unknowns that the search begins with.

    Raises:
        ValueError: points behind the camera that was found.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    middle = points_m.mean(axis=0)

    def camera(x: np.ndarray) -> Calibration:
        K, distortion = intrinsics(x[:-6])
        turned = Rotation.from_rotvec(x[-6:-3]).as_matrix() @ start.R
        # Turning about the middle of the points, not about the camera, keeps rotation and translation apart.
        return Calibration(K, distortion, turned, start.R @ middle - turned @ middle + start.t + x[-3:], 0.0)

    def errors(x: np.ndarray) -> np.ndarray:
        return (camera(x).project(points_m) - pixels).ravel()

    start_x = np.concatenate([first, np.zeros(6)])
    found = least_squares(errors, start_x, x_scale="jac", method="trf", max_nfev=_MOST_STEPS)
    best = camera(found.x)
    check_in_front(points_m @ best.R[2] + best.t[2])

    def described(x: np.ndarray) -> np.ndarray:
        near = camera(x)
        return np.concatenate([np.log(np.abs(near.K[[0, 1], [0, 1]])), near.position])

    deviations = camera_deviations(described, found.x, found.jac, found.fun)
    return best._replace(rms_px=_rms(found.fun.reshape(-1, 2)), deviations=deviations)


def _shares(found: Calibration, points_m: np.ndarray) -> tuple[float, float]:
    """Standard deviations as shares of the focal length, and of the distance to the middle of the points."""
    assert found.deviations is not None
    distance_m = np.linalg.norm(found.position - points_m.mean(axis=0))
    return found.deviations.focal, float(np.linalg.norm(found.deviations.position_m) / distance_m)


def _focal_of_homography(H: np.ndarray, size: float) -> float:
    h1, h2 = (H[:, :2] / [[size], [size], [1]]).T
    # a + b f^2 = 0 twice, with f in units of `size`.
    b = np.array([h1[2] * h2[2], h1[2] ** 2 - h2[2] ** 2])
    a = np.array([h1[:2] @ h2[:2], h1[:2] @ h1[:2] - h2[:2] @ h2[:2]])
    squared = -(a @ b) / max(float(b @ b), 1e-300)
    if not 0.05 < squared < 400:
        raise ValueError(
            "points_m and pixels leave the focal length open (the camera looks straight down, the points are few or "
            "wrong): give points at several heights, or calibrate the intrinsics with a board first."
        )
    return size * float(np.sqrt(squared))


def _normalised(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points about the origin at a mean distance of sqrt(d), and the matrix that does so to homogeneous ones."""
    middle = x.mean(axis=0)
    scale = np.sqrt(x.shape[1]) / np.linalg.norm(x - middle, axis=1).mean()
    matrix = np.diag([*[scale] * x.shape[1], 1.0])
    matrix[:-1, -1] = -scale * middle
    return (x - middle) * scale, matrix


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).sum(axis=-1).mean()))
