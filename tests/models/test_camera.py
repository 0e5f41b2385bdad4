"""Camera: against OpenCV's and numpy's arithmetic, and its own inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole

K = np.array([[365.0, 0, 255.5], [0, 370.0, 211.5], [0, 0, 1]])


@pytest.fixture
def camera():
    with jax.enable_x64(True):
        yield Pinhole.from_matrix(K, (424, 512))


def test_project_is_the_matrix_product(camera):
    points = np.random.default_rng(0).normal(size=(5, 7, 3)) * 0.2 + [0, 0, 1]
    homogeneous = points @ K.T
    expected = homogeneous[..., :2] / homogeneous[..., 2:]
    np.testing.assert_allclose(camera.project(jnp.asarray(points)), expected, rtol=1e-12)


@pytest.mark.system
def test_unproject_inverts_project(camera):
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.2 + [0, 0, 1]
    back = camera.unproject(camera.project(jnp.asarray(points)), jnp.asarray(points[:, 2]))
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_rays_follow_the_pixel_convention(camera):
    rays = np.asarray(camera.rays())
    assert rays.shape == (424, 512, 3)
    np.testing.assert_allclose(rays[30, 7], [(7 - 255.5) / 365, (30 - 211.5) / 370, 1], rtol=1e-12)


@pytest.mark.parametrize("stride", [1, 3])
def test_crop_sees_the_same_rays(camera, stride):
    origin = jnp.asarray([40.0, 90.0])
    cropped = jax.jit(lambda c, o: c.crop(o, (20, 30), stride).rays())(camera, origin)
    expected = np.asarray(camera.rays())[90 : 90 + 20 * stride : stride, 40 : 40 + 30 * stride : stride]
    np.testing.assert_allclose(cropped, expected, atol=1e-12)


def test_matrix_round_trip(camera):
    np.testing.assert_array_equal(camera.matrix(), K)


@pytest.mark.parametrize(
    ("focal", "center", "shape", "message"),
    [
        ((0.0, 1.0), (0, 0), (4, 4), "focal must be positive"),
        ((1.0, np.nan), (0, 0), (4, 4), "focal must be two finite"),
        ((1.0, 1.0), (0, 0, 0), (4, 4), "center must be two finite"),
        ((1.0, 1.0), (0, 0), (4, 0), "shape must be"),
        ((1.0, 1.0), (0, 0), (4, 4, 3), "shape must be"),
    ],
)
def test_bad_intrinsics_are_named(focal, center, shape, message):
    with pytest.raises(ValueError, match=message):
        Pinhole.from_intrinsics(focal, center, shape)


def test_bad_matrix_and_stride_are_named(camera):
    with pytest.raises(ValueError, match="K must have shape"):
        Pinhole.from_matrix(np.eye(4), (4, 4))
    with pytest.raises(ValueError, match="K must be"):
        Pinhole.from_matrix([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], (4, 4))
    with pytest.raises(ValueError, match="stride must be"):
        camera.crop(jnp.zeros(2), (4, 4), 0)


def test_a_camera_is_a_pytree_argument(camera):
    cameras = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), camera)
    point = jnp.asarray([0.1, -0.2, 0.8])
    both = jax.vmap(lambda c: c.project(point))(cameras)
    np.testing.assert_allclose(both[1], 2 * both[0], rtol=1e-12)
    gradient = jax.grad(lambda c: c.project(point)[0])(camera)
    np.testing.assert_allclose(gradient.focal, [0.1 / 0.8, 0], rtol=1e-12)
