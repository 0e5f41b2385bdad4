"""State layout: the specification's table, names, constant velocity against sampled integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.layout import (
    Layout,
    five_fingers,
    transition_matrix,
    white_acceleration_root,
)
from jaxfilters.models.hand.skeleton import hand_geometry


def test_two_fingers_have_the_order_of_the_specification():
    layout = Layout(2)
    assert (layout.num_moving, layout.num_static, layout.size) == (14, 9, 37)
    slices = [layout.position, layout.quaternion, layout.angles, layout.rates, layout.lengths, layout.palm]
    assert [(s.start, s.stop) for s in slices] == [(0, 2), (2, 6), (6, 14), (14, 28), (28, 34), (34, 37)]
    assert (layout.quaternion_rate, layout.angle_rates) == (slice(16, 20), slice(20, 28))
    assert layout.static == slice(28, 37)


@pytest.mark.parametrize("layout", [Layout(1), Layout(2), Layout(5), Layout(3, 3), five_fingers(3)])
def test_every_component_has_its_own_name_in_its_own_block(layout):
    names = layout.names
    assert len(set(names)) == len(names) == layout.size
    assert layout.num_moving == layout.position_size + 4 + 4 * layout.num_fingers
    assert names[layout.quaternion] == ("q_w", "q_x", "q_y", "q_z")
    assert names[layout.angles][4 * layout.num_fingers - 1] == f"theta_{layout.num_fingers}3"
    assert names[layout.rates] == tuple(f"{name}_rate" for name in names[layout.moving])
    assert names[layout.lengths][:3] == ("r_11", "r_12", "r_13")
    assert names[layout.palm] == ("r_w", "r_h", "r_d")
    assert names[layout.flexion_index(layout.num_fingers - 1, 1)] == f"theta_{layout.num_fingers}2"


def test_fingers_are_spread_evenly_from_the_thumb_side():
    np.testing.assert_allclose(Layout(2).base_shares, [(1, 0.25), (1, -0.25)])
    np.testing.assert_allclose(Layout(1).base_shares, [(1, 0)])
    across = Layout(4).base_shares[:, 1]
    np.testing.assert_allclose(np.diff(across), -0.25)
    np.testing.assert_allclose(across.sum(), 0, atol=1e-15)


def test_five_fingers_begin_where_the_average_hand_has_them():
    geometry = hand_geometry()
    # Axes of the skeleton: thumb's side, forearm, back of the hand; here: fingers, inner side, thumb's side.
    palm_from_skeleton = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    bases = np.asarray(geometry.bases) @ palm_from_skeleton.T
    layout = five_fingers()
    np.testing.assert_allclose(layout.base_shares * (0.095, 0.080), bases[:, [0, 2]], atol=1e-7)
    thumb = Rotation.from_quat(np.asarray(geometry.thumb_frame), scalar_first=True).as_matrix()
    expected = palm_from_skeleton @ thumb @ palm_from_skeleton.T
    np.testing.assert_allclose(layout.frame_matrices[0], expected, atol=1e-6)
    np.testing.assert_allclose(layout.frame_matrices[1:], np.broadcast_to(np.eye(3), (4, 3, 3)))


def test_a_left_hand_is_a_right_hand_in_a_mirror():
    right, left = five_fingers(), five_fingers(side=-1.0)
    mirror = np.diag([1, 1, -1])
    np.testing.assert_allclose(left.base_shares, right.base_shares * (1, -1))
    np.testing.assert_allclose(left.frame_matrices, mirror @ right.frame_matrices @ mirror, atol=1e-14)


@pytest.mark.system
@pytest.mark.parametrize("layout", [Layout(2), Layout(3, 3)])
def test_transition_moves_by_rates_and_noise_is_that_of_steps_of_acceleration(layout, x64):
    rng = np.random.default_rng(0)
    x, std, dt = rng.normal(size=layout.size), rng.uniform(0.1, 2, layout.num_moving), 0.7
    m = layout.num_moving
    moved = np.concatenate([x[:m] + dt * x[m : 2 * m], x[m:]])
    np.testing.assert_allclose(transition_matrix(layout, dt) @ x, moved, rtol=1e-14)
    U = np.zeros((layout.size, layout.size))
    U[:m, :m] = np.diag(std**2 * dt**4 / 4)
    U[:m, m : 2 * m] = U[m : 2 * m, :m] = np.diag(std**2 * dt**3 / 2)
    U[m : 2 * m, m : 2 * m] = np.diag(std**2 * dt**2)
    G = white_acceleration_root(layout, jnp.asarray(std), dt)
    np.testing.assert_allclose(G @ G.T, U, atol=1e-15)


def test_time_steps_may_be_traced():
    layout = Layout(2)
    std = layout.per_moving(1.0, 0.1, 0.2)
    steps = jnp.array([0.0, 1.0, 2.0])
    A = jax.vmap(lambda dt: transition_matrix(layout, dt))(steps)
    G = jax.jit(jax.vmap(lambda dt: white_acceleration_root(layout, std, dt)))(steps)
    np.testing.assert_allclose(A[2], A[1] @ A[1])
    np.testing.assert_array_equal(A[0], np.eye(37))
    np.testing.assert_array_equal(G[0], 0)
    assert float(G[2][20, 6]) == pytest.approx(0.2 * 2)


def test_numbers_per_block_are_spread_over_all_that_moves():
    np.testing.assert_allclose(Layout(2).per_moving(1.0, 2.0, 3.0), [1, 1, 2, 2, 2, 2] + [3] * 8)
    assert Layout(2, 3).per_moving(1.0, 2.0, 3.0).shape == (15,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(num_fingers=0), "num_fingers must be 1 or more"),
        (dict(num_fingers=2, position_size=4), "position_size must be 2"),
        (dict(num_fingers=2, bases=((1.0, 0.0),)), "bases must be 2 finite"),
        (dict(num_fingers=1, frames=((1.0, 0.0, float("nan")),)), "frames must be 3 finite"),
    ],
)
def test_bad_layouts_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Layout(**arguments)
