"""Ends of fingers in a silhouette, by correlation with a disc."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

SUPPRESSION = 2.2
"""Radii within which a tip suppresses a worse one."""


class TipCandidates(NamedTuple):
    """Peaks of the correlation."""

    points: Float[np.ndarray, "n 2"]
    """Pixels, best first."""
    scores: Float[np.ndarray, " n"]


@lru_cache(maxsize=32)
def tip_template(radius: float, half_size: int) -> UInt8[np.ndarray, "side side"]:
    """A disc, 255 on 0, in the middle of a square window with that half side; pixels."""
    offset = np.arange(-half_size, half_size + 1.0)
    distance = np.hypot(offset[None], offset[:, None])
    return np.rint(255 * np.clip(radius + 0.5 - distance, 0, 1)).astype(np.uint8)


def correlation(
    silhouette: UInt8[np.ndarray, "rows cols"], disc: UInt8[np.ndarray, "side side"]
) -> Float[np.ndarray, "rows cols"]:
    """Zero-mean normalised correlation of the template with the silhouette around each pixel, 0 outside of it."""
    margin = len(disc) // 2
    padded = cv2.copyMakeBorder(silhouette, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
    response = cv2.matchTemplate(padded, disc, cv2.TM_CCOEFF_NORMED)
    # A window without contrast has no correlation, and rounding decides what OpenCV makes of it.
    return np.where((silhouette > 127) & np.isfinite(response), response, 0.0)


def peaks(response: Float[np.ndarray, "rows cols"], min_correlation: float) -> TipCandidates:
    """Local maxima of a correlation, best first, to fractions of a pixel."""
    largest = cv2.dilate(response, np.ones((3, 3), np.uint8))
    # A search in one dimension is several times as fast as one in two.
    y, x = np.divmod(np.flatnonzero((response >= largest) & (response > min_correlation)), response.shape[1])
    order = np.argsort(-response[y, x], kind="stable")
    places = np.stack([x[order], y[order]], axis=1)
    return TipCandidates(_refined(response, places), response[y[order], x[order]])


def best_apart(
    points: Float[np.ndarray, "n 2"], scores: Float[np.ndarray, " n"], distance: float, most: int
) -> Int[np.ndarray, " kept"]:
    """Which points are kept, best first: at most `most` with positive scores, none near a better one."""
    kept: list[int] = []
    is_free = scores > 0
    for i in np.argsort(-scores, kind="stable").tolist():
        if len(kept) == most:
            break
        if is_free[i]:
            kept.append(i)
            is_free &= np.hypot(*(points - points[i]).T) > distance
    return np.array(kept, int)


def _refined(response: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Vertices (n, 2) of parabolas through the neighbours of each peak, in x and in y."""
    padded = cv2.copyMakeBorder(response, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    x, y = places[:, 0] + 1, places[:, 1] + 1
    middle = padded[y, x]
    shift = []
    for before, after in ((padded[y, x - 1], padded[y, x + 1]), (padded[y - 1, x], padded[y + 1, x])):
        bend = np.maximum(2 * middle - before - after, 1e-9)
        shift.append(np.clip((after - before) / (2 * bend), -0.5, 0.5))
    return places + np.stack(shift, axis=1)
