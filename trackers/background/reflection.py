"""How much of people a floor mirrors: a share of their difference from the background below them.

A polished floor shows people upside down below their feet, weaker than they are. Its difference from the background is
a share of theirs that is a property of floor and camera. Below the lower ends of what differs strongly, a floor that
mirrors nothing shows next to no difference.
"""

from collections.abc import Iterable

import cv2
import numpy as np

REACH = 1 / 7
"""Of the rows of an image: above a reflection by no more than this is something that is mirrored there."""
_SIDE_PX = 3
"""To the left and right, which are not quite below."""
_STRONG = 2.0
"""Thresholds by which people differ where they are compared with what is below them."""
_GAP, _LEAST_HEIGHT, _SOURCE = 0.03, 0.05, 0.05
"""Of the rows of an image: gaps that are closed, least height of what differs strongly, and how much of its lower end
is mirrored first."""
_BELOW = (0.01, 0.06)
"""Of the rows of an image: from where to where below the end the floor is looked at."""
_LEAST_COLUMNS = 100
"""Lower ends, counted by columns, without which nothing is said."""


def strongest_above(differences: np.ndarray, *, every: int = 1) -> np.ndarray:
    """(rows, cols): the largest of the differences (rows, cols) from `REACH` above each pixel down to it.

    Args:
        differences: uint8.
        every: Pixels along a side of the squares whose largest differences are compared. Larger squares are faster,
            and may count differences that are off by less than two of their sides.
    """
    up, down = round(REACH * differences.shape[0]), _SIDE_PX
    if every == 1:
        return _largest_near(differences, up, down, _SIDE_PX)
    # The largest of each square lies at its first pixel, whose anchor it is.
    square = cv2.dilate(differences, np.ones((every, every), np.uint8), anchor=(0, 0))[::every, ::every]
    coarse = _largest_near(np.ascontiguousarray(square), *(-(-reach // every) for reach in (up, down, _SIDE_PX)))
    return enlarged(coarse, every, differences.shape)


def enlarged(coarse: np.ndarray, every: int, shape: tuple[int, ...]) -> np.ndarray:
    """(rows, cols) of `shape`, each pixel of a coarse image repeated in a square of `every` pixels a side."""
    wide = cv2.merge([coarse] * every).reshape(len(coarse), -1)  # several times as fast as `cv2.resize`
    return np.ascontiguousarray(np.repeat(wide, every, axis=0)[: shape[0], : shape[1]])


def _largest_near(differences, up, down, side):
    kernel = np.ones((up + down + 1, 2 * side + 1), np.uint8)
    return cv2.dilate(differences, kernel, anchor=(side, up))


def reflected_share(differences: Iterable[np.ndarray], threshold: float) -> float:
    """Median share of a difference that is found below it; 0 where too few people are visible.

    Args:
        differences: Images (rows, cols) uint8 of absolute differences from the background.
        threshold: Difference of foreground, in the same unit.
    """
    shares = np.concatenate([np.zeros(0), *(_below_ends(one, threshold) for one in differences)])
    return float(np.median(shares)) if len(shares) >= _LEAST_COLUMNS else 0.0


def _below_ends(differences: np.ndarray, threshold: float) -> np.ndarray:
    """(ends,) for each column in which something ends: the median below as a share of the largest above."""
    rows = differences.shape[0]
    gap, height, source, near, far = (max(1, round(share * rows)) for share in (_GAP, _LEAST_HEIGHT, _SOURCE, *_BELOW))
    strong: np.ndarray = (differences >= _STRONG * threshold).astype(np.uint8)
    for operation, length in ((cv2.MORPH_CLOSE, gap), (cv2.MORPH_OPEN, height)):
        strong = cv2.morphologyEx(strong, operation, np.ones((length, 1), np.uint8))
    v, u = np.nonzero((strong[:-1] > 0) & (strong[1:] == 0))
    whole = (v >= source) & (v + far < rows)
    v, u = v[whole], u[whole]
    above = differences[v - np.arange(source)[:, None], u].max(axis=0)
    below = np.median(differences[v + np.arange(near, far + 1)[:, None], u], axis=0)
    return below / np.maximum(above, 1)
