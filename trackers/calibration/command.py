"""`jaxfilters calibrate`: where fixed cameras stand, from points, from pictures of a board, or from Tsai's XML."""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxfilters.models.calibration import (
    FEWEST_FLOOR_POINTS,
    FEWEST_POINTS,
    Calibration,
    calibrate_floor,
    calibrate_points,
    calibrate_pose,
    floor_errors_m,
    is_level,
)
from jaxfilters.models.calibration_board import (
    calibrate_intrinsics,
    calibrate_on_floor,
    charuco_board,
    detect_board,
)
from jaxfilters.models.tsai import calibration_of_tsai
from jaxfilters.trackers.calibration.checked import write_checked
from jaxfilters.trackers.calibration.stereo import calibrate_rig
from jaxfilters.trackers.io.cameras import open_camera, open_intrinsics, read_tsai, write_calibration, write_camera
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.images import read_image
from jaxfilters.trackers.io.tables import exactly, read_table

_COLUMNS = ("x_m", "y_m", "z_m", "u", "v")
_FEW_COEFFICIENTS, _MANY_POINTS = 2, 30
"""k1 and k2 of a handful of points; all five of OpenCV's would bend with their noise."""


def calibrate(options: argparse.Namespace) -> str:
    """Do what `options.source` names, write `options.out`, and say in a few lines how good it is.

    Raises:
        InputError: the input cannot be used.
        OutputError: the camera cannot be written.
    """
    sources: dict[str, Callable[[argparse.Namespace], str]] = {
        "points": _from_points,
        "charuco": _from_boards,
        "tsai": _from_tsai,
        "stereo": calibrate_rig,
    }
    return sources[options.source](options)


def _from_points(options: argparse.Namespace) -> str:
    points_m, pixels, lines = read_room_points(options.file)
    size = options.image_size
    outside = ((pixels < -0.5) | (pixels > np.asarray(size) - 0.5)).any(axis=1)
    if outside.any():
        first = int(np.argmax(outside))
        raise InputError(
            f"{options.file}: line {lines[first]}: pixel ({pixels[first, 0]:g}, {pixels[first, 1]:g}) lies outside "
            f"an image of {size[0]}x{size[1]}."
        )
    calibration, how = _named(options.file, lambda: _camera_of_points(points_m, pixels, options))
    return _written(calibration, options, how, points_m, pixels, lines)


def _camera_of_points(points_m: np.ndarray, pixels: np.ndarray, options: argparse.Namespace) -> tuple[Calibration, str]:
    if options.intrinsics is not None:
        if options.distortion:
            raise ValueError(
                f"--distortion finds what --intrinsics {options.intrinsics} gives; expected one of the two options."
            )
        K, distortion, size = open_intrinsics(options.intrinsics)
        if size != options.image_size:
            raise ValueError(f"{options.intrinsics} is for images of {size[0]}x{size[1]}; got {options.image_size}.")
        return calibrate_pose(points_m, pixels, K, distortion), "the pose, with the intrinsics that were given"
    may_be_floor = len(points_m) >= FEWEST_FLOOR_POINTS and is_level(points_m)
    if len(points_m) < FEWEST_POINTS and not may_be_floor:
        raise ValueError(
            f"{FEWEST_POINTS} points or more are needed, or {FEWEST_FLOOR_POINTS} at one height; got {len(points_m)}."
        )
    coefficients = 0
    if options.distortion:
        coefficients = 5 if len(points_m) >= _MANY_POINTS else _FEW_COEFFICIENTS
    # Heights that differ by centimetres may be errors of the tape. They count where they fix a projection matrix.
    try:
        found = calibrate_points(points_m, pixels, options.image_size, coefficients=coefficients)
        return found, "pose and intrinsics" + (f", {coefficients} coefficients of distortion" if coefficients else "")
    except ValueError:
        if not may_be_floor:
            raise
    if options.distortion:
        raise ValueError(
            "points in one plane, or nearly, do not show distortion; add points at other heights, or use a board."
        )
    how = (
        "pose and focal length (all points are at about one height: square pixels about the image's centre are assumed)"
    )
    return calibrate_floor(points_m, pixels, options.image_size), how


def read_room_points(path: Path) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Places in the room (n, 3), metres, their pixels (n, 2), and the lines of the file (n,) that they are from.

    Raises:
        InputError: a file that cannot be read, another header, or entries that are no finite numbers.
    """
    wanted = f"expected a header {','.join(_COLUMNS)} and numbers"
    table = read_table(path, wanted, exactly(path, wanted, _COLUMNS))
    values = np.stack([table.numbers[name] for name in _COLUMNS], axis=-1)
    return values[:, :3], values[:, 3:], table.lines.tolist()


def _from_boards(options: argparse.Namespace) -> str:
    board = as_input_error(
        lambda: charuco_board(options.squares, options.square_m, options.marker_m, dictionary=options.dictionary)
    )
    files = list(dict.fromkeys([*options.images, *([options.floor] if options.floor else [])]))
    images = {file: read_image(file) for file in files}
    sizes = {file: (image.shape[1], image.shape[0]) for file, image in images.items()}
    size = sizes[files[0]]
    if other := [file for file in files if sizes[file] != size]:
        raise InputError(f"{other[0]}: {sizes[other[0]]} pixels; {files[0]} has {size}. All must be of one camera.")
    views = {file: detect_board(image, board) for file, image in images.items()}
    K, distortion, rms_px = as_input_error(lambda: calibrate_intrinsics(list(views.values()), size))
    corners = sum(len(view.pixels) for view in views.values())
    lines = [f"intrinsics from {corners} corners in {len(files)} pictures: reprojection error {rms_px:.3f} px"]
    if options.floor is None:

        def write(path: Path) -> None:
            write_camera(path, size, K=K, distortion=distortion, name=options.out.stem)

        write_checked(options.out, write, open_intrinsics)
        lines += [
            f"focal length {K[0, 0]:.1f} x {K[1, 1]:.1f} px; where the camera stands is open: give --floor IMAGE of a "
            f"board on the floor, or use `calibrate points --intrinsics {options.out}`",
            f"intrinsics in {options.out}",
        ]
        return "\n".join(lines)
    view = views[options.floor]
    calibration = _named(options.floor, lambda: calibrate_on_floor(view, K, distortion))
    options.image_size = size
    points_m = view.points_m * (1, -1, -1)
    return "\n".join(
        [*lines, _written(calibration, options, "the pose over the board on the floor", points_m, view.pixels)]
    )


def _from_tsai(options: argparse.Namespace) -> str:
    camera = read_tsai(options.file)
    size = options.image_size or camera.image_size
    options.image_size = size
    fit = _named(options.file, lambda: calibration_of_tsai(camera, size))
    where = "all over the image"
    lines: list[str] = []
    if fit.fitted_share < 1:
        where = f"over {fit.fitted_share:.1%} of the image"
        lines = [
            f"warning: kappa1 = {camera.kappa1:g} folds the image onto itself at its border or near it: "
            f"{1 - fit.fitted_share:.1%} of the pixels, those farthest from the centre, have no reliable direction"
        ]
    described = f"Tsai's distortion as OpenCV's coefficients: within {fit.worst_px:.4f} px {where}"
    return "\n".join([described, *lines, _written(fit.calibration, options, "the parameters of the file")])


def _written(
    calibration: Calibration,
    options: argparse.Namespace,
    how: str,
    points_m: np.ndarray | None = None,
    pixels: np.ndarray | None = None,
    lines: list[int] | None = None,
) -> str:
    """Write the camera and describe it."""

    def write(path: Path) -> None:
        write_calibration(path, calibration, options.image_size, name=options.out.stem)

    write_checked(options.out, write, open_camera)
    x, y, z = calibration.position
    described = [f"camera at ({x:.2f}, {y:.2f}) m, {z:.2f} m above the floor; from {how}"]
    if calibration.deviations is not None:
        focal, (x, y, z) = calibration.deviations
        described += [f"standard deviations: focal length {focal:.1%}, position ({x:.2f}, {y:.2f}, {z:.2f}) m"]
    if points_m is not None and pixels is not None:
        described += _errors(calibration, points_m, pixels, lines)
    return "\n".join([*described, f"camera in {options.out}"])


def _errors(calibration: Calibration, points_m: np.ndarray, pixels: np.ndarray, lines: list[int] | None) -> list[str]:
    errors_px = np.linalg.norm(calibration.project(points_m) - pixels, axis=1)
    errors_m = floor_errors_m(calibration, points_m, pixels)
    worst = int(np.argmax(errors_px))
    where = f" (line {lines[worst]})" if lines else ""
    described = [f"reprojection error {calibration.rms_px:.3f} px rms, {errors_px[worst]:.2f} px at worst{where}"]
    known_m = errors_m[np.isfinite(errors_m)]
    if len(known_m):
        mean_m, worst_m = known_m.mean(), known_m.max()
        described += [f"floor error {mean_m:.3f} m on average, {worst_m:.3f} m at worst, in the plane of each point"]
    return described


def _named(path: Path, make: Callable):
    """What `make` returns; what it finds wrong is said of the file."""
    try:
        return make()
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
