"""Fixed cameras over a floor: against plain matrix arithmetic, and what is wrong with matrices that are refused."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera, canonical

GOLDEN = np.array(
    [
        [46.66907927, 21.31720088, -16.06366306, 126.16907927],
        [0, -12.13176997, -49.29407389, 109.02707531],
        [0, 0.26814089, -0.20205865, 1],
    ]
)
"""Camera 1 of the specification, section 2.4, with its last entry 1."""
SHAPE = (120, 160)


def projection(center, *, pitch=37.0, heading=0.0, roll=0.0, focal=139.0):
    """A camera at a heading from +Y to the right, looking down by `pitch`; degrees."""
    a, b, c = np.deg2rad([heading, pitch, roll])
    forward = np.array([np.sin(a) * np.cos(b), np.cos(a) * np.cos(b), -np.sin(b)])
    right = np.array([np.cos(a), -np.sin(a), 0])
    R = np.stack([right, np.cross(forward, right), forward])
    R = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]) @ R
    K = np.array([[focal, 0, 79.5], [0, focal, 59.5], [0, 0, 1]])
    return K @ np.column_stack([R, -R @ center])


@pytest.fixture
def camera(x64):
    return FloorCamera.from_matrix(GOLDEN, SHAPE)


def test_the_golden_matrix_is_the_camera_that_the_specification_names(camera):
    np.testing.assert_allclose(camera.position(), [-1, -1.74, 2.64], atol=1e-6)
    np.testing.assert_allclose(camera.P, projection([-1, -1.74, 2.64]), atol=2e-6)


@pytest.mark.parametrize("scale", [1.0, -0.01, 37.0])
def test_the_scale_of_a_matrix_means_nothing(camera, scale):
    np.testing.assert_allclose(FloorCamera.from_matrix(scale * GOLDEN, SHAPE).P, camera.P, rtol=1e-12)


def test_depth_is_positive_in_front_where_the_origin_is_behind(x64):
    P = projection([0.0, 4.0, 2.5])
    assert P[2, 3] < 0
    camera = FloorCamera.from_matrix(P / P[2, 3], SHAPE)
    uv, depth = camera.project(jnp.array([0.3, 7.0, 0.5]))
    expected = P @ [0.3, 7.0, 0.5, 1]
    np.testing.assert_allclose(depth, expected[2], rtol=1e-12)
    np.testing.assert_allclose(uv, expected[:2] / expected[2], rtol=1e-12)


def test_floor_points_invert_projection(camera):
    floor = np.random.default_rng(0).uniform([-2, 0], [0.5, 4], (3, 20, 2))
    uv, depth = camera.project(jnp.asarray(np.concatenate([floor, np.zeros((3, 20, 1))], axis=-1)))
    back, back_depth = camera.floor_points(uv)
    np.testing.assert_allclose(back, floor, atol=1e-10)
    np.testing.assert_allclose(back_depth, depth, rtol=1e-10)


def test_pixels_above_the_horizon_see_no_floor(x64):
    camera = FloorCamera.from_matrix(projection([0, 0, 2.0], pitch=0.0), SHAPE)
    _, depth = camera.floor_points(jnp.array([[80.0, 50.0], [80.0, 59.5], [80.0, 70.0]]))
    assert depth[0] < 0 < depth[2]
    assert abs(depth[1]) > 1e9


def test_the_parameter_of_a_ray_is_the_depth(camera):
    uv = jnp.asarray(np.random.default_rng(1).uniform(0, [160, 120], (7, 2)))
    points = camera.position() + 3.2 * camera.rays(uv)
    observed, depth = camera.project(points)
    np.testing.assert_allclose(depth, 3.2, rtol=1e-12)
    np.testing.assert_allclose(observed, uv, atol=1e-9)


@pytest.mark.parametrize(("heading", "pitch", "roll"), [(0, 37, 0), (50, 20, 0), (-130, 70, 0), (30, 85, 20)])
def test_floor_axes_lead_away_and_to_the_right(x64, heading, pitch, roll):
    camera = FloorCamera.from_matrix(projection([0.5, -1, 2.6], heading=heading, pitch=pitch, roll=roll), SHAPE)
    axes = np.asarray(camera.floor_axes())
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    at, _ = camera.floor_points(jnp.array([79.5, 59.5]))
    ground = np.concatenate([np.asarray(at) + np.array([np.zeros(2), *(0.01 * axes)]), np.zeros((3, 1))], axis=1)
    uv = np.asarray(camera.project(jnp.asarray(ground))[0])
    assert uv[1, 1] < uv[0, 1]
    assert uv[2, 0] > uv[0, 0]
    if pitch < 80:
        expected = [np.sin(np.deg2rad(heading)), np.cos(np.deg2rad(heading))]
        np.testing.assert_allclose(axes[0], expected, atol=1e-9)


def test_floor_axes_of_a_camera_that_looks_straight_down(x64):
    R = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    K = np.array([[68.0, 0, 79.5], [0, 68, 59.5], [0, 0, 1]])
    P = K @ np.column_stack([R, -R @ [-1.07, 1.32, 3.09]])
    # x_cam = +Y, y_cam = +X: the top of the image is towards -X.
    np.testing.assert_allclose(FloorCamera.from_matrix(P, SHAPE).floor_axes(), [[-1, 0], [0, 1]], atol=1e-12)


@pytest.mark.parametrize("pitch", [37.0, 15.0])
def test_a_mirrored_matrix_is_named(pitch):
    P = projection([0, 0, 2.6], pitch=pitch)
    FloorCamera.from_matrix(P, SHAPE)
    with pytest.raises(ValueError, match="P is mirrored"):
        FloorCamera.from_matrix(np.diag([-1.0, 1, 1]) @ P + np.outer([159.0, 0, 0], P[2]), SHAPE)
    with pytest.raises(ValueError, match="P is mirrored"):
        FloorCamera.from_matrix(P @ np.diag([-1.0, 1, 1, 1]), SHAPE)


def test_a_camera_on_its_side_is_none_the_worse(x64):
    for roll in (90.0, -90.0, 40.0):
        FloorCamera.from_matrix(projection([0, 0, 2.6], pitch=15.0, roll=roll), SHAPE)
    assert FloorCamera.from_matrix(projection([0, 0, 2.6], pitch=50.0, roll=180.0), SHAPE).position()[2] > 0


@pytest.mark.parametrize(
    ("P", "shape", "message"),
    [
        (np.eye(3), SHAPE, r"P must be a finite matrix of shape \(3, 4\); got shape \(3, 3\)"),
        (np.full((3, 4), np.nan), SHAPE, "P must be a finite matrix"),
        (np.zeros((3, 4)), SHAPE, "P is singular"),
        (GOLDEN[[0, 1, 1]], SHAPE, "P is singular"),
        (projection([0, 0, 2.6], pitch=-40.0), SHAPE, "looks away"),
        (projection([0, 0, -1.0]), SHAPE, "height of -1 m"),
        (projection([0, 0, 0.0]), SHAPE, "height of 0 m"),
        (GOLDEN, (120,), "shape must be"),
        (GOLDEN, (120, 0), "shape must be"),
        (GOLDEN, (120, 10.5), "shape must be"),
    ],
)
def test_what_is_no_camera_over_a_floor_is_named(P, shape, message):
    with pytest.raises(ValueError, match=message):
        FloorCamera.from_matrix(P, shape)


def test_canonical_depths_are_metres_along_the_optical_axis():
    P = canonical(-5 * projection([1.0, 2.0, 2.6]))
    np.testing.assert_allclose(np.linalg.norm(P[2, :3]), 1, rtol=1e-12)
    assert np.linalg.det(P[:, :3]) > 0
