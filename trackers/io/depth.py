"""Depth recordings on disk: folders of PNG images and `.npz` files, read one frame at a time."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.hand_depth.recording import DepthSequence
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.frame_numbers import frames_of, times_of
from jaxfilters.trackers.io.images import check_num_pixels, read_image
from jaxfilters.trackers.io.input_files import LARGEST, check_rate, exists, is_folder, too_large
from jaxfilters.trackers.io.json_files import check_intrinsics, read_json, refuse_unknown
from jaxfilters.trackers.io.npz import ArrayStream, names_in_npz, read_npz
from jaxfilters.trackers.io.video_input import DEFAULT_FPS

_CAMERA_KEYS = {"fx", "fy", "cx", "cy", "K", "depth_scale", "timestamps_us", "fps"}


def open_depth(path: str | Path, *, fps: float | None = None) -> DepthSequence:
    """Open a folder of 16-bit PNGs with `camera.json`, or an `.npz` with `depth_mm` and `K`.

    Frames stay on disk until they are asked for; times and shapes are checked at once.

    Args:
        path: the folder or file.
        fps: frames per second, in place of the times and the rate that the recording has; frames that the names of
            images number keep their gaps. `None` is what the recording says, and 30 where it says nothing.

    Raises:
        InputError: missing or wrong intrinsics, shapes, types or times, or an unreadable file.
    """
    path = Path(path)
    if fps is not None:
        check_rate(fps)
    if not exists(path):
        raise InputError(f"{path}: no such file or folder.")
    if is_folder(path):
        return _open_folder(path, fps)
    if path.suffix == ".npz":
        return _open_npz(path, fps)
    raise InputError(f"{path}: expected a folder of PNG images or an .npz file, got suffix {path.suffix!r}.")


def _camera(K: Any, shape: tuple[int, int], name: str) -> Pinhole:
    try:
        camera = Pinhole.from_matrix(K, shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {shortened(str(error), 160)}") from None
    check_intrinsics(np.asarray(K, float), name)
    return camera


def _metres(raw: np.ndarray, units_per_metre: float) -> np.ndarray:
    return np.where(raw > 0, raw.astype(np.float32) / np.float32(units_per_metre), np.float32(np.nan))


def _open_folder(folder: Path, fps: float | None) -> DepthSequence:
    files = sorted(folder.glob("*.png"), key=_frame_order)
    if not files:
        raise InputError(f"{folder}: no PNG images in it.")
    settings = _read_camera_json(folder / "camera.json")
    scale = settings.get("depth_scale", 1000.0)
    if not isinstance(scale, int | float) or not 1 / LARGEST <= scale <= LARGEST:
        raise InputError(f"{folder / 'camera.json'}: depth_scale must be positive units per metre; got {shown(scale)}.")
    shape = _read_png(files[0], None).shape

    def read(index: int) -> np.ndarray:
        return _metres(_read_png(files[index], shape), float(scale))

    times_s = _folder_times(files, settings, fps, folder)
    return DepthSequence(_camera(_matrix(settings, folder), shape, str(folder)), times_s, read, str(folder))


def _frame_order(file: Path) -> tuple[int, str]:
    return (int(file.stem), "") if file.stem.isdecimal() else (0, file.name)


def _read_camera_json(file: Path) -> dict[str, Any]:
    wanted = 'expected {"fx", "fy", "cx", "cy"} or {"K"}, in pixels'
    if not exists(file):
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


def _folder_times(files: list[Path], settings: dict[str, Any], fps: float | None, folder: Path) -> np.ndarray:
    numbers = np.arange(len(files), dtype=np.float64)
    if all(file.stem.isdecimal() for file in files):
        numbers = np.asarray([int(file.stem) for file in files], np.float64)
    if fps is not None:
        return frames_of(numbers) / fps
    if "timestamps_us" in settings:
        return _from_microseconds(settings["timestamps_us"], len(files), f"{folder / 'camera.json'}: timestamps_us")
    rate = settings.get("fps", DEFAULT_FPS)
    if not isinstance(rate, int | float) or not 1 / LARGEST <= rate <= LARGEST:
        raise InputError(f"{folder / 'camera.json'}: fps must be positive; got {shown(rate)}.")
    return times_of(numbers, float(rate))


def _from_microseconds(times: Any, frames: int, name: str) -> np.ndarray:
    try:
        times_us = np.asarray(times, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: expected {frames} numbers (microseconds).") from None
    if times_us.shape != (frames,):
        raise InputError(f"{name}: expected {frames} times, one a frame; got shape {times_us.shape}.")
    return times_us * 1e-6


def _read_png(file: Path, shape: tuple[int, int] | None) -> np.ndarray:
    image = read_image(file, as_it_is=True)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(f"{file}: expected one 16-bit channel; got shape {image.shape}, {image.dtype}.")
    if shape is not None and image.shape != shape:
        raise InputError(f"{file}: expected {shape} pixels like the first image; got {image.shape}.")
    return image


def _open_npz(file: Path, fps: float | None) -> DepthSequence:
    wanted = "expected depth_mm (T, H, W) uint16 and K (3, 3)"
    if missing := {"depth_mm", "K"} - set(names_in_npz(file, wanted)):
        raise InputError(f"{file}: {sorted(missing)} missing; {wanted}.")
    small = read_npz(file, wanted, ("K", "t_us", "joints_mm"))
    depth = ArrayStream(file, "depth_mm", wanted)
    shape, fortran_order, dtype = depth.header
    if len(shape) != 3 or dtype != np.uint16 or fortran_order:
        order = " in Fortran order" if fortran_order else ""
        raise InputError(f"{file}: depth_mm must be (T, H, W) uint16; got {shape} {dtype}{order}.")
    frames, rows, cols = shape
    if not rows * cols:
        raise InputError(f"{file}: depth_mm must be (T, H, W) uint16; got {shape}, without pixels.")
    check_num_pixels(cols, rows, f"{file}: depth_mm")
    times_s = np.arange(frames) / (fps or DEFAULT_FPS)
    if fps is None and "t_us" in small:
        times_s = _from_microseconds(small["t_us"], frames, f"{file}: t_us")
    joints = small.get("joints_mm")
    if joints is not None and (joints.dtype.kind not in "fiu" or too_large(joints).any()):
        raise InputError(f"{file}: joints_mm must be finite numbers or NaN; got {joints.dtype}.")
    joints = None if joints is None else joints.astype(np.float32) / 1000
    camera = _camera(small["K"], (rows, cols), str(file))
    return DepthSequence(camera, times_s, lambda i: _metres(depth.read(i), 1000.0), str(file), joints)
