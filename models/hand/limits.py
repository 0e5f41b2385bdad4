"""Joint limits as a soft prior on the 15 angles, for use inside a log-likelihood."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.hand.skeleton import ANGLE_LIMITS

SOFTNESS = float(np.deg2rad(3.0))


def limit_log_likelihood(angles: Float[Array, " 15"], softness: float = SOFTNESS) -> Float[Array, ""]:
    """`-1/2 sum (excess / softness)^2` over the angles beyond `ANGLE_LIMITS`; zero inside them (radians).

    A likelihood instead of clamping: clamping a sampled pose would break the Gaussian conditioning of the velocity on
    the displacement.
    """
    excess = limit_excess(angles)
    return -0.5 * jnp.sum((excess / softness) ** 2)


def limit_excess(angles: Float[Array, " 15"]) -> Float[Array, " 15"]:
    """How far each angle lies outside its limits: positive above, negative below, zero inside (radians)."""
    low, high = jnp.asarray(ANGLE_LIMITS, dtype=angles.dtype).T
    return jnp.where(angles > high, angles - high, jnp.where(angles < low, angles - low, 0.0))
