"""Small vectors as tuples of components, so that the arithmetic stays elementwise under any batching."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.models.camera import Pinhole


class Vector(NamedTuple):
    """Three components, each an array of one value a part."""

    x: Float[Array, "*parts"]
    y: Float[Array, "*parts"]
    z: Float[Array, "*parts"]


def components(points: Float[Array, "*parts 3"]) -> Vector:
    """The components of stacked vectors."""
    return Vector(points[..., 0], points[..., 1], points[..., 2])


def minus(a: Vector, b: Vector) -> Vector:
    """Difference."""
    return Vector(a.x - b.x, a.y - b.y, a.z - b.z)


def scale(a: Vector, factor) -> Vector:
    """Each component times a factor."""
    return Vector(a.x * factor, a.y * factor, a.z * factor)


def dot(a: Vector, b: Vector) -> Float[Array, "*parts"]:
    """Inner product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def pixel_basis(camera: Pinhole, uv: Float[Array, "*parts 2"]) -> tuple[Vector, Vector, Vector]:
    """The direction with z = 1 through (u, v) in pixels, and its derivatives in u and v."""
    slope = (uv - camera.center) / camera.focal
    one, zero = jnp.ones_like(slope[..., 0]), jnp.zeros_like(slope[..., 0])
    fx, fy = camera.focal
    return Vector(slope[..., 0], slope[..., 1], one), Vector(one / fx, zero, zero), Vector(zero, one / fy, zero)
