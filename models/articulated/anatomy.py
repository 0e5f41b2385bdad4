"""An average hand as a template for articulated hands with five fingers: lengths, limits that most people keep, motion.

Lengths are those of `jaxfilters.models.hand.skeleton`; limits of angles are its, with those of the last joints beside
them, and lengths may differ from the template by a share.
"""

import math
from collections.abc import Sequence

import jax
import numpy as np

from jaxfilters.models.articulated.layout import LINKS, Layout
from jaxfilters.models.articulated.limits import Limit, difference, proportions, within
from jaxfilters.models.articulated.motion import LEAN_STD, AboutEase, about_ease
from jaxfilters.models.hand.skeleton import hand_geometry

PALM_WIDTH, PALM_HEIGHT, PALM_THICKNESS = 80.0, 95.0, 26.0
"""Millimetres: the box of `layout.five_fingers`."""
TOLERANCE = 0.25
"""Share by which a length's ratio to its neighbour may differ from the template's."""

_THUMB = ((-35.0, 35.0), (-20.0, 60.0), (-5.0, 60.0), (-15.0, 80.0))
_FINGER = ((-20.0, 20.0), (-15.0, 90.0), (0.0, 110.0), (-5.0, 80.0))
"""Degrees: abduction from that at ease, then three flexions from the base out."""
_EASE = ((10.0, 21.0, 18.0), *([(19.0, 23.0, 10.0)] * 4))
"""Degrees: flexions of an open hand at ease: the lower ends of the ranges that daily activities use (G. I. Bain et al.,
The functional range of motion of the finger joints, 2015); the last two joints of a thumb at their mean in such
activities (M. C. Hume et al., Functional range of motion of the joints of the hand, 1990)."""

ALIKE_FINGERS, ALIKE_OUTER, ALIKE_INNER = 0.6, 0.8, 0.3
"""Correlations of flexions: of the same joint of neighbouring fingers, of the two outer joints of a finger, and of its
two inner joints. Fingers flex together, and the outer joints of one share a tendon: two combinations of 15 angles
explain over 80 % of how hands hold tools (M. Santello, M. Flanders, J. F. Soechting, Postural hand synergies for tool
use, Journal of Neuroscience 18, 1998). Chosen on the first 350 frames of ICVL and NYU, among 0, .6 and .8 for the
first two, and 0 and .3 for the last."""


def template_lengths() -> np.ndarray:
    """(5, 3): links of thumb, index, middle, ring and little finger from the base out, millimetres."""
    with jax.ensure_compile_time_eval():  # also while something is being traced
        return 1000 * np.asarray(hand_geometry().lengths, dtype=float)


def template_shape() -> np.ndarray:
    """(18,): the constant part of a five-finger state: lengths, then palm width, height and thickness, millimetres."""
    return np.concatenate([template_lengths().ravel(), [PALM_WIDTH, PALM_HEIGHT, PALM_THICKNESS]])


def relaxed_angles(layout: Layout) -> np.ndarray:
    """(5, 4): abduction and three flexions of every finger of a hand at ease, radians."""
    return np.column_stack([_side(layout) * _fan(), np.radians(_EASE)])


def flexion_correlation(layout: Layout) -> np.ndarray:
    """(20, 20): correlation of the angles of a hand at ease, finger by finger, abduction before flexions.

    Flexions of fingers that are `d` apart have the correlation of their joints times `ALIKE_FINGERS ** d`. The thumb
    and all abductions are independent of the rest; the joints of the thumb are correlated as those of a finger.

    Raises:
        ValueError: if the layout has not five fingers.
    """
    _check_five(layout)
    place = np.arange(layout.num_fingers)
    fingers = ALIKE_FINGERS ** np.abs(place[:, None] - place).astype(float)
    fingers[0, 1:] = fingers[1:, 0] = 0.0
    ends = ALIKE_INNER * ALIKE_OUTER
    joints = [[1, ALIKE_INNER, ends], [ALIKE_INNER, 1, ALIKE_OUTER], [ends, ALIKE_OUTER, 1]]
    whole = np.eye((LINKS + 1) * layout.num_fingers)
    flexes = np.flatnonzero(np.arange(len(whole)) % (LINKS + 1))
    whole[np.ix_(flexes, flexes)] = np.kron(fingers, joints)
    return whole


def motion_about_ease(layout: Layout, per_metre: float = 1.0) -> AboutEase:
    """How a hand of five fingers moves before a camera; `per_metre` as for `about_ease`."""
    ease, alike = relaxed_angles(layout).ravel(), flexion_correlation(layout)
    return about_ease(layout, ease, per_metre=per_metre, lean_std=LEAN_STD, correlation=alike)


def five_finger_limits(layout: Layout, tolerance: float = TOLERANCE) -> Sequence[Limit]:
    """Limits of angles, of the last two joints of a finger together, and of proportions; none speaks of the size.

    Raises:
        ValueError: if the layout has not five fingers, or the tolerance is not in (0, 1).
    """
    _check_five(layout)
    limits: list[Limit] = []
    fan = _side(layout) * _fan()
    for finger in range(1, 6):
        for joint, (low, high) in enumerate(_THUMB if finger == 1 else _FINGER):
            middle = float(fan[finger - 1]) if joint == 0 else 0.0
            limits.append(within(f"theta_{finger}{joint}", middle + math.radians(low), middle + math.radians(high)))
        if finger > 1:
            last = math.radians(35.0)
            limits.append(difference(f"theta_{finger}{LINKS - 1}", f"theta_{finger}{LINKS}", -0.3 * last, 1.5 * last))
    return (*limits, *proportions(layout, template_lengths(), PALM_HEIGHT, tolerance))


def _check_five(layout):
    if layout.num_fingers != 5:
        raise ValueError(f"layout must have five fingers; got {layout.num_fingers}.")


def _fan():
    """(5,) radians: abduction of a right hand at ease, whose fingers go on as their metacarpals do."""
    with jax.ensure_compile_time_eval():
        hand = hand_geometry()
        across, back, _ = np.asarray(hand.bases[1:] - hand.metacarpal_starts, dtype=float).T
    return np.concatenate([np.zeros(1), np.arctan2(-across, -back)])


def _side(layout):
    """+1 for a right hand, -1 for a left one: where the index begins, viewed from the middle of the palm."""
    return float(np.sign(layout.base_shares[1, 1]))
