"""What finds the ten landmarks at the start of a track, image by image, once a face holds still."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import EYES
from jaxfilters.trackers.head.common.corners import eyes_apart_px
from jaxfilters.trackers.head.common.detect import STABLE_FRAMES, STABLE_SHARE, StableDetector, complete, detect
from jaxfilters.trackers.head.common.mesh import MOST_FACES, MeshDetector, landmarks_of
from jaxfilters.trackers.head.common.mesh_crops import largest, nearest, solids_about, solids_anywhere, solids_near

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
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"], apart_px: float
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in one image of a face that may move, of several faces those nearest to a place, or `None`.

        Args:
            image: Grey.
            near: Where the face is expected, pixels.
            apart_px: Distance between its eyes, pixels.
        """

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
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"], apart_px: float
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in one image of a face that may move, of several faces those nearest to a place, or `None`."""
        del apart_px
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
        self._mesh = MeshDetector(most_faces=MOST_FACES)
        self._last: np.ndarray | None = None
        self._agreeing = 0

    def find(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in pixels (u, v), or `None`."""
        solids, near = self._solids(image), None if self._last is None else self._last.mean(axis=0)
        if not solids:
            self.complaints = ["no face"]
            self.reset()
            return None
        self.complaints = [f"{len(solids)} faces; the largest is taken"] if len(solids) > 1 else []
        found = landmarks_of(largest(solids) if near is None else nearest(solids, near))
        most = max(MOST_MOVED_PX, STABLE_SHARE * eyes_apart_px(found))
        is_still = self._last is not None and float(np.abs(found - self._last).max()) < most
        self._last, self._agreeing = found, self._agreeing + 1 if is_still else 1
        across = found[EYES[3]] - found[EYES[0]]
        if abs(np.arctan2(across[1], across[0])) >= MOST_TILT:
            self.complaints, self._agreeing = ["the head is tilted"], 0
        return found if self._agreeing >= STABLE_FRAMES else None

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"], apart_px: float
    ) -> Float[np.ndarray, "10 2"] | None:
        """The landmarks in one image of a face that may move, of several faces those nearest to a place, or `None`."""
        solids = solids_about(self._mesh, image, near, apart_px)
        return landmarks_of(nearest(solids, near)) if solids else None

    def _solids(self, image: UInt8[np.ndarray, "rows cols"]) -> list[Float[np.ndarray, "V 3"]]:
        """Faces about the last one, or anywhere if it is gone."""
        last = self._last
        about = [] if last is None else solids_near(self._mesh, image, last.mean(axis=0), eyes_apart_px(last))
        return about or solids_anywhere(self._mesh, image)

    def reset(self) -> None:
        """Forget the images so far."""
        self._last, self._agreeing = None, 0


FINDERS: dict[str, type[CascadeFinder] | type[MeshFinder]] = {"cascades": CascadeFinder, "mediapipe": MeshFinder}
"""By `HeadConfig.detector`."""
