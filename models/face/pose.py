"""Head poses: millimetres and radians, `(x, y, z, roll, yaw, pitch)`.

The model frame has x to the image's right, y down, z away from the camera; a face that looks along the axis of the
first camera, towards it, has no rotation. Positive yaw turns the nose towards the image's left. Everything is algebra
on components, so that `vmap(in_axes=-1, out_axes=-1)` runs it as vector arithmetic over an ensemble.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Angles = TypeVar("Angles", Array, np.ndarray)


@jax.jit  # traced once for each shape, though called at many places of a program
def rotation(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix `Rz(roll) Ry(yaw) Rx(pitch)` of (roll, yaw, pitch) in radians."""
    (ca, cb, cc), (sa, sb, sc) = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [
            jnp.stack([ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc]),
            jnp.stack([sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc]),
            jnp.stack([-sb, cb * sc, cb * cc]),
        ]
    )


def angles(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """(roll, yaw, pitch) in radians of a rotation matrix, yaw within a quarter turn: inverse of `rotation`.

    At a yaw of a quarter turn only roll minus or plus pitch is determined; the roll is then 0.
    """
    (r00, _, _), (r10, r11, r12), (r20, r21, r22) = rotation
    cosine2 = r00 * r00 + r10 * r10
    locked = cosine2 < 16 * jnp.finfo(rotation.dtype).eps ** 2
    cosine = jnp.where(locked, 0.0, jnp.sqrt(jnp.where(locked, 1.0, cosine2)))
    roll = jnp.arctan2(jnp.where(locked, 0.0, r10), jnp.where(locked, 1.0, r00))
    pitch = jnp.arctan2(jnp.where(locked, -r12, r21), jnp.where(locked, r11, r22))
    return jnp.stack([roll, jnp.arctan2(-r20, cosine), pitch])


def within_half_turn(radians: Angles) -> Angles:
    """The same angles from -pi up to pi; arrays of NumPy or JAX."""
    return (radians + np.pi) % (2 * np.pi) - np.pi


def turning_axes(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rows: the world axes about which a head turns as its roll, its yaw and its pitch grow.

    The derivative of `R X` by an angle is the cross product of its axis with `R X`.
    """
    (ca, cb, _), (sa, sb, _) = jnp.cos(angles), jnp.sin(angles)
    zero, one = jnp.zeros_like(ca), jnp.ones_like(ca)
    return jnp.stack(
        [jnp.stack([zero, zero, one]), jnp.stack([-sa, ca, zero]), jnp.stack([ca * cb, sa * cb, -sb])],
    )


@jax.jit  # traced once for each shape, though called at many places of a program
def turn(shape: Float[Array, "K 3"], R: Float[Array, "3 3"]) -> Float[Array, "K 3"]:
    """`R X` of each point."""
    x, y, z = shape[:, 0], shape[:, 1], shape[:, 2]
    # Not a matrix product: accelerators would round its float32 inputs to ten bits.
    return jnp.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=-1)


def place(shape: Float[Array, "K 3"], pose: Float[Array, "6"]) -> Float[Array, "K 3"]:
    """World points `R(pose) X + (x, y, z)` of model points, millimetres."""
    return turn(shape, rotation(pose[3:])) + pose[:3]
