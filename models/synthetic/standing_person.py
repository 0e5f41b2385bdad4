"""People who stand on a floor, with known truth: bodies of six ellipsoids, and the silhouettes that a camera gets.

After the experiments of Kato, Nakazawa, Inokuchi, "Realtime human tracking using ellipsoid model",
1999. The bodies are not the tracker's own ellipsoid, and the silhouettes have holes, stray pixels and a shadow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import Ellipsoid, near_depth, outline, outline_radius, pixel_grid
from jaxfilters.typing import AnyKey

HEIGHT_M, WIDTH_M = 1.66, 0.42
"""Of the body as it is listed."""
CENTERS_M = (
    (0.0, 0.0, 1.54),
    (0.0, 0.0, 1.17),
    (0.08, 0.0, 0.45),
    (-0.08, 0.0, 0.45),
    (0.17, 0.0, 1.08),
    (-0.17, 0.0, 1.08),
)
"""Of head, torso, legs and arms, from the floor point; the body faces along Y."""
SEMI_AXES_M = (
    (0.085, 0.10, 0.12),
    (0.17, 0.12, 0.31),
    (0.085, 0.09, 0.45),
    (0.085, 0.09, 0.45),
    (0.045, 0.06, 0.34),
    (0.045, 0.06, 0.34),
)
SHADOW_SEMI_AXES_M, SHADOW_OFFSET_M = (0.40, 0.22), (0.35, 0.15)
"""Of the shadow on the floor, an ellipse along X and Y; its centre from the feet."""


class Sight(NamedTuple):
    """What the pixels of one camera look at."""

    camera: FloorCamera
    uv: Float[Array, "rows cols 2"]
    """Where a pixel would be without lens distortion."""
    furniture: Float[Array, "rows cols"]
    """Depth of what stands in the room, metres; `inf` where nothing does."""


class Flaws(NamedTuple):
    """What background subtraction does to a silhouette."""

    hole_share: float | Array = 0.15
    """Of the blocks of `HOLE_PX` x `HOLE_PX` pixels that are missing."""
    salt_share: float | Array = 0.002
    """Of the pixels that are foreground for no reason."""


HOLE_PX = 4
NO_FLAWS = Flaws(0.0, 0.0)


def sight(
    camera: FloorCamera,
    *,
    uv: Float[Array, "rows cols 2"] | None = None,
    furniture: Float[Array, "rows cols"] | None = None,
) -> Sight:
    """A camera without lens distortion in an empty room, by default."""
    uv = pixel_grid(camera.shape) if uv is None else uv
    return Sight(camera, uv, jnp.full(camera.shape, jnp.inf) if furniture is None else furniture)


def standing_body(xy: Float[Array, " 2"], height: Float[Array, ""], width: Float[Array, ""]) -> Ellipsoid:
    """Six ellipsoids at a floor point: heights scaled by the height, all across by the width; metres."""
    scale = jnp.stack([width / WIDTH_M, width / WIDTH_M, height / HEIGHT_M])
    return Ellipsoid(jnp.array(CENTERS_M) * scale + jnp.append(xy, 0.0), jnp.array(SEMI_AXES_M) * scale)


def silhouette(sight: Sight, body: Ellipsoid) -> Bool[Array, "rows cols"]:
    """Pixels that see one of the parts (parts, 3) of a body and not the furniture before it."""

    def part(one):
        inside = outline_radius(outline(sight.camera.P, one), sight.uv) <= 1
        return inside & (near_depth(sight.camera.P, one, sight.uv) < sight.furniture)

    return jnp.any(jax.vmap(part)(body), axis=0)


def shadow(sight: Sight, xy: Float[Array, " 2"]) -> Bool[Array, "rows cols"]:
    """Pixels that see the shadow of a person at a floor point."""
    floor, depth = sight.camera.floor_points(sight.uv)
    away = (floor - xy - jnp.array(SHADOW_OFFSET_M)) / jnp.array(SHADOW_SEMI_AXES_M)
    return (jnp.sum(away**2, axis=-1) <= 1) & (depth > 0) & (depth < sight.furniture)


def flawed(key: AnyKey, mask: Bool[Array, "rows cols"], flaws: Flaws) -> Bool[Array, "rows cols"]:
    """A silhouette with blocks missing and stray pixels added."""
    hole_key, salt_key = jax.random.split(key)
    rows, cols = mask.shape
    blocks = jax.random.bernoulli(hole_key, flaws.hole_share, (-(-rows // HOLE_PX), -(-cols // HOLE_PX)))
    holes = jnp.repeat(jnp.repeat(blocks, HOLE_PX, axis=0), HOLE_PX, axis=1)[:rows, :cols]
    return (mask & ~holes) | jax.random.bernoulli(salt_key, flaws.salt_share, mask.shape)
