"""Recordings that are stored sideways, as phones do, without a note that a decoder follows.

The cascades find faces that are upright within some 15 degrees, and none that lies on its side: the quarter turn in
which they find one is that of the recording.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from jaxfilters.trackers.head.common.detect import detect
from jaxfilters.trackers.io.video_input import ImageFolder, VideoFile, VideoSource

ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 270: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180}
"""By degrees, clockwise."""
LOOKS, APART_S = 8, 0.5
"""Images that are looked at, unless one shows an upright face; seconds between them."""
FEWEST = 2
"""Images in which a face must be found that is turned: one may be a mistake."""


class TurnedSource:
    """A recording with all images turned."""

    def __init__(self, source: VideoSource, degrees: int) -> None:
        """The turned recording.

        Args:
            source: As stored.
            degrees: Clockwise: 90, 180 or 270.
        """
        self.name, self.fps, self.frames = source.name, source.fps, getattr(source, "frames", 0)
        self.image_size = source.image_size if degrees == 180 else source.image_size[::-1]
        self._source, self._rotation = source, ROTATIONS[degrees]

    def sample(self, most: int) -> list[np.ndarray]:
        """Up to `most` images spread over the recording."""
        return [cv2.rotate(image, self._rotation) for image in self._source.sample(most)]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """Seconds and the image (rows, cols, 3)."""
        for time_s, image in self._source.images():
            yield time_s, None if image is None else cv2.rotate(image, self._rotation)

    def trouble(self) -> str | None:
        """What went wrong while it was read, for a person; None if nothing did."""
        return self._source.trouble()


def upright(source: VideoSource) -> tuple[VideoSource, str | None]:
    """The recording with its faces upright, and what was done for that, for a person; None if nothing was.

    Live cameras, and recordings whose first seconds show no face in any quarter turn, stay as they are.
    """
    if not isinstance(source, VideoFile | ImageFolder):
        return source, None
    degrees = _turn(source)
    if degrees is None:
        return source, None
    return TurnedSource(
        source, degrees
    ), f"images are turned clockwise by {degrees} degrees: faces lie sideways in them"


def _turn(source: VideoSource) -> int | None:
    """Degrees, clockwise, by which a face in the first seconds has to be turned; None where it need not be."""
    found, looked, due_s = dict.fromkeys(ROTATIONS, 0), 0, -np.inf
    for time_s, image in source.images():
        if image is None or time_s < due_s:
            continue
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if detect(grey) is not None:
            return None
        for degrees, rotation in ROTATIONS.items():
            found[degrees] += detect(cv2.rotate(grey, rotation)) is not None
        looked, due_s = looked + 1, time_s + APART_S
        if looked == LOOKS:
            break
    best = max(found, key=lambda degrees: found[degrees])
    return best if found[best] >= FEWEST else None
