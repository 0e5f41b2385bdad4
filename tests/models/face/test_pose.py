"""Angles and rotations, against scipy and against what the specification says in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face import pose as head


def some_angles(num, seed=0):
    """(roll, yaw, pitch), yaw within a quarter turn."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (num, 3))


def test_rotations_are_those_of_scipy(x64):
    angles = some_angles(50)
    expected = Rotation.from_euler("ZYX", angles).as_matrix()
    np.testing.assert_allclose(jax.vmap(head.rotation)(jnp.asarray(angles)), expected, atol=1e-14)


@pytest.mark.system
def test_an_ensemble_along_the_last_axis_is_the_same(x64):
    angles = jnp.asarray(some_angles(20)).T
    along_last = jax.vmap(head.rotation, -1, -1)(angles)
    np.testing.assert_allclose(along_last[..., 7], head.rotation(angles[:, 7]), atol=1e-15)


def test_angles_invert_rotations(x64):
    angles = jnp.asarray(some_angles(50))
    np.testing.assert_allclose(jax.vmap(lambda a: head.angles(head.rotation(a)))(angles), angles, atol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize("yaw", [np.pi / 2, -np.pi / 2])
def test_at_a_quarter_turn_the_angles_still_give_the_rotation(x64, yaw):
    R = jnp.round(head.rotation(jnp.array([0.0, yaw, 0.0])), 15)
    R = head.rotation(jnp.array([0.4, 0.0, 0.0])).T @ R
    angles, slope = head.angles(R), jax.jacobian(head.angles)(R)
    np.testing.assert_allclose(head.rotation(angles), R, atol=1e-12)
    assert np.all(np.isfinite(slope))


def test_positive_yaw_turns_the_nose_to_the_left_of_the_image():
    nose = jnp.array([[0.0, 0.0, -20.0]])
    assert head.place(nose, jnp.array([0, 0, 600, 0, 0.3, 0]))[0, 0] < 0


def test_positive_roll_and_pitch_turn_about_z_and_x():
    right, down = jnp.array([[10.0, 0.0, 0.0]]), jnp.array([[0.0, 10.0, 0.0]])
    assert head.place(right, jnp.array([0, 0, 600, 0.3, 0, 0]))[0, 1] > 0
    assert head.place(down, jnp.array([0, 0, 600, 0, 0, 0.3]))[0, 2] > 600


def test_placed_points_are_rotated_then_moved(x64):
    shape = np.random.default_rng(1).normal(0, 40, (10, 3))
    pose = np.array([60.0, -20.0, 650.0, 0.2, -0.4, 0.3])
    expected = Rotation.from_euler("ZYX", pose[3:]).apply(shape) + pose[:3]
    np.testing.assert_allclose(head.place(jnp.asarray(shape), jnp.asarray(pose)), expected, atol=1e-12)


@pytest.mark.system
def test_turning_axes_are_the_derivatives_of_the_rotation(x64):
    point = jnp.array([10.0, -30.0, 20.0])
    for angles in jnp.asarray(some_angles(10, seed=2)):
        slope = jax.jacobian(lambda a: head.rotation(a) @ point)(angles)
        axes = head.turning_axes(angles)
        np.testing.assert_allclose(jnp.cross(axes, head.rotation(angles) @ point), slope.T, atol=1e-12)
