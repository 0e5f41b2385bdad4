"""`jaxfilters calibrate stereo`: how two cameras stand to each other, from pictures of a ChArUco board."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.models.calibration_board import BoardView, calibrate_intrinsics, charuco_board, detect_board
from jaxfilters.models.calibration_stereo import StereoPose, calibrate_stereo
from jaxfilters.trackers.calibration.checked import write_checked
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.images import images_in, read_image
from jaxfilters.trackers.io.input_files import is_folder
from jaxfilters.trackers.io.rigs import RigCamera, open_rig, write_rig

WORST_PX = 3.0
"""Epipolar error beyond which there is no rig: landmarks are matched along these lines."""
GOOD_PX = 1.0
"""Epipolar error beyond which registration of a face will fail now and then."""


def calibrate_rig(options: argparse.Namespace) -> str:
    """Write `options.out` from the folders `options.left` and `options.right`, and say how good it is.

    Raises:
        InputError: the pictures cannot be used, or contradict each other.
        OutputError: the rig cannot be written.
    """
    board = as_input_error(
        lambda: charuco_board(options.squares, options.square_m, options.marker_m, dictionary=options.dictionary)
    )
    folders = (options.left, options.right)
    files = [_pictures(folder) for folder in folders]
    if len(files[0]) != len(files[1]):
        raise InputError(
            f"{options.left} and {options.right}: {len(files[0])} and {len(files[1])} pictures; expected one of each "
            "camera for every moment, in the order of their names."
        )
    views, image_size = _views(files, board)
    found = [_intrinsics(folder, own, image_size) for folder, own in zip(folders, views, strict=True)]
    pose = as_input_error(lambda: calibrate_stereo(views[0], views[1], (found[0][:2], found[1][:2]), image_size))
    total = _check_agreement(pose, files)
    poses = [(np.eye(3), np.zeros(3)), (pose.R, 1000 * pose.t)]
    cameras = [
        RigCamera(folder.resolve().name, image_size, K, distortion, R, t_mm)
        for folder, (K, distortion, _), (R, t_mm) in zip(folders, found, poses, strict=True)
    ]
    note = f"reprojection error {pose.rms_px:.3g} px, epipolar error {total:.3g} px"
    write_checked(options.out, lambda path: write_rig(path, cameras, note=note), open_rig)
    return _described(options, pose, total, cameras, [rms for *_, rms in found])


def _pictures(folder: Path) -> list[Path]:
    if not is_folder(folder):
        raise InputError(f"{folder}: no such folder; expected one of pictures of the board.")
    return images_in(folder)


def _views(files: list[list[Path]], board: Any) -> tuple[list[list[BoardView]], tuple[int, int]]:
    """What every picture shows of the board, and the one size that all have."""
    views: list[list[BoardView]] = [[], []]
    first: tuple[int, int] | None = None
    for camera, listed in enumerate(files):
        for file in listed:
            image = read_image(file)
            size = (image.shape[1], image.shape[0])
            first = first or size
            if size != first:
                raise InputError(f"{file}: {size} pixels; {files[0][0]} has {first}. All must be of one size.")
            views[camera].append(detect_board(image, board))
    assert first is not None
    return views, first


def _intrinsics(
    folder: Path, views: list[BoardView], image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, float]:
    try:
        return calibrate_intrinsics(views, image_size)
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from None


def _check_agreement(pose: StereoPose, files: list[list[Path]]) -> float:
    """Epipolar error over all pairs, pixels; raises `InputError` where pictures contradict each other."""
    total = float(np.sqrt(np.nanmean(pose.epipolar_px**2)))
    if total > WORST_PX:
        worst = int(np.nanargmax(pose.epipolar_px))
        left, right = (listed[worst] for listed in files)
        raise InputError(
            f"{left} and {right}: corners lie {pose.epipolar_px[worst]:.1f} px from their epipolar lines, {total:.1f} "
            f"px over all pairs; expected at most {WORST_PX:g}. Were the pictures taken at the same moments, with the "
            "cameras in place, and do their names sort alike?"
        )
    return total


def _described(
    options: argparse.Namespace, pose: StereoPose, total: float, cameras: list[RigCamera], rms_px: list[float]
) -> str:
    used = np.isfinite(pose.epipolar_px)
    lines = [
        f"{camera.name}: focal length {camera.K[0, 0]:.1f} x {camera.K[1, 1]:.1f} px, reprojection error {rms:.3f} px"
        for camera, rms in zip(cameras, rms_px, strict=True)
    ]
    degrees = np.degrees(np.arccos(np.clip(0.5 * (np.trace(pose.R) - 1), -1, 1)))
    lines += [
        f"baseline {1000 * pose.baseline:.1f} mm, cameras turned by {degrees:.2f} degrees; from {used.sum()} of "
        f"{used.size} pairs of pictures",
        f"reprojection error {pose.rms_px:.3f} px over both cameras, epipolar error {total:.3f} px rms, "
        f"{np.nanmax(pose.epipolar_px):.2f} px in the worst pair",
    ]
    if total > GOOD_PX:
        lines.append(f"warning: an epipolar error above {GOOD_PX:g} px; faces will not always be found in both images")
    return "\n".join([*lines, f"rig in {options.out}"])
