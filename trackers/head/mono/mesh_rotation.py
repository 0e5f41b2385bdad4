"""The rotation of a face by all vertices of a detector's mesh, and that of a track and a mesh together.

The ten landmarks that are tracked determine the pitch of an unknown person who speaks poorly: a linear regression from
their places in space to a millimetre leaves errors of 3.5 degrees in people of the ICT face model, one from 68
landmarks 1.0 (`jaxfilters bench head-mono`). The vertices of a mesh cover the whole face. Their rotation is the one
that takes the mesh of a mean person nearest to them.

The errors of a track and of a mesh last while the face looks as it does, and no number of frames reduces them. The
reported rotation is therefore the mean of both, weighted by the inverses of their variances, in each frame by itself;
nothing of it goes back into the tracker. Between two meshes, the motion of the track is added to the last one. The
errors of the mesh count as independent of those of the track, although the person was registered from landmarks of the
same mesh: the standard deviations of both together hold on rendered people (`docs/accuracy/head.md`).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace, shape
from jaxfilters.models.face.pose import angles, rotation, turn, within_half_turn
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import align
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.io.face_models import people_face_model

STD, STD_BY_YAW = np.radians([0.6, 1.0, 3.0]), np.radians([4.0, 4.0, 1.0])
"""Usual errors of roll, yaw and pitch of a mesh, radians: `STD + STD_BY_YAW (yaw / 30 degrees)^2` are their standard
deviations, with the yaw to the line of sight."""
GROSS_STD, GROSS_SHARE, MOST_GROSS = np.radians([24.0, 16.0, 25.0]), 0.9, 0.9
"""What gross errors add to these, and their probability `GROSS_SHARE (yaw / 30 degrees)^2`, at most `MOST_GROSS`.

A mesh turns some heads by 30 degrees that are turned by 60. All these numbers have the best log score (natural
logarithm of the density of the three angles in degrees, mean over 668 frames of people 12 to 31 of the ICT face model)
of the mean of track and mesh: -4.02, and -4.18 without gross errors. On people 0 to 7, on whom none of these numbers
was chosen, it is -3.78 in place of -3.99. The pitch of the head was not varied.
"""
MOTION_STD = np.radians([0.0, 2.0, 2.0])
"""Error of the motion of a track, radians for the square root of a second; chosen on people 12 to 23."""
STALE_S = 1.0
"""Age beyond which a mesh is not used. After 0.6 seconds it still raises the log score of these people."""
REFERENCE_YAW = np.radians(30.0)
SAME_FACE = 1.0
"""Distance of the middle of a mesh from that of the landmarks, by the root mean square distance of the landmarks from
their middle, beyond which the mesh is that of another face."""


class MeshRotation(NamedTuple):
    """The rotation of a mesh in one frame, and that of the track in the same frame; radians: roll, yaw, pitch."""

    time: float
    """Seconds."""
    angles: Float[np.ndarray, " 3"]
    """Of the mesh."""
    yaw: float
    """Of the mesh to the line of sight, on which its errors depend."""
    shared_variance: Float[np.ndarray, " 3"]
    """Of errors that track and mesh have in common: those of the line of sight, by the focal length."""
    track_angles: Float[np.ndarray, " 3"]
    track_variance: Float[np.ndarray, " 3"]
    """Of the other errors of the track."""


class MeshRotations:
    """The rotations of the last meshes beside a track."""

    def __init__(
        self,
        face: MultilinearFace,
        rig: CameraRig,
        vertices: Float[np.ndarray, "V 3"] | None,
        focal_log_std: float = 0.0,
    ) -> None:
        """No mesh so far.

        Args:
            face: Model of ten landmarks, on whose axes the track is.
            rig: One camera, which is the world.
            vertices: Mesh of the mean person, millimetres on the axes of the package's general model of people; None
                for a detector without meshes.
            focal_log_std: Standard deviation of the logarithm of the focal length.
        """
        self._rig, self._focal_log_std = rig, focal_log_std
        self._vertices = None if vertices is None else on_axes_of(face, vertices)
        self._measured: list[MeshRotation] = []
        self._since = -math.inf
        """When the track was put elsewhere, in the rows that are to be reported."""

    @property
    def are_used(self) -> bool:
        """Whether the detector has meshes."""
        return self._vertices is not None

    def saved(self) -> list[MeshRotation]:
        """All that later rows need, for `restore`, once all rows so far were reported."""
        return list(self._measured)

    def restore(self, saved: list[MeshRotation]) -> None:
        """Go on from what `saved` gave."""
        self._measured, self._since = list(saved), -math.inf

    def prepare(self) -> None:
        """Compiles what the first mesh and the first row need, so that the frames of a live camera do not wait."""
        if self._vertices is not None:
            measured(self._vertices, self._vertices, self._rig)
            _turned_back(np.zeros((NUM_LANDMARKS, 3), np.float32), *np.zeros((2, 3), np.float32))

    def add(
        self, solid: Float[np.ndarray, "V 3"] | None, row: MonoTrack, time: float, replaced: MonoTrack | None = None
    ) -> None:
        """Add the mesh in one image beside the row of the track in it.

        Nothing is added without a mesh or a track, or where the mesh is that of another face.

        Args:
            solid: As for `measured`.
            row: Of the track alone.
            time: Seconds.
            replaced: The row that the track has in its place, if it was put elsewhere: earlier meshes are not used
                from then on.
        """
        if replaced is not None:
            row, self._since = replaced, time
        if self._vertices is None or solid is None or not np.all(np.isfinite(solid)):
            return
        if not np.all(np.isfinite(row.pose)) or not np.all(np.isfinite(row.pose_std)):
            return
        points = np.asarray(row.image_points[0], float)
        middle, spread = solid[:, :2].mean(axis=0), np.sqrt(2.0 * np.mean(np.var(points, axis=0)))
        if np.linalg.norm(middle - points.mean(axis=0)) > SAME_FACE * spread:
            return
        in_camera, yaw = measured(self._vertices, solid, self._rig)
        ray = (middle - np.asarray(self._rig.center[0], float)) / np.asarray(self._rig.focal[0], float)
        shared = np.square(np.append(0.0, self._focal_log_std * ray / (1.0 + np.square(ray))))
        own, variance = np.asarray(row.pose[3:], float), np.square(np.asarray(row.pose_std[3:], float))
        self._measured.append(MeshRotation(time, in_camera, yaw, shared, own, np.maximum(variance - shared, 0.0)))

    def reported(self, track: MonoTrack, times: Float[np.ndarray, " b"]) -> MonoTrack:
        """Rows of a track, in the order of time, with the rotations of the last meshes before each."""
        for time in times[~np.all(np.isfinite(track.pose), axis=1)]:
            self._since = max(self._since, float(time))
        found = with_meshes(track, times, self._measured, self._since)
        self._measured = [mesh for mesh in self._measured[-1:] if mesh.time >= self._since]
        self._since = -math.inf
        return found


_aligned = compiled_quickly(align)


def on_axes_of(face: MultilinearFace, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """A mesh on the axes of another model. The rotation between the axes is that between the models' mean faces.

    Args:
        face: Model of ten landmarks.
        vertices: Millimetres, on the axes of the package's general model of people.
    """
    general = people_face_model().model
    mean = lambda model: shape(model, model.identity_mean, model.expression_mean)
    between, _ = _aligned(mean(general), mean(face))
    return vertices @ np.asarray(between, float).T


def measured(
    vertices: Float[np.ndarray, "V 3"], solid: Float[np.ndarray, "any 3"], rig: CameraRig
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Roll, yaw and pitch of a mesh, and its yaw to the line of sight; radians.

    Args:
        vertices: Of the mean person's mesh.
        solid: Of the mesh in an image, pixels: (u, v), and the depth on the same scale.
        rig: One camera, which is the world.

    Raises:
        ValueError: if the meshes have different vertices.
    """
    if np.shape(vertices) != np.shape(solid):
        raise ValueError(f"solid must have the vertices of the mean mesh, {vertices.shape}; got {np.shape(solid)}.")
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


def with_meshes(
    track: MonoTrack, times: Float[np.ndarray, " b"], meshes: list[MeshRotation], since: float = -math.inf
) -> MonoTrack:
    """The track with the rotations that it and the last mesh before each row give together.

    The landmarks stay where they are in space, so that the shape turns the other way.

    Args:
        track: Of the tracker alone.
        times: Of its rows, seconds.
        meshes: In the order of time.
        since: When the track was put elsewhere: rows from then on do without earlier meshes.
    """
    pose, std, turned = (np.array(leaf) for leaf in (track.pose, track.pose_std, track.shape))
    for i, time in enumerate(times):
        usable = [mesh for mesh in meshes if 0 <= time - mesh.time <= STALE_S and not mesh.time < since <= time]
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
    Of the errors of the track now, those with the smaller of both variances are the errors that it had then.
    """
    own = np.maximum(np.square(np.asarray(std, float)) - mesh.shared_variance, 0.0)
    lasting, turned = np.minimum(own, mesh.track_variance), np.square(mesh.yaw / REFERENCE_YAW)
    usual = STD + STD_BY_YAW * turned
    variance = np.square(np.stack([usual, usual + GROSS_STD])) + np.square(MOTION_STD) * (time - mesh.time)
    apart = within_half_turn(mesh.angles - mesh.track_angles)
    both = mesh.track_variance + variance
    gross = min(GROSS_SHARE * turned, MOST_GROSS)
    with np.errstate(divide="ignore"):
        log_weights = np.log([1.0 - gross, gross]) - 0.5 * np.sum(np.square(apart) / both + np.log(both), axis=1)
    weights = np.exp(log_weights - np.max(log_weights))[:, None]
    weights, gain = weights / np.sum(weights), lasting / both
    mean = np.sum(weights * gain * apart, axis=0)
    spread = own - np.sum(weights * gain, axis=0) * lasting + np.sum(weights * np.square(gain * apart - mean), axis=0)
    return track + mean, np.sqrt(spread + mesh.shared_variance)


@compiled_quickly
def _turned_back(points: Float[Array, "K 3"], before: Float[Array, " 3"], after: Float[Array, " 3"]) -> Array:
    """Points of a model that stay where they are in space while its axes turn."""
    return turn(points, dot(rotation(after).T, rotation(before)))
