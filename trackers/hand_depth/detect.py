"""Where in a depth frame a hand may be: surfaces without a jump in depth, and where these are as wide as a palm."""

from typing import NamedTuple

import cv2
import numpy as np

from jaxfilters.models.camera import Pinhole

NEAREST, FARTHEST = 0.15, 2.0
"""Metres between which a hand is looked for."""
JUMP, FINGER_JUMP = 0.015, 0.06
"""Metres of depth between neighbouring pixels that separate two surfaces, at least; and where no palm is found so,
since fingers before it cut it into pieces."""
STEEPEST = 4.0
"""Depth over width from pixel to pixel that is still one surface."""
SMALLEST_AREA = 0.002
"""Square metres of surface below which an object is not a hand."""
LARGEST_AREA = 0.8
"""Square metres above which it is a wall or a floor; a person who reaches out is one surface with the hand."""
LARGEST_PART = 0.008
"""Square metres above which another surface is not a finger before the palm."""
PALM_INSET, EDGE_INSET = (0.018, 0.065), 0.012
"""Metres from the middle of a palm to the outline of the hand; a forearm has less than a body or a desk, too. And of a
hand whose edge or fingertips point at the camera."""
USUAL_INSET = 0.038
APART = 0.07
"""Metres between the middles of two palms that are tried."""
MOST_SIGHTINGS, MOST_ON_SURFACE = 3, 2
"""Places that are tried, and those on one surface while there are others: a desk that is nearer than the hand has many
places of a palm's width."""
FARTHER = 0.6
"""Metres behind the nearest of these places within which others are tried."""
SKIN_TO_MIDDLE = 0.015
"""Metres from the skin to the middle of the palm."""


FEWEST_NEAR = 50
"""Readings that may be noise."""
TOO_NEAR, TOO_FAR = 0.3, 2.0
"""Metres: no reading beyond the first, or none nearer than the second, is what a wrong unit of length gives."""


def check_unit(frame: np.ndarray) -> str | None:
    """A warning where all readings of a frame (metres) are too far away for any hand; `None` where they are not.

    Raises:
        ValueError: all readings are nearer than a depth camera can measure.
    """
    readings = frame[np.isfinite(frame)]
    if not readings.size:
        return None
    near, far = np.sort(readings)[min(FEWEST_NEAR, readings.size - 1)], np.percentile(readings, 99)
    if far < TOO_NEAR:
        raise ValueError(f"depth must be in metres: no reading is beyond {far:.3g} m; is the unit off by ten or more?")
    if near > TOO_FAR:
        return f"no reading is nearer than {near:.3g} m, where no hand is looked for; is the unit of depth right?"
    return None


class Sighting(NamedTuple):
    """Something that may be a hand."""

    center: np.ndarray
    """(3,) metres, camera frame: the middle of the palm."""
    frame: np.ndarray
    """(rows, cols) metres: without other large surfaces, which are `inf` where they are farther away, else NaN."""
    surface: int
    """Number of the surface on which it lies: a hand and its forearm are one."""


def hand_sightings(camera: Pinhole, frame: np.ndarray) -> list[Sighting]:
    """Places of a palm's width in a frame (rows, cols) in metres, at most `MOST_SIGHTINGS`, the likeliest first.

    Likely is what is near the camera and as wide as a palm (distance transform of its surface). Where there is no such
    place, a hand may point at the camera: fingers before the palm are then of its surface, and less width is enough.
    """
    depth = _without_small_holes(frame)
    depth = np.where((depth > NEAREST) & (depth < FARTHEST), depth, np.inf).astype(np.float32)
    facing = _sightings(camera, frame, depth, JUMP, PALM_INSET[0])
    return facing or _sightings(camera, frame, depth, FINGER_JUMP, EDGE_INSET)


def _sightings(camera: Pinhole, frame: np.ndarray, depth: np.ndarray, jump: float, least: float) -> list[Sighting]:
    """Places on surfaces that a `jump` in depth separates, at least `least` metres from their outlines."""
    surfaces, area = _surfaces(depth, float(camera.focal[0]), jump)
    labels = np.where((area[surfaces] > SMALLEST_AREA) & (area[surfaces] < LARGEST_AREA), surfaces, 0)
    inset = cv2.distanceTransform((labels > 0).astype(np.uint8), cv2.DIST_L2, 5)
    inset = np.where(labels > 0, inset * np.where(np.isfinite(depth), depth, 0.0) / float(camera.focal[0]), 0.0)
    peaks = (inset >= cv2.dilate(inset.astype(np.float32), np.ones((5, 5), np.uint8)) - 1e-6) & (inset > least)
    rows, cols = np.nonzero(peaks & (inset < PALM_INSET[1]))
    if not len(rows):
        return []
    z = depth[rows, cols]
    fx, fy = np.asarray(camera.focal)
    cx, cy = np.asarray(camera.center)
    centers = np.stack([(cols - cx) / fx * z, (rows - cy) / fy * z, z + SKIN_TO_MIDDLE], axis=-1)
    cost = 3.0 * z + np.abs(np.log(inset[rows, cols] / USUAL_INSET))
    order = [int(i) for i in np.argsort(cost) if z[i] <= z.min() + FARTHER]
    on = labels[rows, cols]
    return [_sighting(frame, surfaces, area, centers[i], int(on[i])) for i in _chosen(order, centers, on)]


def _chosen(order: list[int], centers: np.ndarray, surface: np.ndarray) -> list[int]:
    """The first ones in an order that are `APART`, of all surfaces that have one, at most `MOST_SIGHTINGS`."""
    chosen: list[int] = []
    for most in (MOST_ON_SURFACE, MOST_SIGHTINGS):
        for i in order:
            full = len(chosen) == MOST_SIGHTINGS or np.sum(surface[chosen] == surface[i]) >= most
            if not full and all(np.linalg.norm(centers[i] - centers[j]) > APART for j in chosen):
                chosen.append(i)
    return chosen


def _without_small_holes(frame: np.ndarray) -> np.ndarray:
    """The frame with pixels that have no reading filled from their neighbours, two pixels deep."""
    filled = np.where(np.isfinite(frame), frame, np.inf).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    near = cv2.dilate(np.where(np.isfinite(filled), filled, 0.0).astype(np.float32), kernel, iterations=2)
    near = cv2.erode(near, kernel, iterations=2)
    return np.where(np.isfinite(filled), filled, np.where(near > 0, near, np.inf))


def _surfaces(depth: np.ndarray, focal: float, jump: float) -> tuple[np.ndarray, np.ndarray]:
    """(rows, cols) int: numbers of the surfaces, 0 between them; and their areas in square metres, that of 0 being 0.

    The farther one of two neighbours across a jump is taken out, so that what is in front keeps its shape.
    """
    near = cv2.erode(depth, np.ones((3, 3), np.uint8))
    finite = np.isfinite(depth)
    z = np.where(finite, depth, 1.0)
    with np.errstate(invalid="ignore"):
        jumps = finite & (depth - near > np.maximum(jump, STEEPEST * z / focal))
    mask = (finite & ~jumps).astype(np.uint8)
    count, labels = cv2.connectedComponents(mask, connectivity=4)
    area = np.bincount(labels.ravel(), weights=np.where(mask > 0, (z / focal) ** 2, 0.0).ravel(), minlength=count)
    return labels, np.where(np.arange(count) > 0, area, 0.0)


def _sighting(frame: np.ndarray, surfaces: np.ndarray, area: np.ndarray, center: np.ndarray, label: int) -> Sighting:
    # Small surfaces stay: fingers before the palm are separated from it by a jump.
    other = (surfaces != label) & ((surfaces == 0) | (area[surfaces] > LARGEST_PART)) & np.isfinite(frame)
    behind = np.where(frame > center[2], np.inf, np.nan)
    return Sighting(center.astype(np.float32), np.where(other, behind, frame).astype(np.float32), label)
