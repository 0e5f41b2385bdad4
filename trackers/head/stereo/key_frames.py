"""Patches of a turned head: what landmarks are compared with where those of registration fit no more.

A patch of the first images fits the less the farther the head has turned. What then is followed from frame to frame
drifts, without an end and without a sign of it. A key frame keeps the patches of a frame in which the head was turned,
cut where landmarks were found by the patches of before: later frames of such a head are compared with it, and do not
drift. Key frames are those of L. Vacchetti, V. Lepetit and P. Fua ("Stable real-time 3D tracking using online and
offline information", 2004), but of landmarks, and made while the face is followed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.patches import SKIN_NORMALS, Patches, patches_of
from jaxfilters.models.face.pose import rotation
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.common.state import POSE, KeyFrames, Recent

NUM_KEY_FRAMES = 6
"""Beside registration."""
FARTHEST = 22.0
"""Degrees from the nearest key frame, registration among them, from which on another is kept."""
PREFERENCE = 15.0
"""Degrees by which a key frame must be nearer than registration, whose landmarks are where they are by definition."""
LEAST_SCORE, FEWEST_LANDMARKS = 0.6, 3
"""Mean correlation and landmarks of a frame that becomes a key frame."""


def no_key_frames(patches: Patches) -> KeyFrames:
    """Room for key frames of a face with these patches."""
    room = jax.tree.map(lambda leaf: jnp.zeros((NUM_KEY_FRAMES, *leaf.shape), leaf.dtype), patches)
    shown = jnp.zeros((NUM_KEY_FRAMES, *patches.template.shape[:2]), bool)
    zeros = lambda *shape: jnp.zeros((NUM_KEY_FRAMES, *shape), patches.template.dtype)
    return KeyFrames(room, shown, zeros(3), zeros(POSE, POSE), jnp.zeros((), jnp.int32))


def nearest_patches(
    key_frames: KeyFrames, registered: Patches, first: Float[Array, " 6"], pose: Float[Array, " 6"]
) -> tuple[Patches, Float[Array, "6 6"]]:
    """Of each landmark in each camera, the patch that was observed from the most similar side; what they are off by.

    Turning in the image's plane does not count: it changes a patch as a whole.

    Args:
        key_frames: Kept so far.
        registered: Patches of the first images.
        first: Pose in these, millimetres and radians.
        pose: Expected now.

    Returns:
        The patches, and the mean covariance of the poses at which they were cut; those of registration are where they
        are by definition.
    """
    apart = jnp.where(key_frames.is_valid, _degrees(key_frames.outward, _outward(pose))[:, None, None], jnp.inf)
    best = jnp.argmin(apart, axis=0)
    is_nearer = jnp.min(apart, axis=0) < _degrees(_outward(first), _outward(pose)) - PREFERENCE

    def pick(kept: Array, there: Array) -> Array:
        # What does not depend on a camera is of the model, and the same in all key frames.
        if there.shape[:2] != best.shape:
            return there
        one_each = best.shape + (1,) * (there.ndim - 2)
        chosen = jnp.take_along_axis(kept, best.reshape(1, *one_each), axis=0)[0]
        return jnp.where(is_nearer.reshape(one_each), chosen, there)

    covariance = jnp.where(is_nearer[..., None, None], key_frames.covariance[best], 0.0)
    return jax.tree.map(pick, key_frames.patches, registered), jnp.mean(covariance, axis=(0, 1))


def with_key_frame(
    key_frames: KeyFrames,
    first: Float[Array, " 6"],
    belief: Gaussian,
    recent: Recent,
    is_placed: Bool[Array, "C K"],
    score: Float[Array, ""],
    rig: CameraRig,
) -> KeyFrames:
    """Key frames after a frame, which becomes one if it shows a new side well and there is room.

    Args:
        key_frames: Kept so far.
        first: Pose at registration, millimetres and radians.
        belief: Of the pose, as estimated.
        recent: What the frame shows.
        is_placed: Landmarks that were found by patches, not by following.
        score: Mean correlation at the estimate.
        rig: Cameras.
    """
    pose = belief.mean
    outward = _outward(pose)
    kept = jnp.where(jnp.arange(NUM_KEY_FRAMES) < key_frames.num_kept, _degrees(key_frames.outward, outward), jnp.inf)
    nearest = jnp.minimum(jnp.min(kept), _degrees(_outward(first), outward))
    is_good = (score > LEAST_SCORE) & (jnp.sum(jnp.any(is_placed, axis=0)) >= FEWEST_LANDMARKS)

    def added() -> KeyFrames:
        normals = jnp.asarray(SKIN_NORMALS, pose.dtype)
        patches = patches_of(recent.found, recent.shape, recent.pose, rig, normals)
        put = lambda leaf, value: leaf.at[key_frames.num_kept].set(value)
        return KeyFrames(
            jax.tree.map(put, key_frames.patches, patches),
            put(key_frames.is_valid, is_placed),
            put(key_frames.outward, outward),
            put(key_frames.covariance, belief.covariance),
            key_frames.num_kept + 1,
        )

    return jax.lax.cond(
        is_good & (nearest > FARTHEST) & (key_frames.num_kept < NUM_KEY_FRAMES), added, lambda: key_frames
    )


def _outward(pose: Float[Array, " 6"]) -> Float[Array, "3"]:
    """Where the face looks: against the z axis of its frame."""
    return -rotation(pose[3:])[:, 2]


def _degrees(a: Float[Array, "*n 3"], b: Float[Array, "3"]) -> Float[Array, "*n"]:
    return jnp.degrees(jnp.arccos(jnp.clip(dot(a, b), -1.0, 1.0)))
