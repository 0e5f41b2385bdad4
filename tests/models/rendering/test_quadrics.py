"""Analytic depth against sphere tracing and against quadratic equations solved pixel by pixel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math.lie import quaternion_to_matrix
from jaxfilters.models.rendering.depth import capsule_depth, render_capsules, render_ellipsoids
from jaxfilters.models.rendering.geometry import Capsules, Ellipsoids

GRAZING = 1e-7  # metres: rays that miss or cut by less are left to rounding


def capsule_distance(points, capsules):
    """Distance from points (n, 3) to a union of capsules, negative inside."""
    start, end, radius = (np.asarray(value, float) for value in (capsules.start, capsules.end, capsules.radius))
    axis = end - start
    square = np.maximum(np.sum(axis**2, axis=-1), 1e-300)
    offset = points[:, None] - start
    place = np.clip(np.sum(offset * axis, axis=-1) / square, 0, 1)
    return np.min(np.linalg.norm(offset - place[..., None] * axis, axis=-1) - radius, axis=1)


def sphere_trace(camera, capsules, steps=1500):
    """Depth by marching along unit rays, and which rays pass so close to a surface that a mask is undecided."""
    rays = np.asarray(camera.rays(), float).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)
    directions, travelled, closest = rays / lengths[:, None], np.zeros(len(rays)), np.full(len(rays), np.inf)
    active = np.arange(len(rays))
    for _ in range(steps):
        gap = capsule_distance(directions[active] * travelled[active, None], capsules)
        travelled[active] += gap
        closest[active] = np.minimum(closest[active], gap)
        active = active[(gap > 1e-14) & (travelled[active] < 1.2)]
        if not len(active):
            break
    hit = closest < 1e-13
    shape = np.asarray(camera.rays()).shape[:2]
    depth = np.where(hit, travelled / lengths, np.inf)
    return depth.reshape(shape), ((closest > 1e-13) & (closest < GRAZING)).reshape(shape)


@pytest.mark.parametrize("seed", range(2))
def test_capsules_against_sphere_tracing(x64, camera, random_capsules, seed):
    capsules = random_capsules(seed)
    expected, undecided = sphere_trace(camera, capsules)
    depth = np.asarray(jax.jit(render_capsules)(camera, capsules))
    hit = np.isfinite(expected)
    assert hit.mean() > 0.1
    np.testing.assert_array_equal(np.isfinite(depth)[~undecided], hit[~undecided])
    both = hit & np.isfinite(depth)
    # Marching stops within 1e-14 of the surface; a ray at the angle of GRAZING multiplies that by at most 1e3.
    np.testing.assert_allclose(depth[both], expected[both], rtol=0, atol=1e-9)


def test_single_precision_is_close_to_double(x64, camera, random_capsules):
    capsules = random_capsules(1)
    exact = np.asarray(render_capsules(camera, capsules))
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (camera, capsules))
    depth = np.asarray(render_capsules(*single))
    assert depth.dtype == np.float32
    both = np.isfinite(exact) & np.isfinite(depth)
    assert np.sum(np.isfinite(exact) != np.isfinite(depth)) <= 2
    # A hundred rounding errors of half a metre in the mean; near an outline the square root magnifies them.
    error = np.abs(depth[both] - exact[both])
    assert error.mean() < 100 * 0.5 * 2**-24
    assert error.max() < 1e-4


def test_a_capsule_of_no_length_is_a_sphere(x64, camera):
    center = jnp.asarray([[0.02, -0.03, 0.5]])
    capsule = Capsules(center, center, jnp.asarray([0.05]))
    ball = Ellipsoids(center, jnp.asarray([[1.0, 0, 0, 0]]), jnp.full((1, 3), 0.05))
    depth = render_capsules(camera, capsule)
    assert np.isfinite(depth).sum() > 100
    np.testing.assert_allclose(depth, render_ellipsoids(camera, ball), rtol=1e-12)


def test_what_is_behind_the_camera_is_not_seen(x64, camera, random_capsules):
    capsules = random_capsules(0)
    flip = jnp.asarray([1.0, 1.0, -1.0])
    behind = Capsules(capsules.start * flip, capsules.end * flip, capsules.radius)
    assert np.all(np.isinf(render_capsules(camera, behind)))
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), behind, capsules)
    np.testing.assert_array_equal(render_capsules(camera, both), render_capsules(camera, capsules))


def test_a_capsule_through_the_image_plane_is_seen_in_front(x64, camera):
    capsule = Capsules(jnp.asarray([[0.08, 0.05, -0.3]]), jnp.asarray([[0.06, 0.02, 0.6]]), jnp.asarray([0.03]))
    expected, undecided = sphere_trace(camera, capsule)
    depth = np.asarray(render_capsules(camera, capsule))
    assert np.isfinite(expected).sum() > 50
    np.testing.assert_allclose(depth[~undecided], expected[~undecided], rtol=0, atol=1e-9)


def test_ellipsoids_against_the_quadratic_equation(x64, camera):
    rng = np.random.default_rng(3)
    rotation = rng.normal(size=(5, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    center, radii = rng.uniform((-0.2, -0.15, 0.4), (0.2, 0.15, 0.6), (5, 3)), rng.uniform(0.01, 0.1, (5, 3))
    rays = np.asarray(camera.rays())
    expected = np.full(rays.shape[:2], np.inf)
    for q, c, r in zip(rotation, center, radii, strict=True):
        R = np.asarray(quaternion_to_matrix(jnp.asarray(q)))
        Q = R @ np.diag(1 / r**2) @ R.T
        A, B, C = np.einsum("hwi,ij,hwj->hw", rays, Q, rays), -rays @ Q @ c, c @ Q @ c - 1
        discriminant = B**2 - A * C
        root = (-B - np.sqrt(np.maximum(discriminant, 0))) / A
        expected = np.minimum(expected, np.where(discriminant > 0, root, np.inf))
    depth = render_ellipsoids(camera, Ellipsoids(*(jnp.asarray(value) for value in (center, rotation, radii))))
    assert np.isfinite(expected).mean() > 0.1
    np.testing.assert_allclose(depth, expected, rtol=1e-10)


def test_a_pose_moves_the_capsules(x64, camera, random_capsules, random_transform):
    T = random_transform(4)
    capsules = random_capsules(2)
    here = capsules.moved(T.inverse())
    np.testing.assert_allclose(render_capsules(camera, here, T), render_capsules(camera, capsules), rtol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize("stride", [1, 2])
def test_depth_without_a_derivative_is_the_same_image(x64, camera, random_capsules, stride):
    rows, columns = camera.shape
    camera, capsules = camera.crop(jnp.zeros(2), (rows // stride, columns // stride), stride), random_capsules(4)
    depth = jax.jit(capsule_depth)(camera, capsules)
    assert np.isfinite(depth).any()
    np.testing.assert_allclose(depth, render_capsules(camera, capsules), rtol=1e-12)
