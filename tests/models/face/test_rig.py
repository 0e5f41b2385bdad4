"""Rigs of cameras against OpenCV and finite differences (oracles 1 and 2 of the specification), and refused ones."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face import pose as head
from jaxfilters.models.face import rig as cameras
from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.rig import CameraRig, monocular, nominal

jacobian, project_shape, triangulate = (
    jax.jit(f) for f in (cameras.jacobian, cameras.project_shape, cameras.triangulate)
)

SHAPE = (480, 640)
POSE = np.array([60.0, -10.0, 650.0, 0.1, -0.35, 0.2])
TURNS = Rotation.from_euler("xyz", [(0, 0, 0), (0.02, -0.2, 0.05), (-0.1, 0.15, -0.02)])
PLACES = np.array([(0.0, 0.0, 0.0), (-150.0, 4.0, 20.0), (90.0, -30.0, 10.0)])


@pytest.fixture
def rig(x64):
    """Three cameras that differ in everything but their size."""
    focal, center = [(800, 810), (700, 690), (950, 950)], [(319.5, 239.5), (330, 220), (300, 250)]
    cameras = [Pinhole.from_intrinsics(np.array(f), c, SHAPE) for f, c in zip(focal, center, strict=True)]
    return CameraRig.from_cameras(cameras, TURNS.as_matrix(), PLACES)


def head_points(num=40, seed=0):
    return np.random.default_rng(seed).normal(0, 60, (num, 3)) + POSE[:3]


def intrinsics(rig, camera):
    K = np.eye(3)
    K[[0, 1], [0, 1]], K[:2, 2] = rig.focal[camera], rig.center[camera]
    return K


@pytest.mark.system
def test_projection_is_that_of_opencv(rig):
    points = head_points()
    uv, in_front = rig.project(jnp.asarray(points))
    assert in_front.all()
    for c in range(3):
        expected, _ = cv2.projectPoints(points, TURNS[c].as_rotvec(), PLACES[c], intrinsics(rig, c), None)
        np.testing.assert_allclose(uv[c], expected[:, 0], atol=1e-9)


def test_a_posed_shape_is_the_projection_of_its_points(rig):
    shape, pose = jnp.asarray(MEAN_SHAPE), jnp.asarray(POSE)
    expected = rig.project(head.place(shape, pose))[0]
    np.testing.assert_allclose(project_shape(rig, shape, pose)[0], expected, rtol=1e-13)


@pytest.mark.system
def test_points_behind_a_camera_have_no_image_and_a_derivative_of_zero(rig):
    points = jnp.array([[5.0, 3.0, 600.0], [5.0, 3.0, -600.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1e-4]])
    uv, in_front = rig.project(points)
    np.testing.assert_array_equal(in_front[0], [True, False, False, False])
    np.testing.assert_array_equal(np.isnan(uv[0]), [[False] * 2, [True] * 2, [True] * 2, [True] * 2])
    slope = jax.jit(jax.grad(lambda p: jnp.nansum(rig.project(p)[0][0])))(points)
    assert np.all(np.isfinite(slope))
    assert np.all(slope[0, :2] > 0)
    assert not slope[1:].any()


def test_jacobians_are_central_differences(rig):
    """Oracle 1. At a step of 1e-4 mm (1e-6 rad) the third derivative adds 1e-12, rounding 1e-9 of a pixel per mm."""
    shape, pose = jnp.asarray(MEAN_SHAPE), jnp.asarray(POSE)
    by_shape, by_pose = jacobian(rig, shape, pose)
    uv = lambda shape, pose: np.asarray(project_shape(rig, shape, pose)[0])
    for axis in range(3):
        step = 1e-4 * np.eye(3)[axis]
        difference = (uv(shape + step, pose) - uv(shape - step, pose)) / 2e-4
        np.testing.assert_allclose(by_shape[..., axis], difference, atol=1e-6 * np.abs(by_shape).max())
    for axis, size in enumerate([1e-4] * 3 + [1e-6] * 3):
        step = size * np.eye(6)[axis]
        difference = (uv(shape, pose + step) - uv(shape, pose - step)) / (2 * size)
        np.testing.assert_allclose(by_pose[..., axis], difference, atol=1e-6 * np.abs(by_pose[..., axis]).max())


def test_jacobians_are_those_of_automatic_differentiation(rig):
    shape, pose = jnp.asarray(MEAN_SHAPE), jnp.asarray(POSE)
    by_shape, by_pose = jacobian(rig, shape, pose)
    all_pairs = jax.jit(jax.jacfwd(lambda shape: project_shape(rig, shape, pose)[0]))(shape)
    each = np.arange(len(shape))
    np.testing.assert_allclose(by_shape, jnp.moveaxis(all_pairs[:, each, :, each], 0, 1), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(
        by_pose, jax.jit(jax.jacfwd(lambda p: project_shape(rig, shape, p)[0]))(pose), atol=1e-10
    )


def test_jacobians_of_points_behind_a_camera_are_nan(rig):
    by_shape, by_pose = jacobian(rig, jnp.asarray(MEAN_SHAPE), jnp.array([0.0, 0, -650, 0, 0, 0]))
    assert np.all(np.isnan(by_shape))
    assert np.all(np.isnan(by_pose))


def test_triangulation_inverts_projection(rig):
    """Oracle 2, first part."""
    points = head_points()
    np.testing.assert_allclose(triangulate(rig, rig.project(jnp.asarray(points))[0]), points, atol=1e-8)


def test_triangulation_of_noisy_pixels_is_opencv_s(x64):
    """Two linear methods that scale their equations differently agree to a small part of what the noise does."""
    rig, rng = nominal(), np.random.default_rng(1)
    points = head_points()
    uv = np.asarray(rig.project(jnp.asarray(points))[0]) + rng.normal(0, 0.3, (2, len(points), 2))
    P = [intrinsics(rig, c) @ np.column_stack([rig.rotation[c], rig.translation[c]]) for c in range(2)]
    homogeneous = cv2.triangulatePoints(P[0], P[1], uv[0].T, uv[1].T)
    expected = (homogeneous[:3] / homogeneous[3]).T
    found = np.asarray(triangulate(rig, jnp.asarray(uv)))
    noise = np.abs(expected - points).max()
    assert noise > 1
    np.testing.assert_allclose(found, expected, atol=0.01 * noise)


@pytest.mark.system
def test_the_spread_of_depths_is_that_of_the_disparity(x64):
    """Oracle 2, second part: z^2 / (f B) sqrt(2) sigma, within 10 %; 4000 draws determine it to 1.1 %."""
    rig, rng, sigma = nominal(), np.random.default_rng(2), 0.2
    point = np.array([[60.0, 0.0, 650.0]])
    uv = np.asarray(rig.project(jnp.asarray(point))[0]) + rng.normal(0, sigma, (2, 4000, 2))
    depth = np.asarray(triangulate(rig, jnp.asarray(uv)))[:, 2]
    assert depth.std() == pytest.approx(650**2 / (800 * 120) * np.sqrt(2) * sigma, rel=0.1)


@pytest.mark.system
def test_single_precision_is_enough():
    points = head_points().astype(np.float32)
    rig = nominal()
    uv, _ = rig.project(jnp.asarray(points))
    assert uv.dtype == jnp.float32
    # Pixels are rounded by 3e-5, for which depths change by 1.3e-4 mm; the solver's rounding is some times larger.
    np.testing.assert_allclose(triangulate(rig, uv), points, atol=0.02)


@pytest.mark.system
def test_a_rig_of_one_camera_is_that_camera(x64):
    camera = Pinhole.from_intrinsics(700.0, (320, 240), SHAPE)
    points = jnp.asarray(head_points())
    rig = monocular(camera)
    assert rig.num_cameras == 1
    np.testing.assert_allclose(rig.project(points)[0][0], camera.project(points), atol=1e-10)
    with pytest.raises(ValueError, match="two cameras or more to triangulate; got 1"):
        triangulate(rig, jnp.zeros((1, 10, 2)))


def test_the_nominal_rig_sees_a_disparity_of_f_b_over_z(x64):
    uv, _ = nominal().project(jnp.array([[0.0, 0.0, 640.0]]))
    np.testing.assert_allclose(uv[:, 0], [(319.5, 239.5), (319.5 - 800 * 120 / 640, 239.5)], atol=1e-10)


CAMERA = Pinhole(jnp.array([800.0, 800.0]), jnp.array([319.5, 239.5]), SHAPE)
EYE = np.eye(3)


@pytest.mark.parametrize(
    ("cameras", "rotations", "translations", "message"),
    [
        ([], np.zeros((0, 3, 3)), np.zeros((0, 3)), "got none"),
        ([Pinhole(jnp.zeros(2), jnp.ones(2), SHAPE)], [EYE], [(0, 0, 0)], "positive focal lengths"),
        ([Pinhole(jnp.ones(2), jnp.array([1.0, jnp.nan]), SHAPE)], [EYE], [(0, 0, 0)], "finite centres"),
        ([CAMERA, Pinhole(jnp.ones(2), jnp.ones(2), (240, 320))], [EYE, EYE], [(0, 0, 0)] * 2, "one size"),
        ([CAMERA], [EYE, EYE], [(0, 0, 0)] * 2, r"must be \(1, 3, 3\) and \(1, 3\)"),
        ([CAMERA], [EYE], [(0, 0, np.inf)], "must be finite"),
        ([CAMERA], [EYE + 1e-5], [(0, 0, 0)], "orthonormal to 1e-6"),
        ([CAMERA], [np.diag([1, 1, -1])], [(0, 0, 0)], "of determinant 1"),
        ([CAMERA, CAMERA], [EYE, EYE], [(-120, 0, 0)] * 2, "a baseline is 0"),
    ],
)
def test_what_is_no_rig_is_named(cameras, rotations, translations, message):
    with pytest.raises(ValueError, match=message):
        CameraRig.from_cameras(cameras, rotations, translations)
