"""Options of the hand tracker."""

from dataclasses import dataclass


@dataclass(frozen=True)
class HandDepthConfig:
    """Options of the tracker."""

    filter: str = "rbpf"
    """`rbpf` carries the velocity of each particle in a Kalman filter, `pf` has none."""
    num_particles: int = 512
    stride: int | None = None
    """Every how many pixels one is compared; `None` lets the hand fill the window at any distance."""
    seed: int = 0
    hand: str = "auto"
    """`right`, `left`, or `auto`, which decides between them by what they explain."""
    scale: float | None = None
    """Size of the hand relative to the average adult's; `None` fits it to the first frame."""
    guide: bool = True
    """Draw particles around what registration finds; otherwise from the motion model alone."""
    missing: str = "auto"
    """Pixels without a reading: `background`, `unknown`, or `auto`, background if they are half of the first frame."""
    surface: str = "capsules"
    """What particles are rendered as: `capsules`, or the triangle `mesh`, three times slower."""

    def __post_init__(self) -> None:
        choices = {
            "filter": ("rbpf", "pf"),
            "hand": ("right", "left", "auto"),
            "surface": ("capsules", "mesh"),
            "missing": ("auto", "background", "unknown"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}; got {getattr(self, name)!r}.")
        if self.num_particles < 1:
            raise ValueError(f"num_particles must be at least 1; got {self.num_particles}.")
        if self.stride is not None and self.stride < 1:
            raise ValueError(f"stride must be at least 1; got {self.stride}.")
        if self.scale is not None and not 0.5 <= self.scale <= 2:
            raise ValueError(f"scale must be between 0.5 and 2 (1 is the average adult); got {self.scale}.")
