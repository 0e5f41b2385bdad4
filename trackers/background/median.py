"""A running median as the background of a fixed camera, and thresholds from how much each pixel flickers."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from jaxfilters.trackers.background.difference import Difference
from jaxfilters.trackers.background.gain import in_one_light, without_gain
from jaxfilters.trackers.background.temporal_median import temporal_median

SHADOW_PROBABILITY = 0.3
"""Of foreground, where the background looks darkened: less than even, since shadows are more frequent than clothes of
just the colour of the floor."""
SAMPLES = 25
"""Images of which a background is made: enough that a person may stand in each place in almost half of them."""
DIFFERENCE = 30.0
"""Least difference from the background, of 255, at which foreground is as likely as not."""
MOST_FOREGROUND = 0.6
"""Share of an image: more than this is no longer the room that was estimated, but one in another light."""
LOST_AFTER = 10
"""Images in a row with so much foreground after which the room is estimated anew."""
_EVERY_PX = 8


class MedianBackground:
    """Median over time, with a threshold for each pixel from how much it flickers.

    The background is the exact median of samples first. From then on it follows by steps of one level towards each
    image (McFarlane & Schofield 1995, approximate median), a tenth as often where there is foreground. A camera that
    was not primed starts with its first image and with probabilities near one half, and is sure after `SAMPLES`
    samples. Every image is compared in the light of the background, by one factor a channel. Where most of an image is
    foreground for a while, as when half of the lamps go out, the camera settles anew.
    """

    def __init__(
        self,
        *,
        difference: float = DIFFERENCE,
        spread: float = 4.0,
        shadow_probability: float = SHADOW_PROBABILITY,
        learn_every: int = 10,
        sample_every: int = 5,
    ):
        """An empty model.

        Args:
            difference: Of 255; least threshold on the largest difference among the channels.
            spread: Threshold in standard deviations of a pixel, where these are large.
            shadow_probability: Upper bound of the probability where the background looks darkened; 1 for none.
            learn_every: Frames from one step of one level to the next; 0 never to learn.
            sample_every: Frames from one sample to the next, while a camera that was not primed settles.

        Raises:
            ValueError: a value out of range.
        """
        check_range("difference", difference, 1, 255)
        check_range("spread", spread, 0, 100)
        check_range("shadow_probability", shadow_probability, 0, 1)
        check_range("learn_every", learn_every, 0, np.inf)
        check_range("sample_every", sample_every, 1, np.inf)
        self._difference = Difference(difference, spread, shadow_probability)
        self._learn_every, self._sample_every = learn_every, sample_every
        self._samples: list[np.ndarray] = []
        self._frames, self._sure = 0, 0.0
        self._covered, self.restarts = 0, 0
        """Images in a row that were mostly foreground, and how often the room was therefore estimated anew."""

    @property
    def image(self) -> np.ndarray | None:
        """The background as it is now, uint8; None before the first image."""
        return self._difference.background

    @property
    def reflection(self) -> float:
        """Share of a difference that the floor mirrors; 0 where it mirrors too little to matter."""
        return self._difference.reflection if self._difference.mirrors else 0.0

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Take the median of up to `SAMPLES` of the images, evenly spread, as the background."""
        self._learn_from(evenly(images))
        self._samples, self._sure = [], 1.0

    def estimate_reflection(self, images: Sequence[np.ndarray]) -> None:
        """How much of people the floor mirrors, from images that show them; `prime` does it with its own."""
        if self.image is not None:
            self._difference.estimate_reflection([self._in_same_light(image) for image in images])

    def compare(self, image: np.ndarray) -> np.ndarray:
        """Probability of foreground as `apply`, without learning anything."""
        return self._difference.probability(image)

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:
        """As `Background.apply`."""
        if self._sure < 1:
            self._settle(image)
        image = self._in_same_light(image)
        probability = self.compare(image)
        self._frames += 1
        self._watch(probability)
        if self._sure == 1 and self._learn_every and self._frames % self._learn_every == 0:
            is_turn_of_foreground = self._frames // self._learn_every % 10 == 0
            self._difference.follow(image, None if is_turn_of_foreground else probability, keep)
        if self._sure < 1:
            probability = np.float32(0.5) + np.float32(self._sure) * (probability - np.float32(0.5))
        return probability

    def state(self) -> dict[str, np.ndarray]:
        """As `Background.state`; empty before the first image."""
        if self.image is None:
            return {}
        counts = np.array([self._frames, self._sure, self._covered, self.restarts])
        found = self._difference
        return {
            "background": self.image.copy(),
            "noise": found.noise.copy(),
            "counts": counts,
            "reflection": np.array(found.reflection),
            "samples": np.array(self._samples, np.uint8),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """As `Background.restore`."""
        if not state:
            return
        self._difference.set_background(state["background"].copy(), state["noise"].copy())
        self._difference.reflection = float(state["reflection"])
        frames, self._sure, covered, restarts = map(float, state["counts"])
        self._frames, self._covered, self.restarts = int(frames), int(covered), int(restarts)
        self._samples = list(state["samples"])

    def _in_same_light(self, image: np.ndarray) -> np.ndarray:
        """Exposure and lamps change within a frame, the background by a level in ten frames."""
        background = self.image
        if background is None or image.shape != background.shape or image.dtype != np.uint8:
            return image  # `compare` says what is wrong.
        return without_gain(image, background)

    def _watch(self, probability: np.ndarray) -> None:
        is_covered = np.mean(probability[::_EVERY_PX, ::_EVERY_PX] >= 0.5) > MOST_FOREGROUND
        self._covered = self._covered + 1 if is_covered and self._sure == 1 else 0
        if self._covered >= LOST_AFTER:
            self._sure, self._samples, self._covered = 0.0, [], 0
            self.restarts += 1

    def _settle(self, image: np.ndarray) -> None:
        """Samples are costly to combine: as often as it matters, when their number has doubled."""
        if self._frames % self._sample_every == 0:
            self._samples.append(image.copy())
            count = len(self._samples)
            if count == SAMPLES or count & (count - 1) == 0:
                self._learn_from(self._samples)
            self._sure = count / SAMPLES
        if self._sure == 1:
            self._samples = []

    def _learn_from(self, images: list[np.ndarray]) -> None:
        images = in_one_light(images)
        background = temporal_median(images)
        deviations = temporal_median([_largest(cv2.absdiff(image, background)) for image in images])
        self._difference.set_background(background, self._difference.noise_of(deviations))
        self._difference.estimate_reflection(images)


def evenly(images: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Up to `SAMPLES` of the images, evenly spread; ValueError where there is none."""
    found = list(images)
    if not found:
        raise ValueError("images must be at least one; got none.")
    return [found[i] for i in np.unique(np.linspace(0, len(found) - 1, SAMPLES).round().astype(int))]


def check_range(name: str, value: float | int, low: float | int, high: float | int) -> None:
    """Raise ValueError that names the option, unless it lies from low to high."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be from {low:g} to {high:g}; got {value!r}.")


def _largest(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else image.max(axis=-1)
