"""Landmarks found to a fraction of a pixel, in pictures of planes whose every pixel is known."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face import alignment as module
from jaxfilters.models.face.alignment import LEAST_FACING, SEARCHED_PX
from jaxfilters.models.face.patches import (
    CURVATURE_STD,
    LEAST_SLOPE_STD,
    SLOPE_STD,
    learn_slopes,
    patches,
    unknown_slopes,
)
from jaxfilters.models.face.rig import jacobian

align, relocated, facing = (jax.jit(f) for f in (module.align, module.relocated, module.facing))
register = jax.jit(patches)


class Registered:
    """The plane scene, its patches without noise, and alignment of other images of it."""

    def __init__(self, scene, normals=None):
        self.scene, self.rig, self.shape = scene, scene.rig, jnp.asarray(scene.shape)
        images, pose = jnp.asarray(scene.images(scene.registered)), jnp.asarray(scene.registered)
        normals = jnp.asarray(scene.normals if normals is None else normals)
        self.patches = register(images, self.shape, pose, self.rig, normals)
        self.slopes = unknown_slopes(len(scene.shape))

    def align(self, images, pose, start=None, slopes=None, expected=None):
        """Searched from the true places, moved by `start`; the turn of the patches is that of the pose `expected`."""
        uv = jnp.asarray(self.scene.uv(pose) + (0.0 if start is None else start))
        slopes = self.slopes if slopes is None else slopes
        expected = jnp.asarray(pose if expected is None else expected)
        return align(self.patches, slopes, jnp.asarray(images), uv, self.shape, expected, self.rig)


@pytest.fixture
def face(plane_scene, x64):
    return Registered(plane_scene)


@pytest.mark.system
def test_shifts_by_fractions_of_a_pixel_are_found(face):
    """Patches that are moved across the line of sight; 0.02 px are what bilinear interpolation of the waves leaves."""
    rng = np.random.default_rng(0)
    for _ in range(3):
        pose = face.scene.registered + np.array([*rng.uniform(-1, 1, 2), 0, 0, 0, 0])
        found = face.align(face.scene.images(pose), pose, rng.uniform(-2, 2, (2, 6, 2)))
        assert np.abs(found.uv - face.scene.uv(pose)).max() < 0.02
        assert np.all(found.observed)
        assert found.score.min() > 0.998


@pytest.mark.system
def test_landmarks_are_found_on_turned_planes(face, head_poses):
    """Also where the pose that is expected is 3 mm and 3 degrees off."""
    rng = np.random.default_rng(1)
    apart = np.array([3.0, 3, 3, 0.05, 0.05, 0.05])
    for pose in head_poses.more:
        found = face.align(face.scene.images(pose), pose, rng.uniform(-1.5, 1.5, (2, 6, 2)))
        assert np.abs(found.uv - face.scene.uv(pose)).max() < 0.05
        near = face.align(face.scene.images(pose), pose, 1.0, expected=pose + rng.choice([-1, 1], 6) * apart)
        assert np.abs(near.uv - face.scene.uv(pose)).max() < 0.4


def test_light_does_not_matter(face, head_poses):
    pose = head_poses.near[0]
    images = face.scene.images(pose)
    found, dim = face.align(images, pose, 0.7), face.align(0.6 * images + 20, pose, 0.7)
    np.testing.assert_allclose(dim.uv, found.uv, atol=1e-5)
    np.testing.assert_allclose(dim.score, found.score, atol=1e-8)
    np.testing.assert_allclose(dim.covariance, found.covariance, rtol=1e-3, atol=1e-9)


def noisy(face, pose, std, draws, smooth=0.0):
    """Errors and covariances of many alignments to one image, each with noise of its own."""
    clean, key = jnp.asarray(face.scene.images(pose)), jax.random.key(3)
    start, expected = jnp.asarray(face.scene.uv(pose)), jnp.asarray(pose)

    def one(key):
        images = clean + std * jax.random.normal(key, clean.shape)
        found = align(face.patches, face.slopes, images, start, face.shape, expected, face.rig)
        return found.uv - start, found.covariance

    return jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(key, draws))


@pytest.mark.system
@pytest.mark.parametrize("std", [3.0, 10.0])
def test_covariances_are_honest_about_white_noise(face, std):
    """Variances of 200 alignments of 12 landmarks: the mean of 2400 squares is within 4 sqrt(2 / 2400) = 12 % of them.

    The estimated ones err by some 30 %, so that squares over them have a mean above 2, and heavier tails. Of gradients
    that are differences over two pixels a tenth is missing.
    """
    error, covariance = noisy(face, face.scene.registered + np.array([0.3, -0.2, 0, 0, 0, 0]), std, 200)
    error = np.asarray(error - error.mean(axis=0))
    claimed = np.trace(np.asarray(covariance).mean(axis=0), axis1=-2, axis2=-1)
    ratio = (error**2).sum(axis=-1).mean(axis=0) / claimed
    assert 0.88 < ratio.mean() < 1.12 * 1.12
    square = np.einsum("nckj,nckj->nck", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    # The 99 % quantile of chi-square with two degrees of freedom.
    assert (square > 9.21).mean() < 0.04


@pytest.mark.system
def test_the_bias_of_a_turned_plane_is_within_what_is_claimed(face, head_poses):
    """Noise of the sensor, 2 grey levels: true places lie within what the covariance says, 12 landmarks in 8 poses."""
    rng, squares = np.random.default_rng(4), []
    for pose in head_poses.more:
        images = face.scene.images(pose) + rng.normal(0, 2, (2, *face.rig.shape))
        found = face.align(images, pose, 0.5)
        error = np.asarray(found.uv) - face.scene.uv(pose)
        squares.append(np.einsum("cki,cki->ck", error, np.linalg.solve(found.covariance, error[..., None])[..., 0]))
    # 99 % of chi-square with two degrees of freedom; 4 of 96 are four standard deviations more than 1 %.
    assert np.sum(np.array(squares) > 9.21) <= 4
    assert np.mean(squares) < 3


def test_a_smooth_residual_counts_for_less(face):
    """A gradient of light across the patches: no white noise, and far fewer independent numbers."""
    pose = face.scene.registered
    images = face.scene.images(pose)
    waves = 6 * np.sin(np.arange(images.shape[2]) / 3.0) * np.cos(np.arange(images.shape[1]) / 3.5)[:, None]
    white = np.random.default_rng(5).normal(0, waves.std(), images.shape)
    smooth, rough = face.align(images + waves, pose), face.align(images + white, pose)
    ratio = np.trace(smooth.covariance, axis1=2, axis2=3) / np.trace(rough.covariance, axis1=2, axis2=3)
    assert np.median(ratio) > 4


def test_places_follow_the_slopes_as_derivatives_say(face, head_poses):
    """Central differences over whole alignments; a slope that is assumed is one that the skin no longer has beyond."""
    pose = head_poses.near[1]
    images = face.scene.images(pose)
    found = face.align(images, pose)
    for axis, size in enumerate((0.02, 0.02, 0.004, 0.004, 0.004)):
        step = jnp.zeros(5).at[axis].set(size)
        ends = [
            face.align(images, pose, slopes=face.slopes._replace(mean=face.slopes.mean + s * step)) for s in (1, -1)
        ]
        difference = (ends[1].uv - ends[0].uv) / 2
        assert np.abs(difference).max() > 0.3 * 0.02
        np.testing.assert_allclose(difference, size * found.by_slope[..., axis], atol=0.05 * 0.02)


@pytest.mark.system
def test_slopes_that_are_learnt_are_those_of_the_planes(plane_scene, head_poses, x64):
    """Normals that are up to 20 degrees wrong; the rise is measured along the first camera's line of sight."""
    assumed = plane_scene.normals + np.random.default_rng(6).uniform(-0.25, 0.25, (6, 3))
    face = Registered(plane_scene, assumed)
    unit = np.asarray(face.patches.normals)
    across = np.cross(unit, [0.0, 1, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    within = np.stack([across, np.cross(unit, across)], axis=-1)
    true = -np.einsum("kx,kxi->ki", plane_scene.normals, within)
    true /= np.einsum("kx,kx->k", plane_scene.normals, np.mean(face.patches.lift, axis=0))[:, None]
    assert np.abs(true).max() > 0.2
    rng, slopes = np.random.default_rng(7), face.slopes
    for _ in range(3):
        for pose in head_poses.more:
            images = plane_scene.images(pose) + rng.normal(0, 2, (2, *face.rig.shape))
            found = face.align(images, pose, slopes=slopes)
            slopes = learn_slopes(slopes, found.slope_information, found.slope_score)
    assert np.abs(slopes.mean[:, :2] - true).max() < 1.5 * LEAST_SLOPE_STD
    assert np.abs(slopes.mean[:, 2:]).max() < 0.2 * CURVATURE_STD
    variance = np.diagonal(slopes.covariance, axis1=1, axis2=2)
    assert np.all(variance < (0.5 * np.array([SLOPE_STD] * 2 + [CURVATURE_STD] * 3)) ** 2)


@pytest.mark.system
def test_a_patch_faces_a_camera_up_to_a_given_angle(face, head_poses):
    pose = head_poses.near[2]
    sight = np.stack([-place[None] - face.scene.world(pose) for place in (np.zeros(3), np.array([-120.0, 0, 0]))])
    sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
    for angle in np.linspace(0, np.pi, 31):
        normals = np.tile([np.sin(angle), 0, -np.cos(angle)], (6, 1))
        cosine = sight @ (face.scene.world(pose, normals[:1]) - pose[:3])[0]
        by_shape, _ = jacobian(face.rig, face.shape, jnp.asarray(pose))
        found = facing(replace(face.patches, normals=jnp.asarray(normals)), by_shape)
        clear = np.abs(cosine - LEAST_FACING) > 1e-6
        np.testing.assert_array_equal(np.asarray(found)[clear], (cosine > LEAST_FACING)[clear])


@pytest.mark.system
def test_what_cannot_be_seen_is_not_seen(face):
    pose = face.scene.registered.copy()
    images = jnp.asarray(face.scene.images(pose))
    observed = lambda pose, uv: align(face.patches, face.slopes, images, uv, face.shape, jnp.asarray(pose), face.rig)
    uv = jnp.asarray(face.scene.uv(pose)).at[0, 0].set(jnp.array([-30.0, 40])).at[1, 5].set(jnp.nan)
    found = observed(pose, uv)
    expected = np.ones((2, 6), bool)
    expected[0, 0] = expected[1, 5] = False
    np.testing.assert_array_equal(found.observed, expected)
    turned_away = observed(pose + np.array([0, 0, 0, 0, np.pi, 0]), jnp.asarray(face.scene.uv(pose)))
    behind = observed(pose - np.array([0, 0, 2000.0, 0, 0, 0]), jnp.full((2, 6, 2), jnp.nan))
    for nothing in (turned_away, behind):
        assert not np.any(nothing.observed)
        assert np.all(np.isfinite(nothing.uv))
        np.testing.assert_array_equal(nothing.slope_information, 0)


def test_flat_images_score_nothing(face):
    found = face.align(np.full((2, *face.rig.shape), 100.0), face.scene.registered)
    assert np.all(np.isfinite(found.uv))
    assert np.all(np.isfinite(found.covariance))
    assert np.all(np.asarray(found.score) < 0.1)


@pytest.mark.system
def test_landmarks_that_moved_far_are_found_again(face):
    """One landmark, 14 px from where it is expected; the others stay as they were."""
    pose = face.scene.registered
    moved = face.scene.shape + np.array([[0, 0, 0]] * 4 + [[6.0, 9, 0]] + [[0, 0, 0]])
    images, expected = jnp.asarray(face.scene.images(pose, points=moved)), jnp.asarray(face.scene.uv(pose))
    at = partial(align, face.patches, face.slopes, images)
    lost = at(expected, face.shape, jnp.asarray(pose), face.rig)
    arguments = face.patches, face.slopes, images, lost, expected, face.shape, jnp.asarray(pose), face.rig
    found = relocated(*arguments)
    true = face.scene.uv(pose, moved)
    assert 10 < np.abs(true - expected).max() < SEARCHED_PX
    assert np.abs(lost.uv - true)[:, 4].max() > 2
    np.testing.assert_allclose(found.uv, true, atol=0.05)
    np.testing.assert_array_equal(np.delete(found.uv, 4, axis=1), np.delete(lost.uv, 4, axis=1))
    assert found.score[:, 4].min() > 0.98
    kept = relocated(face.patches, face.slopes, jnp.full_like(images, 120.0), *arguments[3:])
    np.testing.assert_array_equal(kept.uv, lost.uv)


@pytest.mark.system
def test_products_have_full_precision(face, products_at_default_precision):
    pose, images = jnp.asarray(face.scene.registered), jnp.zeros((2, *face.rig.shape))
    uv = jnp.asarray(face.scene.uv(face.scene.registered))
    normals = jnp.asarray(face.scene.normals)
    assert not products_at_default_precision(patches, images, face.shape, pose, face.rig, normals)
    look = lambda images, uv: module.align(face.patches, face.slopes, images, uv, face.shape, pose, face.rig)
    assert not products_at_default_precision(look, images, uv)
