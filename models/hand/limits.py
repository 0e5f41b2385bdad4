"""Joint limits as a soft prior on the 15 angles, for use inside a log-likelihood."""

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
