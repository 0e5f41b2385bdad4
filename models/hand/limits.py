"""What the 15 angles of a hand can be and usually are: soft limits, and a broad normal distribution."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.hand.skeleton import ANGLE_LIMITS

SOFTNESS = float(np.deg2rad(3.0))
ABDUCTION = float(np.deg2rad(25.0))
"""By which a finger spreads to either side of the direction of its metacarpal (AAOS, Joint motion, 1965)."""
FAN = np.arctan2([12.0, -1.0, -12.0, -22.0], [78.0, 81.0, 74.0, 64.0])
"""Spread of index to little finger that go on as their metacarpals do: across and along the palm, millimetres, from the
wrist ends to the knuckles of `hand_geometry`."""


def _soft_limits() -> np.ndarray:
    """`ANGLE_LIMITS`, and of the spread what an abduction about the metacarpal's direction reaches beyond them.

    Limits about the axis of the palm alone would hold a spread little finger, whose metacarpal points 19 degrees
    outwards, beside the ring finger.
    """
    limits = ANGLE_LIMITS.copy()
    limits[4::3, 0] = np.minimum(limits[4::3, 0], FAN - ABDUCTION)
    limits[4::3, 1] = np.maximum(limits[4::3, 1], FAN + ABDUCTION)
    return limits


SOFT_LIMITS = _soft_limits()
"""Lowest and highest value of the 15 angles that cost nothing, radians, (15, 2)."""


def _usual() -> tuple[np.ndarray, np.ndarray]:
    """Mean (15,) and inverse covariance (15, 15) of the angles of hands, radians.

    Fingers bend together: that is the first of the synergies of M. Santello, M. Flanders and J. F. Soechting, "Postural
    hand synergies for tool use", Journal of Neuroscience 18, 1998. The standard deviations, 43 and 50 degrees of the
    flexions, of which 35 and 40 are common to the fingers, 12 of the spread, are wide enough for a fist.
    """
    mean = np.deg2rad([5.0, 0.0, 0.0] + 4 * [20.0, 0.0, 30.0])
    mean[4::3] = FAN
    covariance = np.diag(np.square([25.0, 20.0, 30.0] + 4 * [25.0, 12.0, 30.0]))
    for first, common in ((3, 35.0), (5, 40.0)):
        covariance[first::3, first::3] += common**2
    return mean, np.linalg.inv(np.deg2rad(np.deg2rad(covariance)))


_USUAL_MEAN, _USUAL_PRECISION = _usual()


def unusualness(angles: Float[np.ndarray, "h 15"]) -> Float[np.ndarray, " h"]:
    """Mean squared deviation of the angles of hands (radians) from usual ones, in standard deviations."""
    away = angles - _USUAL_MEAN
    return np.asarray(np.einsum("hi,ij,hj->h", away, _USUAL_PRECISION, away)) / angles.shape[-1]


def limit_log_likelihood(angles: Float[Array, " 15"], softness: float = SOFTNESS) -> Float[Array, ""]:
    """`-1/2 sum (excess / softness)^2` over the angles beyond `SOFT_LIMITS`; zero inside them (radians).

    A likelihood instead of clamping: clamping a sampled pose would break the Gaussian conditioning of the velocity on
    the displacement.
    """
    excess = limit_excess(angles)
    return -0.5 * jnp.sum((excess / softness) ** 2)


def limit_excess(angles: Float[Array, " 15"]) -> Float[Array, " 15"]:
    """How far each angle lies outside its limits: positive above, negative below, zero inside (radians)."""
    low, high = jnp.asarray(SOFT_LIMITS, dtype=angles.dtype).T
    return jnp.where(angles > high, angles - high, jnp.where(angles < low, angles - low, 0.0))
