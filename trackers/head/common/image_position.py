"""Where the head of an estimate is in the first image, and how large its face is there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.face.rig import CameraRig

EYES_APART_MM = 62.0
"""Distance between the middles of the eyes in people."""


class ImagePosition(NamedTuple):
    """Where a face is in an image, and how large; pixels."""

    middle: Float[np.ndarray, " 2"]
    apart_px: float
    """Distance between its eyes if they are as far apart as people's."""


def image_position(place: Float[Array, " 3"], rig: CameraRig) -> ImagePosition | None:
    """Position in the first image of a head whose place is given in millimetres; None where it has no finite one."""
    focal = rig.focal[0]
    middle = np.asarray(rig.center[0] + focal * place[:2] / place[2], float)
    apart_px = float(focal[0] * EYES_APART_MM / place[2])
    return ImagePosition(middle, apart_px) if np.all(np.isfinite(middle)) else None
