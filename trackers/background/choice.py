"""How likely every pixel of a fixed camera shows something that does not belong to the room."""

from collections.abc import Callable, Iterable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxfilters.trackers.background.difference import Difference
from jaxfilters.trackers.background.median import DIFFERENCE, MedianBackground, check_range
from jaxfilters.trackers.background.mixture import Knn, MixtureBackground, Mog2


@runtime_checkable
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
        check_range("difference", difference, 1, 255)
        check_range("shadow_probability", shadow_probability, 0, 1)
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


BACKGROUNDS: dict[str, Callable[..., Background]] = {
    "median": MedianBackground,
    "mog2": lambda **options: MixtureBackground(Mog2, **options),
    "knn": lambda **options: MixtureBackground(Knn, **options),
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
