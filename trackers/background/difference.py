"""Differences from a background image as probabilities, in 8-bit arithmetic that keeps up with full HD."""

from collections.abc import Sequence

import cv2
import numpy as np

from jaxfilters.trackers.background.reflection import enlarged, reflected_share, strongest_above

NOISE_STEPS = 16
"""Steps of the noise to one level of brightness."""
_MAD_TO_STD = 1.4826
_AT_THRESHOLD = 64
"""Entry of the table for a difference as large as the threshold; the last one is for four times as much."""
_STEEPNESS = 6.0
"""Slope of the logistic function at the threshold: 0.25 percent without any difference."""
SHADOW_BRIGHTNESS = (0.5, 0.95)
"""How bright the background may remain within a shadow."""
SHADOW_CHROMATICITY = 0.02
"""Largest change of red / (red + green + blue), or of green or blue, within a shadow."""
_REFLECTIONS, _MOST_MIRRORED = 2.0, 0.5
"""Median reflections that are no foreground, and what is more than a reflection in any case."""
_COARSE_COLS = 640
"""Columns in which shadows and reflections are looked for, at least: in larger images they are larger as well."""
_SHADOW_SIDE = 5
"""Pixels: shadows are at least as wide everywhere; the edges of dark clothes, which look alike, are not."""


class Difference:
    """Probability that a pixel differs from the background by more than its noise and more than a shadow would.

    Buffers are kept from image to image; all images have the shape of the background.
    """

    def __init__(self, difference: float, spread: float, shadow_probability: float):
        """Thresholds as in `MedianBackground`; the background comes with `set_background`."""
        self._least, self._spread, self._shadow_probability = difference, spread, shadow_probability
        self.background: np.ndarray | None = None
        """(rows, cols[, 3]) uint8."""
        self.noise = np.zeros((0, 0), np.uint8)
        """(rows, cols): median absolute deviation in steps of 1 / `NOISE_STEPS` of a level."""
        self.reflection = 0.0
        """Share of a difference that the floor mirrors below it; `estimate_reflection` finds it."""
        self._table = logistic_table()

    def set_background(self, background: np.ndarray, noise: np.ndarray) -> None:
        """Compare with `background` from now on; both arrays are taken over."""
        self.background, self.noise = background, noise
        rows, cols = background.shape[:2]
        self._absolute = np.empty_like(background)
        self._channels = [np.empty((rows, cols), np.uint8) for _ in range(3)]
        self._largest, self._smooth, self._ratio = (np.empty((rows, cols), np.uint8) for _ in range(3))
        self._set_threshold()

    @property
    def mirrors(self) -> bool:
        """Whether reflections of what differs most would be foreground."""
        return 255 * _REFLECTIONS * self.reflection > self._least

    def probability(self, image: np.ndarray) -> np.ndarray:
        """(rows, cols) float32, one half where the largest difference among the channels is at the threshold.

        Raises:
            ValueError: an image of another shape or type than the background.
        """
        background = self._checked(image)
        self._compare(image, background)
        cv2.divide(self._smooth, self._raised_threshold(), dst=self._ratio, scale=_AT_THRESHOLD)
        probability = cv2.LUT(self._ratio, self._table)
        if self._shadow_probability < 1:
            self._weaken_shadows(image, probability)
        return probability

    def estimate_reflection(self, images: Sequence[np.ndarray]) -> None:
        """From images in which people stand or walk, in the light of the background."""
        differences = []
        for image in images:
            self._compare(image, self._checked(image))
            differences.append(self._smooth.copy())
        self.reflection = reflected_share(differences, self._least)

    def follow(self, image: np.ndarray, probability: np.ndarray | None, keep: np.ndarray | None) -> None:
        """Move the background and its noise by a step towards `image`.

        Args:
            image: what was compared last.
            probability: where it is one half or more, nothing moves; None for everywhere.
            keep: (rows, cols), non-zero where nothing moves.
        """
        background = self._checked(image)
        still = np.zeros(background.shape[:2], np.uint8) if keep is None else (np.asarray(keep) != 0).astype(np.uint8)
        if probability is not None:
            still |= (probability >= 0.5).view(np.uint8)
        moves = 1 - still
        self.noise = _stepped(self.noise, cv2.convertScaleAbs(self._smooth, alpha=NOISE_STEPS), moves)
        step = moves if image.ndim == 2 else cv2.merge([moves, moves, moves])
        self.background = _stepped(background, image, step)
        self._set_threshold()

    def noise_of(self, deviations: np.ndarray) -> np.ndarray:
        """Noise as stored, of median absolute deviations in levels, smoothed over neighbours."""
        return cv2.blur(cv2.convertScaleAbs(deviations, alpha=NOISE_STEPS), (5, 5))

    def _compare(self, image: np.ndarray, background: np.ndarray) -> None:
        """Leaves the largest difference among the channels, after a median of nine, in `_smooth`."""
        cv2.absdiff(image, background, dst=self._absolute)
        if image.ndim == 2:
            largest = self._absolute
        else:
            cv2.split(self._absolute, self._channels)
            largest = cv2.max(self._channels[0], self._channels[1], dst=self._largest)
            largest = cv2.max(largest, self._channels[2], dst=self._largest)
        cv2.medianBlur(largest, 3, dst=self._smooth)

    def _raised_threshold(self) -> np.ndarray:
        """(rows, cols): where the floor mirrors, more than the reflection of what is above."""
        if not self.mirrors:
            return self._threshold
        share = min(_REFLECTIONS * self.reflection, _MOST_MIRRORED)
        mirrored = strongest_above(self._smooth, every=every_px(self._smooth))
        return cv2.max(self._threshold, cv2.convertScaleAbs(mirrored, alpha=share))

    def _set_threshold(self) -> None:
        levels = cv2.convertScaleAbs(self.noise, alpha=self._spread * _MAD_TO_STD / NOISE_STEPS)
        self._threshold = cv2.max(levels, np.full_like(levels, round(self._least)))

    def _checked(self, image: np.ndarray) -> np.ndarray:
        if self.background is None:
            raise ValueError("the background must be set before images are compared with it.")
        if image.shape != self.background.shape or image.dtype != np.uint8:
            raise ValueError(
                f"image must be uint8 {self.background.shape} like the background; got {image.dtype} {image.shape}."
            )
        return self.background

    def _weaken_shadows(self, image: np.ndarray, probability: np.ndarray) -> None:
        """Only what differs at all is looked at, a few percent of an image; of large images not every pixel."""
        assert self.background is not None
        every = every_px(image)
        ratio = np.ascontiguousarray(self._ratio[::every, ::every])
        found = cv2.findNonZero(cv2.inRange(ratio, _AT_THRESHOLD * 3 // 4, 255))
        if found is None:
            return
        cols, rows = found[:, 0].T
        places = every * (rows * np.int32(image.shape[1]) + cols)
        mask: np.ndarray = np.zeros(ratio.shape, np.uint8)
        mask[rows, cols] = is_shadow(_colors(image, places), _colors(self.background, places))
        mask = wide(mask, -(-_SHADOW_SIDE // every) | 1)
        u, v, width, height = cv2.boundingRect(mask)
        if not width:
            return
        within = probability[every * v : every * (v + height), every * u : every * (u + width)]
        shadow = enlarged(mask[v : v + height, u : u + width], every, within.shape)
        cv2.copyTo(np.minimum(within, np.float32(self._shadow_probability)), shadow, within)


def every_px(image: np.ndarray) -> int:
    """The distance of the pixels (rows, cols[, channels]) at which shadows and reflections are looked for."""
    return max(1, image.shape[1] // _COARSE_COLS)


def logistic_table() -> np.ndarray:
    """(256,) float32: probability by the ratio of difference and threshold, in steps of 1 / 64."""
    ratio = np.arange(256) / _AT_THRESHOLD
    return (1 / (1 + np.exp(-_STEEPNESS * (ratio - 1)))).astype(np.float32)


def is_shadow(now: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """(n,) whether colours (channels, n) are those of the empty room, only darker (Kato et al., improvement 2)."""
    now, empty = now.astype(np.float32), empty.astype(np.float32)
    sum_now, sum_empty = sum(now), sum(empty)
    low, high = SHADOW_BRIGHTNESS
    is_darker = (low * sum_empty <= sum_now) & (sum_now <= high * sum_empty) & (sum_now > 0)
    change = [np.abs(a * sum_empty - b * sum_now) for a, b in zip(now, empty, strict=True)]
    return is_darker & (np.max(change, axis=0) < np.float32(SHADOW_CHROMATICITY) * sum_now * sum_empty)


def wide(mask: np.ndarray, side: int = _SHADOW_SIDE) -> np.ndarray:
    """The parts of a mask (rows, cols) that are at least as wide as a shadow, `side` pixels."""
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))


def _colors(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(channels, n): the image (rows, cols[, channels]) at flat places."""
    return image.reshape(len(image) * image.shape[1], -1).take(places, axis=0).T.copy()


def _stepped(values: np.ndarray, targets: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Values (uint8) moved towards targets by at most `step`."""
    up = cv2.min(cv2.subtract(targets, values), step)
    down = cv2.min(cv2.subtract(values, targets), step)
    return cv2.subtract(cv2.add(values, up), down)
