"""How pictures of patches change, against points of true planes that are projected by hand."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face import patches as module
from jaxfilters.models.face.correlation import cut, ncc
from jaxfilters.models.face.patches import (
    LEAST_CURVATURE_STD,
    LEAST_SLOPE_STD,
    MOST_CURVED,
    REACH_PX,
    SIZE,
    SLOPE_STD,
    WIDE_SIZE,
    Slopes,
    unknown_slopes,
)
from jaxfilters.models.face.rig import jacobian

patches, stretch, turned, learn_slopes = (
    jax.jit(f) for f in (module.patches, module.stretch, module.turned, module.learn_slopes)
)


def registered(scene, normals=None, images=None):
    images = scene.images(scene.registered) if images is None else images
    arrays = (images, scene.shape, scene.registered)
    return patches(*map(jnp.asarray, arrays), scene.rig, jnp.asarray(scene.normals if normals is None else normals))


def stretched(scene, found, pose, slopes=None):
    slopes = unknown_slopes(len(scene.shape)) if slopes is None else slopes
    return stretch(found, slopes, jacobian(scene.rig, jnp.asarray(scene.shape), jnp.asarray(pose))[0])


def by_differences(scene, pose, normals, step=1e-4):
    """Pixels of the moved head for each pixel of the registered one, by central differences on the planes."""
    affine = np.zeros((2, len(scene.shape), 2, 2))
    for c, uv in enumerate(scene.uv(scene.registered)):
        for k in range(len(scene.shape)):
            for j, offset in enumerate(step * np.eye(2)):
                ends = scene.hit(c, k, uv[k] + np.array([offset, -offset]), scene.registered, normals)
                there = scene.pixels(c, scene.world(pose, ends))
                affine[c, k, :, j] = (there[0] - there[1]) / (2 * step)
    return affine


def test_patches_turn_like_the_planes_they_are_on(plane_scene, head_poses, x64):
    found = registered(plane_scene)
    for pose in head_poses.near:
        expected = by_differences(plane_scene, pose, plane_scene.normals)
        np.testing.assert_allclose(stretched(plane_scene, found, pose), expected, atol=1e-6)
    np.testing.assert_allclose(
        stretched(plane_scene, found, plane_scene.registered), np.broadcast_to(np.eye(2), (2, 6, 2, 2)), atol=1e-9
    )


def slopes_between(found, camera, normals):
    """Rise over run, out of the assumed plane, of the plane with these normals; rise as one camera's sight has it."""
    across = np.cross(found.normals, [0.0, 1, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    within = np.stack([across, np.cross(found.normals, across)], axis=-1)
    lift = np.einsum("kx,kx->k", normals, found.lift[camera])
    return -np.einsum("kx,kxi->ki", normals, within) / lift[:, None]


@pytest.mark.parametrize("camera", [0, 1])
def test_slopes_make_up_for_normals_that_were_wrong(plane_scene, head_poses, x64, camera):
    assumed = plane_scene.normals + np.random.default_rng(1).uniform(-0.3, 0.3, (6, 3))
    found = registered(plane_scene, assumed)
    mean = slopes_between(found, camera, plane_scene.normals)
    assert np.abs(mean).max() > 0.2
    slopes = unknown_slopes(6)._replace(mean=jnp.asarray(mean))
    for pose in head_poses.near[:2]:
        expected = by_differences(plane_scene, pose, plane_scene.normals)[camera]
        np.testing.assert_allclose(stretched(plane_scene, found, pose, slopes)[camera], expected, atol=1e-6)
        assert np.abs(stretched(plane_scene, found, pose)[camera] - expected).max() > 0.01


def test_the_length_of_a_normal_does_not_matter(plane_scene, x64):
    found = registered(plane_scene, plane_scene.normals * np.array([[0.5], [2], [3], [1], [1], [7]]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), found, registered(plane_scene))


@pytest.mark.system
def test_templates_are_windows_and_gradients_are_free_of_gain_and_offset(plane_scene, x64):
    images = plane_scene.images(plane_scene.registered)
    found = registered(plane_scene, images=images)
    for camera, (image, uv) in enumerate(zip(images, plane_scene.uv(plane_scene.registered), strict=True)):
        window = cut(jnp.asarray(image), jnp.asarray(uv), SIZE).reshape(6, -1)
        np.testing.assert_allclose(found.template[camera], window - window.mean(axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(jnp.sum(found.gradient, axis=2), 0, atol=1e-8)
    np.testing.assert_allclose(jnp.einsum("ckp,ckpi->cki", found.template, found.gradient), 0, atol=1e-6)
    moments = np.einsum("ckpi,ckpj->ckij", found.gradient, found.gradient)
    np.testing.assert_allclose(np.einsum("ckij,ckjl->ckil", found.inverse, moments)[:, :, 0, 0], 1, rtol=1e-4)


def test_lagged_products_are_sums_over_pixels(x64):
    """And the sums of gradients are those, so that white noise of variance 1 leaves the inverse moments."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, SIZE, SIZE))
    found = module.lagged(jnp.asarray(a), jnp.asarray(b))
    reach = REACH_PX - 1
    assert found.shape == (2 * reach + 1, 2 * reach + 1)
    for v, u in ((0, 0), (2, -3), (-reach, reach)):
        rows, cols = (slice(max(0, -lag), SIZE - max(0, lag)) for lag in (v, u))
        there = b[max(0, v) : SIZE + min(0, v), max(0, u) : SIZE + min(0, u)]
        assert float(found[reach + v, reach + u]) == pytest.approx(np.sum(a[rows, cols] * there), abs=1e-9)


def test_overlaps_of_gradients_keep_white_noise_white(plane_scene, x64):
    """Residuals of white noise are free of shift, gain and offset: with their correlation the moments come out right.

    1000 draws, of which each is projected by hand; 4 standard errors of the mean are 4 sqrt(2 / 1000) = 18 %.
    """
    found = registered(plane_scene)
    template, gradient = np.asarray(found.template)[0, 2], np.asarray(found.gradient)[0, 2]
    basis = np.linalg.qr(np.column_stack([np.ones(SIZE**2), template, gradient]))[0]
    noise = np.random.default_rng(4).normal(size=(1000, SIZE**2))
    left = jnp.asarray((noise - noise @ basis @ basis.T).reshape(-1, SIZE, SIZE))
    correlation = np.asarray(module.lagged(left, left)).mean(axis=0) / SIZE**2
    moments = np.einsum("vu,vuij->ij", correlation, np.asarray(found.overlap)[0, 2])
    ratio = np.trace(moments @ np.asarray(found.inverse)[0, 2]) / 2
    assert ratio == pytest.approx(1, abs=0.05)
    uncorrected = ratio * (1 - _share(found)[0, 2])
    assert uncorrected < 0.85


def _share(found):
    """What the correction has made up for."""
    whole = np.einsum("ckpi,ckpj->ckij", found.gradient, found.gradient)
    middle = REACH_PX - 1
    raw = np.trace(whole, axis1=2, axis2=3) / np.trace(
        np.asarray(found.overlap)[:, :, middle, middle], axis1=2, axis2=3
    )
    return 1 - raw


@pytest.mark.system
@pytest.mark.parametrize("camera", [0, 1])
def test_curved_skin_bends_its_picture(plane_scene, head_poses, x64, camera):
    """Points that rise along the registered line of sight, as slopes and curvatures say, projected by hand.

    Beyond first order in the rise, of up to 1 mm at the corners, up to 0.05 px are left.
    """
    found = registered(plane_scene)
    mean = np.random.default_rng(5).normal(0, 1, (6, 5)) * np.array([0.1, 0.1, 0.01, 0.01, 0.01])
    slopes = unknown_slopes(6)._replace(mean=jnp.asarray(mean))
    grid = np.asarray(module.window_grid())
    for pose in head_poses.near[:2]:
        by_shape, _ = jacobian(plane_scene.rig, jnp.asarray(plane_scene.shape), jnp.asarray(pose))
        affine = np.asarray(stretch(found, slopes, by_shape))
        bent = np.asarray(module.bend(found, slopes, by_shape))
        flat = unknown_slopes(6)._replace(mean=jnp.asarray(mean).at[:, 2:].set(0.0))
        np.testing.assert_array_equal(module.bend(found, flat, by_shape), 0.0)
        for k, uv in enumerate(plane_scene.uv(plane_scene.registered)[camera]):
            there = plane_scene.hit(camera, k, uv + grid, plane_scene.registered)
            rise = module.relief(found, 5)[camera, k] @ mean[k]
            raised = there + np.asarray(rise)[:, None] * np.asarray(found.lift)[camera, k]
            expected = plane_scene.pixels(camera, plane_scene.world(pose, raised)) - plane_scene.uv(pose)[camera, k]
            plane = grid @ affine[camera, k].T
            np.testing.assert_allclose(plane + bent[camera, k], expected, atol=0.15)
            assert np.abs(bent[camera, k]).max() > 3 * np.abs(plane + bent[camera, k] - expected).mean()


@pytest.mark.system
def test_turned_templates_are_what_the_images_show(plane_scene, head_poses, x64):
    found = registered(plane_scene)
    compare = jax.vmap(jax.vmap(ncc))
    gained = []
    windows = jax.vmap(cut)
    for pose in head_poses.more:
        observed = windows(jnp.asarray(plane_scene.images(pose)), jnp.asarray(plane_scene.uv(pose)))
        affine = stretched(plane_scene, found, pose)
        still = compare(observed, found.template.reshape(observed.shape))
        gained.append((np.asarray(still), np.asarray(compare(observed, turned(found, affine)))))
    before, after = np.stack(gained, axis=1)
    assert before.min() < 0.85
    assert after.min() > 0.99


def test_a_template_is_mapped_by_the_affine_map(plane_scene, x64):
    """A ramp, which bilinear interpolation reproduces exactly; outside of the kept window it stays as at the border."""
    found = registered(plane_scene)
    reach = np.arange(WIDE_SIZE) - (WIDE_SIZE - 1) / 2
    ramp = np.broadcast_to(2 * reach - 3 * reach[:, None], found.wide.shape)
    found = replace(found, wide=jnp.asarray(ramp))
    affine = np.array([[1.1, 0.2], [-0.1, 0.9]])
    u, v = np.meshgrid(*[np.arange(SIZE) - (SIZE - 1) / 2] * 2)
    back = np.linalg.inv(affine) @ np.stack([u.ravel(), v.ravel()])
    assert np.abs(back).max() < (WIDE_SIZE - 1) / 2
    result = turned(found, jnp.broadcast_to(jnp.asarray(affine), (2, 6, 2, 2)))
    np.testing.assert_allclose(result[1, 3].ravel(), 2 * back[0] - 3 * back[1], atol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize("affine", [np.zeros((2, 2)), [[1.0, 2], [2, 4]], np.diag([0.3, 0.3]), np.diag([-1.0, 1])])
def test_maps_that_squash_a_patch_leave_numbers(plane_scene, affine):
    result = turned(registered(plane_scene), jnp.broadcast_to(jnp.asarray(affine), (2, 6, 2, 2)))
    assert np.all(np.isfinite(result))
    assert result.min() >= 0
    assert result.max() <= 255


def test_views_add_up_as_bayes_has_it(x64):
    rng = np.random.default_rng(2)
    true = rng.normal(0, 0.2, (3, 2))
    slopes = Slopes(jnp.zeros((3, 2)), jnp.tile(SLOPE_STD**2 * jnp.eye(2), (3, 1, 1)))
    information, score = np.tile(np.eye(2) / SLOPE_STD**2, (3, 1, 1)), np.zeros((3, 2))
    for _ in range(4):
        rows = rng.normal(0, 3, (3, 5, 2))
        one = np.einsum("kri,krj->kij", rows, rows)
        observed = np.einsum("kri,kri->kr", rows, true[:, None]) + 0.1 * rng.normal(size=(3, 5))
        information, score = information + one, score + np.einsum("kri,kr->ki", rows, observed)
        # What a view says is measured against the slopes so far.
        apart = np.einsum("kri,kr->ki", rows, observed - np.einsum("kri,ki->kr", rows, slopes.mean))
        slopes = learn_slopes(slopes, jnp.asarray(one), jnp.asarray(apart))
    np.testing.assert_allclose(slopes.mean, np.linalg.solve(information, score[..., None])[..., 0], rtol=1e-9)
    np.testing.assert_allclose(slopes.covariance, np.linalg.inv(information), rtol=1e-9)


def test_slopes_are_never_quite_known_nor_steep(x64):
    information = jnp.tile(1e12 * jnp.eye(5), (2, 1, 1))
    slopes = learn_slopes(unknown_slopes(2), information, information @ jnp.array([5.0, -5.0, 1.0, -1.0, 0.01]))
    least = np.array([LEAST_SLOPE_STD] * 2 + [LEAST_CURVATURE_STD] * 3) ** 2
    np.testing.assert_allclose(slopes.covariance, np.tile(np.diag(least), (2, 1, 1)), atol=1e-11)
    np.testing.assert_allclose(slopes.mean, np.tile([1.0, -1.0, MOST_CURVED, -MOST_CURVED, 0.01], (2, 1)), rtol=1e-6)


@pytest.mark.system
def test_a_view_can_be_taken_with_other_slopes_than_were_known(x64):
    """Linear equations about what was assumed: the posterior is the same, whatever that was."""
    before = unknown_slopes(2)
    rng = np.random.default_rng(6)
    rows, true = rng.normal(0, 3, (2, 9, 5)), rng.normal(0, 0.01, (2, 5))
    information = jnp.asarray(np.einsum("kri,krj->kij", rows, rows))
    results = []
    for assumed in (np.zeros((2, 5)), rng.normal(0, 0.02, (2, 5))):
        score = np.einsum("kij,kj->ki", information, true - assumed)
        taken_with = before._replace(mean=jnp.asarray(assumed))
        results.append(module.learn_slopes_again(before, taken_with, information, jnp.asarray(score)))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12), *results)


@pytest.mark.system
def test_views_that_say_nothing_change_nothing():
    slopes = Slopes(jnp.full((2, 2), 0.1), jnp.tile(0.04 * jnp.eye(2), (2, 1, 1)))
    again = learn_slopes(slopes, jnp.zeros((2, 2, 2)), jnp.zeros((2, 2)))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-8), again, slopes)
