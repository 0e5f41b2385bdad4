"""Soft silhouettes against the depth renderer's hard ones, areas and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.rendering.geometry import Capsules
from jaxfilters.models.rendering.silhouette import outline_distance, soft_silhouette

FINER = 15


def supersampled_coverage(camera, capsules):
    """Share of hit rays of FINER x FINER in each pixel."""
    rows, cols = camera.shape
    corner = jnp.full(2, -0.5 + 0.5 / FINER)
    fine = type(camera)(camera.focal * FINER, (camera.center - corner) * FINER, (rows * FINER, cols * FINER))
    hit = np.isfinite(jax.jit(render_capsules)(fine, capsules))
    return hit.reshape(rows, FINER, cols, FINER).mean(axis=(1, 3))


def test_the_sign_is_that_of_the_depth_image(x64, camera, random_capsules):
    capsules = random_capsules(0)
    distance = np.asarray(outline_distance(camera, capsules))
    hit = np.isfinite(render_capsules(camera, capsules))
    assert 0.1 < hit.mean() < 0.9
    np.testing.assert_array_equal(distance > 0, hit)


def test_the_distance_is_in_pixels(x64, camera):
    """Of a small ball on the optical axis, whose outline is a circle."""
    center = jnp.asarray([[0.0, 0.0, 0.5]])
    square = type(camera)(jnp.full(2, 60.0), camera.center, camera.shape)
    distance = outline_distance(square, Capsules(center, center, jnp.asarray([0.1])))
    radius = 60 * 0.1 / np.sqrt(0.5**2 - 0.1**2)
    v, u = np.indices(camera.shape)
    expected = radius - np.hypot(u - camera.center[0], v - camera.center[1])
    near = np.abs(expected) < 1
    # Exact at the outline; one pixel away the second order is 1 / (2 radius) of a pixel at most.
    assert np.all(np.abs(distance - expected)[near] <= expected[near] ** 2 / radius + 1e-9)


def test_coverage_against_supersampling(x64, camera, random_capsules):
    capsules = random_capsules(1)
    exact = supersampled_coverage(camera, capsules)
    soft = np.asarray(soft_silhouette(camera, capsules, softness=0.25))
    at_outline = (exact > 0) & (exact < 1)
    assert at_outline.sum() > 50
    # A logistic curve of scale 1/4 is within 0.07 of the coverage by a straight edge; creases between capsules are not.
    assert np.mean(np.abs(soft - exact)[at_outline]) < 0.07
    np.testing.assert_allclose(soft.sum(), exact.sum(), rtol=0.01)


def test_the_area_moves_as_the_true_area_does(x64, camera, random_capsules):
    """A sum over pixels of coverage times a smooth image, before and after two pixels of motion."""
    capsules, shift = random_capsules(2), jnp.asarray([0.014, -0.008, 0.0])
    v, u = np.indices(camera.shape)
    image = np.sin(0.2 * u) + np.cos(0.15 * v)

    def change(coverage):
        ends = [Capsules(capsules.start + s * shift, capsules.end + s * shift, capsules.radius) for s in (1, -1)]
        after, before = (np.sum(np.asarray(coverage(camera, moved)) * image) for moved in ends)
        return after - before

    # Counting 15 x 15 rays a pixel errs by about 1 / 30 at each of some 200 pixels of outline: half a unit in all.
    soft = change(lambda *shape: soft_silhouette(*shape, softness=0.25))
    assert abs(soft) > 5
    np.testing.assert_allclose(soft, change(supersampled_coverage), rtol=0.03, atol=1)


@pytest.mark.parametrize("seed", range(2))
def test_gradient_against_central_differences(x64, camera, random_capsules, seed):
    capsules = random_capsules(seed)
    weights = jnp.asarray(np.random.default_rng(seed).normal(size=camera.shape))
    loss = jax.jit(lambda capsules: jnp.sum(weights * soft_silhouette(camera, capsules)))
    gradient = jax.grad(loss)(capsules)
    direction = jax.tree.map(lambda leaf: jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), capsules)
    step = 1e-6
    after, before = (
        loss(jax.tree.map(lambda leaf, along, s=s: leaf + s * step * along, capsules, direction)) for s in (1, -1)
    )
    slope = sum(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), gradient, direction)))
    np.testing.assert_allclose(slope, (after - before) / (2 * step), rtol=1e-5)


def test_gradients_are_finite_wherever_the_capsules_are(camera, random_capsules):
    capsules = random_capsules(0)
    gradient_of = jax.jit(jax.grad(lambda shape: jnp.sum(soft_silhouette(camera, shape))))
    for depth in (-1.0, -0.5, 0.0, 1e4):
        moved = Capsules(*(leaf.at[:, 2].add(depth) for leaf in (capsules.start, capsules.end)), capsules.radius)
        spheres = Capsules(moved.start, moved.start, moved.radius)
        along_a_ray = Capsules(moved.start, 1.1 * moved.start, moved.radius)
        for shape in (moved, spheres, along_a_ray):
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient_of(shape)))
