"""What is measured once per user, and what detection assumes of a hand."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class HandParameters:
    """Of one user before one camera; pixels of the camera's image."""

    threshold: float = 128.0
    """Grey value between desk and skin, for images in which skin is brighter."""
    tip_radius: float = 6.5
    """Half the width of a finger."""
    half_size: int = 9
    """From the middle to the side of the window that is compared with the template of a tip."""
    min_correlation: float = 0.35
    """Of a disc with the silhouette around a tip, from 0 to 1: what has more is looked at more closely, so that it may
    be less than 0.5 for thin and for tapered fingers."""
    phi_thumb: float = math.radians(55.0)
    """Direction of the thumb's base from the palm, radians from the arm's axis to the side of the thumb."""
    phi_index: float = math.radians(15.0)
    """Likewise of the forefinger; less than `phi_thumb`."""
    handedness: int = 1
    """1: in the image the thumb is counter-clockwise of the arm's axis, as of a right hand viewed from its back; -1: it
    is clockwise, as of a left hand, or of the palm of a right one."""

    def __post_init__(self):
        """Refuse what detection cannot use.

        Raises:
            ValueError: a value out of range.
        """
        if not 2.0 <= self.tip_radius <= 100.0:
            raise ValueError(f"tip_radius must be from 2 to 100 pixels; got {self.tip_radius}.")
        if not self.tip_radius < self.half_size <= 2 * self.tip_radius:
            raise ValueError(
                f"half_size must be more than tip_radius ({self.tip_radius}) and at most twice as much; "
                f"got {self.half_size}."
            )
        if not 0 < self.min_correlation < 1:
            raise ValueError(f"min_correlation must be between 0 and 1; got {self.min_correlation}.")
        if not self.phi_index < self.phi_thumb:
            raise ValueError(f"phi_thumb ({self.phi_thumb}) must be more than phi_index ({self.phi_index}).")
        if self.handedness not in (-1, 1):
            raise ValueError(f"handedness must be 1 or -1; got {self.handedness}.")
