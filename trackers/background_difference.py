"""Differences from a background image as probabilities, in 8-bit arithmetic that keeps up with full HD."""

import cv2
import numpy as np

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
        self._table = logistic_table()

    def set_background(self, background: np.ndarray, noise: np.ndarray) -> None:
        """Compare with `background` from now on; both arrays are taken over."""
        self.background, self.noise = background, noise
        rows, cols = background.shape[:2]
        self._absolute = np.empty_like(background)
        self._channels = [np.empty((rows, cols), np.uint8) for _ in range(3)]
        self._largest, self._smooth, self._ratio = (np.empty((rows, cols), np.uint8) for _ in range(3))
        self._set_threshold()

    def probability(self, image: np.ndarray) -> np.ndarray:
        """(rows, cols) float32, one half where the largest difference among the channels is at the threshold.

        Raises:
            ValueError: an image of another shape or type than the background.
        """
        background = self._checked(image)
        cv2.absdiff(image, background, dst=self._absolute)
        if image.ndim == 2:
            largest = self._absolute
        else:
            cv2.split(self._absolute, self._channels)
            largest = cv2.max(self._channels[0], self._channels[1], dst=self._largest)
            largest = cv2.max(largest, self._channels[2], dst=self._largest)
        cv2.medianBlur(largest, 3, dst=self._smooth)
        cv2.divide(self._smooth, self._threshold, dst=self._ratio, scale=_AT_THRESHOLD)
        probability = cv2.LUT(self._ratio, self._table)
        if self._shadow_probability < 1:
            self._weaken_shadows(image, probability)
        return probability

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
        self.noise = _stepped(self.noise, cv2.multiply(self._smooth, np.uint8(NOISE_STEPS)), moves)
        step = moves if image.ndim == 2 else cv2.merge([moves, moves, moves])
        self.background = _stepped(background, image, step)
        self._set_threshold()

    def noise_of(self, deviations: np.ndarray) -> np.ndarray:
        """Noise as stored, of median absolute deviations in levels, smoothed over neighbours."""
        return cv2.blur(cv2.multiply(deviations, np.uint8(NOISE_STEPS)), (5, 5))

    def _set_threshold(self) -> None:
        levels = cv2.convertScaleAbs(self.noise, alpha=self._spread * _MAD_TO_STD / NOISE_STEPS)
        self._threshold = np.maximum(levels, np.uint8(round(self._least)))

    def _checked(self, image: np.ndarray) -> np.ndarray:
        if self.background is None:
            raise ValueError("the background must be set before images are compared with it.")
        if image.shape != self.background.shape or image.dtype != np.uint8:
            raise ValueError(
                f"image must be uint8 {self.background.shape} like the background; got {image.dtype} {image.shape}."
            )
        return self.background

    def _weaken_shadows(self, image: np.ndarray, probability: np.ndarray) -> None:
        """Only what differs at all is looked at: a few percent of an image."""
        assert self.background is not None
        places = np.flatnonzero(cv2.compare(self._ratio, _AT_THRESHOLD * 3 // 4, cv2.CMP_GT))
        channels = 1 if image.ndim == 2 else 3
        now = image.reshape(-1, channels)[places].astype(np.float32)
        empty = self.background.reshape(-1, channels)[places].astype(np.float32)
        shadows = places[is_shadow(now, empty)]
        flat = probability.reshape(-1)
        flat[shadows] = np.minimum(flat[shadows], np.float32(self._shadow_probability))


def logistic_table() -> np.ndarray:
    """(256,) float32: probability by the ratio of difference and threshold, in steps of 1 / 64."""
    ratio = np.arange(256) / _AT_THRESHOLD
    return (1 / (1 + np.exp(-_STEEPNESS * (ratio - 1)))).astype(np.float32)


def is_shadow(now: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """(n,) whether colours (n, channels) are those of the empty room, only darker (Kato et al., improvement 2)."""
    sum_now, sum_empty = now.sum(axis=-1), np.maximum(empty.sum(axis=-1), 1)
    brightness = sum_now / sum_empty
    low, high = SHADOW_BRIGHTNESS
    change = np.abs(now / np.maximum(sum_now, 1)[:, None] - empty / sum_empty[:, None]).max(axis=-1)
    return (low <= brightness) & (brightness <= high) & (change < SHADOW_CHROMATICITY)


def _stepped(values: np.ndarray, targets: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Values (uint8) moved towards targets by at most `step`."""
    up = cv2.min(cv2.subtract(targets, values), step)
    down = cv2.min(cv2.subtract(values, targets), step)
    return cv2.subtract(cv2.add(values, up), down)
