"""What finds landmarks in one image: OpenCV's cascades, which give the ten, or MediaPipe's mesh, which gives more."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.trackers.head.common.corners import eyes_apart_px
from jaxfilters.trackers.head.common.detect import complete, detect
from jaxfilters.trackers.head.common.mesh import MOST_FACES, MeshDetector
from jaxfilters.trackers.head.common.mesh_crops import largest, nearest, solids_about, solids_anywhere
from jaxfilters.trackers.head.mono.dense import NUM_DENSE
from jaxfilters.trackers.io.detector_errors import DetectorErrors, default_detector_errors

MESH_68: tuple[tuple[int, ...], ...] = (
    *((),) * 8,
    (152,),
    *((),) * 8,
    *((70,), (63,), (105,), (66,), (107,), (336,), (296,), (334,), (293,), (300,)),
    *((168,), (197,), (195, 5), (4,), (97, 98), (97,), (2,), (326,), (326, 327)),
    *((33,), (160,), (158,), (133,), (153,), (144,), (362,), (385,), (387,), (263,), (373,), (380,)),
    *((61,), (39,), (37,), (0,), (267,), (269,), (291,), (321,), (314,), (17,), (84,), (91,)),
    *((78,), (81,), (13,), (311,), (308,), (402,), (14,), (178,)),
)
"""Vertices of MediaPipe's mesh whose mean is each of iBUG's 68 landmarks. Along lips and lids they are those that
divide the mesh's contour as the landmarks of the ICT face model divide its own (within 5 % of the contour's length);
nose and brows are those next to that model's landmarks, viewed from the front. Of the jaw only the chin is taken: the
others slide along the cheeks as a head turns."""
CHIN = 8
IRISES = ((469, 471), (474, 476))
"""Of the refined mesh: vertices on the right iris's and the left iris's edge, on either side of the pupil."""
MESH_SHARE, LEAST_PX = 0.01, 0.5
"""Standard deviation of a coordinate of the mesh from frame to frame: a share of the distance between the eyes, and
never less than so many pixels; twice that at the chin."""
LOOKS = 3
"""Of the mesh at an image: the box that a face is found in is rough where the head is turned or wears glasses.

Of five rendered people, and three with glasses, `solvePnP` from the mesh is wrong in pitch by 8.5 degrees after one
look, 7.4 after two and 7.2 after three within 10 degrees of yaw, and in yaw by 9.8, 6.5 and 5.9 beyond 40 degrees.
"""
MESH_MM = 1.5
"""Standard deviation by which the mesh's landmarks lie beside the model's in all frames alike."""


class DetectedFace(NamedTuple):
    """One face in one image; pixels (u, v)."""

    points: Float[np.ndarray, "10 2"]
    num_faces: int = 1
    """In the image, as far as they were looked for."""
    dense: Float[np.ndarray, "68 2"] | None = None
    """In iBUG's order; NaN where there is none."""
    iris_px: Float[np.ndarray, " 2"] | None = None
    """Width of the right and the left iris."""
    solid: Float[np.ndarray, "V 3"] | None = None
    """All vertices of a mesh: pixels, and the depth on the same scale."""


@runtime_checkable
class Detector(Protocol):
    """Finds a face in an image."""

    @property
    def errors(self) -> DetectorErrors | None:
        """How far the ten landmarks lie from the model's; `None` for noise of a pixel alone."""
        ...

    @property
    def is_averaged(self) -> bool:
        """Whether a track in doubt may be averaged with the landmarks' pose, as it must not where they err grossly."""
        ...

    @property
    def facing_std(self) -> Float[np.ndarray, " 3"] | None:
        """Standard deviation of roll, yaw and pitch of the faces that it finds, radians; `None` if it is not known.

        From the angles of heads at the same places that look into the camera.
        """
        ...

    def detect(
        self,
        image: UInt8[np.ndarray, "rows cols"],
        near: Float[np.ndarray, " 2"] | None,
        apart_px: float | None = None,
    ) -> DetectedFace | str:
        """The face, or why there is none; of several the one nearest to a place, the largest without one.

        Args:
            image: Grey.
            near: Where the face is expected, pixels.
            apart_px: Distance between the eyes of the face that is expected there, pixels, if it is known.
        """
        ...


@runtime_checkable
class MeshGiver(Detector, Protocol):
    """Finds a face in an image by a mesh, of which `errors.vertices` is the mean."""

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"], apart_px: float
    ) -> Float[np.ndarray, "V 3"] | None:
        """The mesh of the face nearest to a place, as fast as it can be found; None without a face.

        Arguments are those of `detect`.
        """
        ...


class CascadeDetector:
    """By OpenCV's cascades and the corners of eyes, mouth, nostrils and brows.

    With glasses or a beard it takes a rim for a brow, or an edge of the beard for a corner of the mouth.
    """

    is_averaged = False
    facing_std = np.radians([3.4, 7.7, 8.5])
    """Root mean square angles of the people of the ICT face model whose faces it finds, who turn as recorded heads
    did."""

    def __init__(self) -> None:
        self.errors = default_detector_errors()["cascades"]

    def detect(
        self,
        image: UInt8[np.ndarray, "rows cols"],
        near: Float[np.ndarray, " 2"] | None,
        apart_px: float | None = None,
    ) -> DetectedFace | str:
        """The face, or why there is none; of several the one nearest to a place, the largest without one."""
        del apart_px
        found = detect(image, near=near)
        if found is None:
            return "no face whose eyes and lips are visible"
        points = complete(image, found.points)
        if points is None:
            return "nostrils or brows are not visible"
        return DetectedFace(points, found.num_faces)


class MeshLandmarks:
    """By MediaPipe's face mesh: most of the 68 landmarks, and the irises."""

    is_averaged = True
    facing_std = np.radians([3.8, 12.6, 14.5])
    """As for the cascades, which find only faces that are turned less."""

    def __init__(self) -> None:
        """Loads the mesh.

        Raises:
            ImportError: without MediaPipe, or with one that has no face mesh of its own.
        """
        self._mesh = MeshDetector(refined=True, most_faces=MOST_FACES, looks=LOOKS)
        self._glance = MeshDetector(refined=True, most_faces=MOST_FACES)
        self.errors = default_detector_errors()["mediapipe"]

    def detect(
        self,
        image: UInt8[np.ndarray, "rows cols"],
        near: Float[np.ndarray, " 2"] | None,
        apart_px: float | None = None,
    ) -> DetectedFace | str:
        """The face, or why there is none; of several the one nearest to a place, the largest without one.

        Small faces are found in parts of the image: about the place that is given, or anywhere if none is.
        """
        if near is None:
            solids = solids_anywhere(self._mesh, image, quick=self._glance)
        else:
            solids = solids_about(self._mesh, image, near, apart_px)
        if not solids:
            return "no face"
        solid = largest(solids) if near is None else nearest(solids, near)
        mesh = solid[:, :2]
        dense = np.array([mesh[list(vertices)].mean(axis=0) if vertices else (np.nan, np.nan) for vertices in MESH_68])
        iris_px = np.array([np.linalg.norm(mesh[a] - mesh[b]) for a, b in IRISES])
        return DetectedFace(dense[list(FROM_68)], len(solids), dense, iris_px, solid)

    def glance(
        self, image: UInt8[np.ndarray, "rows cols"], near: Float[np.ndarray, " 2"], apart_px: float
    ) -> Float[np.ndarray, "V 3"] | None:
        """The mesh of the face nearest to a place after one look; None without a face.

        In a quarter of the time of three looks, and the mean of a track and a mesh (`mesh_rotation`) is as good.
        """
        solids = solids_about(self._glance, image, near, apart_px)
        return nearest(solids, near) if solids else None


DETECTORS: dict[str, type[CascadeDetector] | type[MeshLandmarks]] = {
    "cascades": CascadeDetector,
    "mediapipe": MeshLandmarks,
}
"""By the name that the command line has for them."""


def best_detector() -> tuple[str, Detector]:
    """MediaPipe's face mesh where it is installed, OpenCV's cascades elsewhere: its name, and the detector."""
    try:
        return "mediapipe", MeshLandmarks()
    except ImportError:
        return "cascades", CascadeDetector()


def dense_noise(
    dense: Float[np.ndarray, "n 68 2"],
) -> tuple[Float[np.ndarray, "n 68 2 2"], Bool[np.ndarray, "n 68"]]:
    """Covariance of the mesh's landmarks in each frame, pixels squared, and which of them there are."""
    apart = [eyes_apart_px(points[list(FROM_68[:6])]) for points in dense]
    std_px = np.maximum(MESH_SHARE * np.array(apart), LEAST_PX)[:, None] * np.ones(NUM_DENSE)
    std_px[:, CHIN] *= 2
    return std_px[..., None, None] ** 2 * np.eye(2), np.isfinite(dense).all(axis=-1)
