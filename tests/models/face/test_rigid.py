"""Alignment and removal of rigid motions, against scipy and the definition (oracle 10 of the specification)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face import rigid
from jaxfilters.models.face.landmarks import MEAN_SHAPE, RIGID_WEIGHTS

align, remove_rigid = jax.jit(rigid.align), jax.jit(rigid.remove_rigid)

TURN, SHIFT = Rotation.from_euler("ZYX", [0.3, -0.5, 0.2]), np.array([40.0, -10.0, 650.0])


def noisy(seed=0, sigma=3.0):
    return MEAN_SHAPE + np.random.default_rng(seed).normal(0, sigma, (10, 3))


def tangents():
    """T: the three translations and the three turns of the mean face."""
    turns = [np.cross(axis, MEAN_SHAPE - MEAN_SHAPE.mean(axis=0)) for axis in np.eye(3)]
    return np.stack([np.tile(axis, 10) for axis in np.eye(3)] + [turn.ravel() for turn in turns], axis=1)


def test_a_rigid_motion_is_found_and_removed(x64):
    source, target = noisy(), TURN.apply(noisy()) + SHIFT
    R, t = align(jnp.asarray(source), jnp.asarray(target))
    np.testing.assert_allclose(R, TURN.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(source @ R.T + t, target, atol=1e-9)


@pytest.mark.parametrize("weights", [None, RIGID_WEIGHTS])
def test_alignment_is_that_of_scipy(x64, weights):
    source, target = noisy(), TURN.apply(noisy(1)) + SHIFT
    w = np.ones(10) if weights is None else weights
    mean = lambda p: w @ p / w.sum()
    expected, _ = Rotation.align_vectors(target - mean(target), source - mean(source), weights=w)
    R, t = align(jnp.asarray(source), jnp.asarray(target), None if weights is None else jnp.asarray(weights))
    np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(t, mean(target) - expected.apply(mean(source)), atol=1e-5)


@pytest.mark.parametrize("squeeze", [np.diag([-1.0, 1, 1]), np.diag([1.0, 1, 0]), np.diag([-1.0, 1, 0])])
def test_reflected_and_planar_points_never_give_a_mirror(x64, squeeze):
    R, _ = align(jnp.asarray(noisy() @ squeeze), jnp.asarray(TURN.apply(noisy())))
    assert jnp.linalg.det(R) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_removal_is_weighted_least_squares(x64):
    residual, T, w = noisy() - MEAN_SHAPE, tangents(), np.repeat(RIGID_WEIGHTS, 3)
    expected = residual.ravel() - T @ np.linalg.solve(T.T @ (w[:, None] * T), T.T @ (w * residual.ravel()))
    found = remove_rigid(*(jnp.asarray(a) for a in (residual, MEAN_SHAPE, RIGID_WEIGHTS)))
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-12)


def test_rigid_motions_leave_nothing(x64):
    motions = tangents() @ np.random.default_rng(0).normal(0, 1, (6, 8))
    remove = lambda r: remove_rigid(r, jnp.asarray(MEAN_SHAPE), jnp.asarray(RIGID_WEIGHTS))
    for motion in motions.T:
        np.testing.assert_allclose(remove(jnp.asarray(motion.reshape(10, 3))), 0, atol=1e-9)


def test_removal_is_idempotent_and_leaves_a_moved_mouth_where_it_is(x64):
    remove = lambda r: remove_rigid(r, jnp.asarray(MEAN_SHAPE), jnp.asarray(RIGID_WEIGHTS))
    opened = jnp.zeros((10, 3)).at[4:6, 1].set(10.0)
    once = remove(opened)
    np.testing.assert_allclose(remove(once), once, atol=1e-12)
    assert jnp.abs(once - opened).max() < 0.1
    assert jnp.abs(remove_rigid(opened, jnp.asarray(MEAN_SHAPE), jnp.ones(10)) - opened).max() > 2


def test_removal_of_a_small_turn_is_alignment_to_first_order(x64):
    """A turn by 1e-3 moves points by 0.05 mm; the second order is 1e-3 of that."""
    turned = Rotation.from_rotvec([5e-4, -7e-4, 5e-4]).apply(MEAN_SHAPE)
    left = remove_rigid(*(jnp.asarray(a) for a in (turned - MEAN_SHAPE, MEAN_SHAPE, RIGID_WEIGHTS)))
    assert np.abs(turned - MEAN_SHAPE).max() > 0.03
    assert jnp.abs(left).max() < 1e-4


def test_single_precision_and_derivatives():
    residual, mean, weights = (jnp.asarray(a, jnp.float32) for a in (noisy() - MEAN_SHAPE, MEAN_SHAPE, RIGID_WEIGHTS))
    found = remove_rigid(residual, mean, weights)
    with jax.enable_x64(True):
        exact = remove_rigid(*(jnp.asarray(a) for a in (noisy() - MEAN_SHAPE, MEAN_SHAPE, RIGID_WEIGHTS)))
    np.testing.assert_allclose(found, exact, atol=1e-4)
    slopes = jax.jit(jax.grad(lambda *a: jnp.sum(remove_rigid(*a) ** 2), (0, 1, 2)))(
        residual, mean, weights.at[4].set(0.0)
    )
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
