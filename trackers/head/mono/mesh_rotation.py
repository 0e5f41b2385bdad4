"""The rotation of a face by all vertices of a detector's mesh, and that of a track and a mesh together.

The ten landmarks that are tracked tell little of the pitch of an unknown person who speaks: from their places in space
to a millimetre, the best linear estimate of the pitch of people of the ICT face model is wrong by 3.5 degrees, from 68
landmarks by 1.0 (`jaxfilters bench head-mono`). The vertices of a mesh cover the whole face. Their rotation is the one
that takes the mesh of a mean person nearest to them.

The errors of a track and of a mesh last while the face looks as it does, and no number of frames reduces them. The
reported rotation is therefore the mean of both, weighted by their variances, in each frame by itself; nothing of it
goes back into the tracker. Between two meshes the last one is carried on by the motion of the track.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.multilinear import MultilinearFace, shape
from jaxfilters.models.face.pose import angles, rotation, turn
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import align
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.io.face_models import people_face_model

STD, STD_BY_YAW = np.radians([0.6, 1.0, 3.0]), np.radians([4.0, 4.0, 1.0])
"""Standard deviations of roll, yaw and pitch of a mesh whose face looks into the camera, radians; and what they grow by
at a yaw of 30 degrees to the line of sight, with the square of the yaw."""
GROSS_STD, GROSS_SHARE, MOST_GROSS = np.radians([24.0, 16.0, 25.0]), 0.9, 0.9
"""What gross errors add, and their share at a yaw of 30 degrees, which grows alike; and the largest share.

Of some heads that are turned by 60 degrees a mesh says 30. All these numbers have the best log score of the mean of
track and mesh on people 12 to 31 of the ICT face model (668 frames, all three angles -4.02; without gross errors
-4.18). On people 0 to 7, on whom nothing was chosen, it is -3.78 in place of -3.99.
"""
MOTION_STD = np.radians([0.0, 2.0, 2.0])
"""Of the motion of a track since the last mesh, radians for the square root of a second; chosen on people 12 to 23."""
STALE_S = 1.0
"""Age from which on a mesh is left out. After 0.6 seconds it still raises the log score of these people."""
REFERENCE_YAW = np.radians(30.0)


class MeshRotation(NamedTuple):
    """What a mesh says of the rotation in one frame, and the track in the same frame; radians: roll, yaw, pitch."""

    time: float
    """Seconds."""
    angles: Float[np.ndarray, " 3"]
    """By the mesh."""
    yaw: float
    """The same to the line of sight, by which the errors of a mesh grow."""
    track_angles: Float[np.ndarray, " 3"]
    track_variance: Float[np.ndarray, " 3"]
    """That the track claims."""


class MeshRotations:
    """Those of the last meshes beside a track."""

    def __init__(self, face: MultilinearFace, rig: CameraRig, vertices: Float[np.ndarray, "V 3"] | None) -> None:
        """None so far.

        Args:
            face: Model of ten landmarks, on whose axes the track is.
            rig: One camera, which is the world.
            vertices: Mesh of the mean person, millimetres on the axes of the package's general model of people; None
                for a detector without meshes.
        """
        self._rig = rig
        self._vertices = None if vertices is None else on_axes_of(face, vertices)
        self._measured: list[MeshRotation] = []

    def saved(self) -> list[MeshRotation]:
        """All that later rows need, for `restore`."""
        return list(self._measured)

    def restore(self, saved: list[MeshRotation]) -> None:
        """Go on from what `saved` gave."""
        self._measured = list(saved)

    def add(self, solid: Float[np.ndarray, "V 3"] | None, row: MonoTrack, time: float) -> None:
        """Add the mesh in one image, if there is one, beside the row of the track in it; `time` is in seconds."""
        if self._vertices is None or solid is None or not np.all(np.isfinite(row.pose)):
            return
        in_camera, yaw = measured(self._vertices, solid, self._rig)
        own, std = (np.asarray(leaf[3:], float) for leaf in (row.pose, row.pose_std))
        self._measured.append(MeshRotation(time, in_camera, yaw, own, np.square(std)))

    def reported(self, track: MonoTrack, times: Float[np.ndarray, " b"]) -> MonoTrack:
        """Rows of a track, in the order of time, with the rotations of the last meshes before each."""
        found = with_meshes(track, times, self._measured)
        self._measured = self._measured[-1:]
        return found


def on_axes_of(face: MultilinearFace, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """A mesh on the axes of another model: between the models' mean faces is the rotation between their axes.

    Args:
        face: Model of ten landmarks.
        vertices: Millimetres, on the axes of the package's general model of people.
    """
    general = people_face_model().model
    mean = lambda model: shape(model, model.identity_mean, model.expression_mean)
    between, _ = compiled_quickly(align)(mean(general), mean(face))
    return vertices @ np.asarray(between, float).T


def measured(
    vertices: Float[np.ndarray, "V 3"], solid: Float[np.ndarray, "V 3"], rig: CameraRig
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Roll, yaw and pitch of a mesh, and its yaw to the line of sight; radians.

    Args:
        vertices: Of the mean person's mesh.
        solid: Of the mesh in an image, pixels: (u, v, and away from the camera as large).
        rig: One camera, which is the world.
    """
    number = lambda a: jnp.asarray(a, rig.focal.dtype)
    in_camera, yaw = _rotated(number(vertices), number(solid), rig)
    return np.asarray(in_camera, float), float(yaw)


@compiled_quickly
def _rotated(
    vertices: Float[Array, "V 3"], solid: Float[Array, "V 3"], rig: CameraRig
) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """Angles of a mesh in the camera, and the yaw to the line of sight."""
    about_sight, _ = align(vertices, solid)
    sight = line_of_sight(rig, jnp.mean(solid[:, :2], axis=0))
    return angles(dot(sight, about_sight)), angles(about_sight)[1]


def line_of_sight(rig: CameraRig, uv: Float[Array, " 2"]) -> Float[Array, "3 3"]:
    """The least rotation that takes the axis of the camera to the ray of a pixel."""
    ray = (uv - rig.center[0]) / rig.focal[0]
    x, y, z = jnp.append(ray, 1.0) / jnp.sqrt(1.0 + jnp.sum(jnp.square(ray)))
    return jnp.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), x], [-x * y / (1 + z), 1 - y * y / (1 + z), y], [-x, -y, z]]
    )


def with_meshes(track: MonoTrack, times: Float[np.ndarray, " b"], meshes: list[MeshRotation]) -> MonoTrack:
    """The track with the rotations that it and the last mesh before each row give together.

    The landmarks stay where they are in space, so that the shape turns the other way.

    Args:
        track: Of the tracker alone.
        times: Of its rows, seconds.
        meshes: In the order of time.
    """
    pose, std, turned = (np.array(leaf) for leaf in (track.pose, track.pose_std, track.shape))
    for i, time in enumerate(times):
        usable = [mesh for mesh in meshes if 0 <= time - mesh.time <= STALE_S]
        if not usable or not np.all(np.isfinite(pose[i])):
            continue
        before = pose[i, 3:].copy()
        pose[i, 3:], std[i, 3:] = _together(before, std[i, 3:], usable[-1], float(time))
        turned[i] = _turned_back(turned[i], before, pose[i, 3:])
    return track._replace(pose=pose, pose_std=std, shape=turned)


def _together(
    track: Float[np.ndarray, " 3"], std: Float[np.ndarray, " 3"], mesh: MeshRotation, time: float
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Angles of a track and of a mesh some time before, as one; and their standard deviations.

    The mesh is off as usual, or grossly in all three angles; mean and variance are those of the mixture of both cases.
    """
    own, turned = np.square(np.asarray(std, float)), np.square(mesh.yaw / REFERENCE_YAW)
    # A track that is suddenly less certain, or more, has other errors than it had beside the mesh.
    moved = np.square(MOTION_STD) * (time - mesh.time) + np.abs(own - mesh.track_variance)
    usual = STD + STD_BY_YAW * turned
    variance = np.square(np.stack([usual, usual + GROSS_STD])) + moved
    apart = (mesh.angles - mesh.track_angles + np.pi) % (2 * np.pi) - np.pi
    both, share = own + variance, own / (own + variance)
    gross = min(GROSS_SHARE * turned, MOST_GROSS)
    log_likelihood = -0.5 * np.sum(np.square(apart) / both + np.log(both), axis=1)
    weights = np.array([1.0 - gross, gross]) * np.exp(log_likelihood - np.max(log_likelihood))
    weights = (weights / np.sum(weights))[:, None]
    mean = np.sum(weights * share * apart, axis=0)
    spread = np.sum(weights * ((1 - share) * own + np.square(share * apart - mean)), axis=0)
    return track + mean, np.sqrt(spread)


@compiled_quickly
def _turned_back(points: Float[Array, "K 3"], before: Float[Array, " 3"], after: Float[Array, " 3"]) -> Array:
    """Points of a model that stay where they are in space while its axes turn."""
    return turn(points, dot(rotation(after).T, rotation(before)))
