"""That people mostly look at the camera when a track begins, as information about the shape of their face.

A few images of ten landmarks hardly tell a face that is turned up from one whose nose is higher. Both fit them, with
different persons. The distribution of the angles at which faces are found therefore says something about the person:
how the mean rotation of the first images would change with the person's shape is known from these images, so that its
distribution is a measurement of the shape. As such it stays known in all later adjustments, long after the first images
are no longer part of them.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.bundle import Bundle, Views, projected
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Prior, nothing_past
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.square_root_prior import SquareRootPrior
from jaxfilters.trackers.head.common.state import POSE
from jaxfilters.trackers.head.mono.adjustment import moved_person, of_frames, with_measurement
from jaxfilters.trackers.head.mono.start import Start


def turned_away(pose: Float[Array, " 6"]) -> Float[Array, " 3"]:
    """Roll, yaw and pitch from the rotation of a head at the same place that looks into the camera, radians."""
    x, y, z = pose[:3]
    return pose[3:] - jnp.stack([jnp.zeros_like(x), jnp.arctan2(x, z), -jnp.arctan2(y, jnp.hypot(x, z))])


def with_facing(
    face: MultilinearFace,
    rig: CameraRig,
    start: Start,
    views: Views,
    past: SquareRootPrior | None,
    std: Float[ArrayLike, " 3"],
    prior: Prior,
) -> tuple[Start, SquareRootPrior]:
    """The start as far as its mean rotation is a usual one; and what is known of the person beside `views`.

    Args:
        face: Model of the ten landmarks.
        rig: One camera, which is the world.
        start: From the landmarks, the most probable one by them and `past`.
        views: The landmarks.
        past: What is known beside them, if anything.
        std: Standard deviation of roll, yaw and pitch of faces that are found, from those of heads that look into the
            camera, radians.
        prior: What holds the face; its weight is not 0.
    """
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, start.uv.dtype), tree)
    past = nothing_past(face) if past is None else past
    return _turned(face, rig, start, views, past, numbers(std), numbers(prior))


@compiled_quickly
def _turned(
    face: MultilinearFace,
    rig: CameraRig,
    start: Start,
    views: Views,
    past: SquareRootPrior,
    std: Array,
    prior: Prior,
) -> tuple[Start, SquareRootPrior]:
    bundle, frames = start.bundle, of_frames(face, rig, views, start.bundle, prior)
    by_pose = jax.vmap(jax.jacfwd(turned_away))(bundle.poses)
    by_person = jnp.mean(jnp.matmul(by_pose, frames.response[:, :POSE], precision="highest"), axis=0)
    away = jnp.mean(jax.vmap(turned_away)(bundle.poses), axis=0)
    step, past = with_measurement(face, bundle.person, frames, past, by_person / std[:, None], away / std, prior)
    own = jnp.matmul(frames.response, step, precision="highest")
    person = moved_person(face, bundle.person, step, prior)
    bundle = Bundle(bundle.poses + own[:, :POSE], bundle.expressions + own[:, POSE:], person)
    return start._replace(bundle=bundle, uv=projected(face, rig, bundle)), past
