"""Rigid transforms of the 19 parts of the hand, from the same kinematics as the capsules."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.math.lie import RigidTransform, quaternion_multiply, quaternion_normalize
from jaxfilters.models.hand.skeleton import HandGeometry, forward_kinematics, phalanx_angles


def part_transforms(pose: Float[Array, " 22"], geometry: HandGeometry) -> RigidTransform:
    """`T_camera_part` of every part, in the order of `PART_NAMES`: rotation (19, 4), translation (19, 3) in metres.

    A phalanx begins at the origin of its frame and runs along -y; the metacarpals keep the palm frame with the origin
    at the wrist.
    """
    palm_rotations = _phalanx_quaternions(pose[7:], geometry) * jnp.stack([1.0, 1.0, geometry.side, geometry.side])
    wrist = quaternion_normalize(pose[3:7])
    rotations = jax.vmap(quaternion_multiply, in_axes=(None, 0))(wrist, palm_rotations)
    starts = forward_kinematics(pose, geometry).capsules.start[:15]
    return RigidTransform(
        rotation=jnp.concatenate([rotations, jnp.broadcast_to(wrist, (4, 4))]),
        translation=jnp.concatenate([starts, jnp.broadcast_to(pose[:3], (4, 3))]),
    )


def _phalanx_quaternions(angles, geometry):
    """Rotations (15, 4) of the phalanges against the palm of a right hand."""
    flexion, spread = (angle.reshape(15) / 2 for angle in phalanx_angles(angles))
    cos_x, sin_x, cos_z, sin_z = jnp.cos(flexion), jnp.sin(flexion), jnp.cos(spread), jnp.sin(spread)
    quaternions = jnp.stack([cos_z * cos_x, cos_z * sin_x, sin_z * sin_x, sin_z * cos_x], axis=-1)
    half_cmc = angles[0] / 2
    zero = jnp.zeros_like(half_cmc)
    metacarpal = quaternion_multiply(
        geometry.thumb_frame, jnp.stack([jnp.cos(half_cmc), jnp.sin(half_cmc), zero, zero])
    )
    thumb = jax.vmap(quaternion_multiply, in_axes=(None, 0))(metacarpal, quaternions[:3])
    return jnp.concatenate([thumb, quaternions[3:]])
