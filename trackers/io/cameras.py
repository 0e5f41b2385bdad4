"""Fixed cameras on disk: `camera.json`, and Tsai's parameters as XML."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.calibration import Calibration
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.tsai import TsaiCamera
from jaxfilters.trackers.io.errors import InputError, shown
from jaxfilters.trackers.io.images import check_num_pixels
from jaxfilters.trackers.io.input_files import LARGEST
from jaxfilters.trackers.io.json_files import (
    check_intrinsics,
    image_size_of,
    numbers_of,
    one_entry_a_line,
    read_json,
    refuse_unknown,
    write_json,
)
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.io.xml_files import read_xml

_KEYS = {"name", "note", "image_size", "P", "K", "R", "t", "distortion"}
_WANTED = (
    'expected {"image_size": [columns, rows], "P": 3 x 4} or {"image_size", "K": 3 x 3, "R": 3 x 3, "t": 3}, '
    'in metres with Z up, and {"K", "distortion": [k1, k2, p1, p2, k3]} for images with lens distortion'
)
_ORTHONORMAL = 1e-4
_HIGHEST_M = 200.0
"""Above the floor: no camera shows people from higher up, and one whose lengths are millimetres stands there."""
_USUAL_M = (1.0, 20.0)
"""Heights of cameras, from a tripod to a lamp post or a roof, by which the unit of a file is guessed."""
_UNITS = {"centimetres": 100.0, "millimetres": 1000.0}
_WANTED_XML = "expected XML with Geometry, Intrinsic and Extrinsic, parameters of Tsai's model"


class CameraFile(NamedTuple):
    """A fixed camera as a file describes it."""

    name: str
    camera: FloorCamera
    """World to undistorted pixels."""
    undistortion: Undistortion
    """What makes pixels of the recording undistorted."""


def open_camera(path: str | Path, *, image_size: tuple[int, int] | None = None) -> CameraFile:
    """The camera that a `camera.json` describes.

    Args:
        path: The file.
        image_size: Columns and rows of the images that it is for, if they are known.

    Raises:
        InputError: an unreadable file, unknown or missing entries, matrices of a wrong shape, singular or mirrored
            ones, a camera that stands below the floor or sees none of it, or images of another size.
    """
    path = Path(path)
    settings = read_json(path, _WANTED)
    refuse_unknown(settings, _KEYS, path)
    cols, rows = image_size_of(settings, path)
    if image_size is not None and (cols, rows) != tuple(image_size):
        raise InputError(
            f"{path}: calibrated for images of {cols}x{rows}; got images of {image_size[0]}x{image_size[1]}. "
            "Calibrate for this size, or record at that one."
        )
    K = numbers_of(settings, "K", (3, 3), path)
    if K is not None:
        check_intrinsics(K, path)
    distortion = numbers_of(settings, "distortion", (5,), path)
    if distortion is not None and K is None:
        raise InputError(f"{path}: distortion needs K, the intrinsics of the image with distortion.")
    try:
        camera = FloorCamera.from_matrix(_projection(settings, K, path), (rows, cols))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    _check_height(camera, path)
    name = settings.get("name", path.stem)
    if not isinstance(name, str):
        raise InputError(f"{path}: name must be text; got {shown(name)}.")
    return CameraFile(name, camera, Undistortion((rows, cols), K, distortion))


def open_intrinsics(path: str | Path) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """`(K, distortion, image_size)` of a `camera.json`, which may lack the pose.

    Raises:
        InputError: as `open_camera`, or without K.
    """
    path = Path(path)
    settings = read_json(path, _WANTED)
    refuse_unknown(settings, _KEYS, path)
    image_size = image_size_of(settings, path)
    K, distortion = numbers_of(settings, "K", (3, 3), path), numbers_of(settings, "distortion", (5,), path)
    if K is None:
        raise InputError(f"{path}: K missing, the intrinsics of the camera.")
    check_intrinsics(K, path)
    return K, np.zeros(5) if distortion is None else distortion, image_size


def write_camera(
    path: str | Path,
    image_size: tuple[int, int],
    *,
    P: np.ndarray | None = None,
    K: np.ndarray | None = None,
    distortion: np.ndarray | None = None,
    name: str | None = None,
    note: str | None = None,
) -> None:
    """Write a `camera.json`.

    Args:
        path: The file; its folder is made if need be.
        image_size: Columns and rows.
        P: (3, 4) world in metres to undistorted pixels; without it the file holds intrinsics only.
        K: (3, 3) intrinsics of the image with distortion.
        distortion: (5,) k1, k2, p1, p2, k3.
        name: What the camera is called.
        note: Anything worth knowing.

    Raises:
        OutputError: the file cannot be written.
    """
    arrays = {"P": P, "K": K, "distortion": distortion}
    settings: dict[str, Any] = {} if name is None else {"name": name}
    settings |= {"image_size": [int(size) for size in image_size]}
    settings |= {key: np.asarray(value, float).tolist() for key, value in arrays.items() if value is not None}
    settings |= {} if note is None else {"note": note}
    write_json(path, one_entry_a_line(settings) + "\n")


def write_calibration(path: str | Path, calibration: Calibration, image_size: tuple[int, int], *, name: str) -> None:
    """Write a `camera.json` of a calibration; K and distortion only where there is any.

    Raises:
        OutputError: the file cannot be written.
    """
    note = f"reprojection error {calibration.rms_px:.3g} px" if calibration.rms_px else None
    write_camera(
        path,
        image_size,
        P=calibration.P,
        K=calibration.K,
        distortion=calibration.distortion if calibration.distortion.any() else None,
        name=name,
        note=note,
    )


def read_tsai(path: str | Path) -> TsaiCamera:
    """Parameters of Tsai's model from XML with Geometry, Intrinsic and Extrinsic, as PETS 2009 has it.

    Raises:
        InputError: an unreadable file, or one that lacks a number.
    """
    path = Path(path)
    root = read_xml(path, _WANTED_XML)

    def number(element: str, name: str) -> float:
        found = root.find(element)
        text = None if found is None else found.get(name)
        if text is None:
            raise InputError(f"{path}: {element} {name} missing; {_WANTED_XML}.")
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not abs(value) <= LARGEST:
            raise InputError(f"{path}: {element} {name} must be a finite number; got {shown(text)}.")
        return value

    size = (int(number("Geometry", "width")), int(number("Geometry", "height")))
    if min(size) < 1:
        raise InputError(f"{path}: Geometry width and height must be positive; got {size}.")
    check_num_pixels(*size, f"{path}: Geometry")
    return TsaiCamera(
        image_size=size,
        focal=number("Intrinsic", "focal"),
        kappa1=number("Intrinsic", "kappa1"),
        center=(number("Intrinsic", "cx"), number("Intrinsic", "cy")),
        sx=number("Intrinsic", "sx"),
        pixel=(number("Geometry", "dpx"), number("Geometry", "dpy")),
        translation=(number("Extrinsic", "tx"), number("Extrinsic", "ty"), number("Extrinsic", "tz")),
        rotation=(number("Extrinsic", "rx"), number("Extrinsic", "ry"), number("Extrinsic", "rz")),
    )


def _check_height(camera: FloorCamera, path: Path) -> None:
    """Raise `InputError` for a camera that is finite in double precision only, or stands where none stands."""
    if not np.isfinite(np.asarray(camera.P)).all():
        raise InputError(f"{path}: the projection matrix is not finite in single precision; {_WANTED}.")
    height_m = float(camera.position()[2])
    if not 0 < height_m <= _HIGHEST_M:
        raise InputError(
            f"{path}: the camera stands {height_m:.4g} m above the floor, expected at most {_HIGHEST_M:g} m; P and t "
            f"must be in metres{_likely_unit(height_m)}."
        )


def _likely_unit(height: float) -> str:
    """The question whether lengths are in a smaller unit, of those in which a camera stands at a usual height."""
    low_m, high_m = _USUAL_M
    units = [name for name, of_a_metre in _UNITS.items() if low_m <= height / of_a_metre <= high_m]
    return f" (are they in {' or '.join(units)}?)" if units else ""


def _projection(settings: dict[str, Any], K: np.ndarray | None, path: Path) -> np.ndarray:
    P = numbers_of(settings, "P", (3, 4), path)
    R, t = numbers_of(settings, "R", (3, 3), path), numbers_of(settings, "t", (3,), path)
    if R is not None and (np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0):
        kind = "mirrored" if np.linalg.det(R) < 0 else "not orthonormal"
        raise InputError(f"{path}: R must be a rotation; it is {kind}, det R = {np.linalg.det(R):.4g}.")
    if P is not None and (R is not None or t is not None):
        raise InputError(f"{path}: P says all that R and t say; give one or the other.")
    if P is not None:
        return P
    if K is None or R is None or t is None:
        missing = [key for key in ("K", "R", "t") if key not in settings]
        raise InputError(f"{path}: P missing (or {', '.join(missing)}); {_WANTED}.")
    return K @ np.column_stack([R, t])
