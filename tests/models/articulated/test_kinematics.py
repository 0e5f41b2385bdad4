"""Finger chains: the specification's golden points, homogeneous matrices, rotations with a scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.kinematics import (
    finger_points,
    pivot_base,
    pivot_wrist,
    scaled_rotation,
    turn,
    unit_rotation,
)
from jaxfilters.models.articulated.layout import Layout, five_fingers

pytestmark = pytest.mark.usefixtures("x64")
PIVOTS = {"base": pivot_base, "wrist": pivot_wrist}
LAYOUTS = {"two": Layout(2), "five": five_fingers(), "left": five_fingers(side=-1.0), "one_in_space": Layout(1, 3)}

GOLDEN = [
    [(15, -80), (24.323791, -132.877849), (29.011785, -159.464782), (31.580326, -174.031703)],
    [(-15, -80), (-24.442722, -133.552336), (-29.354234, -161.406906), (-31.776001, -175.141431)],
]


def golden_state():
    angles = np.deg2rad([-10, 30, 20, 15, 10, 25, 20, 20])
    return jnp.asarray(
        np.concatenate([[0, 0, 0.5, -0.5, 0.5, -0.5], angles, np.zeros(14), [62, 42, 35, 60, 40, 33, 60, 80, 20]])
    )


def test_golden_points_with_the_pivot_at_the_base():
    points = articulated_hand(Layout(2)).image_points(golden_state())
    # The specification prints six decimals.
    np.testing.assert_allclose(points, GOLDEN, atol=1e-6)


def test_golden_base_with_the_pivot_at_the_wrist():
    points = articulated_hand(Layout(2), pivot=pivot_wrist).image_points(golden_state())
    np.testing.assert_allclose(points[0, 0], (28.663971, -76.179898), atol=1e-6)
    # The finger itself is only moved: its links are those of the other pivot.
    np.testing.assert_allclose(np.diff(points, axis=1), np.diff(GOLDEN, axis=1), atol=2e-6)


def test_float32_keeps_a_hundred_thousandth_of_a_pixel():
    with jax.enable_x64(False):
        points = articulated_hand(Layout(2)).image_points(jnp.asarray(golden_state(), jnp.float32))
        assert points.dtype == jnp.float32
    np.testing.assert_allclose(points, GOLDEN, atol=1e-4)


@pytest.mark.parametrize("pivot", PIVOTS)
@pytest.mark.parametrize("name", LAYOUTS)
def test_points_match_homogeneous_matrices(name, pivot, random_state, finger_chains_oracle):
    layout = LAYOUTS[name]
    for seed in range(3):
        x = random_state(np.random.default_rng(seed), layout)
        points = finger_points(jnp.asarray(x), layout, pivot=PIVOTS[pivot])
        expected = finger_chains_oracle(x, layout, wrist_pivot=pivot == "wrist")
        # Rounding of some ten operations on up to 300 pixels.
        np.testing.assert_allclose(points, expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_scaled_rotation_is_a_rotation_times_the_squared_length(seed):
    q = np.random.default_rng(seed).normal(size=4) * 1.3
    R = np.asarray(scaled_rotation(jnp.asarray(q)))
    square = np.sum(q**2)
    np.testing.assert_allclose(R @ R.T, square**2 * np.eye(3), atol=1e-12 * square**2)
    assert np.linalg.det(R) == pytest.approx(square**3, rel=1e-12)
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, square * expected, atol=1e-12)
    np.testing.assert_allclose(unit_rotation(jnp.asarray(q)), expected, atol=1e-12)
    np.testing.assert_array_equal(scaled_rotation(-jnp.asarray(q)), R)


def test_turn_is_the_matrix_product_whatever_the_leading_axes():
    rng = np.random.default_rng(0)
    matrix, points = rng.normal(size=(3, 3)), rng.normal(size=(2, 4, 3))
    np.testing.assert_allclose(turn(jnp.asarray(matrix), jnp.asarray(points)), points @ matrix.T, atol=1e-14)


def test_links_keep_their_lengths(random_state):
    layout = five_fingers()
    x = random_state(np.random.default_rng(2), layout)
    for pivot in PIVOTS.values():
        links = np.diff(finger_points(jnp.asarray(x), layout, pivot=pivot), axis=1)
        np.testing.assert_allclose(np.linalg.norm(links, axis=2).ravel(), x[layout.lengths], rtol=1e-12)


@pytest.mark.system
def test_vmap_over_the_last_axis_equals_a_loop(random_state):
    layout = five_fingers()
    states = jnp.asarray(np.stack([random_state(np.random.default_rng(seed), layout) for seed in range(4)], axis=-1))
    mapped = jax.vmap(lambda x: finger_points(x, layout), in_axes=-1, out_axes=-1)(states)
    for i in range(4):
        np.testing.assert_allclose(mapped[..., i], finger_points(states[:, i], layout), atol=1e-12)
