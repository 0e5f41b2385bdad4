"""Where a face is in a grey image: corners of eyes and mouth, by OpenCV's cascades and minimum eigenvalues."""

import math
import threading
from typing import NamedTuple

import cv2
import numpy as np
from cv2 import data as cascades
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.trackers.head.common import corners

SEARCH_WIDTH = 240
"""Pixels to which an image is scaled before faces are looked for: a face at 1.2 m is still 30 wide."""
FACE_WIDTH = 120
"""Pixels to which a face is scaled before eyes and mouth are looked for."""
MOUTH_SCALE = 0.5
"""Of the upright image in which the mouth is looked for."""
MOUTH_DROP, MOST_MISPLACED, MOUTH_SIZE = 1.25, 0.6, (1.2, 0.6)
"""How far the box of a mouth is below the eyes, how far it may be from there, and how large: in distances between the
eyes."""
STABLE_FRAMES, STABLE_PIXELS = 5, 2.0
"""How many frames in a row must agree, and how well."""
STABLE_SHARE = 0.026
"""Share of the eyes' distance that is allowed where it is more than `STABLE_PIXELS`."""
MOST_ROLL = math.radians(15.0)
"""Beyond which a face is too tilted to register."""
OTHERS_SPREAD = ((0.06, 0.1), (0.06, 0.1), (0.07, 0.09), (0.07, 0.09))
"""How far nostrils and brows lie from where the average face has them."""
CLOSEST = 0.08
"""Between two landmarks."""
FAINTEST = 0.003
"""Corner strength, as a share of the face's strongest, below which nothing is a landmark."""
_loaded = threading.local()


class Detection(NamedTuple):
    """One face, in pixels (u, v); boxes are (u, v, width, height)."""

    points: Float[np.ndarray, "6 2"]
    """Landmarks 0 to 5: eye corners from the image's left to its right, then the mouth's."""
    face: Float[np.ndarray, " 4"]
    eyes: Float[np.ndarray, "2 4"]
    """The subject's right eye, then the left one."""
    mouth: Float[np.ndarray, " 4"]
    num_faces: int
    """Faces in the image; of several the largest is taken, or the one nearest to where it was asked for."""


def detect(image: UInt8[np.ndarray, "rows cols"], *, near: np.ndarray | None = None) -> Detection | None:
    """Corners of the eyes and of the mouth of one face; `None` without a face whose eyes and lips are seen.

    Of several faces the largest is taken.

    Args:
        image: Grey.
        near: (u, v): of several faces the one nearest to it is taken instead.

    Raises:
        ValueError: if the image is not grey with 8 bits.
    """
    found = _search(image, near)
    return found if isinstance(found, Detection) else None


def complete(image: UInt8[np.ndarray, "rows cols"], six: Float[np.ndarray, "6 2"]) -> Float[np.ndarray, "10 2"] | None:
    """All ten landmarks: the six, and nostrils and inner ends of the brows near where the average face has them.

    The average face is laid over the six by an affine map, which takes up most of a turn of the head. Each of the
    others is the point of largest minimum eigenvalue of the structure tensor [S3.2], weighted by its distance from
    where it is due; `None` if none is strong enough, or two landmarks coincide (specification, section 2.3).

    Raises:
        ValueError: if the image is not grey with 8 bits, or `six` not (6, 2) and finite.
    """
    _check_grey(image)
    six = np.asarray(six, float)
    if six.shape != (6, 2) or not np.isfinite(six).all():
        raise ValueError(f"six must be finite pixels of shape (6, 2); got {six.tolist()}.")
    to_upright = corners.upright_from(corners.eye_centers(six))
    known = corners.apply(to_upright, six)
    mean = np.column_stack([MEAN_SHAPE[:, :2], np.ones(len(MEAN_SHAPE))])
    due = mean[6:] @ np.linalg.lstsq(mean[:6], known, rcond=None)[0]
    upright = corners.warped(image, to_upright, corners.SHAPE)
    strength = corners.corner_strength(upright)
    dark = strength * (corners.darkness(upright) + 0.02)
    maps = (dark, dark, strength, strength)
    others = [corners.strongest(*where) for where in zip(maps, due, OTHERS_SPREAD, strict=True)]
    if min(strength[round(v), round(u)] for u, v in others) <= FAINTEST * strength[:, 40:-40].max():
        return None
    points = np.concatenate([known, others])
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + 1e3 * np.eye(len(points))
    if apart.min() < CLOSEST * corners.EYE_DISTANCE:
        return None
    return np.concatenate([six, corners.apply(cv2.invertAffineTransform(to_upright), points[6:])])


class StableDetector:
    """Waits for a face that holds still and upright: `STABLE_FRAMES` detections in a row that agree."""

    def __init__(self) -> None:
        self.reason = "no frame yet"
        """Why the last frame did not end the wait; empty when it did."""
        self._last: Detection | None = None
        self._agreeing = 0

    def update(self, image: UInt8[np.ndarray, "rows cols"]) -> Detection | None:
        """The detection in this frame once it is the last of enough that agree; `None` until then."""
        last = self._last
        found = _search(image, None if last is None else last.face[:2] + 0.5 * last.face[2:])
        if not isinstance(found, Detection):
            self.reason, self._last, self._agreeing = found, None, 0
            return None
        right, left = corners.eye_centers(found.points)
        roll = math.atan2(left[1] - right[1], left[0] - right[0])
        most = max(STABLE_PIXELS, STABLE_SHARE * float(np.linalg.norm(left - right)))
        moved = np.inf if last is None else np.linalg.norm(found.points - last.points, axis=-1).max()
        self._last, self._agreeing = found, self._agreeing + 1 if moved < most else 1
        if abs(roll) >= MOST_ROLL:
            self.reason, self._agreeing = f"the head is tilted by {math.degrees(roll):.0f} degrees", 0
            return None
        if self._agreeing < STABLE_FRAMES:
            self.reason = f"{self._agreeing} of {STABLE_FRAMES} frames agree to {most:.1f} px"
            return None
        self.reason = ""
        return found


def _search(image: np.ndarray, near: np.ndarray | None) -> Detection | str:
    """A detection, or what was not found."""
    _check_grey(image)
    faces = _faces(image)
    if not len(faces):
        return "no face"
    rank = faces[:, 2]
    if near is not None:
        rank = -np.linalg.norm(faces[:, :2] + 0.5 * faces[:, 2:] - near, axis=1)
    face = faces[rank.argmax()]
    scale = FACE_WIDTH / face[2]
    patch = corners.warped(image, np.array([[scale, 0, -scale * face[0]], [0, scale, -scale * face[1]]]), (132, 120))
    eyes = _eyes(patch)
    if eyes is None:
        return "a face, but not both of its eyes"
    eyes = np.concatenate([eyes[:, :2] / scale + face[:2], eyes[:, 2:] / scale], axis=1)
    mouth = _mouth(image, eyes)
    points = corners.corners(image, eyes, mouth)
    if points is None:
        return "a face and its eyes, but no line between its lips"
    return Detection(points, face, eyes, mouth, len(faces))


def _check_grey(image: np.ndarray) -> None:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image must be grey, (rows, cols) of uint8; got {image.shape} of {image.dtype}.")


def _faces(image: np.ndarray) -> Float[np.ndarray, "n 4"]:
    """Boxes of frontal faces in the image's pixels."""
    scale = min(1.0, SEARCH_WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = _cascade("frontalface_alt2").detectMultiScale(small, 1.1, 4, minSize=(SEARCH_WIDTH // 8,) * 2)
    return np.reshape(found, (-1, 4)) / scale


def _eyes(patch: np.ndarray) -> Float[np.ndarray, "2 4"] | None:
    """Boxes of both eyes in the upper half of a face."""
    top, bottom = int(0.15 * FACE_WIDTH), int(0.6 * FACE_WIDTH)
    for name in ("eye_tree_eyeglasses", "eye"):
        found = _cascade(name).detectMultiScale(patch[top:bottom], 1.1, 3, minSize=(20, 20), maxSize=(48, 48))
        boxes = np.reshape(found, (-1, 4)) + np.array([0.0, top, 0.0, 0.0])
        best = _pair(boxes)
        if best is not None:
            return best
    return None


def _pair(boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "2 4"] | None:
    """The two boxes that lie most like eyes in a face."""
    centers = (boxes[:, :2] + 0.5 * boxes[:, 2:]) / FACE_WIDTH
    best, least = None, 0.15
    for i in range(len(boxes)):
        for j in range(len(boxes)):
            across = centers[j] - centers[i]
            if not 0.25 < across[0] < 0.5 or abs(across[1]) > 0.6 * across[0]:
                continue
            misplaced = float(np.linalg.norm(0.5 * (centers[i] + centers[j]) - (0.5, 0.39)))
            if misplaced < least:
                best, least = boxes[[i, j]], misplaced
    return best


def _mouth(image: np.ndarray, eyes: np.ndarray) -> Float[np.ndarray, " 4"]:
    """Box of the mouth in the lower third of a face turned upright: of several, the one most nearly where it is due.

    Where the cascade sees none, which is made for smiles, it is where it is due.
    """
    to_upright = corners.upright_from(eyes[:, :2] + 0.5 * eyes[:, 2:] - 0.5) * MOUTH_SCALE
    rows, cols = (round(MOUTH_SCALE * size) for size in corners.SHAPE)
    distance, middle = (MOUTH_SCALE * np.asarray(a) for a in (corners.EYE_DISTANCE, corners.MIDDLE))
    due = middle + np.array([0, MOUTH_DROP * distance])
    top = round(middle[1] + 0.55 * distance)
    lower = corners.warped(image, to_upright, (rows, cols))[top:]
    found = _cascade("smile").detectMultiScale(lower, 1.05, 3, minSize=(36, 18), maxSize=(84, 42))
    boxes = np.reshape(found, (-1, 4)) + np.array([0.0, top, 0.0, 0.0])
    centers = np.concatenate([boxes[:, :2] + 0.5 * boxes[:, 2:] - 0.5, [due]])
    sizes = np.concatenate([boxes[:, 2:], distance * np.array([MOUTH_SIZE])])
    away = np.linalg.norm(centers - due, axis=1)
    away[-1] = MOST_MISPLACED * distance
    best = away.argmin()
    size = sizes[best] / np.linalg.norm(to_upright[0, :2])
    center = corners.apply(cv2.invertAffineTransform(to_upright), centers[best][None])[0] + 0.5
    return np.concatenate([center - 0.5 * size, size])


def _cascade(name: str) -> cv2.CascadeClassifier:
    """One classifier of OpenCV for this thread: they keep state while they search."""
    if not hasattr(_loaded, name):
        setattr(_loaded, name, cv2.CascadeClassifier(f"{cascades.haarcascades}haarcascade_{name}.xml"))
    return getattr(_loaded, name)
