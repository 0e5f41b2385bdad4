"""Poses of heads beside the truth, as tables show them."""

from typing import Any

import numpy as np
from jaxtyping import Float

DISPLAY = np.array([1.0, 1.0, 1.0, *np.rad2deg(np.ones(3))])
"""From millimetres and radians to millimetres and degrees."""


def pose_errors(poses: Any, truth: Any) -> Float[np.ndarray, "t 6"]:
    """Millimetres and degrees, angles within half a turn.

    Args:
        poses: (t, 6) estimates, millimetres and radians.
        truth: (t, 6).
    """
    errors = (np.asarray(poses, float) - np.asarray(truth, float)) * DISPLAY
    errors[:, 3:] = (errors[:, 3:] + 180) % 360 - 180
    return errors
