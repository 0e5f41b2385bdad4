"""Options of the head tracker for two cameras."""

from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check


@dataclass(frozen=True)
class HeadConfig:
    """Options of the tracker, read when a session is built; the command line has some of them.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    variant: Annotated[str, OneOf("recommended", "published")] = "recommended"
    """Improved filter, which refines what the particles find, or the one of Oka, Sato and Sugano's papers."""
    num_particles: int = 1000
    """Number of particles."""
    seed: int = 0
    """Random seed."""
    diffusion: Annotated[str, OneOf("proportional", "online", "fixed")] = "proportional"
    """`proportional`: speed plus one unit, as in the paper's experiments; `online`: that regression is updated while
    tracking; `fixed`: `fixed_diffusion`, whatever the speed."""
    fixed_diffusion: float = 5.0
    """Millimetres and degrees a frame."""
    learn: bool = True
    """Whether the face may deform; with one camera it never does."""
    rigid_frames: int = 120
    """Frames after registration in which deformations are estimated but not yet used."""
    detector: Annotated[str, OneOf("cascades", "mediapipe")] = "cascades"
    """What finds the landmarks at the start: OpenCV's cascades and corners, or MediaPipe's face mesh."""
    chunk: int = 8
    """Frames in one compiled call; 1 for live cameras."""
    live: bool = False
    """Whether frames cannot wait: a lost face is then searched for beside the tracking."""

    def __post_init__(self) -> None:
        check(self, at_least={"num_particles": 1, "chunk": 1, "rigid_frames": 0})
        if not self.fixed_diffusion > 0:
            raise ValueError(f"fixed_diffusion must be positive; got {self.fixed_diffusion}.")


def compiled(config: HeadConfig) -> HeadConfig:
    """What of the configuration a compiled program depends on: those that differ only in numbers share one.

    The diffusion is among the filters and in the state, but for whether it is estimated.
    """
    diffusion = "online" if config.diffusion == "online" else "proportional"
    return HeadConfig(
        config.variant, config.num_particles, diffusion=diffusion, learn=config.learn, rigid_frames=config.rigid_frames
    )
