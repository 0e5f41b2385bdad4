"""Parts of an object as functions of the pixel: what every kind of shape must provide to be rendered."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.camera import Pinhole


@pytree_dataclass
class Parts:
    """What the pixels need to know of k parts observed by one camera."""

    coefficients: Float[Array, "k c"]
    """As the kind of surface arranges them."""
    anchor: Float[Array, "k 2"]
    """Integer pixel (u, v) about which the coefficients are expanded; no derivative goes through it."""
    box: Float[Array, "k 4"]
    """(u_min, v_min, u_max, v_max) in pixels outside which a part cannot be; empty boxes have min > max."""


class Surface(NamedTuple):
    """A kind of part, made of a fixed number of smooth pieces: sides and caps, faces, triangles.

    All functions take offsets (x, y) from the anchor in pixels and return inverse depth, 0 = miss.
    """

    inverse_depth: Callable[..., Array]
    """`(coefficients (c,), x, y) -> w` of the part."""
    pieces: Callable[..., Sequence[Array]]
    """`(coefficients (c,), x, y) -> [w, ...]` of each piece where it is the part's surface, and less elsewhere."""
    rows: Callable[[Array], Array]
    """`(coefficients (k, c)) -> (k, pieces, r)`: the coefficients that the pieces' smooth functions need."""
    smooth: Callable[..., Array]
    """`(row (r, *pixels), x, y) -> w` of a piece known to be hit: what is differentiated.

    It is the polynomial `r0 + r1 x + r2 y`, plus, with `has_root`, the root of
    `r3 + r4 x + r5 y + r6 x^2 + r7 x y + r8 y^2`.
    """
    has_root: bool
    """Whether rows have nine coefficients, or three."""


def anchor_of(camera: Pinhole, box: Float[Array, "*parts 4"]) -> Float[Array, "*parts 2"]:
    """A whole pixel in the middle of each box; the principal point where a box is empty or unbounded."""
    middle = jax.lax.stop_gradient(0.5 * (box[..., :2] + box[..., 2:]))
    center = jax.lax.stop_gradient(camera.center)
    return jnp.round(jnp.where(jnp.isfinite(middle), middle, center))


def depth_of(inverse: Float[Array, "*image"]) -> Float[Array, "*image"]:
    """Depth of inverse depth: metres, inf where the inverse is 0."""
    hit = inverse > 0
    return jnp.where(hit, 1 / jnp.where(hit, inverse, 1.0), jnp.inf)
