"""Options of the people tracker."""

import math
from dataclasses import dataclass, fields

_MAY_BE_ZERO = ("spread_px", "silhouette_bias_px", "calibration_error")


@dataclass(frozen=True)
class PeopleConfig:
    """Constants of the tracker; Python values that are read when it is built.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    capacity: int = 32
    """Largest number of people at a time, the lost ones who may come back included."""
    height_m: float = 1.72
    """Mean height of people, metres."""
    height_sd_m: float = 0.1
    """Standard deviation of the heights of people, metres."""
    width_m: float = 0.45
    """Of the ellipsoid of an unknown person, clothes, arms and stride included."""
    width_sd_m: float = 0.06
    acceleration_sd: float = 0.5
    """Metres per second squared per root second: how walking varies."""
    speed_sd: float = 1.0
    """Metres per second, of a new person, along each axis."""
    independent_patches: float = 40.0
    """How many independent looks one silhouette is worth, whatever its size in pixels."""
    silhouette_sd_m: float = 0.05
    """Of what shape and gait add to every coordinate."""
    silhouette_bias_m: float = 0.04
    """Standard deviation of what shape, clothes and thresholds displace feet, head and sides for seconds."""
    silhouette_bias_px: float = 2.0
    """The same in pixels, of edges and lenses. With 1.25 the places of PETS are as accurate, but two standard
    deviations across the line of sight cover 89 % of its frames in place of 97 %."""
    silhouette_bias_s: float = 5.0
    """Time in which these displacements change."""
    spread_px: float = 0.75
    """How far silhouettes reach beyond their edges: where the contrast is 100, an edge that lens, video coder and
    resampling blur by 1.4 pixels crosses a threshold of 30 grey levels that much too far out. Chosen among 0.5, 0.75
    and 1 on frames 0-199 of PETS; on CAVIAR's corridor the difference is within the noise."""
    calibration_error: float = 0.0
    """Standard deviation of the shift of silhouettes by the calibration of each camera but the first, which defines the
    floor, as a share of the columns of its image; 0 for cameras that agree, .005 where they differ by decimetres."""
    grid: tuple[int, int] = (32, 16)
    """Samples of a person's window, rows and columns."""
    cell_m: float = 0.3
    """Between floor points at which births are looked for."""
    birth_evidence: float = 0.5
    """Mean log likelihood ratio a pixel from which on unexplained foreground is a new person."""
    confirmed: float = 4.0
    """Log odds of being a person, to count as tracked."""
    dropped: float = -1.0
    """Log odds below which a slot is given up."""
    memory_s: float = 5.0
    """For how long a person who was lost is recognised, seconds."""
    hidden_s: float = 3.0
    """For how long a person who is hidden is believed to be there, seconds; a longer gap between images ends all
    tracks."""

    def __post_init__(self) -> None:
        for name in [
            entry.name for entry in fields(self) if entry.name not in ("grid", "dropped", "capacity", *_MAY_BE_ZERO)
        ]:
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0 < value < math.inf):
                raise ValueError(f"{name} must be positive; got {value!r}.")
        sizes = (self.capacity, *self.grid)
        if len(sizes) != 3 or any(not isinstance(size, int) or size < 1 for size in sizes):
            raise ValueError(f"capacity and grid must be positive integers; got {self.capacity!r}, {self.grid!r}.")
        for name in _MAY_BE_ZERO:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more; got {getattr(self, name)!r}.")
        if not self.dropped < 0:
            raise ValueError(f"dropped must be negative log odds; got {self.dropped!r}.")
