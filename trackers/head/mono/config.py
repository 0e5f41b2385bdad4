"""Options of the head tracker for one camera."""

import math
from dataclasses import dataclass
from typing import Annotated

from jaxfilters.trackers.configuration import OneOf, check

EYES_APART_MM = (40.0, 80.0)
"""Distances between the pupils of people of any age."""


@dataclass(frozen=True)
class MonoConfig:
    """Options of the tracker, read when a session is built; the command line has some of them.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    num_particles: int = 750
    """Number of particles."""
    seed: int = 0
    """Random seed."""
    landmarks: Annotated[str, OneOf("aligned", "recalculated", "projected")] = "aligned"
    """How landmarks are measured: `aligned` patches that turn with the head; `recalculated` as published, then also
    with its estimate from particles, its narrow boxes and its mean identity; or `projected` from the estimate itself
    instead, which only shows what measuring is good for."""
    selection: Annotated[str, OneOf("information", "angles", "latest")] = "information"
    """Which frames are adjusted to: those of most `information` about the person, of the largest variance of `angles`,
    as published, or the `latest`."""
    past: Annotated[str, OneOf("dropped", "marginalised")] = "dropped"
    """What frames that are replaced leave behind: nothing, or, `marginalised`, their information about the person. The
    latter forgets nothing, neither the errors that landmarks have in common over many frames."""
    adjust: bool = True
    """Whether the face is adjusted while it is followed; otherwise at the start alone."""
    prior_weight: float = 1.0
    """Of the training set's statistics; 0 as published."""
    offset_std: float = 0.7e-3
    """Metres by which a face may differ from what the model can form; 0 as published."""
    eyes_apart_mm: float | None = None
    """Distance between the pupils in millimetres, as an optician measures it (default: unknown, so that size and
    distance have a relative standard deviation of 5.5 to 7 percent)."""
    chunk: int = 8
    """Frames in one compiled call; 1 for live cameras."""
    live: bool = False
    """Whether frames cannot wait: a face is then searched for beside the tracking."""

    def __post_init__(self) -> None:
        check(self, at_least={"num_particles": 1, "chunk": 1})
        for name in ("prior_weight", "offset_std"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must be finite and at least 0; got {getattr(self, name)}.")
        least, most = EYES_APART_MM
        if self.eyes_apart_mm is not None and not least <= self.eyes_apart_mm <= most:
            raise ValueError(f"eyes_apart_mm must be within {least:g} and {most:g}; got {self.eyes_apart_mm}.")

    @property
    def offset_std_mm(self) -> float:
        """`offset_std` in millimetres, the unit of the face."""
        return 1e3 * self.offset_std

    @property
    def is_published(self) -> bool:
        """Whether estimates, boxes and the identity's mean are those of the thesis."""
        return self.landmarks != "aligned"


PUBLISHED = MonoConfig(landmarks="recalculated", selection="angles", prior_weight=0.0, offset_std=0.0)
"""The tracker of the thesis."""
VARIANTS = {"recommended": MonoConfig(), "published": PUBLISHED}
