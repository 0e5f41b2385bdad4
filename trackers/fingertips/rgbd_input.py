"""Colour images with the depths of their pixels, as RGB-D cameras record them once depth is aligned to colour."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.hand_depth.detect import check_unit
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import InputError, as_input_error


class RgbdImage(NamedTuple):
    """An image with the depths of its pixels."""

    image: np.ndarray
    """(rows, cols) or (rows, cols, 3) uint8."""
    depth: np.ndarray
    """(rows, cols) metres; not finite or not positive without a reading."""


class RgbdVideo:
    """A recording of colours and one of depths as a source of images with both, frame by frame."""

    def __init__(self, video: Any, path: Path):
        """Pair a recording with the depth recording at a path.

        Args:
            video: Source of the colour images; its times count.
            path: Depth images in the same pixels, one for each colour image, as `open_depth` reads them.

        Raises:
            InputError: a depth recording that cannot be read, is in another unit than it says, or differs from the
                colour images in size or number.
        """
        self._video, self._depth = video, open_depth(path, fps=video.fps)
        self.name, self.fps, self.image_size = f"{video.name} with {path}", video.fps, video.image_size
        self.frames = len(self._depth)
        first = self._depth[0]
        if first.shape[::-1] != self.image_size:
            size, own = ("{}x{}".format(*pair) for pair in (self.image_size, first.shape[::-1]))
            raise InputError(
                f"{path}: depth images of {own} pixels beside colour images of {size}; align depth to colour first."
            )
        as_input_error(partial(check_unit, first))
        # A video file may claim another number than it has, which shows at its end.
        self._check_number(getattr(video, "frames", 0))

    def sample(self, most: int) -> list[np.ndarray]:
        """The colours of every n-th image: depths are not needed to know the user."""
        return self._video.sample(most)

    def images(self) -> Iterator[tuple[float, RgbdImage]]:
        """From the first to the last."""
        number = 0
        for number, (time_s, image) in enumerate(self._video.images(), 1):
            if number > self.frames:
                self._check_number(number)
            yield time_s, RgbdImage(image, self._depth[number - 1])
        self._check_number(number)

    def trouble(self) -> str | None:
        """What went wrong with the colours; depths that cannot be read are an error."""
        return self._video.trouble()

    def _check_number(self, found: int) -> None:
        if found and found != self.frames:
            raise InputError(
                f"{self._depth.name}: {self.frames} depth images beside {found} colour images; expected one for each."
            )
