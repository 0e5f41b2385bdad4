"""Landmarks that start far from where they are, in rendered frames; blur against that of OpenCV."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face import coarse_recalculation as module
from jaxfilters.models.face.coarse_recalculation import LEVELS_PX, blurred
from jaxfilters.models.face.recalculation import patches, recalculate
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence

MM_PER_PX = 650 / 800


class Scene:
    """A neutral face, then moved a little, with an expression; landmarks that start `px` pixels beside their places."""

    def __init__(self, seed):
        poses = np.tile([*STEREO_PLACE_MM, 0.0, 0, 0], (2, 1)).astype(float)
        poses[1] += [2, 1, 3, 0.02, 0.03, 0.02]
        video = face_sequence(jax.random.key(seed), poses, expressions=np.array([(0.0, 0), (0.2, 0.1)]))
        images = jnp.asarray(video.frames(0, 2), float)
        self.rig, self.pose, self.images, self.true = (
            video.rig,
            jnp.asarray(poses[1], float),
            images[1],
            video.shapes[1],
        )
        self._registered = images[0], jnp.asarray(video.shapes[0]), jnp.asarray(poses[0], float), self.rig
        self.direction = np.random.default_rng(seed).normal(size=(10, 2))
        self.direction /= np.linalg.norm(self.direction, axis=1, keepdims=True)

    def start(self, px):
        return jnp.asarray(self.true + np.pad(px * MM_PER_PX * self.direction, ((0, 0), (0, 1))), float)

    def plain(self, px):
        first = patches(*self._registered)
        return self.off(_plain(self.start(px), self.start(px), self.images, first, first, self.pose, self.rig)[0])

    def coarse(self, px):
        first = _windows(_blurred(self._registered[0]), *self._registered[1:])
        images = _blurred(self.images)
        return self.off(_coarse(self.start(px), self.start(px), images, first, first, self.pose, self.rig)[0])

    def off(self, shape):
        return np.linalg.norm((np.asarray(shape) - self.true)[:, :2], axis=1)


_plain, _coarse = jax.jit(recalculate), jax.jit(module.recalculate_from_coarse)
_blurred, _windows = jax.jit(blurred), jax.jit(module.windows)


@pytest.fixture(scope="module")
def scenes():
    return [Scene(seed) for seed in range(3)]


@pytest.mark.system
@pytest.mark.parametrize(("px", "plain", "coarse"), [(4.0, 1.0, 1.0), (6.0, 0.95, 1.0), (8.0, 0.6, 0.9)])
def test_blur_widens_the_range_from_which_landmarks_are_found(scenes, px, plain, coarse):
    """Share of 30 landmarks that end within 0.5 mm; at 8 px a third of them without blur, and nearly all with it."""
    found = [
        np.mean([scene.plain(px) < 0.5 for scene in scenes]),
        np.mean([scene.coarse(px) < 0.5 for scene in scenes]),
    ]
    assert found[0] <= plain
    assert found[1] >= coarse


@pytest.mark.system
def test_the_last_level_is_as_exact_as_without_blur(scenes):
    for scene in scenes:
        np.testing.assert_allclose(scene.coarse(2.0), scene.plain(2.0), atol=0.05)


@pytest.mark.system
def test_blur_is_that_of_a_gaussian():
    image = np.random.default_rng(0).uniform(0, 255, (2, 60, 80)).astype(np.float32)
    found = blurred(jnp.asarray(image))
    np.testing.assert_array_equal(found[-1], image)
    for level, sigma in zip(found[:-1], LEVELS_PX[:-1], strict=True):
        size = (2 * int(np.ceil(3 * sigma)) + 1,) * 2
        expected = [cv2.GaussianBlur(one, size, sigma, borderType=cv2.BORDER_REPLICATE) for one in image]
        np.testing.assert_allclose(level, expected, atol=1e-2)


@pytest.mark.parametrize("levels", [(), (2.0, -1.0)])
def test_levels_that_mean_nothing_are_refused(levels):
    with pytest.raises(ValueError, match="levels_px"):
        blurred(jnp.zeros((1, 20, 20)), levels_px=levels)
