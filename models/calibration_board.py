"""Cameras from pictures of a ChArUco board: intrinsics from several, the floor from one of a board that lies on it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfilters.models.calibration import Calibration, calibrate_pose

FEWEST_CORNERS = 6
"""Of a board that counts as observed."""
FEWEST_VIEWS = 3
"""Of intrinsics that are not guessed."""
_UPWARDS = np.diag([1.0, -1.0, -1.0])
"""OpenCV's boards have y down and z into the board; the world has Z up."""


class BoardView(NamedTuple):
    """The corners of the board that one picture shows."""

    points_m: np.ndarray
    """(n, 3) on the board, x to the right, y down, z = 0, metres."""
    pixels: np.ndarray
    """(n, 2)."""


def charuco_board(
    squares: tuple[int, int], square_m: float, marker_m: float, *, dictionary: str = "DICT_4X4_50"
) -> Any:
    """A board of `squares` (columns, rows) with sides of `square_m` and markers of `marker_m`.

    Args:
        squares: Columns and rows, three or more each.
        square_m: Side of a square, metres.
        marker_m: Side of a marker, metres.
        dictionary: Name of the markers in `cv2.aruco`.

    Raises:
        ValueError: sizes that make no board, or an unknown dictionary.
    """
    if min(squares) < 3:
        raise ValueError(f"squares must be three or more each way; got {squares[0]}x{squares[1]}.")
    if not 0 < marker_m < square_m:
        raise ValueError(f"marker_m must be positive and less than square_m = {square_m}; got {marker_m}.")
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
        raise ValueError(f"dictionary must be one of {known}; got {dictionary!r}.")
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    if squares[0] * squares[1] // 2 > len(markers.bytesList):
        raise ValueError(
            f"squares {squares[0]}x{squares[1]} need {squares[0] * squares[1] // 2} markers; {dictionary} has "
            f"{len(markers.bytesList)}."
        )
    return cv2.aruco.CharucoBoard(squares, square_m, marker_m, markers)


def detect_board(image: np.ndarray, board: Any) -> BoardView:
    """What an image (rows, cols) or (rows, cols, 3), uint8, shows of the board; no rows where it is not visible."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    if corners is None or ids is None or len(ids) == 0:
        return BoardView(np.zeros((0, 3)), np.zeros((0, 2)))
    points, pixels = board.matchImagePoints(corners, ids)
    return BoardView(np.asarray(points, float).reshape(-1, 3), np.asarray(pixels, float).reshape(-1, 2))


def calibrate_intrinsics(
    views: Sequence[BoardView], image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, float]:
    """`(K, distortion, rms_px)` from several views of the board (Zhang 2000, with OpenCV's five coefficients).

    Args:
        views: As `detect_board` gave them; those with fewer than `FEWEST_CORNERS` corners are left out.
        image_size: Columns and rows.

    Raises:
        ValueError: too few usable views.
    """
    usable = [view for view in views if _is_usable(view)]
    if len(usable) < FEWEST_VIEWS:
        raise ValueError(
            f"views must show {FEWEST_CORNERS} corners or more, not in one line, in {FEWEST_VIEWS} pictures or more; "
            f"{len(usable)} of {len(views)} do (are the squares, the sizes and the dictionary those of the board?)."
        )
    points = [view.points_m.astype(np.float32) for view in usable]
    pixels = [view.pixels.astype(np.float32) for view in usable]
    guess = np.eye(3)
    rms_px, K, distortion, _, _ = cv2.calibrateCamera(points, pixels, image_size, guess, np.zeros(5))
    return K, np.asarray(distortion).ravel()[:5], float(rms_px)


def calibrate_on_floor(view: BoardView, K: np.ndarray, distortion: np.ndarray) -> Calibration:
    """A camera over a board that lies on the floor: the origin is the board's first corner, X along its columns.

    Args:
        view: The board on the floor, observed by the camera where it stands.
        K: (3, 3) intrinsics.
        distortion: (5,) k1, k2, p1, p2, k3.

    Raises:
        ValueError: too little of the board is visible, or the camera would be below the floor.
    """
    if not _is_usable(view):
        raise ValueError(
            f"view must show {FEWEST_CORNERS} corners or more of the board on the floor, not in one line; "
            f"got {len(view.pixels)}."
        )
    return calibrate_pose(view.points_m @ _UPWARDS, view.pixels, K, distortion)


def _is_usable(view: BoardView) -> bool:
    if len(view.pixels) < FEWEST_CORNERS:
        return False
    extents = np.linalg.svd(view.points_m - view.points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 1e-2 * extents[0])
