"""Where in the image each part is drawn: windows of a few fixed sizes that compile once, and never cut a part off.

Every part takes the smallest window of a ladder that holds its visible pixels. Loops with as many turns as there are
parts in a size replace one program for every part and size; parts out of sight are not drawn at all.
"""

from dataclasses import field

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters._struct import pytree_dataclass

Window = tuple[int, int]

FINE = ((16, 16), (32, 16), (16, 32), (32, 32), (64, 32), (32, 64), (64, 64), (128, 128))
"""Sizes for what is run often: fewest pixels."""
COARSE = ((16, 16), (32, 32), (64, 64), (128, 128))
"""Sizes for what is run seldom: half the time to compile, twice the pixels."""
_COUNTED_PARTS = 64


@pytree_dataclass
class Plan:
    """Where and in which order k parts are drawn."""

    order: Int[Array, " k"]
    """Parts by growing window; those out of sight first."""
    bounds: Int[Array, " sizes_and_one"]
    """Where in `order` each window size begins, and where the last one ends."""
    start: Int[Array, "k 2"]
    """First (row, column) of each part's window."""
    sizes: tuple[Window, ...] = field(metadata=dict(static=True))
    """Window sizes (rows, columns) from small to the whole image."""


def plan_windows(box: Float[Array, "*poses k 4"], shape: Window, sides: tuple[Window, ...]) -> Plan:
    """The plan for parts with bounds (u_min, v_min, u_max, v_max) in an image of `shape`, windows of `sides`."""
    within = {(min(rows, shape[0]), min(columns, shape[1])) for rows, columns in sides} | {shape}
    sizes = tuple(sorted(within, key=lambda size: (size[0] * size[1], size)))
    last = jnp.asarray(shape, box.dtype) - 1
    first_visible = jnp.maximum(jnp.ceil(box[..., 1::-1]), 0)
    extent = jnp.minimum(jnp.floor(box[..., :1:-1]), last) - first_visible + 1
    held = jnp.stack([jnp.all(extent <= jnp.asarray(size, box.dtype), axis=-1) for size in sizes], axis=-1)
    smallest = jnp.where(jnp.any(held, axis=-1), jnp.argmax(held, axis=-1), len(sizes) - 1)
    # Written so that bounds of NaN count as visible, and the whole image shows what becomes of them.
    rung = jnp.where(jnp.any(extent <= 0, axis=-1), -1, smallest)
    limit = jnp.asarray([(shape[0] - rows, shape[1] - columns) for rows, columns in sizes], jnp.int32)
    return Plan(
        order=_order(rung),
        bounds=jnp.sum(rung[..., None] < jnp.arange(len(sizes) + 1), axis=-2, dtype=jnp.int32),
        start=jnp.clip(jnp.minimum(first_visible, last).astype(jnp.int32), 0, limit[rung]),
        sizes=sizes,
    )


def _order(rung):
    """Parts by growing rung."""
    count = rung.shape[-1]
    if count > _COUNTED_PARTS:
        return jnp.argsort(rung, axis=-1).astype(jnp.int32)
    # Counting who comes before whom takes a sixth of the time of many short sorts.
    part = jnp.arange(count, dtype=jnp.int32)
    key = rung * count + part
    place = jnp.sum(key[..., None, :] < key[..., :, None], axis=-1)
    return jnp.sum(jnp.where(place[..., None, :] == part[:, None], part, 0), axis=-1, dtype=jnp.int32)
