"""Options of the tracker of articulated hands."""

from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check


@dataclass(frozen=True)
class ArticulatedConfig:
    """Options of the tracker; the command line has them, too.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    mode: Annotated[str, OneOf("recommended", "literal", "unconstrained")] = "recommended"
    """How estimates are kept within the limits of a hand; literal is the filter of the paper, with one hypothesis, no
    mirrored one beside it and no gate, and unconstrained has no limits and one hypothesis."""
    hypotheses: int = 6
    """Largest number of hypotheses about the depth."""
    hand: Annotated[str, OneOf("right", "left")] = "right"
    """Which hand."""
    gate: float = 5.0
    """Ignore features whose innovation is larger, in standard deviations; 0 ignores none."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        check(self, at_least={"hypotheses": 1, "gate": 0})
