"""From images to the landmarks of several frames, which a track starts with."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.trackers.head.common.corners import eye_centers, eyes_apart_px
from jaxfilters.trackers.head.common.image_position import EYES_APART_MM
from jaxfilters.trackers.head.mono.dense import NUM_DENSE, Dense
from jaxfilters.trackers.head.mono.detectors import MESH_MM, CascadeDetector, DetectedFace, Detector, dense_noise
from jaxfilters.trackers.head.mono.start import DETECTED_PX, is_symmetric
from jaxfilters.trackers.head.mono.state import NUM_FRAMES
from jaxfilters.trackers.io.detector_errors import DetectorErrors

APART_S, STALE_S = 0.2, 5.0
"""Seconds between two detections that count; from which on one does not any more."""
SAME_PLACE = 3.0
"""Distances between the eyes within which two detections are of one face."""


LEAST_NOISE_PX = 0.5
"""Noise of a detector, at least."""


class Detections(NamedTuple):
    """Landmarks in several frames, and those of their images that a track needs."""

    points: Float[np.ndarray, "n K 2"]
    """Pixels."""
    images: UInt8[np.ndarray, "n rows cols"]
    time: float
    """Of the last, seconds."""
    std_px: float | Float[np.ndarray, " K"] = DETECTED_PX
    """Standard deviation of each coordinate of the points, perhaps for each landmark."""
    dense: Dense | None = None
    """The 68 landmarks, if they are known."""
    iris_px: Float[np.ndarray, "n 2"] | None = None
    """Widths of the irises, if they are visible."""
    errors: DetectorErrors | None = None
    """By how much the detector misplaces the points in all images alike, if it does."""
    facing_std: Float[np.ndarray, " 3"] | None = None
    """Standard deviation of roll, yaw and pitch of the faces that it finds from those of heads that look into the
    camera, radians, if it is known."""


class Collector:
    """Gathers detections until there are enough of them; what is wrong with a frame is in `reason`."""

    def __init__(self, detector: Detector | None = None) -> None:
        """Nothing gathered yet.

        Args:
            detector: What finds the landmarks; OpenCV's cascades if none.
        """
        self.reason = ""
        """Why the last frame was no detection, in a few words; empty if it was one."""
        self.several = 0
        """Faces in the last frame, if more than one."""
        self._detector = detector or CascadeDetector()
        self._observed: list[DetectedFace] = []
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
        observed = self._detected(image)
        if observed is None:
            return None
        self._drop_others(observed.points, time)
        return self._kept(observed, image, time)

    def given(self, points: Float[np.ndarray, "K 2"], image: UInt8[np.ndarray, "rows cols"], time: float) -> Detections:
        """Detections that are one frame's landmarks, ten or 68, given by a person."""
        # The same frame several times tells no more than once.
        std_px = DETECTED_PX * math.sqrt(NUM_FRAMES)
        several = np.tile(points, (NUM_FRAMES, 1, 1))
        images = np.stack([image] * NUM_FRAMES)
        if len(points) != NUM_DENSE:
            return Detections(several, images, time, std_px)
        covariance = np.broadcast_to(std_px**2 * np.eye(2), (*several.shape, 2))
        dense = Dense(several, covariance, np.ones(several.shape[:2], bool), 0.0)
        return Detections(several[:, list(FROM_68)], images, time, std_px, dense)

    def clear(self) -> None:
        """Begins anew."""
        self._observed, self._images, self._times = [], [], []

    def _detected(self, image: np.ndarray) -> DetectedFace | None:
        near, apart_px = None, None
        if self._observed:
            last = self._observed[-1].points
            near, apart_px = last.mean(axis=0), eyes_apart_px(last)
        found = self._detector.detect(image, near, apart_px)
        if isinstance(found, str):
            self.reason = found
            return None
        self.several = found.num_faces if found.num_faces > 1 else 0
        if not is_symmetric(found.points):
            self.reason = "left and right landmarks do not lie alike"
            return None
        return found

    def _drop_others(self, points: np.ndarray, time: float) -> None:
        """Only what is recent and of the same face stays."""
        if not self._times:
            return
        right, left = eye_centers(points[:6])
        most = SAME_PLACE * np.linalg.norm(left - right)
        is_other = np.linalg.norm(points.mean(axis=0) - self._observed[-1].points.mean(axis=0)) > most
        if is_other or time < self._times[-1]:
            self.clear()
        while self._times and time - self._times[0] > STALE_S:
            del self._observed[0], self._images[0], self._times[0]

    def _kept(self, observed: DetectedFace, image: np.ndarray, time: float) -> Detections | None:
        self._observed.append(observed)
        self._images.append(image.copy())
        self._times.append(time)
        if len(self._observed) < NUM_FRAMES:
            return None
        points = np.stack([one.points for one in self._observed])
        many = [one.dense for one in self._observed if one.dense is not None]
        widths = [one.iris_px for one in self._observed if one.iris_px is not None]
        dense = None if len(many) < NUM_FRAMES else _of_mesh(np.stack(many))
        iris_px = None if len(widths) < NUM_FRAMES else np.stack(widths)
        errors = self._detector.errors
        std_px = DETECTED_PX if errors is None else noise_px(errors, points)
        facing_std = self._detector.facing_std
        found = Detections(points, np.stack(self._images), time, std_px, dense, iris_px, errors, facing_std)
        self.clear()
        return found


def noise_px(errors: DetectorErrors, points: Float[np.ndarray, "n K 2"]) -> Float[np.ndarray, " K"]:
    """Standard deviation of the detector's noise for each landmark in several frames of one face, pixels.

    Frames within a few seconds look alike, and a detector is wrong in them alike: all of them tell as much as one.
    """
    apart = [eyes_apart_px(one) for one in points]
    px_per_mm = float(np.mean(apart)) / EYES_APART_MM
    return math.sqrt(len(points)) * np.maximum(px_per_mm * errors.white, LEAST_NOISE_PX)


def _of_mesh(points: Float[np.ndarray, "n 68 2"]) -> Dense:
    covariance, observed = dense_noise(points)
    return Dense(np.nan_to_num(points), covariance, observed, MESH_MM)
