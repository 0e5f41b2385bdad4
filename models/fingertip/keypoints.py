"""A hand over a desk from 21 keypoints of a detector, in place of a silhouette.

Keypoints are those of MediaPipe and OpenPose: wrist, thumb 1-4, index, middle, ring, little finger, base to tip. A
finger counts as extended where it is straight and its tip far from the palm.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxfilters.models.fingertip.detection import no_hand
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.thumb import Posture

NUM_KEYPOINTS = 21
WRIST, KNUCKLES = 0, (5, 9, 13, 17)
FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
"""Of each finger, base to tip, the thumb first."""
FIRST_BONES = ((2, 3), (5, 6), (9, 10), (13, 14), (17, 18))
"""Of each finger, in front of the palm; the thumb's metacarpal lies beside it."""
PALM_SHARE = 0.6
"""Of the way from the wrist to the knuckles, where the middle of the palm is."""
LEAST_CONFIDENCE = 0.2
"""Keypoints below it count as not found; it is what OpenPose draws hands from."""
LEAST_STRAIGHTNESS, LEAST_REACH = 0.85, 0.8
"""Of an extended finger: distance of its ends by the length of its bones; distance of the tip from the palm by that
of the knuckles from the wrist. In a recording of one hand fingers have medians of 0.99 and 1.05 to 1.26."""
KEYPOINT_POSTURE = Posture(
    open_thumb=math.radians(87),
    open_forefinger=math.radians(37),
    thumb=math.radians(80),
    forefinger=math.radians(35),
    person_sd=math.radians(6),
)
"""Angles between the palm's direction and the middle of a finger's first bone: medians of one hand in 281 frames in
which it is open, and in those in which the finger is extended and another one is not. Bases in silhouettes are farther
from the palm, and their angles smaller."""


def observe_keypoints(points: np.ndarray, confidence: np.ndarray) -> HandObservation:
    """What keypoints show of a hand; `detection.no_hand()` where wrist or all knuckles were not found.

    Args:
        points: (21, 2) pixels; anything where a keypoint was not found.
        confidence: (21,), from 0 to 1; below `LEAST_CONFIDENCE` a keypoint was not found.

    Raises:
        ValueError: if `points` is not (21, 2) or `confidence` not (21,).
    """
    points, confidence = np.asarray(points, float), np.asarray(confidence, float)
    if points.shape != (NUM_KEYPOINTS, 2) or confidence.shape != (NUM_KEYPOINTS,):
        raise ValueError(
            f"points and confidence must be ({NUM_KEYPOINTS}, 2) and ({NUM_KEYPOINTS},); got {points.shape} and "
            f"{confidence.shape}."
        )
    is_found = (confidence >= LEAST_CONFIDENCE) & np.isfinite(points).all(axis=1)
    knuckles = [i for i in KNUCKLES if is_found[i]]
    if not is_found[WRIST] or not knuckles:
        return no_hand()
    middle = points[knuckles].mean(axis=0)
    length = float(np.linalg.norm(middle - points[WRIST]))
    if length == 0:
        return no_hand()
    palm = points[WRIST] + PALM_SHARE * (middle - points[WRIST])
    is_tip = _extended(points, is_found, palm, length)
    starts = [points[list(bone)].mean(axis=0) for bone in FIRST_BONES]
    tips = [points[chain[-1]] for chain in FINGERS]
    shown = np.array(is_tip)[:, None]
    found: dict[str, Any] = dict(
        tips=np.where(shown, tips, 0.0).astype(np.float32),
        is_tip=is_tip,
        scores=np.where(is_tip, confidence[[chain[-1] for chain in FINGERS]], 0.0).astype(np.float32),
        bases=np.where(shown, starts, 0.0).astype(np.float32),
        has_base=is_tip,
        palm=palm.astype(np.float32),
        palm_radius=np.asarray(0.5 * length, np.float32),
        axis=((middle - points[WRIST]) / length).astype(np.float32),
        has_axis=np.asarray(True),
        is_hand=np.asarray(True),
    )
    return no_hand()._replace(**found)


def thumb_side(points: np.ndarray) -> int:
    """1 if the thumb is counter-clockwise of the palm's direction as a person sees the image, -1 if it is clockwise.

    From the first knuckle to the last, which do not move beside the palm; 0 where they are not finite.
    """
    points = np.asarray(points, float)
    x, y = points[KNUCKLES[0]] - points[KNUCKLES[-1]]
    along = points[list(KNUCKLES)].mean(axis=0) - points[WRIST]
    across = along[1] * x - along[0] * y
    return int(np.sign(across)) if np.isfinite(across) else 0


def _extended(
    points: Float[np.ndarray, "21 2"], is_found: Bool[np.ndarray, " 21"], palm: Float[np.ndarray, "2"], length: float
) -> Bool[np.ndarray, " tips"]:
    extended = np.zeros(MAX_TIPS, bool)
    for i, chain in enumerate(FINGERS):
        joints = points[list(chain)]
        if not is_found[list(chain)].all():
            continue
        bones = float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())
        is_straight = float(np.linalg.norm(joints[-1] - joints[0])) > LEAST_STRAIGHTNESS * bones
        extended[i] = is_straight and float(np.linalg.norm(joints[-1] - palm)) > LEAST_REACH * length
    return extended
