"""A track in doubt, or lost, beside the face that a detector finds in the same images.

Landmarks that do not look as registered are followed from frame to frame, and drift; a face that comes back from a turn
of 60 degrees may so be followed in a wrong pose for as long as it is watched. A detector finds faces that look at the
cameras, wherever they were before. What it finds is registered, the face that is known is laid over it, and the tracker
goes on from there in the same images: the correlation of the registered face decides between the two poses. The face
keeps its axes in this way, which one that was registered anew would take from the camera.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.pose import angles, rotation
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import align
from jaxfilters.trackers.head.common.recent import nothing_changed
from jaxfilters.trackers.head.common.search import scattered
from jaxfilters.trackers.head.common.state import LOST, NUM_MODES, UNITS, HeadState, HeadTrack
from jaxfilters.trackers.head.stereo.known_face import pose_of_known_face
from jaxfilters.trackers.head.stereo.registration import Registration
from jaxfilters.trackers.head.stereo.tracking import LEAST_SCORE, REGAINED_SCORE

EVERY_S = 0.1
"""Seconds between two frames in which a track in doubt is compared with a detection."""
SIMILAR_FACE_MM = 6.0
"""Root mean square distance between two registered shapes up to which the images are asked whether they are of one
person."""
CLEARLY_BETTER = 0.05
"""By how much the registered face must correlate better at another pose."""
DETECTED_STD, KNOWN_STD = np.full(6, 3.0), np.array([5.0, 5.0, 15.0, 8.0, 8.0, 8.0])
"""Millimetres and degrees: of a pose from the landmarks of a detector; from images that look as at registration."""


def located(
    state: HeadState, found: Registration, images: Num[np.ndarray, "C rows cols"], rig: CameraRig
) -> HeadState | None:
    """The state with the face where it is detected; None if the detected face has another shape.

    Args:
        state: Of the tracker.
        found: The detected face.
        images: In which it was detected.
        rig: Cameras.
    """
    pose, apart = _laid_over(state, found.model.mean, found.pose)
    return placed(state, pose, images, rig, DETECTED_STD) if float(apart) <= SIMILAR_FACE_MM else None


def prepare(state: HeadState, images: Num[np.ndarray, "C rows cols"], rig: CameraRig) -> None:
    """Compiles what a comparison runs, so that the frames of live cameras do not wait for it."""
    pose_of_known_face(state, images, rig)
    _laid_over(state, state.registered.shape, state.registered.pose)
    placed(state, state.registered.pose, images, rig, DETECTED_STD)


def is_better(other: HeadTrack, track: HeadTrack) -> bool:
    """Whether the row from a detected face is to be believed rather than that of the track in doubt, or lost."""
    if track.status == LOST:
        return is_found(other)
    return bool(np.all(np.isfinite(other.pose)) and other.score >= max(LEAST_SCORE, track.score + CLEARLY_BETTER))


def is_found(row: HeadTrack) -> bool:
    """Whether the row from a detected face shows the face that was lost."""
    return bool(np.all(np.isfinite(row.pose)) and row.score >= REGAINED_SCORE)


@compiled_quickly
def aligned(
    shape: Float[Array, "K 3"], other: Float[Array, "K 3"]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, ""]]:
    """Rotation and translation of a shape to another one, and root mean square distance left, millimetres."""
    R, t = align(shape, other)
    return R, t, jnp.sqrt(jnp.mean(jnp.sum((dot(shape, R.T) + t - other) ** 2, axis=-1)))


@compiled_quickly
def _laid_over(
    state: HeadState, detected: Float[Array, "K 3"], detected_pose: Float[Array, " 6"]
) -> tuple[Float[Array, " 6"], Float[Array, ""]]:
    """Pose of the face laid over a detected one, and how far the two shapes are apart, millimetres."""
    R, t, apart = aligned(state.registered.shape, detected)
    turn = rotation(detected_pose[3:])
    pose = jnp.concatenate([detected_pose[:3] + dot(turn, t), angles(dot(turn, R))])
    return pose, apart


@compiled_quickly
def placed(
    state: HeadState,
    pose: Float[ArrayLike, " 6"],
    images: Num[ArrayLike, "C rows cols"],
    rig: CameraRig,
    deviation: Float[ArrayLike, " 6"],
) -> HeadState:
    """The state with the face at another pose.

    Args:
        state: Of the tracker.
        pose: Millimetres and radians.
        images: The last ones.
        rig: Cameras.
        deviation: Standard deviations of the pose, millimetres and degrees.
    """
    pose = jnp.asarray(pose, state.belief.mean.dtype)
    x = jnp.concatenate([pose, jnp.zeros(NUM_MODES, pose.dtype)])
    key, noise_key = jax.random.split(state.key)
    search, belief = scattered(noise_key, state.search, x, jnp.asarray(deviation * UNITS, x.dtype))
    none = jnp.zeros_like(state.misses)
    return state._replace(
        search=search,
        belief=belief,
        recent=nothing_changed(jnp.asarray(images, x.dtype), state.registered.shape, pose, rig),
        last_good=x,
        misses=none,
        num_outliers=none,
        key=key,
    )
