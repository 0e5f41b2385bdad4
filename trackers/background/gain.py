"""The light of an image in that of the background: one factor a channel, by the median over a grid of pixels."""

from collections.abc import Sequence

import cv2
import numpy as np

_GRID = 96
"""Pixels along the longer side of the image that are looked at."""
_DARK, _BRIGHT = 16, 245
"""Values outside are noise or saturated."""
_LEAST_PIXELS = 100
_STEADY = 0.01
"""A light that is as near to that of the background as this is the same."""
_LEAST, _MOST = 0.3, 3.0
_SPARSE = 8
"""Every so many rows and columns are enough for the brightness of an image."""


def gain_of(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(channels,) how much brighter an image is than its background.

    The median of ratios holds as long as people and shadows cover less than half of the image. A channel of which too
    few pixels are neither dark nor saturated has the median of the others, or 1.

    Args:
        image: (rows, cols) or (rows, cols, channels), uint8.
        background: Of the same shape.
    """
    every = max(1, max(image.shape[:2]) // _GRID)
    now, empty = (a[::every, ::every].reshape(-1, *a.shape[2:], 1)[..., 0].astype(float) for a in (image, background))
    now, empty = now.reshape(len(now), -1), empty.reshape(len(empty), -1)
    usable = (now > _DARK) & (now < _BRIGHT) & (empty > _DARK) & (empty < _BRIGHT)
    found = np.array(
        [
            np.median(now[use, c] / empty[use, c]) if use.sum() >= _LEAST_PIXELS else np.nan
            for c, use in enumerate(usable.T)
        ]
    )
    others = np.nanmedian(found) if np.isfinite(found).any() else 1.0
    return np.clip(np.where(np.isfinite(found), found, others), _LEAST, _MOST)


def without_gain(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """The image in the light of its background; the image itself where the light is the same."""
    gain = gain_of(image, background)
    if np.all(np.abs(gain - 1) < _STEADY):
        return image
    levels = np.arange(256)
    tables = np.stack([np.clip(np.round(levels / one), 0, 255).astype(np.uint8) for one in gain], axis=-1)
    return cv2.LUT(image, tables[None] if image.ndim == 3 else tables[:, 0])


def in_one_light(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Images (rows, cols[, channels]) uint8 in the light of the one that is brighter than half of the others."""
    brightness = [image[::_SPARSE, ::_SPARSE].mean() for image in images]
    usual = images[int(np.argsort(brightness, kind="stable")[len(images) // 2])]
    return [without_gain(image, usual) for image in images]
