"""From images to the landmarks of several frames, which a track starts with."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.trackers.head.corners import eye_centers
from jaxfilters.trackers.head.detect import complete, detect
from jaxfilters.trackers.head_mono.start import DETECTED_PX, is_symmetric
from jaxfilters.trackers.head_mono.state import NUM_FRAMES

APART_S, STALE_S = 0.2, 5.0
"""Seconds between two detections that count; from which on one does not any more."""
SAME_PLACE = 3.0
"""Distances between the eyes within which two detections are of one face."""


class Detections(NamedTuple):
    """Landmarks in several frames, and those of their images that a track needs."""

    points: Float[np.ndarray, "n K 2"]
    """Pixels."""
    images: UInt8[np.ndarray, "n rows cols"]
    time: float
    """Of the last, seconds."""
    std_px: float = DETECTED_PX
    """Standard deviation of each coordinate of the points."""


class Collector:
    """Gathers detections until there are enough of them; what is wrong with a frame is in `reason`."""

    def __init__(self) -> None:
        self.reason = ""
        """Why the last frame was no detection, in a few words; empty if it was one."""
        self.several = 0
        """Faces in the last frame, if more than one."""
        self._points: list[np.ndarray] = []
        self._images: list[np.ndarray] = []
        self._times: list[float] = []

    def update(self, image: UInt8[np.ndarray, "rows cols"], time: float) -> Detections | None:
        """All detections once there are enough; `None` until then.

        Args:
            image: Grey, without lens distortion.
            time: Seconds.
        """
        self.reason, self.several = "", 0
        if self._times and 0 <= time - self._times[-1] < APART_S:
            return None
        points = self._detected(image)
        if points is None:
            return None
        self._drop_others(points, time)
        return self._kept(points, image, time)

    def given(self, points: Float[np.ndarray, "K 2"], image: UInt8[np.ndarray, "rows cols"], time: float) -> Detections:
        """Detections that are one frame's landmarks, given by a person."""
        # The same frame several times tells no more than once.
        std_px = DETECTED_PX * math.sqrt(NUM_FRAMES)
        return Detections(np.tile(points, (NUM_FRAMES, 1, 1)), np.stack([image] * NUM_FRAMES), time, std_px)

    def clear(self) -> None:
        """Begins anew."""
        self._points, self._images, self._times = [], [], []

    def _detected(self, image: np.ndarray) -> np.ndarray | None:
        near = self._points[-1].mean(axis=0) if self._points else None
        found = detect(image, near=near)
        if found is None:
            self.reason = "no face whose eyes and lips are seen"
            return None
        self.several = found.num_faces if found.num_faces > 1 else 0
        points = complete(image, found.points)
        if points is None:
            self.reason = "nostrils or brows are not seen"
            return None
        if not is_symmetric(points):
            self.reason = "left and right landmarks do not lie alike"
            return None
        return points

    def _drop_others(self, points: np.ndarray, time: float) -> None:
        """Only what is recent and of the same face stays."""
        if not self._times:
            return
        right, left = eye_centers(points[:6])
        most = SAME_PLACE * np.linalg.norm(left - right)
        is_other = np.linalg.norm(points.mean(axis=0) - self._points[-1].mean(axis=0)) > most
        if is_other or time < self._times[-1]:
            self.clear()
        while self._times and time - self._times[0] > STALE_S:
            del self._points[0], self._images[0], self._times[0]

    def _kept(self, points: np.ndarray, image: np.ndarray, time: float) -> Detections | None:
        self._points.append(points)
        self._images.append(image.copy())
        self._times.append(time)
        if len(self._points) < NUM_FRAMES:
            return None
        found = Detections(np.stack(self._points), np.stack(self._images), time)
        self.clear()
        return found
