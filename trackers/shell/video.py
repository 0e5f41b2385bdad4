"""Videos of what was tracked, and text in pictures."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.shell.results import OutputError

STATUS_COLORS = ((0, 200, 255), (110, 220, 90), (84, 92, 255))
"""Blue, green, red, in the order of `STATUS_NAMES`."""


def write_video(
    path: Path, images: Iterator[np.ndarray], times_s: np.ndarray, on_progress: Callable[[int], None]
) -> None:
    """Write images (rows, cols, 3) uint8, all of one shape and at least one, as a video of the pace of `times_s`.

    Raises:
        OutputError: the video cannot be written.
    """
    steps = np.diff(times_s)
    pace = float(np.clip(1 / np.median(steps), 1, 120)) if len(steps) else 30.0
    _write(path, _counted(images, on_progress), pace)


def caption(image: np.ndarray, text: str, line: int, color: tuple = (255, 255, 255)) -> None:
    """Write `text` into the top left corner of `image`, `line` lines down, outlined to stay legible on anything."""
    place = (10, 22 + 22 * line)
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, color, 1, cv2.LINE_AA)


def _counted(images: Iterator[np.ndarray], on_progress: Callable[[int], None]) -> Iterator[np.ndarray]:
    for done, image in enumerate(images, 1):
        yield image
        on_progress(done)


def _write(path: Path, images: Iterator[np.ndarray], frames_per_second: float) -> None:
    first = next(images)
    video = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"mp4v"), frames_per_second, (first.shape[1], first.shape[0])
    )
    if not video.isOpened():
        raise OutputError(f"cannot write {path}: the video could not be opened for writing.")
    try:
        video.write(first)
        for image in images:
            video.write(image)
    finally:
        video.release()
    # A full disk is no error to the writer: it leaves a file that cannot be opened.
    check = cv2.VideoCapture(str(path))
    try:
        if not check.isOpened():
            raise OutputError(f"cannot write {path}: the finished video does not open (is the disk full?).")
    finally:
        check.release()
