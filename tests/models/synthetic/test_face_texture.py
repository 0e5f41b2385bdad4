"""Texture of drawn faces: its strength, waves and symmetry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import MIRROR
from jaxfilters.models.synthetic.face_texture import (
    AXES,
    NORMALS,
    _cosine,
    make_background,
    make_scene,
    make_texture,
    patch,
)


@pytest.fixture(scope="module")
def texture():
    return make_texture(jax.random.key(0))


def summed_waves(texture, k, x, y):
    """Without the window, in NumPy."""
    wave, phase = np.asarray(texture.wave[k], float), np.asarray(texture.phase[k], float)
    return float(texture.amplitude[k]) * np.cos(x[..., None] * wave[:, 0] + y[..., None] * wave[:, 1] + phase).sum(-1)


def test_texture_has_the_rms_and_the_wavelengths_of_the_specification(texture):
    x, y = np.meshgrid(np.linspace(-18, 18, 100), np.linspace(-18, 18, 100))
    rms = [np.sqrt(np.mean(summed_waves(texture, k, x, y) ** 2)) for k in range(10)]
    np.testing.assert_allclose(rms, 40, rtol=0.02)
    length = 2 * np.pi / np.linalg.norm(texture.wave, axis=-1)
    assert texture.wave.shape == (10, 14, 2)
    assert length.min() >= 7 - 1e-4
    assert length.max() <= 22 + 1e-4


@pytest.mark.system
def test_a_patch_is_the_waves_within_a_window(texture):
    x, y = np.random.default_rng(0).uniform(-15, 15, (2, 50))
    for k in (0, 5):
        observed = patch(texture.wave[k], texture.phase[k], texture.amplitude[k], jnp.asarray(x), jnp.asarray(y))
        expected = np.exp(-(x**2 + y**2) / 72) * summed_waves(texture, k, x, y)
        np.testing.assert_allclose(observed, expected, atol=1e-3)


def test_the_subjects_left_is_the_mirror_image_of_the_right(texture):
    x, y = np.random.default_rng(1).uniform(-15, 15, (2, 30))
    for k in range(10):
        np.testing.assert_allclose(
            summed_waves(texture, k, x, y), summed_waves(texture, MIRROR[k], -x, y), rtol=1e-4, atol=1e-3
        )


def test_patches_are_planes_with_their_own_right_and_down():
    frames = np.concatenate([AXES, -NORMALS[:, None]], axis=1)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-12)
    assert AXES[:, 0, 0].min() > 0.8
    assert AXES[:, 1, 1].min() > 0.9
    np.testing.assert_allclose(NORMALS[list(MIRROR)] * [-1, 1, 1], NORMALS)


def test_backgrounds_are_waves_of_amplitude_five_about_95():
    """40 waves: variance 40 5^2 / 2 = 500, within the scatter of images that hold few of the long waves."""
    image = np.asarray(make_background(jax.random.key(2), (480, 640)))
    assert image.mean() == pytest.approx(95, abs=1.0)
    assert image.std() == pytest.approx(np.sqrt(500), rel=0.1)


def test_every_camera_has_a_background_of_its_own():
    scene = make_scene(jax.random.key(3), (48, 64), num_cameras=3)
    assert scene.background.shape == (3, 48, 64)
    assert np.abs(np.diff(scene.background, axis=0)).mean() > 10


def test_the_fast_cosine_is_the_cosine() -> None:
    angles = np.linspace(-350, 350, 100_001).astype(np.float32)
    error = np.abs(_cosine(jnp.asarray(angles)) - np.cos(angles.astype(float)))
    assert np.all(error < 1e-6 + 2 * np.spacing(np.abs(angles)))
