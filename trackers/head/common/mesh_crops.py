"""Faces that a mesh finds in parts of an image: small ones anywhere, and the one that is followed about its place.

MediaPipe scales the whole image down to 128 pixels before it looks for faces, so that it finds none whose eyes are less
than 7 % of the width apart. In a part of the image the same face is larger.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.trackers.head.common.mesh import EYE_VERTICES

WIDTH = 7.0
"""Of the part about a face, in distances between the eyes: three times the width of the face."""
MOST_SHARE = 0.75
"""Of the width of the image, beyond which the part about a face is not worth while."""
LEAST_PX = 48
"""Width of such a part, at least."""
AGREE = 0.3
"""Distances between the eyes by which the mesh in a part about a face may be from the mesh that the part was taken for.

Half a face at the edge of a part also gives a mesh, which such a part refutes."""


@runtime_checkable
class Meshes(Protocol):
    """Finds meshes in an image."""

    def solids(self, image: UInt8[np.ndarray, "rows cols"]) -> list[Float[np.ndarray, "V 3"]]:
        """All vertices of each face in pixels (u, v, and away from the camera as large)."""
        ...


def eyes_px(solid: Float[np.ndarray, "V 3"]) -> float:
    """Distance between the middles of the eyes of a mesh in the image, pixels."""
    right, left = (solid[list(vertices), :2].mean(axis=0) for vertices in EYE_VERTICES)
    return float(np.linalg.norm(right - left))


def solids_near(
    meshes: Meshes, image: UInt8[np.ndarray, "rows cols"], middle: Float[np.ndarray, " 2"], apart_px: float
) -> list[Float[np.ndarray, "V 3"]]:
    """The faces in the part of an image about a place, in pixels of the whole image.

    Args:
        meshes: What finds them.
        image: Grey.
        middle: Of the face, pixels (u, v).
        apart_px: Distance between its eyes, pixels.

    Returns:
        None of them where the part would be most of the image, or the place is not finite.
    """
    rows, cols = image.shape
    if not np.isfinite(apart_px) or WIDTH * apart_px > MOST_SHARE * cols or not np.all(np.isfinite(middle)):
        return []
    size = min(max(round(WIDTH * apart_px), LEAST_PX), rows, cols)
    u, v = (int(np.clip(round(float(middle[i])) - size // 2, 0, (cols, rows)[i] - size)) for i in range(2))
    return _in_part(meshes, image, (u, v), (size, size))


def solids_about(
    meshes: Meshes, image: UInt8[np.ndarray, "rows cols"], middle: Float[np.ndarray, " 2"], apart_px: float | None
) -> list[Float[np.ndarray, "V 3"]]:
    """As `solids_near`, and where that has no face, or the size is not known, those of the whole image."""
    found = [] if apart_px is None else solids_near(meshes, image, middle, apart_px)
    return found or meshes.solids(image)


def solids_anywhere(
    meshes: Meshes, image: UInt8[np.ndarray, "rows cols"], *, quick: Meshes | None = None
) -> list[Float[np.ndarray, "V 3"]]:
    """The faces in an image and, if there are none, those in nine overlapping parts of half its size.

    A face in one of the parts counts if the part of the image about it has the same face.

    Args:
        meshes: What finds the faces that are returned.
        image: Grey.
        quick: What finds faces in the nine parts; `meshes` if not given.
    """
    whole = meshes.solids(image)
    if whole:
        return whole
    rows, cols = image.shape
    size, found = (cols // 2, rows // 2), list[np.ndarray]()
    candidates = [
        solid
        for j in range(3)
        for i in range(3)
        for solid in _in_part(quick or meshes, image, (i * size[0] // 2, j * size[1] // 2), size)
    ]
    for candidate in sorted(candidates, key=eyes_px, reverse=True):
        if any(_apart(candidate, other) < 1.0 for other in found):
            continue
        about = solids_near(meshes, image, candidate[:, :2].mean(axis=0), eyes_px(candidate))
        found += [solid for solid in about if _apart(solid, candidate) < AGREE][:1]
    return found


def nearest(solids: list[Float[np.ndarray, "V 3"]], place: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "V 3"]:
    """The face whose middle is nearest to a pixel."""
    return min(solids, key=lambda one: float(np.linalg.norm(one[:, :2].mean(axis=0) - place)))


def largest(solids: list[Float[np.ndarray, "V 3"]]) -> Float[np.ndarray, "V 3"]:
    """The face whose box in the image is the largest."""
    return max(solids, key=lambda one: float(np.prod(np.ptp(one[:, :2], axis=0))))


def _in_part(
    meshes: Meshes, image: UInt8[np.ndarray, "rows cols"], corner: tuple[int, int], size: tuple[int, int]
) -> list[Float[np.ndarray, "V 3"]]:
    """Faces of a part of an image, whose corner and size are (u, v), in pixels of the whole image."""
    (u, v), (width, height) = corner, size
    part = np.ascontiguousarray(image[v : v + height, u : u + width])
    return [solid + np.array([u, v, 0.0]) for solid in meshes.solids(part)]


def _apart(one: Float[np.ndarray, "V 3"], other: Float[np.ndarray, "V 3"]) -> float:
    """Median distance of the vertices of two meshes in the image, in distances between the eyes of the first."""
    return float(np.median(np.linalg.norm(one[:, :2] - other[:, :2], axis=1))) / max(eyes_px(one), 1e-6)
