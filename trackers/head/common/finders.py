"""What finds the ten landmarks at the start of a track, image by image, once a face holds still."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import EYES
from jaxfilters.trackers.head.common.corners import eye_centers
from jaxfilters.trackers.head.common.detect import STABLE_FRAMES, STABLE_SHARE, StableDetector, complete, detect
from jaxfilters.trackers.head.common.mesh import MeshDetector

MOST_MOVED_PX = 2.0
"""Between two images of a face that holds still; `STABLE_SHARE` of the eyes' distance where that is more."""
MOST_TILT = np.radians(15.0)


@runtime_checkable
class Finder(Protocol):
    """Finds a face that holds still; says why there is none, and what else there is to say."""

    complaints: list[str]
    """Of the last image; none where a face only has to hold still for longer."""

    def find(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in pixels (u, v), or `None`."""

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"]
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in one image of a face that may move, of several faces those nearest to a pixel, or `None`."""

    def reset(self) -> None:
        """Forget the images so far."""


class CascadeFinder:
    """By OpenCV's cascades and the corners of eyes, mouth, nostrils and brows."""

    def __init__(self) -> None:
        self.complaints: list[str] = []
        self._detector = StableDetector()

    def find(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in pixels (u, v), or `None`."""
        found = self._detector.update(image)
        if found is None:
            # That a detection is not steady yet is no reason.
            self.complaints = [] if self._detector.reason.endswith("px") else [self._detector.reason]
            return None
        points = complete(image, found.points)
        self.complaints = [f"{found.num_faces} faces; the largest is taken"] if found.num_faces > 1 else []
        if points is None:
            self.complaints.append("nostrils or brows are not visible")
        return points

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"]
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in one image of a face that may move, of several faces those nearest to a pixel, or `None`."""
        found = detect(image, near=near)
        return None if found is None else complete(image, found.points)

    def reset(self) -> None:
        """Forget the images so far."""
        self._detector = StableDetector()


class MeshFinder:
    """By MediaPipe's face mesh."""

    def __init__(self) -> None:
        """Loads the mesh.

        Raises:
            ImportError: without MediaPipe, or with one that has no face mesh of its own.
        """
        self.complaints: list[str] = []
        self._mesh = MeshDetector()
        self._last: np.ndarray | None = None
        self._agreeing = 0

    def find(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in pixels (u, v), or `None`."""
        found = self._mesh.detect(image)
        self.complaints = ["no face"] if found is None else []
        if found is None:
            self.reset()
            return None
        most = max(MOST_MOVED_PX, STABLE_SHARE * float(np.linalg.norm(np.subtract(*eye_centers(found)))))
        is_still = self._last is not None and float(np.abs(found - self._last).max()) < most
        self._last, self._agreeing = found, self._agreeing + 1 if is_still else 1
        across = found[EYES[3]] - found[EYES[0]]
        if abs(np.arctan2(across[1], across[0])) >= MOST_TILT:
            self.complaints, self._agreeing = ["the head is tilted"], 0
        return found if self._agreeing >= STABLE_FRAMES else None

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"]
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks of the most evident face in one image, which may move, or `None`."""
        del near
        return self._mesh.detect(image)

    def reset(self) -> None:
        """Forget the images so far."""
        self._last, self._agreeing = None, 0


FINDERS: dict[str, type[CascadeFinder] | type[MeshFinder]] = {"cascades": CascadeFinder, "mediapipe": MeshFinder}
"""By `HeadConfig.detector`."""
