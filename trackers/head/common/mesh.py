"""The ten landmarks by MediaPipe's face mesh, for those who have installed it; nothing else here needs it."""

from importlib import import_module
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

VERTICES = ((33,), (133,), (362,), (263,), (61,), (291,), (79,), (309,), (55, 107), (285, 336))
"""Of the mesh of 468 for each landmark: brows end between their upper and lower edge."""
EYE_VERTICES = ((33, 133), (362, 263))
"""Corners of the right and of the left eye."""
MOST_FACES = 4
"""That are looked for in an image."""


class MeshDetector:
    """Landmarks of the most evident face, image by image."""

    def __init__(self, *, refined: bool = False, most_faces: int = 1, looks: int = 1) -> None:
        """Loads the mesh.

        Args:
            refined: With more careful eyes and lips, and five vertices for each iris: 478 in all.
            most_faces: Faces that are looked for in an image, the most evident ones.
            looks: At each image: the first in the frame of the face's box, each further one in that of the landmarks
                of the look before.

        Raises:
            ImportError: without MediaPipe, or with one that has no face mesh of its own.
        """
        try:
            solutions: Any = import_module("mediapipe").solutions
        except (ImportError, AttributeError) as error:
            raise ImportError(
                "the face mesh needs mediapipe with bundled models, such as mediapipe==0.10.14; landmarks from the "
                "cascades of OpenCV need nothing."
            ) from error
        # As a video it begins with the landmarks that it found last: here those in the same image.
        self._mesh = solutions.face_mesh.FaceMesh(
            static_image_mode=looks == 1, max_num_faces=most_faces, refine_landmarks=refined
        )
        self._looks, self._lock = looks, Lock()

    def solids(self, image: UInt8[np.ndarray, "rows cols"]) -> list[Float[np.ndarray, "V 3"]]:
        """All vertices of each face in pixels (u, v, and away from the camera as large)."""
        rows, cols = image.shape
        found = self._looked_at(np.repeat(image[:, :, None], 3, axis=2))
        in_pixels = np.array([cols, rows, cols]), np.array([0.5, 0.5, 0.0])
        return [np.array([(p.x, p.y, p.z) for p in face.landmark]) * in_pixels[0] - in_pixels[1] for face in found]

    def _looked_at(self, image: UInt8[np.ndarray, "rows cols 3"]) -> Any:
        with self._lock:  # a search beside the frames must not come between two looks
            if self._looks > 1:
                self._mesh.reset()
            for look in range(self._looks):
                found = self._mesh.process(image).multi_face_landmarks or []
                if not found or look == self._looks - 1:
                    break
            return found

    def solid(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "V 3"] | None:
        """All vertices in pixels (u, v, and away from the camera as large), or `None` without a face."""
        found = self.solids(image)
        return found[0] if found else None

    def detect(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """All ten landmarks in pixels (u, v), or `None` without a face."""
        solid = self.solid(image)
        return None if solid is None else landmarks_of(solid)


def landmarks_of(solid: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "10 2"]:
    """The ten landmarks of a mesh in pixels (u, v)."""
    return np.array([solid[list(vertices), :2].mean(axis=0) for vertices in VERTICES])
