"""Fingers behind their tips: where they begin, how thick they are, and where exactly they end."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

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
    depth: Float[np.ndarray, "rows cols *layers"],
    tips: Float[np.ndarray, "n 2"],
    palm: Float[np.ndarray, "2"],
    radius: float,
    layer: Int[np.ndarray, " n"] | None = None,
) -> Bases:
    """The ends of fingers at the palm, by going down their middles from the tips until they widen.

    Args:
        depth: Distance of each pixel to the outline, 0 outside, pixels; of several silhouettes with `layer`.
        tips: Pixels.
        palm: Pixels; fingers begin somewhere between it and their tips.
        radius: Of tips, pixels.
        layer: Which silhouette each finger is in, the last axis of `depth`.
    """
    if len(tips) == 0:
        return Bases(tips, np.zeros(0, bool))
    # Complex numbers are turned and scaled in a third of the time of vectors.
    place = np.ascontiguousarray(tips, float).view(complex)[:, 0]
    base = place
    is_found, going = np.zeros(len(tips), bool), np.ones(len(tips), bool)
    direction = _units(complex(*palm) - place)
    sideways, drift = 1j * radius * SIDEWAYS, (0.02 * radius * np.abs(SIDEWAYS)).astype(np.float32)
    thickness = np.full(len(tips), 0.7 * radius)
    each = np.arange(len(tips))
    for step in range(MOST_STEPS):
        ahead = place + STEP * radius * direction
        options = ahead[:, None] + sideways * direction[:, None]
        sampled = _sampled(depth, options.real, options.imag)
        inset = (sampled if layer is None else sampled[each, :, layer]) - drift
        best = inset.argmax(axis=1)
        here = inset[each, best]
        if step < NEAR_TIP:
            thickness = np.clip(np.maximum(thickness, here), None, 1.3 * radius)
        narrow = (here <= WIDENING * thickness) & going
        # Where it widens, the middle of what is there is no longer that of the finger.
        chosen = np.where(narrow, options[each, best], ahead)
        turned = _units((1 - TURNING) * direction + TURNING * _units(chosen - place))
        place, direction = chosen, np.where(narrow, turned, direction)
        base = np.where(narrow, place, base)
        is_found |= going & (here > PALM * thickness)
        going &= ~is_found & (here > 0.3 * radius)
        if not going.any():
            break
    return Bases(np.stack([base.real, base.imag], axis=1), is_found)


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
    return ends_of(end_patches(silhouette, tips, towards, radius), tips, towards, radius)


def end_patches(
    silhouette: UInt8[np.ndarray, "rows cols"],
    tips: Float[np.ndarray, "n 2"],
    towards: Float[np.ndarray, "n 2"],
    radius: float,
) -> Float[np.ndarray, "n across along"]:
    """Shares of hand around tips, in axes across and along the fingers; arguments as for `measured_ends`."""
    t, along = _patch_axes(radius)
    if len(tips) == 0:
        return np.zeros((0, len(t), len(along)), np.float32)
    # Coordinates first: loops over the last axis are fast if it is long.
    middles, ahead, aside = (vectors.T[:, :, None, None] for vectors in (tips, towards, _across(towards)))
    x, y = (middles + along * ahead + t[:, None] * aside).reshape(2, -1, len(along))
    return _sampled(silhouette, x, y).reshape(len(tips), len(t), len(along)) / np.float32(255)


def _patch_axes(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels across and along a finger from the middle of its tip."""
    reach = int(np.ceil(2 * radius))
    return np.arange(-reach, reach + 1.0), np.arange(-reach, int(np.ceil(3 * radius)) + 1.0)


def _across(towards: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    return np.stack([-towards[:, 1], towards[:, 0]], axis=1)


def ends_of(
    whole: Float[np.ndarray, "n across along"],
    tips: Float[np.ndarray, "n 2"],
    towards: Float[np.ndarray, "n 2"],
    radius: float,
) -> Ends:
    """What `measured_ends` gives, of `end_patches` that may be of several silhouettes."""
    if len(tips) == 0:
        return Ends(tips.astype(float), np.zeros(0), np.zeros(0), np.zeros(0, bool))
    t, along = _patch_axes(radius)
    reach, across = len(t) // 2, _across(towards)
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
    squares = [np.square(places).astype(np.float32) for places in (np.maximum(along, 0), t)]
    distance = np.sqrt(squares[0][:, None, :] + squares[1][:, :, None])
    finger = np.clip((radius + 0.5).astype(np.float32)[:, None, None] - distance, 0, 1)
    count = np.maximum(weight.sum(axis=(1, 2)), 1)

    def centred(image):
        mean = np.sum(weight * image, axis=(1, 2)) / count
        return weight * (image - mean.astype(np.float32)[:, None, None])

    a, b = centred(finger), centred(patch)
    power, common = np.vecdot(a, a).sum(axis=1) * np.vecdot(b, b).sum(axis=1), np.vecdot(a, b).sum(axis=1)
    return common / np.sqrt(np.maximum(power, 1e-6))


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (rows, cols) between pixels at such columns and rows, 0 outside."""
    x, y = x.astype(np.float32), y.astype(np.float32)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _units(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.abs(vectors), 1e-9)
