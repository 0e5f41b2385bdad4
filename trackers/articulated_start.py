"""Where an articulated hand may be when it is seen for the first time: hypotheses from 21 keypoints."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.lie import quaternion_multiply, so3_exp
from jaxfilters.models.articulated.anatomy import PALM_HEIGHT, PALM_WIDTH, template_shape
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.layout import Layout

NUM_STARTS = 6
_TILTS = (0.0, math.radians(35.0), math.radians(-35.0))
"""About the axis across the palm: fingers towards the camera or away from it."""
ROTATION_STD, ANGLE_STD, LENGTH_SHARE = math.radians(25.0), math.radians(25.0), 0.2
POSITION_STD = 10.0
"""Pixels."""
RATE_STD = (6.0, 0.03, math.radians(4.0))
"""Per frame: pixels, quaternion, radians."""
_BENT = (0.0, 0.35, 0.35, 0.2)
"""Abduction and flexions of a relaxed finger, radians."""
FEWEST_BASES = 2


class Starts(NamedTuple):
    """Gaussians, hypotheses first."""

    means: Float[Array, "h n"]
    covariances: Float[Array, "h n n"]
    found: Bool[Array, ""]
    """Whether enough was seen: the wrist and two finger bases."""


def starts_from_keypoints(
    hand: ArticulatedHand, wrist: Float[Array, " 2"], bases: Float[Array, "5 2"], seen: Bool[Array, " 6"]
) -> Starts:
    """Palm or back to the camera, level or tilted by 35 degrees, about what the wrist and the finger bases show.

    Args:
        hand: Five fingers in weak perspective.
        wrist: Pixels.
        bases: First joints of the fingers from the thumb on, pixels.
        seen: Which of wrist and bases were measured; what was not may hold anything.
    """
    layout = hand.layout
    shares = jnp.asarray(layout.base_shares, dtype=wrist.dtype)
    template = shares * jnp.array([PALM_HEIGHT, PALM_WIDTH])
    usable = (seen[1:] & seen[0])[:, None]
    offsets = jnp.where(usable, bases - wrist, 0.0)
    template = jnp.where(usable, template, 0.0)
    # How palm coordinates (along, across) lie in the image: a similarity for each side of the hand that may be seen.
    # The angle of the axis along the palm comes from the fingers' mean, its length from all of them.
    along, forward = jnp.sum(offsets, axis=0), jnp.sum(template[:, 0])
    direction = jnp.arctan2(along[1], along[0])
    spread = jnp.sqrt(jnp.sum(template**2))
    scale = jnp.sqrt(jnp.sum(offsets**2)) / jnp.where(spread > 0, spread, 1.0)
    found = seen[0] & (jnp.sum(seen[1:]) >= FEWEST_BASES) & (scale > 0) & (forward > 0)
    scale = jnp.where(found, scale, 1.0)
    lengths = jnp.asarray(template_shape(), dtype=wrist.dtype)

    def start(flip: Array, tilt: Array) -> tuple[Array, Array]:
        # A tilt shortens the palm's image: the hand is larger than it looks.
        size = scale / jnp.cos(tilt)
        q = _facing(direction, flip, tilt)
        mean = jnp.zeros(layout.size, wrist.dtype).at[layout.position].set(jnp.where(seen[0], wrist, 0.0))
        mean = mean.at[layout.quaternion].set(q).at[layout.angles].set(jnp.tile(jnp.array(_BENT), layout.num_fingers))
        mean = mean.at[layout.static].set(size * lengths)
        return mean, _covariance(layout, q, size * lengths)

    flips, tilts = np.meshgrid([0.0, math.pi], _TILTS, indexing="ij")
    means, covariances = jax.vmap(start)(
        jnp.asarray(flips.ravel(), wrist.dtype), jnp.asarray(tilts.ravel(), wrist.dtype)
    )
    return Starts(means, covariances, found)


def _facing(direction: Array, flip: Array, tilt: Array) -> Array:
    """Camera from palm, with the palm's axis along `direction` in the image, turned about it and across it."""
    x, _, z = jnp.eye(3)
    upright = jnp.array([0.5, -0.5, 0.5, -0.5])  # palm to the camera, its axis up: direction -90 degrees
    q = quaternion_multiply(so3_exp((direction + 0.5 * jnp.pi) * z), upright)
    q = quaternion_multiply(q, so3_exp(flip * x))
    return quaternion_multiply(q, so3_exp(tilt * z))


def _covariance(layout: Layout, q: Array, shape: Array) -> Array:
    moving = layout.per_moving(POSITION_STD, 0.0, ANGLE_STD) ** 2
    rates = layout.per_moving(*RATE_STD) ** 2
    variances = jnp.concatenate([moving, rates, (LENGTH_SHARE * shape) ** 2]).astype(q.dtype)
    across = jnp.eye(4, dtype=q.dtype) - jnp.outer(q, q)
    block = layout.quaternion
    return jnp.diag(variances).at[block, block].set((0.5 * ROTATION_STD) ** 2 * across)
