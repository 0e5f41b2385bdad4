"""Options of the hand tracker."""

from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check


@dataclass(frozen=True)
class HandDepthConfig:
    """Options of the tracker; the command line has them, too.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    filter: Annotated[str, OneOf("rbpf", "pf")] = "rbpf"
    """Rao-Blackwellized particle filter, which carries the velocity of each particle in a Kalman filter, or plain
    particle filter without velocities."""
    num_particles: int = 512
    """Number of particles."""
    stride: int | None = None
    """Compare every N-th row and column (default: as many as let the hand fill the window at any distance)."""
    seed: int = 0
    """Random seed."""
    hand: Annotated[str, OneOf("auto", "right", "left")] = "auto"
    """Which hand; auto decides by what the two explain of the depth."""
    scale: float | None = None
    """Size of the hand, 1 = average adult (default: fitted to the first frame)."""
    guide: bool = True
    """Draw particles around what registration finds, otherwise from the motion model alone."""
    missing: Annotated[str, OneOf("auto", "background", "unknown")] = "auto"
    """What pixels without a reading are; auto takes them for background if they are half of the first frame."""
    surface: Annotated[str, OneOf("capsules", "mesh")] = "capsules"
    """What particles are rendered as; the triangle mesh is three times slower."""

    def __post_init__(self) -> None:
        check(self, at_least={"num_particles": 1, "stride": 1})
        if self.scale is not None and not 0.5 <= self.scale <= 2:
            raise ValueError(f"scale must be between 0.5 and 2 (1 is the average adult); got {self.scale}.")
