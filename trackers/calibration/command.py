"""`jaxfilters calibrate`: where fixed cameras stand, from points, from pictures of a board, or from Tsai's XML."""

import argparse
import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxfilters.models.calibration import (
    FEWEST_POINTS,
    Calibration,
    calibrate_floor,
    calibrate_points,
    calibrate_pose,
    floor_errors_m,
    is_flat,
)
from jaxfilters.models.calibration_board import (
    calibrate_intrinsics,
    calibrate_on_floor,
    charuco_board,
    detect_board,
)
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.tsai import calibration_of_tsai
from jaxfilters.trackers.calibration.stereo import calibrate_rig
from jaxfilters.trackers.io.cameras import open_intrinsics, read_tsai, write_calibration, write_camera
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.images import read_image

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
    points_m, pixels, lines = _read_points(options.file)
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
        K, distortion, size = open_intrinsics(options.intrinsics)
        if size != options.image_size:
            raise ValueError(f"{options.intrinsics} is for images of {size[0]}x{size[1]}; got {options.image_size}.")
        return calibrate_pose(points_m, pixels, K, distortion), "the pose, with the intrinsics that were given"
    if len(points_m) >= 4 and is_flat(points_m):
        if options.distortion:
            raise ValueError("points in one plane do not show distortion; add points at other heights, or use a board.")
        how = "pose and focal length (all points lie in one plane: square pixels about the image's centre are assumed)"
        return calibrate_floor(points_m, pixels, options.image_size), how
    if len(points_m) < FEWEST_POINTS:
        raise ValueError(f"{FEWEST_POINTS} points or more are needed, or 4 in one plane; got {len(points_m)}.")
    coefficients = 0
    if options.distortion:
        coefficients = 5 if len(points_m) >= _MANY_POINTS else _FEW_COEFFICIENTS
    how = "pose and intrinsics" + (f", {coefficients} coefficients of distortion" if coefficients else "")
    return calibrate_points(points_m, pixels, coefficients=coefficients), how


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray, list[int]]:
    wanted = f"expected a header {','.join(_COLUMNS)} and numbers"
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            header = [name.strip() for name in reader.fieldnames or []]
            if header != list(_COLUMNS):
                raise InputError(f"{path}: {wanted}; the header is {','.join(header)!r}.")
            reader.fieldnames = header
            numbered = [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: no CSV ({error}); {wanted}.") from None
    values = np.array([_numbers(row, f"{path}: line {line}") for line, row in numbered]).reshape(-1, len(_COLUMNS))
    return values[:, :3], values[:, 3:], [line for line, _ in numbered]


def _numbers(row: dict, place: str) -> list[float]:
    try:
        values = [float(row[name]) for name in _COLUMNS]
    except (TypeError, ValueError):
        values = []
    if len(values) != len(_COLUMNS) or not np.isfinite(values).all() or None in row:
        raise InputError(f"{place}: expected five finite numbers; got {list(row.values())}.")
    return values


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
    seen = sum(len(view.pixels) for view in views.values())
    told = [f"intrinsics from {seen} corners in {len(files)} pictures: reprojection error {rms_px:.3f} px"]
    if options.floor is None:
        write_camera(options.out, size, K=K, distortion=distortion, name=options.out.stem)
        told += [
            f"focal length {K[0, 0]:.1f} x {K[1, 1]:.1f} px; where the camera stands is open: give --floor IMAGE of a "
            f"board on the floor, or use `calibrate points --intrinsics {options.out}`",
            f"intrinsics in {options.out}",
        ]
        return "\n".join(told)
    view = views[options.floor]
    calibration = _named(options.floor, lambda: calibrate_on_floor(view, K, distortion))
    options.image_size = size
    points_m = view.points_m * (1, -1, -1)
    return "\n".join(
        [*told, _written(calibration, options, "the pose over the board on the floor", points_m, view.pixels)]
    )


def _from_tsai(options: argparse.Namespace) -> str:
    camera = read_tsai(options.file)
    size = options.image_size or camera.image_size
    options.image_size = size
    calibration, worst_px = _named(options.file, lambda: calibration_of_tsai(camera, size))
    return "\n".join(
        [
            f"Tsai's distortion as OpenCV's coefficients: within {worst_px:.4f} px all over the image",
            _written(calibration, options, "the parameters of the file"),
        ]
    )


def _written(
    calibration: Calibration,
    options: argparse.Namespace,
    how: str,
    points_m: np.ndarray | None = None,
    pixels: np.ndarray | None = None,
    lines: list[int] | None = None,
) -> str:
    """Write the camera and describe it; it is checked as its reader will."""
    cols, rows = options.image_size
    camera = as_input_error(lambda: FloorCamera.from_matrix(calibration.P, (rows, cols)))
    write_calibration(options.out, calibration, (cols, rows), name=options.out.stem)
    x, y, z = np.asarray(camera.position(), float)
    told = [f"camera at ({x:.2f}, {y:.2f}) m, {z:.2f} m above the floor; from {how}"]
    if points_m is not None and pixels is not None:
        told += _errors(calibration, points_m, pixels, lines)
    return "\n".join([*told, f"camera in {options.out}"])


def _errors(calibration: Calibration, points_m: np.ndarray, pixels: np.ndarray, lines: list[int] | None) -> list[str]:
    errors_px = np.linalg.norm(calibration.project(points_m) - pixels, axis=1)
    errors_m = floor_errors_m(calibration, points_m, pixels)
    worst = int(np.argmax(errors_px))
    where = f" (line {lines[worst]})" if lines else ""
    told = [f"reprojection error {calibration.rms_px:.3f} px rms, {errors_px[worst]:.2f} px at worst{where}"]
    seen = errors_m[np.isfinite(errors_m)]
    if len(seen):
        told += [f"floor error {seen.mean():.3f} m on average, {seen.max():.3f} m at worst, in the plane of each point"]
    return told


def _named(path: Path, make: Callable):
    """What `make` returns; what it finds wrong is said of the file."""
    try:
        return make()
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
