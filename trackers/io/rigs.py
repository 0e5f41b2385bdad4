"""Cameras that look at one head together, on disk: `rig.json`.

    {
      "note": "anything worth knowing",
      "cameras": [
        {"name": "left", "image_size": [640, 480],
         "K": [[800, 0, 319.5], [0, 800, 239.5], [0, 0, 1]], "distortion": [-0.2, 0.05, 0, 0, 0],
         "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 0]},
        {"name": "right", ..., "t": [-120, 0, 0]}
      ]
    }

Two cameras or more, in the order in which their images are given. `image_size` is columns and rows, the same for all.
`K` is of the images as they come, without skew; `distortion` is k1, k2, p1, p2, k3 as in OpenCV, and may be left out
where there is none. `R` and `t` lead from the first camera's frame (x right, y down, z forward) into this one's,
`X = R X_first + t`, with `t` in millimetres; the first camera itself has none, or the identity and zeros. `name` and
`note` may be left out.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.io.errors import InputError
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

_KEYS = {"cameras", "note"}
_CAMERA_KEYS = {"name", "image_size", "K", "distortion", "R", "t"}
_WANTED = (
    'expected {"cameras": [{"image_size": [columns, rows], "K": 3 x 3, "distortion": [k1, k2, p1, p2, k3], '
    '"R": 3 x 3, "t": 3 in millimetres}, ...]}, each relative to the first'
)
_ORTHONORMAL = 1e-6
_NEAREST_MM = 1e-6


class RigCamera(NamedTuple):
    """One camera of a rig."""

    name: str
    image_size: tuple[int, int]
    """Columns and rows."""
    K: np.ndarray
    """(3, 3) of the images as they come."""
    distortion: np.ndarray
    """(5,) k1, k2, p1, p2, k3."""
    R: np.ndarray
    """(3, 3) from the first camera's frame into this one's."""
    t_mm: np.ndarray
    """(3,) origin of the first camera's frame in this one's."""


class RigFile(NamedTuple):
    """A rig as a file describes it."""

    cameras: list[RigCamera]
    rig: CameraRig
    """World, the first camera's frame in millimetres, to undistorted pixels."""
    undistortions: list[Undistortion]
    """What makes the pixels of each camera's recording undistorted."""


def open_rig(path: str | Path) -> RigFile:
    """The rig that a `rig.json` describes.

    Raises:
        InputError: an unreadable file, unknown or missing entries, fewer than two cameras, matrices of a wrong shape,
            intrinsics with skew, rotations that are none, two cameras at one place, or images of different sizes; the
            message names the file, the camera and the entry.
    """
    path = Path(path)
    settings = read_json(path, _WANTED)
    refuse_unknown(settings, _KEYS, path)
    listed = settings.get("cameras")
    if not isinstance(listed, list) or len(listed) < 2:
        what = f"{len(listed)}" if isinstance(listed, list) else repr(listed)
        raise InputError(f"{path}: cameras must be a list of two or more; got {what}; {_WANTED}.")
    cameras = [_camera(one, i, f"{path}: cameras[{i}]") for i, one in enumerate(listed)]
    for i, camera in enumerate(cameras[1:], 1):
        _check_beside(camera, i, cameras, path)
    rig = _rig(cameras, path)
    return RigFile(cameras, rig, [Undistortion(rig.shape, one.K, one.distortion) for one in cameras])


def write_rig(path: str | Path, cameras: Sequence[RigCamera], *, note: str | None = None) -> None:
    """Write a `rig.json`.

    Raises:
        OutputError: the file cannot be written.
    """
    entries = [one_entry_a_line(_settings(camera), "    ") for camera in cameras]
    noted = "" if note is None else f'  "note": {json.dumps(note)},\n'
    write_json(path, "{\n" + noted + '  "cameras": [\n' + ",\n".join(entries) + "\n  ]\n}\n")


def _settings(camera: RigCamera) -> dict[str, Any]:
    arrays = {"K": camera.K, "distortion": camera.distortion, "R": camera.R, "t": camera.t_mm}
    return {
        "name": camera.name,
        "image_size": [int(size) for size in camera.image_size],
        **{key: np.asarray(value, float).tolist() for key, value in arrays.items()},
    }


def _camera(settings: Any, index: int, place: str) -> RigCamera:
    if not isinstance(settings, dict):
        raise InputError(f"{place}: {_WANTED}; got {settings!r}.")
    refuse_unknown(settings, _CAMERA_KEYS, place)
    name = settings.get("name", f"camera {index + 1}")
    if not isinstance(name, str):
        raise InputError(f"{place}: name must be text; got {name!r}.")
    image_size = image_size_of(settings, place)
    K = numbers_of(settings, "K", (3, 3), place)
    if K is None:
        raise InputError(f"{place}: K missing, the intrinsics of the camera.")
    check_intrinsics(K, place)
    distortion = numbers_of(settings, "distortion", (5,), place)
    R, t_mm = _pose(settings, index, place)
    return RigCamera(name, image_size, K, np.zeros(5) if distortion is None else distortion, R, t_mm)


def _pose(settings: dict[str, Any], index: int, place: str) -> tuple[np.ndarray, np.ndarray]:
    if index == 0:
        settings = {"R": np.eye(3), "t": np.zeros(3)} | settings
    R, t_mm = numbers_of(settings, "R", (3, 3), place), numbers_of(settings, "t", (3,), place)
    if R is None or t_mm is None:
        raise InputError(f"{place}: {'R' if R is None else 't'} missing; {_WANTED}.")
    determinant = np.linalg.det(R)
    if determinant < 0 or np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL:
        kind = "mirrored" if determinant < 0 else f"not orthonormal to {_ORTHONORMAL:g}"
        raise InputError(f"{place}: R must be a rotation; it is {kind}, det R = {determinant:.6g}.")
    if index == 0 and (np.abs(R - np.eye(3)).max() > _ORTHONORMAL or np.abs(t_mm).max() > _NEAREST_MM):
        raise InputError(
            f"{place}: R and t must be the identity and zeros, or be left out: all cameras are relative to the first."
        )
    return R, t_mm


def _check_beside(camera: RigCamera, index: int, cameras: list[RigCamera], path: Path) -> None:
    """Raise `InputError` where a camera contradicts those before it."""
    place, first = f"{path}: cameras[{index}]", cameras[0]
    if camera.image_size != first.image_size:
        sizes = " and ".join(f"{cols}x{rows}" for cols, rows in (first.image_size, camera.image_size))
        raise InputError(f"{place}: image_size must be that of the first camera; got {sizes}.")
    for i, other in enumerate(cameras[:index]):
        if np.linalg.norm(camera.R.T @ camera.t_mm - other.R.T @ other.t_mm) < _NEAREST_MM:
            raise InputError(f"{place}: t puts it where cameras[{i}] is; the baseline is 0.")


def _rig(cameras: list[RigCamera], path: Path) -> CameraRig:
    try:
        pinholes = [Pinhole.from_matrix(one.K, one.image_size[::-1]) for one in cameras]
        return CameraRig.from_cameras(pinholes, [one.R for one in cameras], [one.t_mm for one in cameras])
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
