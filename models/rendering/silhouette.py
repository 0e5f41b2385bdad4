"""Soft silhouettes: how much of each pixel an object covers, smooth in its pose across the outline."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.geometry import Capsules
from jaxfilters.models.rendering.rays import Vector, components, dot, minus, scale

# Metres: rays are followed from here on, so that what is behind the camera stays out of sight.
_NEAREST = 1e-4


def soft_silhouette(
    camera: Pinhole,
    capsules: Capsules,
    T_camera_object: RigidTransform | None = None,
    *,
    softness: Float[ArrayLike, ""] = 0.5,
) -> Float[Array, "rows cols"]:
    """Coverage of every pixel by a union of capsules, 0 to 1: sigmoid(signed distance to the outline / softness).

    Depth images have no derivative across outlines, where most of what a pose changes happens; this has. Every capsule
    is evaluated at every pixel. Without a transform the capsules are in the camera frame already.

    Args:
        camera: whose pixels.
        capsules: metres; at least a tenth of a millimetre away from the camera.
        T_camera_object: pose of the frame in which the capsules are given.
        softness: pixels, positive; 0.25 to 0.5 follows the true area of a pixel best.
    """
    return jax.nn.sigmoid(outline_distance(camera, capsules, T_camera_object) / softness)


def outline_distance(
    camera: Pinhole, capsules: Capsules, T_camera_object: RigidTransform | None = None
) -> Float[Array, "rows cols"]:
    """Signed distance in pixels to the outline of a union of capsules, positive inside.

    To first order: exact sign, exact value and derivative at the outline, where it is to be used.
    """
    if T_camera_object is not None:
        capsules = capsules.moved(T_camera_object)
    rays = components(camera.rays())

    def deeper_inside(distance, capsule):
        one = _outline_distance_of_one(camera, rays, capsule)
        return jnp.where(one > distance, one, distance), None

    far = jnp.full(camera.shape, -jnp.inf, capsules.start.dtype)
    return jax.lax.scan(jax.checkpoint(deeper_inside), far, capsules)[0]


def _outline_distance_of_one(camera, rays, capsule):
    """A ray touches a capsule where its distance to the axis is the radius; a pixel moves it by depth / focal."""
    start, axis = components(capsule.start), components(capsule.end - capsule.start)
    square, along = dot(rays, rays), dot(rays, axis)
    determinant = dot(axis, axis) - along**2 / square
    skew = determinant > 0
    place = (along * dot(rays, start) / square - dot(axis, start)) / jnp.where(skew, determinant, 1.0)
    place = jnp.where(skew, jnp.clip(place, 0.0, 1.0), 0.0)
    nearest = Vector(*(a + place * b for a, b in zip(start, axis, strict=True)))
    depth = dot(rays, nearest) / square
    depth = jnp.where(depth > _NEAREST, depth, _NEAREST)
    gap = minus(scale(rays, depth), nearest)
    apart = dot(gap, gap)
    on_axis = apart <= (1e-6 * capsule.radius) ** 2
    distance = jnp.sqrt(jnp.where(on_axis, 1.0, apart))
    # On the axis itself the direction to the outline is open; any of them is far from the outline.
    pixel = jnp.hypot(
        jnp.where(on_axis, 1.0, gap.x / distance) / camera.focal[0],
        jnp.where(on_axis, 0.0, gap.y / distance) / camera.focal[1],
    )
    return (capsule.radius - jnp.where(on_axis, 0.0, distance)) / (depth * pixel)
