"""Where in a depth frame a hand may be: the nearest object, its palm, and the arm behind it."""

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.start import Sighting

NEAREST, FARTHEST = 0.15, 1.5
"""Metres between which a hand is looked for."""
OBJECT_DEPTH = 0.25
"""Metres behind its nearest point that an arm may reach and still be the same object."""
SMALLEST_AREA = 0.002
"""Square metres of surface below which an object is not a hand."""
MOST_SPECKS = 20
"""Smaller things in front of the hand that are looked past."""
PALM_SEARCH = 0.10
"""Metres about the nearest points within which the palm is looked for."""


def nearest_hand(camera: Pinhole, frame: np.ndarray) -> Sighting | None:
    """Palm and forearm of the nearest object of a hand's size in a frame (rows, cols) in metres; `None` without one.

    The palm is the point farthest from the object's outline (distance transform) among those near the object's nearest
    points: a raised hand is nearer than its arm.
    """
    candidates = np.where((frame > NEAREST) & (frame < FARTHEST), frame, np.inf)
    for _ in range(MOST_SPECKS):
        if not np.isfinite(candidates).any():
            break
        limit = candidates.min() + OBJECT_DEPTH
        _, labels = cv2.connectedComponents((candidates < limit).astype(np.uint8))
        label = labels[np.unravel_index(candidates.argmin(), candidates.shape)]
        mask = labels == label
        area = np.sum(candidates[mask] ** 2) / float(np.prod(camera.focal))
        if area > SMALLEST_AREA:
            return _sighting(camera, candidates, mask)
        candidates[mask] = np.inf  # a speck of noise
    return None


def _sighting(camera: Pinhole, depth: np.ndarray, mask: np.ndarray) -> Sighting:
    fx, fy = np.asarray(camera.focal)
    cx, cy = np.asarray(camera.center)
    v, u = np.nonzero(mask)
    z = depth[v, u]
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    tip = points[z <= np.percentile(z, 2)].mean(axis=0)
    inset = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)[v, u] * z / fx
    inset[np.linalg.norm(points - tip, axis=-1) > PALM_SEARCH] = 0
    center = points[inset.argmax()] + [0.0, 0.0, 0.015]  # from the skin to the middle of the palm
    distance = np.linalg.norm(points - center, axis=-1)
    arm = points[(distance > 0.11) & (distance < 0.25)]
    forearm = np.zeros(3)
    if len(arm) > 0.1 * np.sum(distance < 0.11):
        forearm = arm.mean(axis=0) - center
        forearm /= np.linalg.norm(forearm)
    return Sighting(jnp.asarray(center, jnp.float32), jnp.asarray(forearm, jnp.float32))
