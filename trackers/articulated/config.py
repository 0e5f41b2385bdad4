"""Options of the tracker of articulated hands."""

import math
from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check

PALM_WIDTHS = (0.03, 0.15)
"""Metres: from a baby's to more than anybody's; other numbers are in another unit."""


@dataclass(frozen=True)
class ArticulatedConfig:
    """Options of the tracker; the command line has them, too.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    variant: Annotated[str, OneOf("recommended", "published", "unconstrained")] = "recommended"
    """How estimates are kept within the limits of a hand; published is the filter of the paper, with one hypothesis, no
    mirrored one beside it and no gate, and unconstrained has no limits and one hypothesis after the first frame."""
    hypotheses: int = 6
    """Largest number of hypotheses about the depth; at the start there are six where the hand is found by keypoints."""
    hand: Annotated[str, OneOf("right", "left")] = "right"
    """Which hand."""
    gate: float = 5.0
    """Ignore features whose innovation is larger, in standard deviations; 0 ignores none."""
    seed: int = 0
    """Random seed."""
    focal: float | None = None
    """Focal length of the camera in pixels, for keypoints: the hand is followed in metres, with its distance, through a
    camera whose axis meets the middle of the image."""
    palm_width: float | None = None
    """Measured width of the palm across the knuckles without the thumb, metres, for the size that one camera cannot
    tell; it needs the focal length. That of the average hand, 0.08, more or less, unless given."""

    def __post_init__(self) -> None:
        check(self, at_least={"hypotheses": 1, "gate": 0})
        for name in ("focal", "palm_width"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive; got {value}.")
        if self.palm_width is not None and self.focal is None:
            raise ValueError("palm_width needs focal: without it, lengths are in pixels and the hand has no size.")
        if self.palm_width is not None and not PALM_WIDTHS[0] <= self.palm_width <= PALM_WIDTHS[1]:
            raise ValueError(f"palm_width must be {PALM_WIDTHS[0]} to {PALM_WIDTHS[1]} metres; got {self.palm_width}.")
