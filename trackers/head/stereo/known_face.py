"""Where a face that is known looks in images as it did at registration: correlation of its whole image.

The cascades need both eyes and the line between the lips; a face with its mouth open and its chin down has neither. Of
a face that is known the image itself can be looked for, at several sizes, up to some 20 degrees from the pose of its
registration. The places in all images together give the position; the axes stay those of the registration.
"""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfilters._xla.from_host import from_host
from jaxfilters.models.face import rig as cameras
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.common.state import POSE, HeadState

WIDTH, MARGIN = 28, 0.3
"""Pixels to which the landmarks' extent is scaled; margin about it, in its own width and height."""
SIZES = (0.7, 0.8, 0.9, 1.0, 1.12, 1.25, 1.4)
"""Of the face, in that of its registration."""
LEAST_SCORE = 0.4
"""Mean correlation of the images below which nothing is found."""


def pose_of_known_face(
    state: HeadState, images: Num[np.ndarray, "C rows cols"], rig: CameraRig
) -> Float[np.ndarray, " 6"] | None:
    """Pose of the registered face where images resemble those of its registration most; None where they do not.

    Args:
        state: Of the tracker.
        images: Grey.
        rig: Two cameras or more.
    """
    registered = state.registered
    uv, origin = (np.asarray(a, float) for a in _projected(rig, registered.shape, registered.pose))
    best, at = LEAST_SCORE, None
    # All images are scaled alike, so that one size of the face fits all of them.
    scale = WIDTH / np.ptp(uv[0, :, 0])
    crops = [_crop(image, points, scale) for image, points in zip(np.asarray(registered.images), uv, strict=True)]
    small = [_scaled(image, scale) for image in images]
    for size in SIZES:
        found = [_matched(image, crop, size) for image, (crop, _) in zip(small, crops, strict=True)]
        score = sum(one[0] for one in found) / len(found)
        if score > best:
            apart = [(o * scale - corner) * size for o, (_, corner) in zip(origin, crops, strict=True)]
            best, at = score, [(corner + a) / scale for (_, corner), a in zip(found, apart, strict=True)]
    if at is None:
        return None
    place = np.asarray(_triangulated(rig, from_host(np.stack(at)[:, None])))[0]
    return np.concatenate([place, np.asarray(registered.pose)[3:POSE]]) if np.all(np.isfinite(place)) else None


def _crop(image: np.ndarray, uv: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """The image about landmarks, scaled, and the scaled pixel of its corner."""
    small = _scaled(image, scale)
    margin = MARGIN * np.ptp(uv, axis=0)
    low, high = (scale * end for end in (uv.min(axis=0) - margin, uv.max(axis=0) + margin))
    low = np.maximum(np.round(low), 0).astype(int)
    high = np.minimum(np.round(high), small.shape[::-1]).astype(int)
    return small[low[1] : high[1], low[0] : high[0]], low.astype(float)


def _scaled(image: np.ndarray, scale: float) -> np.ndarray:
    return cv2.resize(image.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _matched(image: np.ndarray, crop: np.ndarray, size: float) -> tuple[float, np.ndarray]:
    """Highest correlation of a resized crop, and the pixel of its corner there."""
    resized = cv2.resize(crop, None, fx=size, fy=size, interpolation=cv2.INTER_LINEAR)
    if np.any(np.array(resized.shape) > image.shape):
        return -1.0, np.zeros(2)
    _, score, _, corner = cv2.minMaxLoc(cv2.matchTemplate(image, resized, cv2.TM_CCOEFF_NORMED))
    return score, np.array(corner, float)


@jax.jit
def _projected(rig: CameraRig, shape: Array, pose: Array) -> tuple[Array, Array]:
    return cameras.project_shape(rig, shape, pose)[0], cameras.project_shape(rig, jnp.zeros((1, 3)), pose)[0][:, 0]


@jax.jit
def _triangulated(rig: CameraRig, uv: Array) -> Array:
    return cameras.triangulate(rig, uv)
