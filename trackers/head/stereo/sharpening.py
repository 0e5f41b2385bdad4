"""A registered shape made sharper: patches of the first camera found in the others as their skin is inclined."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfilters._full_precision import einsum
from jaxfilters.models.face.alignment import align
from jaxfilters.models.face.patches import (
    SKIN_NORMALS,
    Slopes,
    learn_slopes_again,
    patches,
    unknown_slopes,
)
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape

PLACED_PX = 0.01
"""Standard deviation of a landmark in the first camera, where it is by definition: what sampling adds."""
MOST_CHANGE_PX = 1.0
"""A patch that would go farther is not the one that was matched."""
LOOKS = 4
"""Rounds until slopes and pictures agree."""
SAME_SKIN, MISMATCH_PX = 0.995, 8.0
"""Normalised correlation below which two cameras see different things, such as a face and what is behind it; standard
deviation for what is lacking, in windows that have nothing in common."""
UNSEEN_DEPTH_MM = 6.0
"""Standard deviation, along the line of sight, of a landmark that one camera registered: faces differ."""


class Sharpened(NamedTuple):
    """A registered shape, and how well it is known."""

    shape: Float[Array, "K 3"]
    """Model frame, millimetres."""
    covariance: Float[Array, "K 3 3"]
    """Of each landmark, mm^2."""
    alike: Float[Array, "3 3"]
    """Of what all landmarks are off alike beside that, mm^2: faces are convex, and their pictures err to one side."""


def sharpened(
    images: Num[Array, "C rows cols"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    slopes: Slopes,
    rig: CameraRig,
) -> Sharpened:
    """The shape with depths found anew, with the skin inclined as estimated.

    A window of the second camera shows a patch of skin from another side than that of the first: matched as it is,
    it is found where the two pictures are most alike, not where the landmark is. Here it is stretched as the skin
    there would be, and what is not known of that adds to the covariance. In the first camera landmarks stay where they
    are: that is what makes them landmarks.

    Args:
        images: Grey levels at registration.
        shape: As registered, or sharpened before.
        pose: Of the head in these images, millimetres and radians.
        slopes: Of the skin, as known by now.
        rig: Cameras.
    """
    normals = jnp.asarray(SKIN_NORMALS, shape.dtype)
    images = jnp.asarray(images, shape.dtype)
    uv, _ = project_shape(rig, shape, pose)
    first = patches(images[:1], shape, pose, _one(rig, 0), normals)
    sampled = PLACED_PX**2 * jnp.eye(2, dtype=shape.dtype)
    places, covariances = [uv[0]], [jnp.tile(sampled, (len(shape), 1, 1))]
    lacking = jnp.zeros((1, len(shape)), shape.dtype)
    for c in range(1, rig.num_cameras):
        found = align(first, slopes, images[c : c + 1], uv[c : c + 1], shape, pose, _one(rig, c))
        near = found.observed[0] & (jnp.linalg.norm(found.uv[0] - uv[c], axis=-1) < MOST_CHANGE_PX)
        inclined = einsum("kis,kst,kjt->kij", found.by_slope[0], slopes.covariance, found.by_slope[0])
        places.append(jnp.where(near[:, None], found.uv[0], uv[c]))
        mismatch = MISMATCH_PX * jnp.maximum(SAME_SKIN - found.score, 0.0)
        lacking = jnp.concatenate([lacking, mismatch])
        sampled_there = sampled + jnp.square(mismatch[0])[:, None, None] * jnp.eye(2, dtype=shape.dtype)
        covariances.append(found.covariance[0] + inclined + sampled_there)
    return _along_rays(shape, pose, jnp.stack(places), jnp.stack(covariances), lacking, rig)


def first_slopes(
    images: Num[Array, "C rows cols"], shape: Float[Array, "K 3"], pose: Float[Array, " 6"], rig: CameraRig
) -> Slopes:
    """What the pictures of one moment say of the skin's slopes: patches of the first camera as the others see them.

    Args:
        images: Grey levels at registration.
        shape: As registered.
        pose: Of the head in these images, millimetres and radians.
        rig: Cameras.
    """
    unknown = unknown_slopes(len(shape))
    images = jnp.asarray(images, shape.dtype)
    uv, _ = project_shape(rig, shape, pose)
    first = patches(images[:1], shape, pose, _one(rig, 0), jnp.asarray(SKIN_NORMALS, shape.dtype))

    def again(_: Array | int, assumed: Slopes) -> Slopes:
        looks = [
            align(first, assumed, images[c : c + 1], uv[c : c + 1], shape, pose, _one(rig, c))
            for c in range(1, rig.num_cameras)
        ]
        information = sum((look.slope_information for look in looks), jnp.zeros_like(unknown.covariance))
        score = sum((look.slope_score for look in looks), jnp.zeros_like(unknown.mean))
        return learn_slopes_again(unknown, assumed, information, score)

    return jax.lax.fori_loop(0, LOOKS, again, unknown)


def _along_rays(shape: Array, pose: Array, uv: Array, covariance: Array, lacking: Array, rig: CameraRig) -> Sharpened:
    """Points moved along their lines of sight of the first camera to where the other cameras have them."""
    projected, _ = project_shape(rig, shape, pose)
    by_shape, _ = jacobian(rig, shape, pose)
    sight = jnp.cross(by_shape[0, :, 0], by_shape[0, :, 1])
    sight /= jnp.linalg.norm(sight, axis=-1, keepdims=True)
    precision = jnp.linalg.inv(covariance)
    along = einsum("ckix,kx->cki", by_shape, sight)[1:]
    information = einsum("cki,ckij,ckj->k", along, precision[1:], along)
    pull = einsum("cki,ckij,ckj->k", along, precision[1:], (uv - projected)[1:])
    prior = 1 / UNSEEN_DEPTH_MM**2
    # A match as far as it may be from where it was: depth is nearly linear in the shift.
    shape = shape + sight * (pull / jnp.maximum(information, prior))[:, None]
    total = einsum("ckix,ckij,ckjy->kxy", by_shape, precision, by_shape)
    middle = jnp.mean(sight, axis=0)
    reach = jnp.maximum(jnp.sum(along**2), 1e-6)
    alike = jnp.sum(lacking**2) / reach * jnp.outer(middle, middle)
    return Sharpened(shape, jnp.linalg.inv(total + prior * jnp.eye(3, dtype=shape.dtype)), alike)


def _one(rig: CameraRig, camera: int) -> CameraRig:
    return jax.tree.map(lambda leaf: leaf[camera : camera + 1], rig)
