"""Videos of what was tracked, and text in pictures."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.app.canvas import write_outlined
from jaxfilters.trackers.io.errors import OutputError

STATUS_COLORS = ((0, 200, 255), (110, 220, 90), (84, 92, 255), (0, 140, 255))
"""Blue, green, red, in the order of `STATUS_NAMES`."""
_TALLEST_PX = 720
"""Images side by side are shrunk to this height."""


class OverlayVideo:
    """A video that is written while the tracker runs; what was written stays if the run breaks off."""

    def __init__(self, path: Path, frames_per_second: float, shape: tuple[int, ...]):
        """Begin a video of pictures of `shape` (rows, cols, ...).

        Raises:
            OutputError: it cannot be opened for writing.
        """
        self._path = path
        self._video = cv2.VideoWriter(
            str(path), cv2.VideoWriter.fourcc(*"mp4v"), frames_per_second, (shape[1], shape[0])
        )
        if not self._video.isOpened():
            raise OutputError(f"cannot write {path}: the video could not be opened for writing.")

    def write(self, picture: np.ndarray) -> None:
        """Add a picture (rows, cols, 3) uint8."""
        self._video.write(picture)

    def close(self) -> None:
        """Finish the file."""
        self._video.release()

    def check(self) -> None:
        """Raise `OutputError` unless the finished file opens: a full disk is no error to the writer."""
        check = cv2.VideoCapture(str(self._path))
        try:
            if not check.isOpened():
                raise OutputError(f"cannot write {self._path}: the finished video does not open (is the disk full?).")
        finally:
            check.release()


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
    write_outlined(image, text, place, color)


def side_by_side(images: list[np.ndarray], time_s: float) -> np.ndarray:
    """The images of all cameras in one, with the time."""
    height = min(_TALLEST_PX, max(image.shape[0] for image in images))
    scaled = [
        image if image.shape[0] == height else cv2.resize(image, (round(image.shape[1] * height / len(image)), height))
        for image in images
    ]
    whole = np.concatenate(scaled, axis=1)
    # Video coders want even sizes.
    whole = np.ascontiguousarray(whole[: len(whole) // 2 * 2, : whole.shape[1] // 2 * 2])
    caption(whole, f"{time_s:.1f} s", 0)
    return whole


def _counted(images: Iterator[np.ndarray], on_progress: Callable[[int], None]) -> Iterator[np.ndarray]:
    for done, image in enumerate(images, 1):
        yield image
        on_progress(done)


def _write(path: Path, images: Iterator[np.ndarray], frames_per_second: float) -> None:
    first = next(images)
    video = OverlayVideo(path, frames_per_second, first.shape)
    try:
        video.write(first)
        for image in images:
            video.write(image)
    finally:
        video.close()
    video.check()
