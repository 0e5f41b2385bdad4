"""An average hand as a template for articulated hands with five fingers: lengths, and limits that most people keep.

Lengths are those of `jaxfilters.models.hand.skeleton`; limits of angles are its, with those of the last joints beside
them, and lengths may differ from the template by a share.
"""

import math
from collections.abc import Sequence

import jax
import numpy as np

from jaxfilters.models.articulated.layout import LINKS, Layout
from jaxfilters.models.articulated.limits import Limit, difference, proportions, within
from jaxfilters.models.hand.skeleton import hand_geometry

PALM_WIDTH, PALM_HEIGHT, PALM_THICKNESS = 80.0, 95.0, 26.0
"""Millimetres: the box of `layout.five_fingers`."""
TOLERANCE = 0.25
"""Share by which a length's ratio to its neighbour may differ from the template's."""

_THUMB = ((-35.0, 35.0), (-20.0, 60.0), (-5.0, 60.0), (-15.0, 80.0))
_FINGER = ((-20.0, 20.0), (-15.0, 90.0), (0.0, 110.0), (-5.0, 80.0))
"""Degrees: abduction from that of the fan below, then three flexions from the base out."""
_FAN = (0.0, -8.0, 0.0, 8.0, 18.0)
"""Degrees: abduction of the fingers of a right hand at ease, which spread from the wrist as its metacarpals do; rounded
from fits to the true joints of two recorded hands."""
_EASE = ((10.0, 15.0, 15.0), *([(20.0, 25.0, 15.0)] * 4))
"""Degrees: flexions of a hand at ease."""


def template_lengths() -> np.ndarray:
    """(5, 3): links of thumb, index, middle, ring and little finger from the base out, millimetres."""
    with jax.ensure_compile_time_eval():  # also while something is being traced
        return 1000 * np.asarray(hand_geometry().lengths, dtype=float)


def template_shape() -> np.ndarray:
    """(18,): the constant part of a five-finger state: lengths, then palm width, height and thickness, millimetres."""
    return np.concatenate([template_lengths().ravel(), [PALM_WIDTH, PALM_HEIGHT, PALM_THICKNESS]])


def relaxed_angles(layout: Layout) -> np.ndarray:
    """(5, 4): abduction and three flexions of every finger of a hand at ease, radians."""
    return np.radians(np.column_stack([_side(layout) * np.array(_FAN), _EASE]))


def five_finger_limits(layout: Layout, tolerance: float = TOLERANCE) -> Sequence[Limit]:
    """Limits of angles, of the last two joints of a finger together, and of proportions; none speaks of the size.

    Raises:
        ValueError: if the layout has not five fingers, or the tolerance is not in (0, 1).
    """
    if layout.num_fingers != 5:
        raise ValueError(f"layout must have five fingers; got {layout.num_fingers}.")
    limits: list[Limit] = []
    for finger in range(1, 6):
        fan = _side(layout) * _FAN[finger - 1]
        for joint, (low, high) in enumerate(_THUMB if finger == 1 else _FINGER):
            low, high = (fan + low, fan + high) if joint == 0 else (low, high)
            limits.append(within(f"theta_{finger}{joint}", math.radians(low), math.radians(high)))
        if finger > 1:
            last = math.radians(35.0)
            limits.append(difference(f"theta_{finger}{LINKS - 1}", f"theta_{finger}{LINKS}", -0.3 * last, 1.5 * last))
    return (*limits, *proportions(layout, template_lengths(), PALM_HEIGHT, tolerance))


def _side(layout):
    """+1 for a right hand, -1 for a left one: where the index begins, seen from the middle of the palm."""
    return float(np.sign(layout.base_shares[1, 1]))
