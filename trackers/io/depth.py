"""Depth recordings on disk: folders of PNG images and `.npz` files, read one frame at a time."""

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth.recording import DepthSequence
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.images import check_pixels
from jaxfilters.trackers.io.json_files import read_json, refuse_unknown
from jaxfilters.trackers.io.npz import names_in_npz, read_array_header, read_npz

_CAMERA_KEYS = {"fx", "fy", "cx", "cy", "K", "depth_scale", "timestamps_us", "fps"}
_SHORTEST_STEP_US = 1000
"""Numeric file names that step by less are frame numbers, not microseconds: no depth camera runs at 1 kHz."""


def open_depth(path: str | Path, *, fps: float = 30.0) -> DepthSequence:
    """Open a folder of 16-bit PNGs with `camera.json`, or an `.npz` with `depth_mm` and `K`.

    Frames stay on disk until they are asked for; times and shapes are checked at once.

    Args:
        path: the folder or file.
        fps: frames per second where the recording carries no times.

    Raises:
        InputError: missing or wrong intrinsics, shapes, types or times, or an unreadable file.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    if path.is_dir():
        return _open_folder(path, fps)
    if path.suffix == ".npz":
        return _open_npz(path, fps)
    raise InputError(f"{path}: expected a folder of PNG images or an .npz file, got suffix {path.suffix!r}.")


def _camera(K: Any, shape: tuple[int, int], name: str) -> Pinhole:
    try:
        return Pinhole.from_matrix(K, shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {error}") from None


def _metres(raw: np.ndarray, units_per_metre: float) -> np.ndarray:
    return np.where(raw > 0, raw.astype(np.float32) / np.float32(units_per_metre), np.float32(np.nan))


def _open_folder(folder: Path, fps: float) -> DepthSequence:
    files = sorted(folder.glob("*.png"), key=_frame_order)
    if not files:
        raise InputError(f"{folder}: no PNG images in it.")
    settings = _read_camera_json(folder / "camera.json")
    scale = settings.get("depth_scale", 1000.0)
    if not isinstance(scale, int | float) or not 0 < scale < np.inf:
        raise InputError(f"{folder / 'camera.json'}: depth_scale must be positive units per metre; got {scale!r}.")
    shape = _read_png(files[0], None).shape

    def read(index: int) -> np.ndarray:
        return _metres(_read_png(files[index], shape), float(scale))

    times_s = _folder_times(files, settings, fps, folder)
    return DepthSequence(_camera(_matrix(settings, folder), shape, str(folder)), times_s, read, str(folder))


def _frame_order(file: Path) -> tuple[int, str]:
    return (int(file.stem), "") if file.stem.isdecimal() else (0, file.name)


def _read_camera_json(file: Path) -> dict[str, Any]:
    wanted = 'expected {"fx", "fy", "cx", "cy"} or {"K"}, in pixels'
    if not file.exists():
        raise InputError(f"{file}: missing; {wanted}.")
    settings = read_json(file, wanted)
    refuse_unknown(settings, _CAMERA_KEYS, file)
    return settings


def _matrix(settings: dict[str, Any], folder: Path) -> Any:
    if "K" in settings:
        return settings["K"]
    if missing := {"fx", "fy", "cx", "cy"} - set(settings):
        raise InputError(f"{folder / 'camera.json'}: intrinsics missing: {sorted(missing)} (or K).")
    fx, fy, cx, cy = (settings[name] for name in ("fx", "fy", "cx", "cy"))
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


def _folder_times(files: list[Path], settings: dict[str, Any], fps: float, folder: Path) -> np.ndarray:
    if "timestamps_us" in settings:
        return _from_microseconds(settings["timestamps_us"], len(files), f"{folder / 'camera.json'}: timestamps_us")
    fps = settings.get("fps", fps)
    if not isinstance(fps, int | float) or not 0 < fps < np.inf:
        raise InputError(f"{folder / 'camera.json'}: fps must be positive; got {fps!r}.")
    if not all(file.stem.isdecimal() for file in files):
        return np.arange(len(files)) / fps
    numbers = np.asarray([int(file.stem) for file in files], np.float64)
    in_microseconds = len(files) > 1 and np.median(np.diff(numbers)) >= _SHORTEST_STEP_US
    return numbers * 1e-6 if in_microseconds else numbers / fps


def _from_microseconds(times: Any, frames: int, name: str) -> np.ndarray:
    try:
        times_us = np.asarray(times, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected {frames} numbers (microseconds).") from None
    if times_us.shape != (frames,):
        raise InputError(f"{name}: expected {frames} times, one a frame; got shape {times_us.shape}.")
    return times_us * 1e-6


def _read_png(file: Path, shape: tuple[int, int] | None) -> np.ndarray:
    try:
        encoded = np.fromfile(file, np.uint8)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}).") from None
    check_pixels(encoded, file)
    image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
    if image is None:
        raise InputError(f"{file}: not a complete PNG image (truncated or damaged).")
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(f"{file}: expected one 16-bit channel; got shape {image.shape}, {image.dtype}.")
    if shape is not None and image.shape != shape:
        raise InputError(f"{file}: expected {shape} pixels like the first image; got {image.shape}.")
    return image


def _open_npz(file: Path, fps: float) -> DepthSequence:
    wanted = "expected depth_mm (T, H, W) uint16 and K (3, 3)"
    if missing := {"depth_mm", "K"} - set(names_in_npz(file, wanted)):
        raise InputError(f"{file}: {sorted(missing)} missing; {wanted}.")
    small = read_npz(file, wanted, ("K", "t_us", "joints_mm"))
    depth = _NpzFrames(file)
    frames, rows, cols = depth.shape
    times_s = _from_microseconds(small["t_us"], frames, f"{file}: t_us") if "t_us" in small else np.arange(frames) / fps
    joints = small["joints_mm"].astype(np.float32) / 1000 if "joints_mm" in small else None
    camera = _camera(small["K"], (rows, cols), str(file))
    return DepthSequence(camera, times_s, lambda i: _metres(depth.read(i), 1000.0), str(file), joints)


class _NpzFrames:
    """Frames of the compressed `depth_mm` of an `.npz`, without holding the whole array.

    Reading forward continues in the open stream; only a step back starts decompression anew.
    """

    def __init__(self, file: Path):
        self._file = file
        archive = zipfile.ZipFile(file)
        size = archive.getinfo("depth_mm.npy").file_size
        self._stream = archive.open("depth_mm.npy")
        try:
            self.shape, fortran_order, dtype = read_array_header(self._stream)
        except (ValueError, EOFError) as error:
            raise InputError(f"{file}: depth_mm is not a NumPy array ({error}).") from None
        if len(self.shape) != 3 or dtype != np.uint16 or fortran_order:
            order = " in Fortran order" if fortran_order else ""
            raise InputError(f"{file}: depth_mm must be (T, H, W) uint16; got {self.shape} {dtype}{order}.")
        self._dtype, self._first_byte = dtype, self._stream.tell()
        if self._first_byte + 2 * math.prod(self.shape) != size:
            raise InputError(f"{file}: depth_mm claims shape {self.shape}, and holds {size} bytes.")

    def read(self, index: int) -> np.ndarray:
        size = self.shape[1] * self.shape[2] * self._dtype.itemsize
        try:
            self._stream.seek(self._first_byte + index * size)
            content = self._stream.read(size)
        except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{self._file}: frame {index} of depth_mm is damaged ({error}).") from None
        if len(content) != size:
            raise InputError(f"{self._file}: depth_mm ends inside frame {index}.")
        return np.frombuffer(content, self._dtype).reshape(self.shape[1:])
