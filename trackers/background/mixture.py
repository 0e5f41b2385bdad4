"""OpenCV's models of a background with several colours for each pixel."""

from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from jaxfilters.trackers.background.difference import wide
from jaxfilters.trackers.background.median import (
    DIFFERENCE,
    SAMPLES,
    SHADOW_PROBABILITY,
    MedianBackground,
    check_range,
    evenly,
)


@runtime_checkable
class Mixture(Protocol):
    """One of OpenCV's models, with comparing and learning told apart."""

    steps: int
    """After which what was learnt before is forgotten."""

    def compare(self, image: np.ndarray) -> np.ndarray:
        """(rows, cols) uint8: 0 background, 127 shadow, 255 foreground; nothing is learnt."""

    def learn(self, image: np.ndarray, share: float) -> None:
        """Let the image be this share of the background."""

    def image(self) -> np.ndarray:
        """The likeliest background."""


class Mog2:
    """A mixture of Gaussians (Zivkovic 2004)."""

    steps = 125

    def __init__(self) -> None:
        """With 8 standard deviations: around people, compression changes more than OpenCV's 4.

        What is seen for less than 30 percent of the time may be a person, in place of OpenCV's 10.
        """
        self._model = cv2.createBackgroundSubtractorMOG2(varThreshold=64, detectShadows=True)
        self._model.setBackgroundRatio(0.7)

    def compare(self, image: np.ndarray) -> np.ndarray:
        """As `Mixture.compare`."""
        return self._model.apply(image, learningRate=0)

    def learn(self, image: np.ndarray, share: float) -> None:
        """As `Mixture.learn`."""
        self._model.apply(image, learningRate=share)

    def image(self) -> np.ndarray:
        """As `Mixture.image`."""
        return self._model.getBackgroundImage()


class Knn:
    """The last 21 colours that were learnt, of which four must be near (Zivkovic & van der Heijden 2006)."""

    steps = 21

    def __init__(self) -> None:
        """Near is within the same difference as for the other models."""
        self._model = cv2.createBackgroundSubtractorKNN(dist2Threshold=DIFFERENCE**2, detectShadows=True)
        self._model.setkNNSamples(4)

    def compare(self, image: np.ndarray) -> np.ndarray:
        """As `Mixture.compare`."""
        # At a rate of zero this model learns from every image.
        return self._model.apply(image, learningRate=1e-6)

    def learn(self, image: np.ndarray, share: float) -> None:  # noqa: ARG002
        """As `Mixture.learn`; the share is always that of one colour."""
        # A sample is taken in the call after the one that has the high rate.
        self._model.apply(image, learningRate=0.9)
        self._model.apply(image, learningRate=1e-6)

    def image(self) -> np.ndarray:
        """As `Mixture.image`."""
        return self._model.getBackgroundImage()


class MixtureBackground:
    """One of OpenCV's models: several colours for each pixel, and shadows. The answer is yes, no or shadow."""

    def __init__(
        self,
        make: Callable[[], Mixture],
        *,
        shadow_probability: float = SHADOW_PROBABILITY,
        history: int = 500,
        sample_every: int = 5,
    ):
        """An empty model.

        Args:
            make: `Mog2` or `Knn`.
            shadow_probability: The answer where there is a shadow.
            history: Frames after which a colour that is gone is forgotten.
            sample_every: Frames from one step of learning to the next, while a camera that was not primed settles.

        Raises:
            ValueError: a value out of range.
        """
        check_range("shadow_probability", shadow_probability, 0, 1)
        check_range("history", history, 1, np.inf)
        check_range("sample_every", sample_every, 1, np.inf)
        self._make, self._model = make, make()
        self._shadow_probability = np.float32(shadow_probability)
        self._learn_every = max(1, round(history / self._model.steps))
        self._share, self._sample_every = self._learn_every / history, sample_every
        self._frames, self._samples = 0, 0
        self._shape: tuple[int, ...] = ()

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Learn from up to `SAMPLES` of the images, evenly spread, but for what differs from their median.

        A colour that is seen in every fifth image is background to these models, and people are seen as often.
        """
        median = MedianBackground(shadow_probability=1.0)
        found = evenly(images)
        median.prime(found)
        empty = median.state()["background"]
        self._model = self._make()
        for count, image in enumerate(found, 1):
            people = median.compare(image) > 0.5
            self._model.learn(_pasted(image, empty, people), 1 / count)
        self._samples, self._shape = SAMPLES, empty.shape

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:
        """As `Background.apply`."""
        self._check(image)
        if self._samples < SAMPLES:
            return self._settled(image)
        probability = self._probability(image)
        self._frames += 1
        if self._frames % self._learn_every == 0:
            # Neither model takes a mask for what not to learn without fail: it is shown what it believes to be there.
            kept = image if keep is None else _pasted(image, self._model.image(), np.asarray(keep) != 0)
            self._model.learn(kept, self._share)
        return probability

    def state(self) -> dict[str, np.ndarray]:
        """The likeliest background; the other colours of the mixture cannot be read and are learnt again."""
        if not self._samples:
            return {}
        return {"background": self._model.image(), "counts": np.array([self._frames, self._samples])}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """As `Background.restore`."""
        if not state:
            return
        self._model, self._shape = self._make(), state["background"].shape
        self._frames, self._samples = (int(count) for count in state["counts"])
        for count in range(1, SAMPLES + 1):
            self._model.learn(state["background"], 1 / count)

    def _check(self, image: np.ndarray) -> None:
        """OpenCV would forget everything and begin anew with images of another shape."""
        self._shape = self._shape or image.shape
        if image.shape != self._shape or image.dtype != np.uint8:
            raise ValueError(f"image must be uint8 {self._shape} like the background; got {image.dtype} {image.shape}.")

    def _settled(self, image: np.ndarray) -> np.ndarray:
        """Of a camera that was not primed: nearer to one half the less was learnt."""
        if self._frames % self._sample_every == 0:
            self._samples += 1
            self._model.learn(image, 1 / self._samples)
        self._frames += 1
        half = np.float32(0.5)
        return half + np.float32(self._samples / SAMPLES) * (self._probability(image) - half)

    def _probability(self, image: np.ndarray) -> np.ndarray:
        """Without single pixels; shadows that are too narrow are the edges of dark clothes."""
        mask = self._model.compare(image)
        shadow = wide(cv2.inRange(mask, 1, 254))
        probability = cv2.LUT(cv2.medianBlur(mask, 3), _YES)
        cv2.copyTo(np.minimum(probability, self._shadow_probability), shadow, probability)
        return probability


_YES = (np.arange(256) > 0).astype(np.float32)


def _pasted(image: np.ndarray, other: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return cv2.copyTo(other, mask.view(np.uint8), image.copy())
