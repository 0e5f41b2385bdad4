"""How well a simulated silhouette agrees with an observed one: the paper's score, and overlap."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int8, Real

Pixels = Real[Array, "*pixels"] | Bool[Array, "*pixels"]
RING = 5
"""Pixels around a region that count against it (section 3.4 of the paper)."""


def ternary_mask(mask: Bool[Array, "rows cols"], ring: int = RING) -> Int8[Array, "rows cols"]:
    """1 on the mask, -1 on pixels within `ring` of it in both directions, 0 elsewhere.

    Raises:
        ValueError: if `ring` is negative.
    """
    return jnp.where(mask, 1, -dilated(mask, ring).astype(jnp.int8)).astype(jnp.int8)


def dilated(mask: Bool[Array, "rows cols"], ring: int) -> Bool[Array, "rows cols"]:
    """The mask and all pixels within `ring` rows and columns of it.

    Raises:
        ValueError: if `ring` is negative.
    """
    if ring < 0:
        raise ValueError(f"ring must be 0 or more pixels; got {ring}.")
    size = 2 * ring + 1
    for window in ((size, 1), (1, size)):
        mask = lax.reduce_window(mask, False, lax.bitwise_or, window, (1, 1), "SAME")
    return mask


def match_score(sim: Pixels, real: Pixels) -> Float[Array, ""]:
    """`sum sim real / sum |sim|` in [-1, 1] ([5]); `-inf` for an empty simulated image."""
    agreement = jnp.sum(sim.astype(jnp.float32) * real)
    size = jnp.sum(jnp.abs(sim).astype(jnp.float32))
    return jnp.where(size > 0, agreement / jnp.where(size > 0, size, 1.0), -jnp.inf)


def overlap(sim: Pixels, real: Pixels) -> Float[Array, ""]:
    """Intersection over union of two masks, or of two images of probabilities in [0, 1]; 0 if both are empty."""
    sim, real = sim.astype(jnp.float32), real.astype(jnp.float32)
    common = jnp.sum(sim * real)
    union = jnp.sum(sim) + jnp.sum(real) - common
    return common / jnp.where(union > 0, union, 1.0)
