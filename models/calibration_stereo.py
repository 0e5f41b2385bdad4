"""Where two cameras stand to each other, from pictures of a board that both took at the same moments.

Everything here runs on the host in float64: it is done once for a rig.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxfilters.models.calibration import Calibration
from jaxfilters.models.calibration_board import FEWEST_CORNERS, FEWEST_VIEWS, BoardView, is_usable

_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10)
_SAME_CORNER = 1e-6


class StereoPose(NamedTuple):
    """The second camera relative to the first, `X_second = R X_first + t`, and how well the pictures agree with it."""

    R: Float[np.ndarray, "3 3"]
    """Rotation between the cameras' frames: x right, y down, z forward."""
    t: Float[np.ndarray, " 3"]
    """The first camera in the frame of the second, metres."""
    rms_px: float
    """Root mean square distance of corners and their images, over both cameras."""
    epipolar_px: Float[np.ndarray, " pairs"]
    """For each pair of pictures, the root mean square distance of corners from the epipolar lines of their partners,
    in images without distortion; NaN for a pair that shows too little."""

    @property
    def baseline(self) -> float:
        """Distance of the cameras, metres."""
        return float(np.linalg.norm(self.t))


def calibrate_stereo(
    first: Sequence[BoardView],
    second: Sequence[BoardView],
    intrinsics: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    image_size: tuple[int, int],
) -> StereoPose:
    """Relative pose that moves corners of the board the least, with the intrinsics of both cameras held.

    Args:
        first: What each picture of the first camera shows of the board.
        second: What the second camera's pictures of the same moments show.
        intrinsics: `(K, distortion)` of both, (3, 3) and k1, k2, p1, p2, k3.
        image_size: Columns and rows.

    Raises:
        ValueError: not one picture of each camera for every moment, or too few pairs in which both see enough of the
            board.
    """
    if len(first) != len(second):
        raise ValueError(f"first and second must have one view each for every moment; got {len(first)}, {len(second)}.")
    pairs = [_shared(a, b) for a, b in zip(first, second, strict=True)]
    shows_enough = [is_usable(BoardView(points_m, pixels)) for points_m, pixels, _ in pairs]
    usable = [pair for pair, is_shown in zip(pairs, shows_enough, strict=True) if is_shown]
    if len(usable) < FEWEST_VIEWS:
        raise ValueError(
            f"both cameras must see the same {FEWEST_CORNERS} corners or more, not in one line, in {FEWEST_VIEWS} "
            f"pairs of pictures or more; they do in {len(usable)} of {len(pairs)}."
        )
    points, pixels_1, pixels_2 = ([part.astype(np.float32) for part in parts] for parts in zip(*usable, strict=True))
    (K_1, lens_1), (K_2, lens_2) = intrinsics
    rms_px, *_, R, t, _, _ = cv2.stereoCalibrate(
        points, pixels_1, pixels_2, K_1, lens_1, K_2, lens_2, image_size,
        flags=cv2.CALIB_FIX_INTRINSIC, criteria=_UNTIL,
    )  # fmt: skip
    t = np.asarray(t, float).ravel()
    cameras = [Calibration(K, lens, np.eye(3), np.zeros(3), 0.0) for K, lens in intrinsics]
    fundamental = _fundamental(K_1, K_2, R, t)
    errors = [
        epipolar_rms(fundamental, cameras[0].undistort(u), cameras[1].undistort(v)) if is_shown else np.nan
        for (_, u, v), is_shown in zip(pairs, shows_enough, strict=True)
    ]
    return StereoPose(np.asarray(R, float), t, float(rms_px), np.asarray(errors))


def epipolar_rms(
    fundamental: Float[np.ndarray, "3 3"], first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]
) -> float:
    """Root mean square distance, pixels, of points from the epipolar lines of their partners, both ways.

    The line of `x` in the second image is `F x`, that of `x'` in the first `F^T x'` (Hartley & Zisserman, 9.2).
    """
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (first, second))
    lines_2, lines_1 = a @ fundamental.T, b @ fundamental
    product = np.sum(b * lines_2, axis=1)
    squares = product**2 * (1 / np.sum(lines_2[:, :2] ** 2, axis=1) + 1 / np.sum(lines_1[:, :2] ** 2, axis=1))
    return float(np.sqrt(0.5 * squares.mean()))


def _fundamental(K_1: np.ndarray, K_2: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    x, y, z = t
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(K_2).T @ cross @ R @ np.linalg.inv(K_1)


def _shared(first: BoardView, second: BoardView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (n, 3) that both views show, and their pixels (n, 2) in either."""
    apart = np.abs(first.points_m[:, None] - second.points_m).max(axis=-1)
    i, j = np.nonzero(apart < _SAME_CORNER)
    return first.points_m[i], first.pixels[i], second.pixels[j]
