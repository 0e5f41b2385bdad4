"""Outlines and depths of upright ellipsoids on a floor.

Source: H. Kato, A. Nakazawa, S. Inokuchi, "Realtime human tracking using ellipsoid model", 1999; the outline is the
dual form of its equation [4]. Lengths in metres, pixels (u, v), projection matrices in canonical scale (`FloorCamera`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass

VISIBLE, INSIDE, BEHIND, CROSSING = 0, 1, 2, 3
"""Codes of an outline: an ellipse; the camera is inside the body and sees nothing else; the body lies wholly behind the
camera; the body crosses the camera's plane, and its outline is no ellipse."""


@pytree_dataclass
class Ellipsoid:
    """An ellipsoid with axes along those of the world."""

    center: Float[Array, " 3"]
    """Metres."""
    semi_axes: Float[Array, " 3"]
    """Metres, positive."""


def standing(
    xy: Float[Array, "*batch 2"], height: Float[ArrayLike, "*#batch"], width: Float[ArrayLike, "*#batch"]
) -> Ellipsoid:
    """A person at a floor point as an ellipsoid that stands on the floor ([2]); all in metres."""
    height, width = (jnp.broadcast_to(jnp.asarray(size), xy.shape[:-1]) for size in (height, width))
    return Ellipsoid(
        jnp.concatenate([xy, height[..., None] / 2], axis=-1), jnp.stack([width, width, height], axis=-1) / 2
    )


class Outline(NamedTuple):
    """The image of an ellipsoid: pixels u with `(u - center)^T shape^-1 (u - center) <= 1`."""

    center: Float[Array, " 2"]
    """Pixels."""
    shape: Float[Array, "2 2"]
    """Square pixels; its eigenvalues are the squared semi-axes."""
    depth: Float[Array, ""]
    """Of the ellipsoid's centre, metres."""
    code: Int[Array, ""]
    """`VISIBLE` or why there is no ellipse; then `center` and `shape` are finite and mean nothing."""


class Ellipse(NamedTuple):
    """The parameters of an outline."""

    center: Float[Array, " 2"]
    """Pixels."""
    semi_axes: Float[Array, " 2"]
    """Pixels, the longer first."""
    angle: Float[Array, ""]
    """Radians from the u axis to the longer one, towards v."""
    box: Float[Array, " 4"]
    """Least u, least v, greatest u, greatest v, pixels."""


@jax.jit  # traced once for each shape, though called at many places of a program
def outline(P: Float[Array, "3 4"], body: Ellipsoid) -> Outline:
    """The outline from the dual conic `P Q* P^T`.

    With the pixel origin moved to the image of the centre, `Q*` comes to `N - h^2 e3 e3^T` with `N = M diag(r^2) M^T`:
    nothing large is subtracted from anything large, which single precision would not survive.
    """
    homogeneous = dot(P[:, :3], body.center) + P[:, 3]
    depth = homogeneous[2]
    reach = jnp.sum((P[2, :3] * body.semi_axes) ** 2)
    code = _code(P, body, depth, reach)
    visible = code == VISIBLE
    at = homogeneous[:2] / jnp.where(visible, depth, 1.0)
    M = (P[:2, :3] - at[:, None] * P[2, :3]) * body.semi_axes
    beyond = jnp.where(visible, depth**2 - reach, 1.0)
    shift = -dot(M, P[2, :3] * body.semi_axes) / beyond
    shape = dot(M, M.T) / beyond + jnp.outer(shift, shift)
    return Outline(at + shift, jnp.where(visible, shape, jnp.eye(2, dtype=shape.dtype)), depth, code)


def _code(P, body, depth, reach):
    away = (_position(P) - body.center) / body.semi_axes
    crossing = jnp.where(depth**2 > reach, jnp.where(depth > 0, VISIBLE, BEHIND), CROSSING)
    return jnp.where(jnp.sum(away**2) <= 1, INSIDE, crossing)


def _position(P):
    """Of the camera, metres; by Cramer's rule, which needs no call for every body."""
    first, second, third = P[:, :3]
    adjugate = jnp.stack([jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)])
    return -dot(P[:, 3], adjugate) / dot(first, adjugate[0])


@jax.jit  # traced once for each shape, though called at many places of a program
def outline_radius(contour: Outline, uv: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    """Squared distance of pixels from the centre in units of the outline: 1 on it; 0 inside a body, inf without one."""
    (a, b), (_, c) = contour.shape
    d = uv - contour.center
    x, y = d[..., 0], d[..., 1]
    squared = (c * x**2 - 2 * b * x * y + a * y**2) / (a * c - b**2)
    return jnp.where(contour.code == VISIBLE, squared, jnp.where(contour.code == INSIDE, 0.0, jnp.inf))


def grown(contour: Outline, pixels: Float[ArrayLike, ""]) -> Outline:
    """An outline that reaches farther by some pixels to the left and right, above and below."""
    reach = jnp.sqrt(jnp.diagonal(contour.shape))
    scale = 1 + jnp.asarray(pixels) / reach
    return contour._replace(shape=contour.shape * jnp.outer(scale, scale))


def ellipse_of(contour: Outline) -> Ellipse:
    """Centre, semi-axes, angle and bounding box of an outline."""
    (a, b), (_, c) = contour.shape
    mean, half = (a + c) / 2, jnp.hypot((a - c) / 2, b)
    semi_axes = jnp.sqrt(jnp.stack([mean + half, mean - half]))
    reach = jnp.sqrt(jnp.stack([a, c]))
    box = jnp.concatenate([contour.center - reach, contour.center + reach])
    return Ellipse(contour.center, semi_axes, jnp.arctan2(2 * b, a - c) / 2, box)


def near_depth(P: Float[Array, "3 4"], body: Ellipsoid, uv: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    """Depth of the nearer side of the ellipsoid at pixels, metres; outside the outline, where rays pass it nearest."""
    inverse = jnp.linalg.inv(P[:, :3])
    v = (dot(uv, inverse[:, :2].T) + inverse[:, 2]) / body.semi_axes
    away = (dot(-inverse, P[:, 3]) - body.center) / body.semi_axes
    A, B = jnp.sum(v * v, axis=-1), dot(v, away)
    discriminant = B**2 - A * (dot(away, away) - 1)
    root = jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0))
    return (-B - jnp.where(discriminant > 0, root, 0.0)) / A


def pixel_grid(shape: tuple[int, int]) -> Float[Array, "rows cols 2"]:
    """(u, v) of all pixels."""
    v, u = jnp.meshgrid(jnp.arange(shape[0], dtype=float), jnp.arange(shape[1], dtype=float), indexing="ij")
    return jnp.stack([u, v], axis=-1)


def ellipse_mask(contour: Outline, shape: tuple[int, int]) -> Bool[Array, "rows cols"]:
    """Pixels whose centres lie inside an outline."""
    return outline_radius(contour, pixel_grid(shape)) <= 1


def soft_ellipse_mask(contour: Outline, shape: tuple[int, int], sharpness: float = 8.0) -> Float[Array, "rows cols"]:
    """`sigmoid(sharpness (1 - radius))`, differentiable in everything: 1/2 on the outline."""
    squared = outline_radius(contour, pixel_grid(shape))
    radius = jnp.sqrt(jnp.where(squared > 0, squared, 1.0)) * (squared > 0)
    return jax.nn.sigmoid(sharpness * (1 - radius))


def ellipsoid_depth(P: Float[Array, "3 4"], body: Ellipsoid, shape: tuple[int, int]) -> Float[Array, "rows cols"]:
    """Depth of the nearer side at every pixel, metres; `inf` outside the outline."""
    return jnp.where(ellipse_mask(outline(P, body), shape), near_depth(P, body, pixel_grid(shape)), jnp.inf)
