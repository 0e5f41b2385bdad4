"""Fingers behind their tips: where they begin, how thick they are, and where exactly they end."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

STEP = 0.5
"""Tip radii from one place along a finger to the next."""
MOST_STEPS = 28
SIDEWAYS = np.array([-0.6, -0.3, 0.0, 0.3, 0.6])
"""Tip radii from the expected to a possible middle of the finger."""
NEAR_TIP = 4
"""Steps over which the thickness of a finger is measured."""
TURNING = 0.4
"""Weight of the last step in the direction of the next."""
WIDENING, PALM = 1.15, 1.45
"""Times as thick as near its tip a finger begins at the latest, and is the palm."""
LONGEST_SHIFT = 0.7
"""Tip radii by which a tip is moved at most."""
LEAST_RADIUS, MOST_RADIUS = 0.6, 1.8
"""Tip radii of any finger of a hand."""
AHEAD, MOST_AHEAD = (0.2, 0.6), 0.3
"""Tip radii ahead of its end where a finger goes on if it does, and the share that may be hand there."""
THINNER = 25
"""Percentile of the widths near the end that counts: farther down, another finger may touch."""
END_REACH = 1.7
"""Radii of a finger over which its end is compared with a half disc."""


class Bases(NamedTuple):
    """Where fingers begin."""

    points: Float[np.ndarray, "n 2"]
    """Pixels; of what is not found the tip."""
    is_found: Bool[np.ndarray, " n"]


class Ends(NamedTuple):
    """How fingers end."""

    points: Float[np.ndarray, "n 2"]
    """Middles of the discs, pixels."""
    radii: Float[np.ndarray, " n"]
    """Pixels."""
    scores: Float[np.ndarray, " n"]
    """Agreement with a half disc on a finger of that thickness and direction, at most 1."""
    is_end: Bool[np.ndarray, " n"]
    """Whether the finger does not go on ahead."""


def find_bases(
    depth: Float[np.ndarray, "rows cols"],
    tips: Float[np.ndarray, "n 2"],
    palm: Float[np.ndarray, "2"],
    radius: float,
) -> Bases:
    """The ends of fingers at the palm, by going down their middles from the tips until they widen.

    Args:
        depth: Distance of each pixel to the outline, 0 outside, pixels.
        tips: Pixels.
        palm: Pixels; fingers begin somewhere between it and their tips.
        radius: Of tips, pixels.
    """
    if len(tips) == 0:
        return Bases(tips, np.zeros(0, bool))
    place, base = tips.copy(), tips.copy()
    is_found, going = np.zeros(len(tips), bool), np.ones(len(tips), bool)
    direction = _units(palm - tips)
    thickness = np.full(len(tips), 0.7 * radius)
    each = np.arange(len(tips))
    for step in range(MOST_STEPS):
        across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        ahead = place + STEP * radius * direction
        options = ahead[:, None] + radius * SIDEWAYS[:, None] * across[:, None]
        inset = _sampled(depth, options) - 0.02 * radius * np.abs(SIDEWAYS)
        best = inset.argmax(axis=1)
        here = inset[each, best]
        if step < NEAR_TIP:
            thickness = np.clip(np.maximum(thickness, here), None, 1.3 * radius)
        narrow = (here <= WIDENING * thickness) & going
        # Where it widens, the middle of what is there is no longer that of the finger.
        chosen = np.where(narrow[:, None], options[each, best], ahead)
        turned = _units((1 - TURNING) * direction + TURNING * _units(chosen - place))
        place, direction = chosen, np.where(narrow[:, None], turned, direction)
        base = np.where(narrow[:, None], place, base)
        is_found |= going & (here > PALM * thickness)
        going &= ~is_found & (here > 0.3 * radius)
        if not going.any():
            break
    return Bases(base, is_found)


def measured_ends(
    silhouette: UInt8[np.ndarray, "rows cols"],
    tips: Float[np.ndarray, "n 2"],
    towards: Float[np.ndarray, "n 2"],
    radius: float,
) -> Ends:
    """Middles of the discs in which fingers end, from where their outlines end along and across their directions.

    Args:
        silhouette: 255 times the share of each pixel that is hand.
        tips: To about half a radius, pixels.
        towards: Unit vectors along the fingers, to their ends.
        radius: Of tips, pixels; each finger's own is measured.
    """
    if len(tips) == 0:
        return Ends(tips.astype(float), np.zeros(0), np.zeros(0), np.zeros(0, bool))
    reach = int(np.ceil(2 * radius))
    t, along = np.arange(-reach, reach + 1.0), np.arange(-reach, int(np.ceil(3 * radius)) + 1.0)
    across = np.stack([-towards[:, 1], towards[:, 0]], axis=1)
    places = tips[:, None, None] + along[:, None] * towards[:, None, None] + t[:, None, None] * across[:, None, None]
    whole = _sampled(silhouette, places.reshape(-1, len(along), 2)).reshape(places.shape[:3]) / np.float32(255)
    # Only what is joined to the middle across the finger: not the next finger.
    left = np.minimum.accumulate(whole[:, reach::-1], axis=1)[:, ::-1]
    patch = np.concatenate([left, np.minimum.accumulate(whole[:, reach:], axis=1)[:, 1:]], axis=1)
    shaft = (along > -1.5 * radius) & (along < -0.5 * radius)
    widths = np.percentile(patch[:, :, shaft].sum(axis=1), THINNER, axis=1)
    own = np.clip(widths / 2, LEAST_RADIUS * radius, MOST_RADIUS * radius)
    half = patch[:, :, (along > -radius) & (along < 0.3 * radius)].sum(axis=2)
    aside = half @ t / np.maximum(half.sum(axis=1), 1e-6)
    off = t - aside[:, None]
    core = np.maximum(1 - np.maximum(np.abs(off) - 0.6 * own[:, None], 0), 0)
    front = (along >= -0.5 * radius) & (along <= 2 * radius)
    ends = along[front][0] - 0.5 + whole[:, :, front].sum(axis=2)
    middles = ends - np.sqrt(np.maximum(own[:, None] ** 2 - off**2, 0))
    beyond = np.sum(core * middles, axis=1) / np.sum(core, axis=1)
    shift = np.clip([beyond, aside], -LONGEST_SHIFT * radius, LONGEST_SHIFT * radius)
    points = tips + shift[0][:, None] * towards + shift[1][:, None] * across
    ahead, off = along - shift[0][:, None], t - shift[1][:, None]
    return Ends(points, own, _agreement(whole, ahead, off, own), _is_free(whole, ahead, off, own, radius))


def _is_free(patch: np.ndarray, along: np.ndarray, t: np.ndarray, own: np.ndarray, radius: float) -> np.ndarray:
    """(n,) whether patches (n, t, along) are mostly empty ahead of the ends."""
    low, high = (own[:, None] + share * radius for share in AHEAD)
    weight = (np.abs(t) <= 0.5 * own[:, None])[:, :, None] & ((along >= low) & (along <= high))[:, None, :]
    return np.sum(weight * patch, axis=(1, 2)) < MOST_AHEAD * np.maximum(weight.sum(axis=(1, 2)), 1)


def _agreement(patch: np.ndarray, along: np.ndarray, t: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Zero-mean normalised correlation (n,) of patches (n, t, along) with a half disc on a finger, near its end."""
    near = [np.abs(places) <= END_REACH * radius[:, None] for places in (t, along)]
    weight = near[0][:, :, None] & near[1][:, None, :]
    distance = np.hypot(np.maximum(along, 0)[:, None, :], t[:, :, None])
    finger = np.clip(radius[:, None, None] + 0.5 - distance, 0, 1)
    count = np.maximum(weight.sum(axis=(1, 2)), 1)

    def centred(image):
        mean = np.sum(weight * image, axis=(1, 2)) / count
        return weight * (image - mean[:, None, None])

    a, b = centred(finger), centred(patch)
    power = np.sum(a**2, axis=(1, 2)) * np.sum(b**2, axis=(1, 2))
    return np.sum(a * b, axis=(1, 2)) / np.sqrt(np.maximum(power, 1e-6))


def _sampled(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values between pixels (..., ) at points (..., 2), 0 outside."""
    x, y = points[..., 0].astype(np.float32), points[..., 1].astype(np.float32)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _units(vectors: np.ndarray) -> np.ndarray:
    lengths = np.hypot(vectors[:, 0], vectors[:, 1])
    return vectors / np.maximum(lengths, 1e-9)[:, None]
