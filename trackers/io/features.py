"""Recordings of features on disk: `.npz` files of features or keypoints; what detectors of hands write is passed on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.articulated.recording import (
    FeatureSequence,
    Start,
    features_named,
    from_keypoints,
    looks_normalized,
)
from jaxfilters.trackers.io import keypoints as keypoint_files
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.images import check_num_pixels
from jaxfilters.trackers.io.input_files import LARGEST, are_finite, check_rate, exists, is_folder, too_large
from jaxfilters.trackers.io.npz import names_in_npz, read_npz

FPS = 30.0
"""Frames per second where neither the recording nor the user says."""
_NAMES = (
    *("features", "names", "mask", "noise_std", "keypoints", "confidence", "noise_px", "t_s", "t_us", "fps"),
    *("image_shape", "start_mean", "start_covariance", "truth_states"),
)


def open_features(
    path: str | Path,
    *,
    hand: str = "right",
    image_size: tuple[int, int] | None = None,
    noise_px: float | None = None,
    fps: float | None = None,
) -> FeatureSequence:
    """Open an `.npz` of features or keypoints, or what OpenPose (a folder) or MediaPipe (`.json`, `.csv`) detected.

    Args:
        path: The folder or file.
        hand: `right` or `left`, where detections have both.
        image_size: Width and height of the image in pixels; scales coordinates from 0 to 1.
        noise_px: Standard deviation of a keypoint's coordinate at full confidence; goes before what the file says.
        fps: Frames per second where the recording carries no times.

    Raises:
        InputError: an unreadable file, wrong names, shapes, times or noise, or nothing measured.
    """
    path = Path(path)
    if not exists(path):
        raise InputError(f"{path}: no such file or folder.")
    if fps is not None:
        check_rate(fps)
    shape = None if image_size is None else (image_size[1], image_size[0])
    if path.suffix == ".npz" and not is_folder(path):
        return _open_npz(path, shape, noise_px, fps)
    detections = keypoint_files.read(path, hand, fps or FPS)
    points = detections.points
    if looks_normalized(points):
        if image_size is None:
            raise InputError(
                f"{path}: its coordinates lie within {np.nanmin(points):.3g} and {np.nanmax(points):.3g}, shares of "
                "the image instead of pixels; say how large that was with --image-size WIDTHxHEIGHT."
            )
        points = points * np.asarray(image_size, float)
    return from_keypoints(
        detections.times_s,
        points,
        str(path),
        confidence=detections.confidence,
        noise_px=noise_px,
        image_shape=shape,
    )


def _open_npz(
    file: Path, image_shape: tuple[int, int] | None, noise_px: float | None, fps: float | None
) -> FeatureSequence:
    arrays, present = _read(file)
    image_shape = image_shape or _image_shape(arrays, file)
    if "features" in arrays:
        if noise_px is not None:
            raise InputError(f"{file}: --noise is for keypoints; features have their own noise_std.")
        return _features(file, arrays, image_shape, fps)
    if "keypoints" not in arrays:
        raise InputError(
            f"{file}: expected features (T, rows) with names and noise_std, or keypoints (T, 21, 2); "
            f"got {shortened(', '.join(present)) or 'nothing'}."
        )
    points = _numbers(file, arrays, "keypoints")
    if points.ndim != 3:
        raise InputError(f"{file}: keypoints must be (T, 21, 2); got {points.shape}.")
    if noise_px is None and "noise_px" in arrays:
        noise_px = _scalar(file, arrays, "noise_px")
    confidence = _numbers(file, arrays, "confidence") if "confidence" in arrays else None
    times_s = _times(file, arrays, len(points), fps)
    sequence = from_keypoints(
        times_s, points, str(file), confidence=confidence, noise_px=noise_px, image_shape=image_shape
    )
    return replace(sequence, start=_start(file, arrays), truth=_truth(file, arrays))


def _features(
    file: Path, arrays: dict[str, np.ndarray], image_shape: tuple[int, int] | None, fps: float | None
) -> FeatureSequence:
    if missing := [name for name in ("names", "noise_std") if name not in arrays]:
        raise InputError(f"{file}: {missing} missing; features (T, rows) need names (rows,) and noise_std.")
    y = _numbers(file, arrays, "features")
    if y.ndim != 2 or arrays["names"].shape != y.shape[1:]:
        raise InputError(
            f"{file}: features must be (T, rows) and names (rows,); got {y.shape} and {arrays['names'].shape}."
        )
    num_fingers, features, places = features_named([str(name) for name in arrays["names"]], str(file))
    if "mask" in arrays:
        mask = arrays["mask"]
        if mask.shape != y.shape or mask.dtype != np.bool_:
            raise InputError(f"{file}: mask must be {y.shape} bool; got {mask.shape} {mask.dtype}.")
        y = np.where(mask, y, np.nan)
    std = _numbers(file, arrays, "noise_std")
    if std.shape not in (y.shape, y.shape[1:]):
        raise InputError(f"{file}: noise_std must be {y.shape[1:]} or {y.shape}; got {std.shape}.")
    return FeatureSequence(
        num_fingers=num_fingers,
        features=features,
        times_s=_times(file, arrays, len(y), fps),
        y=y[:, places],
        std=np.broadcast_to(std, y.shape)[:, places],
        name=str(file),
        image_shape=image_shape,
        start=_start(file, arrays),
        truth=_truth(file, arrays),
    )


def _read(file: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays that mean something here, and the names of all."""
    wanted = "expected an .npz with keypoints (T, 21, 2) or features (T, rows)"
    return read_npz(file, wanted, _NAMES), names_in_npz(file, wanted)


def _numbers(file: Path, arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    if not np.issubdtype(arrays[name].dtype, np.number) or np.iscomplexobj(arrays[name]):
        raise InputError(f"{file}: {name} must be numbers; got {arrays[name].dtype}.")
    numbers = arrays[name].astype(np.float64)
    if too_large(numbers[np.isfinite(numbers)]).any():
        raise InputError(f"{file}: {name} must be numbers of at most {LARGEST:g}.")
    return numbers


def _scalar(file: Path, arrays: dict[str, np.ndarray], name: str) -> float:
    value = _numbers(file, arrays, name)
    if value.size != 1:
        raise InputError(f"{file}: {name} must be one number; got shape {value.shape}.")
    return float(value.reshape(()))


def _times(file: Path, arrays: dict[str, np.ndarray], frames: int, fps: float | None) -> np.ndarray:
    for name, seconds in (("t_s", 1.0), ("t_us", 1e-6)):
        if name in arrays:
            times = _numbers(file, arrays, name)
            if times.shape != (frames,):
                raise InputError(f"{file}: {name}: expected {frames} times, one a frame; got shape {times.shape}.")
            return times * seconds
    fps = _scalar(file, arrays, "fps") if "fps" in arrays else fps or FPS
    if not 1 / LARGEST <= fps <= LARGEST:
        raise InputError(f"{file}: fps must be positive; got {fps}.")
    return np.arange(frames) / fps


def _image_shape(arrays: dict[str, np.ndarray], file: Path) -> tuple[int, int] | None:
    if "image_shape" not in arrays:
        return None
    shape = _numbers(file, arrays, "image_shape")
    if shape.shape != (2,) or not (are_finite(shape) and (shape >= 1).all()):
        raise InputError(f"{file}: image_shape must be rows and columns, positive; got {shown(shape.tolist())}.")
    check_num_pixels(int(shape[1]), int(shape[0]), f"{file}: image_shape")
    return int(shape[0]), int(shape[1])


def _start(file: Path, arrays: dict[str, np.ndarray]) -> Start | None:
    given = [name for name in ("start_mean", "start_covariance") if name in arrays]
    if len(given) == 1:
        raise InputError(
            f"{file}: start_mean (n,) and start_covariance (n, n) belong together; only {given[0]} is there."
        )
    return Start(*(_numbers(file, arrays, name) for name in given)) if given else None


def _truth(file: Path, arrays: dict[str, np.ndarray]) -> Any:
    return _numbers(file, arrays, "truth_states") if "truth_states" in arrays else None
