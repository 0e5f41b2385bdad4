"""The motion model: against the spec's matrices, an integrated damped velocity, and the walk without one."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.motion import HandMotion, paper_motion, per_coordinate
from jaxfilters.models.hand.skeleton import TANGENT_SIZE, open_palm

POSE = open_palm(jnp.array([0.0, 0.09, 0.7]))


@pytest.mark.system
def test_without_damping_it_is_the_papers_model():
    dt = 1 / 30
    step = paper_motion(dt).dynamics(POSE, jnp.asarray(dt))
    np.testing.assert_allclose(step.A_n, dt * np.eye(TANGENT_SIZE), rtol=1e-6)
    np.testing.assert_allclose(step.A_l, np.eye(TANGENT_SIZE), rtol=1e-6)
    std = np.sqrt(np.diagonal(step.Q_n))
    np.testing.assert_allclose(std[[0, 3, 6]], [0.002, 0.016, np.deg2rad(2)], rtol=1e-5)
    np.testing.assert_allclose(np.sqrt(np.diagonal(step.Q_l))[[0, 3, 6]], [0.02, 0.1, np.deg2rad(12)], rtol=1e-5)


@pytest.mark.parametrize("dt", [0.001, 1 / 30, 0.5, 20.0])
def test_a_damped_velocity_covers_its_integral(dt):
    tau = 0.3
    zero = jnp.zeros(TANGENT_SIZE)
    step = HandMotion(zero, zero, per_coordinate(0.0, 0.0, 1 / tau)).dynamics(POSE, jnp.asarray(dt))
    times = np.linspace(0, dt, 20_001)
    covered = np.trapezoid(np.exp(-times / tau), times)
    # float32: 1 - exp(-x) keeps 1e-7 / x of relative precision, x >= 0.003 here.
    np.testing.assert_allclose(np.diagonal(step.A_n)[6:], covered, rtol=1e-4)
    np.testing.assert_allclose(np.diagonal(step.A_n)[:6], dt, rtol=1e-6)
    np.testing.assert_allclose(np.diagonal(step.A_l)[6:], np.exp(-dt / tau), rtol=1e-5)


def test_the_walk_has_the_same_noise_and_no_velocity():
    motion, dt = paper_motion(), jnp.asarray(0.1)
    walk, step = motion.walk(POSE, dt), motion.dynamics(POSE, dt)
    assert walk.A_n.shape == (TANGENT_SIZE, 0)
    assert walk.A_l.shape == walk.Q_l.shape == (0, 0)
    assert walk.f_l.shape == (0,)
    np.testing.assert_array_equal(walk.Q_n, step.Q_n)
