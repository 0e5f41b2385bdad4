"""Cameras from pictures of a ChArUco board: intrinsics from several, the floor from one of a board that lies on it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfilters.models.calibration import Calibration, calibrate_pose
from jaxfilters.models.calibration_errors import standard_deviations

FEWEST_CORNERS = 6
"""Of a board that counts as observed."""
FEWEST_VIEWS = 3
"""Of intrinsics that are not guessed."""
MOST_OPEN_FOCAL = 0.02
"""Standard deviation of a focal length that is known, as a share of it."""
_LEAST_NOISE_PX = 0.1
"""Standard deviation of a coordinate of a corner, at best."""
_SAME_VIEW_PX = 1.0
"""Root mean square distance of the corners of a board that was not moved."""
_NUM_INTRINSICS = 9
"""fx, fy, cx, cy, k1, k2, p1, p2, k3, in OpenCV's order."""
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
        ValueError: too few usable views of a board that was moved in between; views that leave the focal length open,
            as those of boards that all face the camera do; or a lens that would map two directions to one pixel.
    """
    usable = _moved([view for view in views if is_usable(view)])
    if len(usable) < FEWEST_VIEWS:
        raise ValueError(
            f"views must show {FEWEST_CORNERS} corners or more, not in one line, in {FEWEST_VIEWS} pictures or more, "
            f"with the board moved in between; {len(usable)} of {len(views)} do (are the squares, the sizes and the "
            "dictionary those of the board?)."
        )
    num_free = _NUM_INTRINSICS
    rms_px, K, distortion, poses = _least_squares(usable, image_size, 0)
    if not _is_monotone(K, distortion, image_size):
        # A few pictures bend k3 with their noise, so that the lens folds at the rim of the image.
        num_free -= 1
        rms_px, K, distortion, poses = _least_squares(usable, image_size, cv2.CALIB_FIX_K3)
    _check_focal(usable, K, distortion, poses, num_free)
    if not _is_monotone(K, distortion, image_size):
        raise ValueError(
            f"views fit only a lens, k1 and k2 = {distortion[0]:.3g} and {distortion[1]:.3g}, that maps two directions "
            f"to one pixel of the image, {image_size[0]}x{image_size[1]}; hold the board near its corners as well."
        )
    return K, distortion, rms_px


def calibrate_on_floor(view: BoardView, K: np.ndarray, distortion: np.ndarray) -> Calibration:
    """A camera over a board that lies on the floor: the origin is the board's first corner, X along its columns.

    Args:
        view: The board on the floor, observed by the camera where it stands.
        K: (3, 3) intrinsics.
        distortion: (5,) k1, k2, p1, p2, k3.

    Raises:
        ValueError: too little of the board is visible, or the camera would be below the floor.
    """
    if not is_usable(view):
        raise ValueError(
            f"view must show {FEWEST_CORNERS} corners or more of the board on the floor, not in one line; "
            f"got {len(view.pixels)}."
        )
    return calibrate_pose(view.points_m @ _UPWARDS, view.pixels, K, distortion)


def is_usable(view: BoardView) -> bool:
    """Whether a view shows enough corners, and not all in one line."""
    if len(view.pixels) < FEWEST_CORNERS:
        return False
    extents = np.linalg.svd(view.points_m - view.points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 1e-2 * extents[0])


def _moved(views: Sequence[BoardView]) -> list[BoardView]:
    """Views without those that show the board where an earlier one does: with the same noise, they add nothing."""
    kept: list[BoardView] = []
    for view in views:
        if not any(_is_same(view, other) for other in kept):
            kept.append(view)
    return kept


def _is_same(view: BoardView, other: BoardView) -> bool:
    if not np.array_equal(view.points_m, other.points_m):
        return False
    return bool(np.sqrt(((view.pixels - other.pixels) ** 2).sum(axis=1).mean()) < _SAME_VIEW_PX)


def _least_squares(
    views: Sequence[BoardView], image_size: tuple[int, int], flags: int
) -> tuple[float, np.ndarray, np.ndarray, list[Any]]:
    """`(rms_px, K, distortion, poses)`, the poses as rotation vectors and translations of the board in each view."""
    points = [view.points_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    rms_px, K, lens, *poses = cv2.calibrateCamera(points, pixels, image_size, np.eye(3), np.zeros(5), flags=flags)
    return float(rms_px), K, np.asarray(lens, float).ravel()[:5], poses


def _check_focal(
    views: Sequence[BoardView], K: np.ndarray, distortion: np.ndarray, poses: Sequence[Any], num_free: int
) -> None:
    """Raise `ValueError` where views leave the focal lengths open.

    Args:
        views: What was calibrated with.
        K: (3, 3) intrinsics that were found.
        distortion: (5,) k1, k2, p1, p2, k3.
        poses: As `_least_squares` gives them.
        num_free: How many of the intrinsics were searched for.
    """
    ends = np.cumsum([0, *(2 * len(view.pixels) for view in views)])
    slopes, errors = np.zeros((ends[-1], num_free + 6 * len(views))), np.zeros(ends[-1])
    for i, (view, turn, t) in enumerate(zip(views, *poses, strict=True)):
        projected, derivatives = cv2.projectPoints(view.points_m, turn, t, K, distortion)
        rows = slice(ends[i], ends[i + 1])
        slopes[rows, :num_free] = derivatives[:, 6 : 6 + num_free]
        slopes[rows, num_free + 6 * i : num_free + 6 * (i + 1)] = derivatives[:, :6]
        errors[rows] = (projected.reshape(-1, 2) - view.pixels).ravel()
    logarithms = np.zeros((slopes.shape[1], 2))
    logarithms[[0, 1], [0, 1]] = 1 / K[[0, 1], [0, 1]]
    deviation = standard_deviations(slopes, errors, logarithms, least_noise_px=_LEAST_NOISE_PX).max()
    if not deviation <= MOST_OPEN_FOCAL:
        raise ValueError(
            f"views leave the focal length open: {K[0, 0]:.4g} px with a standard deviation of {deviation:.2g} of it; "
            f"expected at most {MOST_OPEN_FOCAL:g}. Take more pictures, with the board tilted by 30 degrees or more to "
            "different sides and so near that it fills much of the image."
        )


def _is_monotone(K: np.ndarray, distortion: np.ndarray, image_size: tuple[int, int]) -> bool:
    """Whether directions farther from the axis lie farther from the principal point, all over the image."""
    k1, k2, _, _, k3 = distortion
    corners = np.array([[u, v] for u in (-0.5, image_size[0] - 0.5) for v in (-0.5, image_size[1] - 0.5)])
    rim = np.linalg.norm((corners - K[:2, 2]) / K[[0, 1], [0, 1]], axis=1).max()
    turns = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
    turns = turns[(np.abs(turns.imag) < 1e-12 * np.abs(turns)) & (turns.real > 0)].real
    if not len(turns):
        return True
    r2 = turns.min()
    return bool(np.sqrt(r2) * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) > rim)
