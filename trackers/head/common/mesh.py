"""The ten landmarks by MediaPipe's face mesh, for those who have installed it; nothing else here needs it."""

from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

VERTICES = ((33,), (133,), (362,), (263,), (61,), (291,), (79,), (309,), (55, 107), (285, 336))
"""Of the mesh of 468 for each landmark: brows end between their upper and lower edge."""


class MeshDetector:
    """Landmarks of the most evident face, image by image."""

    def __init__(self, *, refined: bool = False, most_faces: int = 1) -> None:
        """Loads the mesh.

        Args:
            refined: With more careful eyes and lips, and five vertices for each iris: 478 in all.
            most_faces: Faces that are looked for in an image, the most evident ones.

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
        self._mesh = solutions.face_mesh.FaceMesh(
            static_image_mode=True, max_num_faces=most_faces, refine_landmarks=refined
        )

    def solids(self, image: UInt8[np.ndarray, "rows cols"]) -> list[Float[np.ndarray, "V 3"]]:
        """All vertices of each face in pixels (u, v, and away from the camera as large)."""
        rows, cols = image.shape
        found = self._mesh.process(np.repeat(image[:, :, None], 3, axis=2)).multi_face_landmarks or []
        in_pixels = np.array([cols, rows, cols]), np.array([0.5, 0.5, 0.0])
        return [np.array([(p.x, p.y, p.z) for p in face.landmark]) * in_pixels[0] - in_pixels[1] for face in found]

    def solid(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "V 3"] | None:
        """All vertices in pixels (u, v, and away from the camera as large), or `None` without a face."""
        found = self.solids(image)
        return found[0] if found else None

    def mesh(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "V 2"] | None:
        """All vertices in pixels (u, v), or `None` without a face."""
        solid = self.solid(image)
        return None if solid is None else solid[:, :2]

    def detect(self, image: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "10 2"] | None:
        """All ten landmarks in pixels (u, v), or `None` without a face."""
        mesh = self.mesh(image)
        return None if mesh is None else np.array([mesh[list(vertices)].mean(axis=0) for vertices in VERTICES])
