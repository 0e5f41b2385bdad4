"""Rotations of meshes, against SciPy's; that of a track and a mesh, against the product of two Gaussians."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face.pose import place
from jaxfilters.trackers.head.mono.detectors import DetectedFace
from jaxfilters.trackers.head.mono.mesh_rotation import (
    GROSS_SHARE,
    GROSS_STD,
    MOTION_STD,
    STALE_S,
    STD,
    STD_BY_YAW,
    MeshRotation,
    MeshRotations,
    measured,
    on_axes_of,
    with_meshes,
)
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.io.detector_errors import default_detector_errors
from jaxfilters.trackers.io.face_models import people_face_model
from jaxfilters.trackers.io.trees import put_together, taken_apart

TRUE = np.array([0.1, -0.4, 0.2])
"""Roll, yaw and pitch, radians."""
WRONG = np.radians([1.0, 2.0, -6.0])
"""By what the mesh of the session's detector is off."""


def sight_of(uv, rig):
    """The least turn of the axis of the camera to a pixel."""
    ray = np.append((uv - np.asarray(rig.center[0])) / np.asarray(rig.focal[0]), 1.0)
    axis = np.cross([0.0, 0.0, 1.0], ray)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), ray[2]))


def solid_of(vertices, angles, uv, rig):
    """Vertices in pixels of a face of that rotation in the camera; and its yaw to the line of sight."""
    about_sight = sight_of(uv, rig).inv() * Rotation.from_euler("ZYX", angles)
    points = 1.3 * about_sight.apply(vertices - vertices.mean(axis=0))
    return points + np.append(uv, 0.0), about_sight.as_euler("ZYX")[1]


@pytest.mark.parametrize("angles", [TRUE, [-2.5, 0.9, -0.5]], ids=["upright", "upside down"])
def test_the_rotation_of_a_mesh_is_the_best_one(rig, angles):
    """With noise it is SciPy's solution of Wahba's problem; without, that of the face. Float32: 1e-4 radians."""
    rng = np.random.default_rng(0)
    vertices, uv = rng.normal(0, 40.0, (120, 3)), np.array([520.0, 120.0])
    solid, yaw = solid_of(vertices, angles, uv, rig)
    np.testing.assert_allclose(measured(vertices, solid, rig)[0], angles, atol=1e-4)
    assert measured(vertices, solid, rig)[1] == pytest.approx(yaw, abs=1e-4)
    noisy = solid + rng.normal(0, 8.0, solid.shape)
    best, _ = Rotation.align_vectors(noisy - noisy.mean(axis=0), vertices - vertices.mean(axis=0))
    expected = sight_of(noisy[:, :2].mean(axis=0), rig) * best
    found = Rotation.from_euler("ZYX", measured(vertices, noisy, rig)[0])
    assert (found * expected.inv()).magnitude() < 1e-4


def test_a_mesh_has_the_axes_of_the_model():
    general, turned = people_face_model().model, Rotation.from_euler("ZYX", [0.0, 0.1, 0.3])
    R = jnp.asarray(turned.as_matrix(), general.mean.dtype)
    face = dataclasses.replace(
        general, mean=general.mean @ R.T, tensor=jnp.einsum("ij,kj...->ki...", R, general.tensor)
    )
    vertices = np.random.default_rng(0).normal(0, 40.0, (50, 3))
    np.testing.assert_allclose(on_axes_of(general, vertices), vertices, atol=1e-3)
    np.testing.assert_allclose(on_axes_of(face, vertices), turned.apply(vertices), atol=1e-3)


def rows_of(angles, std):
    count, draw = len(angles), np.random.default_rng(1)
    pose = np.concatenate([draw.normal(0, 100.0, (count, 3)), angles], axis=1)
    deviations = np.concatenate([np.ones((count, 3)), std], axis=1)
    rows = dict.fromkeys(MonoTrack._fields, np.zeros(count))
    return MonoTrack(**rows | {"pose": pose, "pose_std": deviations, "shape": draw.normal(0, 40.0, (count, 10, 3))})


def mesh_beside(track, row, time, apart, yaw=0.0):
    own = track.pose[row, 3:]
    return MeshRotation(time, own + apart, yaw, np.zeros(3), own, np.square(track.pose_std[row, 3:]))


def test_a_track_and_a_mesh_are_one_gaussian():
    """In the frame of the mesh; before it, and long after, the track is as it was. Landmarks stay where they are."""
    times = np.array([0.9, 1.0, 1.0 + STALE_S + 0.01])
    track = rows_of(np.tile(TRUE, (3, 1)), np.tile([0.02, 0.05, 0.1], (3, 1)))
    mesh = mesh_beside(track, 1, 1.0, np.array([0.01, -0.1, 0.2]))
    found = with_meshes(track, times, [mesh])
    information = 1 / track.pose_std[1, 3:] ** 2, 1 / np.square(STD)
    mean = (information[0] * TRUE + information[1] * mesh.angles) / sum(information)
    np.testing.assert_allclose(found.pose[1, 3:], mean, rtol=1e-6)
    np.testing.assert_allclose(found.pose_std[1, 3:], 1 / np.sqrt(sum(information)), rtol=1e-6)
    np.testing.assert_array_equal(found.pose[:, :3], track.pose[:, :3])
    np.testing.assert_array_equal(found.pose[[0, 2]], track.pose[[0, 2]])
    where = jax.vmap(place)
    np.testing.assert_allclose(where(found.shape, found.pose), where(track.shape, track.pose), atol=1e-3)
    # Half a turn is where angles start anew.
    over = mesh._replace(track_angles=np.array([np.pi - 0.001, 0.0, 0.0]), angles=np.array([0.001 - np.pi, 0.0, 0.0]))
    beyond = track._replace(pose=track.pose.copy())
    beyond.pose[1, 3:] = over.track_angles
    assert with_meshes(beyond, times, [over]).pose[1, 3] == pytest.approx(np.pi, abs=0.002)


@pytest.mark.parametrize(("apart", "degrees"), [(0.03, 20.0), (0.15, 20.0), (0.6, 20.0), (0.1, 60.0)])
def test_a_turned_mesh_may_be_off_grossly(apart, degrees):
    """Mean and standard deviation of 400,000 weighted draws of the track's error; 5 of their standard errors."""
    track, yaw = rows_of(TRUE[None], np.array([[0.05, 0.12, 0.1]])), np.radians(degrees)
    mesh = mesh_beside(track, 0, 0.0, np.array([0.2, 1.0, -0.5]) * apart, yaw)
    found = with_meshes(track, np.zeros(1), [mesh])
    draws = np.random.default_rng(0).normal(0, track.pose_std[0, 3:], (400_000, 3))
    turned = (degrees / 30.0) ** 2
    gross, usual = min(GROSS_SHARE * turned, 0.9), STD + STD_BY_YAW * turned
    left = mesh.angles - TRUE - draws
    density = lambda std: np.prod(np.exp(-0.5 * np.square(left / std)) / std, axis=1)
    weights = (1 - gross) * density(usual) + gross * density(usual + GROSS_STD)
    weights /= weights.sum()
    mean = weights @ draws
    std = np.sqrt(weights @ np.square(draws - mean))
    error = 5 * std * np.sqrt(np.sum(np.square(weights)))
    assert np.all(np.abs(found.pose[0, 3:] - TRUE - mean) < error)
    assert np.all(np.abs(found.pose_std[0, 3:] - std) < error)


def test_a_mesh_is_carried_on_by_the_motion_of_the_track():
    """A constant error of the track, of known size, is corrected alike in later frames, by less as time goes on."""
    angles = TRUE + np.outer([0.0, 1.0, 2.0], [0.1, 0.2, -0.1])
    track, times = rows_of(angles, np.full((3, 3), 0.1)), np.array([0.0, 0.25, 0.5])
    mesh = mesh_beside(track, 0, 0.0, np.full(3, 0.05))
    found = with_meshes(track, times, [mesh])
    variance = np.square(STD) + np.outer(times, np.square(MOTION_STD))
    np.testing.assert_allclose(found.pose[:, 3:] - angles, 0.05 * 0.01 / (0.01 + variance), rtol=1e-5)
    # A track that has become less certain has further errors, which the mesh before tells nothing of; one that has
    # become more certain has lost some of those that it had.
    for std, lasting in ((0.3, 0.01), (0.05, 0.0025)):
        other = track._replace(pose_std=track.pose_std.copy())
        other.pose_std[2, 3:] = std
        later = with_meshes(other, times, [mesh])
        gain = lasting / (0.01 + variance[2])
        np.testing.assert_allclose(later.pose[2, 3:] - angles[2], 0.05 * gain, rtol=1e-5)
        np.testing.assert_allclose(np.square(later.pose_std[2, 3:]), std**2 - gain * lasting, rtol=1e-5)


def test_errors_of_the_focal_length_are_those_of_both():
    """What track and mesh have in common is neither reduced nor a reason to believe one of them."""
    track = rows_of(TRUE[None], np.full((1, 3), 0.1))
    shared = np.array([0.0, 0.0036, 0.0064])
    mesh = mesh_beside(track, 0, 0.0, np.full(3, 0.05))._replace(shared_variance=shared)
    mesh = mesh._replace(track_variance=0.01 - shared)
    found, own = with_meshes(track, np.zeros(1), [mesh]), 0.01 - shared
    gain = own / (own + np.square(STD))
    np.testing.assert_allclose(found.pose[0, 3:] - TRUE, 0.05 * gain, rtol=1e-5)
    np.testing.assert_allclose(np.square(found.pose_std[0, 3:]), shared + (1 - gain) * own, rtol=1e-5)


def in_image(track, uv):
    """With landmarks about a pixel."""
    about = 30.0 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1), (0, 0), (0, 0)])
    return track._replace(image_points=np.broadcast_to(uv + about, (len(track.pose), 1, 10, 2)))


def test_meshes_are_of_the_track_before_them(rig, face):
    """After a loss, and where the track was put elsewhere, the meshes before count no more; nor do other faces."""
    uv, times = np.array([400.0, 200.0]), np.array([0.0, 0.1, 0.2])
    vertices = np.random.default_rng(0).normal(0, 40.0, (60, 3))
    track = in_image(rows_of(np.tile(TRUE, (3, 1)), np.full((3, 3), 0.1)), uv)
    row = jax.tree.map(lambda leaf: leaf[0], track)
    solid, _ = solid_of(on_axes_of(face, vertices), TRUE + 0.05, uv, rig)

    def meshes(**options):
        made = MeshRotations(face, rig, vertices, **options)
        made.add(solid, row, 0.0)
        return made

    corrected = lambda found: (np.abs(found.pose[:, 4] - TRUE[1]) > 1e-3).tolist()
    assert corrected(meshes().reported(track, times)) == [True] * 3
    lost = track._replace(pose=track.pose.copy())
    lost.pose[1] = np.nan
    found = meshes()
    assert corrected(found.reported(lost, times)) == [True, False, False]
    assert not found.saved()
    put = meshes()
    put.add(None, row, 0.2, replaced=row)
    assert corrected(put.reported(track, times)) == [True, True, False]
    assert not put.saved()
    again = meshes()
    again.add(solid, row, 0.2, replaced=row)
    assert corrected(again.reported(track, times)) == [True] * 3
    assert [mesh.time for mesh in again.saved()] == [0.2]
    other = MeshRotations(face, rig, vertices)
    other.add(solid + np.array([120.0, 0.0, 0.0]), row, 0.0)
    assert not other.saved()
    (mesh,) = meshes(focal_log_std=0.25).saved()
    x, y = (uv - np.asarray(rig.center[0])) / 800.0
    slopes = 0.25 * np.array([0.0, x / (1 + x * x), y / (1 + y * y)])  # of the direction of a pixel
    np.testing.assert_allclose(mesh.shared_variance, np.square(slopes), rtol=1e-3)
    with pytest.raises(ValueError, match=r"solid must have the vertices of the mean mesh, \(60, 3\); got \(59, 3\)"):
        MeshRotations(face, rig, vertices).add(solid[1:], row, 0.0)


def test_frames_without_a_mesh_or_without_a_face_add_none(rig, face):
    track = in_image(rows_of(TRUE[None], np.full((1, 3), 0.1)), np.array([300.0, 200.0]))
    row = jax.tree.map(lambda leaf: leaf[0], track)
    without = MeshRotations(face, rig, None)
    without.add(np.zeros((20, 3)), row, 0.0)
    meshes = MeshRotations(face, rig, np.random.default_rng(0).normal(0, 40.0, (20, 3)))
    meshes.add(None, row, 0.0)
    meshes.add(np.ones((20, 3)), row._replace(pose=np.full(6, np.nan)), 0.0)
    assert not without.saved()
    assert not meshes.saved()
    np.testing.assert_array_equal(meshes.reported(track, np.zeros(1)).pose, track.pose)


class Meshes:
    """A detector of true landmarks, and of meshes that are turned by `WRONG` in all frames."""

    is_averaged = True
    facing_std = None

    def __init__(self, made, images, rig, vertices):
        self.errors = default_detector_errors()["mediapipe"]
        self._frames = {image.tobytes(): i for i, image in enumerate(images[:, 0])}
        self._made, self._rig, self._vertices = made, rig, vertices
        self.asked = []

    def detect(self, image, near, apart_px=None):
        del near, apart_px
        i = self._frames[image.tobytes()]
        self.asked.append(i)
        uv = self._made.uv[i, 0]
        solid, _ = solid_of(self._vertices, self._made.poses[i, 3:] + WRONG, uv.mean(axis=0), self._rig)
        return DetectedFace(uv, solid=solid)

    def glance(self, image, near, apart_px):
        return self.detect(image, near, apart_px).solid


@pytest.mark.system
def test_a_session_reports_both_and_goes_on_the_same_after_it_was_saved(rig, face, talking, detected):
    made, images = talking
    vertices = on_axes_of(face, default_detector_errors()["mediapipe"].vertices)
    detector = Meshes(made, images, rig, vertices)
    session = MonoSession(rig, face, detections=detected, detector=detector)
    whole = session.process(images, made.times)
    track = MonoSession(rig, face, detections=detected).process(images, made.times)
    rows = np.flatnonzero(np.isfinite(whole.pose[:, 0]))
    assert len(detector.asked) >= len(rows) // 4  # ten times a second, in 30 frames a second
    asked = rows[np.isin(rows, detector.asked)]
    for i in asked:
        alone = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], track)
        own = alone.pose[0, 3:].astype(float), np.square(alone.pose_std[0, 3:].astype(float))
        angles, middle = made.poses[i, 3:] + WRONG, made.uv[i, 0].mean(axis=0)
        mesh = MeshRotation(made.times[i], angles, solid_of(vertices, angles, middle, rig)[1], np.zeros(3), *own)
        expected = with_meshes(alone, made.times[i : i + 1], [mesh])
        np.testing.assert_allclose(whole.pose[i, 3:], expected.pose[0, 3:], atol=1e-3)
        np.testing.assert_allclose(whole.pose_std[i], expected.pose_std[0], rtol=1e-2)
    # The frames between have the last mesh before them, and those before the first one have none.
    between = rows[rows < asked[0]]
    np.testing.assert_array_equal(whole.pose[between], track.pose[between])
    later = np.setdiff1d(rows[rows > asked[0]], asked)
    assert np.all(np.any(np.abs(whole.pose[later, 3:] - track.pose[later, 3:]) > 1e-4, axis=1))
    nearer = np.abs(whole.pose[asked, 3:] - made.poses[asked, 3:] - WRONG) < np.abs(
        track.pose[asked, 3:] - made.poses[asked, 3:] - WRONG
    )
    assert nearer.mean() > 0.95
    first = MonoSession(rig, face, detections=detected, detector=Meshes(made, images, rig, vertices))
    half = first.process(images[:40], made.times[:40])
    second = MonoSession(rig, face, detector=Meshes(made, images, rig, vertices))
    second.restore(put_together(*taken_apart(first.saved())))
    rest = second.process(images[40:], made.times[40:])
    for name in ("pose", "pose_std", "shape"):
        joined = np.concatenate([getattr(half, name), getattr(rest, name)])
        np.testing.assert_array_equal(joined, getattr(whole, name), err_msg=name)
