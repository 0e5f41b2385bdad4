"""How likely every pixel of a fixed camera shows something that does not belong to the room."""

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import cv2
import numpy as np

from jaxfilters.trackers.background_difference import Difference
from jaxfilters.trackers.temporal_median import temporal_median

SHADOW_PROBABILITY = 0.3
"""Of foreground, where the background looks darkened: less than even, since shadows are more frequent than clothes of
just the colour of the floor."""
SAMPLES = 25
"""Images of which a background is made: enough that somebody may stand in each place in almost half of them."""
DIFFERENCE = 25
"""Least difference from the background, of 255, at which foreground is as likely as not."""


class Background(Protocol):
    """What is compared with every image of a fixed camera. Images are (rows, cols, 3) or (rows, cols), uint8."""

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Learn the empty room from images in which people move, such as some dozens spread over the first minute."""

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:
        """Probability of foreground, (rows, cols) float32 from 0 to 1; the background then follows slowly.

        Args:
            image: uint8, of the shape of all others.
            keep: (rows, cols), non-zero where the background must not follow, as where tracked people stand.
        """

    def state(self) -> dict[str, np.ndarray]:
        """What was learnt, as arrays to save."""

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from what `state` gave."""


class MedianBackground:
    """Median over time, with a threshold for each pixel from how much it flickers.

    The background is the exact median of samples first. From then on it follows by steps of one level towards each
    image (McFarlane & Schofield 1995, approximate median), a tenth as often where there is foreground. A camera that
    was not primed starts with its first image and with probabilities near one half, and is sure after `SAMPLES`
    samples.
    """

    def __init__(
        self,
        *,
        difference: float = DIFFERENCE,
        spread: float = 6.0,
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
        _check_range("difference", difference, 1, 255)
        _check_range("spread", spread, 0, 100)
        _check_range("shadow_probability", shadow_probability, 0, 1)
        _check_range("learn_every", learn_every, 0, np.inf)
        _check_range("sample_every", sample_every, 1, np.inf)
        self._difference = Difference(difference, spread, shadow_probability)
        self._learn_every, self._sample_every = learn_every, sample_every
        self._samples: list[np.ndarray] = []
        self._frames, self._sure = 0, 0.0

    @property
    def image(self) -> np.ndarray | None:
        """The background as it is now, uint8; None before the first image."""
        return self._difference.background

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Take the median of up to `SAMPLES` of the images, evenly spread, as the background."""
        found = list(images)
        if not found:
            raise ValueError("images must be at least one; got none.")
        picked = np.unique(np.linspace(0, len(found) - 1, SAMPLES).round().astype(int))
        self._learn_from([found[i] for i in picked])
        self._samples, self._sure = [], 1.0

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:
        """As `Background.apply`."""
        if self._sure < 1:
            self._settle(image)
        probability = self._difference.probability(image)
        self._frames += 1
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
        counts = np.array([self._frames, self._sure])
        return {"background": self.image.copy(), "noise": self._difference.noise.copy(), "counts": counts}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """As `Background.restore`."""
        if not state:
            return
        self._difference.set_background(state["background"].copy(), state["noise"].copy())
        self._frames, self._sure = int(state["counts"][0]), float(state["counts"][1])

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
        background = temporal_median(images)
        deviations = temporal_median([_largest(cv2.absdiff(image, background)) for image in images])
        self._difference.set_background(background, self._difference.noise_of(deviations))


class ReferenceBackground:
    """A given image of the empty room, never changed: `|I - B| > tau` after a 3 x 3 median (Kato et al. 1999)."""

    def __init__(self, image: np.ndarray, *, difference: float = DIFFERENCE, shadow_probability: float = 1.0):
        """A model of the room that is known.

        Args:
            image: The empty room, uint8.
            difference: Of 255: probability one half.
            shadow_probability: Upper bound of the probability where the background looks darkened; 1 for none.

        Raises:
            ValueError: an image that is not uint8, or a value out of range.
        """
        _check_range("difference", difference, 1, 255)
        _check_range("shadow_probability", shadow_probability, 0, 1)
        if image.dtype != np.uint8 or image.ndim not in (2, 3):
            raise ValueError(f"image must be uint8 (rows, cols) or (rows, cols, 3); got {image.dtype} {image.shape}.")
        self._difference = Difference(difference, 0.0, shadow_probability)
        self._difference.set_background(image.copy(), np.zeros(image.shape[:2], np.uint8))

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Nothing: the room is known."""

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:  # noqa: ARG002
        """As `Background.apply`; nothing is learnt."""
        return self._difference.probability(image)

    def state(self) -> dict[str, np.ndarray]:
        """Nothing that the constructor would not have."""
        return {}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Nothing."""


class MixtureBackground:
    """One of OpenCV's models: several colours for each pixel, and shadows. The answer is yes, no or shadow."""

    def __init__(
        self,
        make: Callable[[], Any],
        *,
        shadow_probability: float = SHADOW_PROBABILITY,
        history: int = 500,
        learn_every: int = 4,
    ):
        """An empty model.

        Args:
            make: `cv2.createBackgroundSubtractorMOG2` or `...KNN`.
            shadow_probability: The answer where there is a shadow.
            history: Frames after which a colour that is gone is forgotten.
            learn_every: Frames from one update to the next; the updates are as much larger.

        Raises:
            ValueError: a value out of range.
        """
        _check_range("shadow_probability", shadow_probability, 0, 1)
        _check_range("history", history, 1, np.inf)
        _check_range("learn_every", learn_every, 1, np.inf)
        self._make, self._history, self._learn_every = make, history, learn_every
        self._model = make()
        self._table = np.zeros(256, np.float32)
        self._table[128:] = 1
        self._table[self._model.getShadowValue()] = shadow_probability
        self._frames = 0

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Learn from all images, each as much as the others."""
        for count, image in enumerate(images, 1):
            self._model.apply(image, learningRate=1 / min(count, self._history))
            self._frames = max(self._frames, SAMPLES)

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:
        """As `Background.apply`."""
        if self._frames < SAMPLES:
            self._model.apply(image, learningRate=1 / (self._frames + 1))
        mask = self._model.apply(image, learningRate=0)
        self._frames += 1
        if self._frames >= SAMPLES and self._frames % self._learn_every == 0:
            self._learn(image, keep)
        probability = cv2.LUT(mask, self._table)
        if self._frames < SAMPLES:
            probability = np.float32(0.5) + np.float32(self._frames / SAMPLES) * (probability - np.float32(0.5))
        return probability

    def state(self) -> dict[str, np.ndarray]:
        """The likeliest background; the other colours of the mixture cannot be read and are learnt again."""
        if not self._frames:
            return {}
        return {"background": self._model.getBackgroundImage(), "counts": np.array([self._frames])}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """As `Background.restore`."""
        if not state:
            return
        self._model = self._make()
        self._frames = int(state["counts"][0])
        for count in range(1, SAMPLES + 1):
            self._model.apply(state["background"], learningRate=1 / count)

    def _learn(self, image: np.ndarray, keep: np.ndarray | None) -> None:
        rate = self._learn_every / self._history
        if keep is None:
            self._model.apply(image, learningRate=rate)
            return
        self._model.apply(image, knownForegroundMask=np.asarray(keep, np.uint8), learningRate=rate)


def _mog2() -> Any:
    return cv2.createBackgroundSubtractorMOG2(detectShadows=True)


def _knn() -> Any:
    return cv2.createBackgroundSubtractorKNN(detectShadows=True)


BACKGROUNDS: dict[str, Callable[..., Background]] = {
    "median": MedianBackground,
    "mog2": lambda **options: MixtureBackground(_mog2, **options),
    "knn": lambda **options: MixtureBackground(_knn, **options),
    "reference": ReferenceBackground,
}
"""Models by name; `reference` needs the image of the empty room."""


def background(name: str, *arguments: Any, **options: Any) -> Background:
    """The model of that name, with what its class takes.

    Raises:
        ValueError: an unknown name, or a value out of range.
    """
    if name not in BACKGROUNDS:
        raise ValueError(f"background must be one of {', '.join(sorted(BACKGROUNDS))}; got {name!r}.")
    return BACKGROUNDS[name](*arguments, **options)


def _largest(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else image.max(axis=-1)


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be from {low:g} to {high:g}; got {value!r}.")
