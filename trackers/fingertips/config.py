"""Options of a run of the fingertip tracker; the constants of the tracker itself are `state.FingertipConfig`."""

from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check

MOST_HANDS = 2


@dataclass(frozen=True)
class RunConfig:
    """Options of a run; the command line has all of them.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    mask: Annotated[str, OneOf("infrared", "depth", "colour")] = "infrared"
    """How hands differ from the desk: they are the brightest (infrared, or a dark desk), they lie above it (depth:
    16-bit PNGs with camera.json, or .npz), or they have the colour of skin."""
    hands: int = 1
    """How many hands at most, 1 or 2."""
    seed: int = 0
    """Random seed of the synthetic hand."""

    def __post_init__(self) -> None:
        check(self)
        if not 1 <= self.hands <= MOST_HANDS:
            raise ValueError(f"hands must be 1 or {MOST_HANDS}; got {self.hands}.")
