"""Mirrors in depth: exact depths and lengths, the displacement formula, cases without change of the image, triggers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.ambiguity import (
    depth_mirror,
    depth_mirrors,
    mirror_trigger,
    reversal_trigger,
    reverse_depth,
    separated_points,
    shows_length,
)
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.kinematics import pivot_wrist
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.camera import Pinhole

pytestmark = pytest.mark.usefixtures("x64")
FACING = (0.5, -0.5, 0.5, -0.5)
points = jax.jit(lambda hand, x: hand.points(x))
observed = jax.jit(lambda hand, x: hand.observe(x))
mirror = jax.jit(depth_mirror)
LINKS = [(finger, link) for finger in range(2) for link in range(3)]


def hand_state(angles_deg, q=FACING, position=(0.0, 0.0), layout=None):
    layout = layout or Layout(2)
    lengths = np.tile([62.0, 42, 35], layout.num_fingers)
    return jnp.asarray(
        np.concatenate([position, q, np.deg2rad(angles_deg), np.zeros(layout.num_moving), lengths, [60, 80, 20]])
    )


def link_vectors(hand, x):
    """Unit vectors of the links in the camera frame."""
    links = np.diff(np.asarray(points(hand, x)), axis=1)
    return links / np.linalg.norm(links, axis=2, keepdims=True)


@pytest.mark.system
@pytest.mark.parametrize("pivot_at_wrist", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_mirror_flips_the_depth_keeps_the_length_and_moves_the_tip_as_stated(seed, pivot_at_wrist, random_state):
    hand = articulated_hand(Layout(2), **({"pivot": pivot_wrist} if pivot_at_wrist else {}))
    x = jnp.asarray(random_state(np.random.default_rng(seed), hand.layout))
    before = link_vectors(hand, x)
    for finger, link in LINKS:
        mirrored = mirror(x, hand, finger, link)
        u, v = before[finger, link], link_vectors(hand, mirrored.x)[finger, link]
        assert v[2] == pytest.approx(-u[2], abs=1e-12)
        assert np.hypot(*v[:2]) == pytest.approx(np.hypot(*u[:2]), abs=1e-12)
        # cos(psi - psi_0) is the depth over A.
        A = float(mirrored.amplitude)
        moved = 2 * abs(u[2]) / A * np.sqrt(1 - A**2)
        assert np.hypot(*(v - u)[:2]) == pytest.approx(moved, abs=1e-12)
        assert A <= 1 + 1e-12
        own = hand.layout.flexion_index(finger, link)
        np.testing.assert_array_equal(np.delete(mirrored.x, own), np.delete(x, own))
        assert abs(float(mirrored.change)) <= np.pi


@pytest.mark.system
def test_amplitude_is_the_cosine_of_sight_and_finger_plane(random_state):
    hand = articulated_hand(five_fingers())
    x = jnp.asarray(random_state(np.random.default_rng(0), hand.layout))
    links = link_vectors(hand, x)
    # Two links span the finger's plane; its normal's depth is the sine of the angle between plane and line of sight.
    normals = np.cross(links[:, 0], links[:, 1])
    sines = normals[:, 2] / np.linalg.norm(normals, axis=1)
    amplitude = np.asarray(depth_mirrors(x, hand).amplitude)
    np.testing.assert_allclose(amplitude, np.broadcast_to(np.sqrt(1 - sines**2)[:, None], (5, 3)), atol=1e-12)


@pytest.mark.system
def test_palm_to_the_camera_without_abduction_has_the_same_image():
    hand = articulated_hand(Layout(2))
    x = hand_state([0, 30, 0, 0, 0, 20, 30, 10])
    mirrored = depth_mirror(x, hand, 0, 0)
    assert float(mirrored.amplitude) == pytest.approx(1, abs=1e-12)
    assert float(mirrored.x[7]) == pytest.approx(-np.deg2rad(30), abs=1e-12)
    np.testing.assert_allclose(observed(hand, mirrored.x), observed(hand, x), atol=1e-10)


@pytest.mark.system
def test_indices_may_be_traced(random_state):
    hand = articulated_hand(Layout(2))
    x = jnp.asarray(random_state(np.random.default_rng(1), hand.layout))
    fingers, links = jnp.array(LINKS).T
    mapped = jax.jit(jax.vmap(lambda i, j: depth_mirror(x, hand, i, j).x))(fingers, links)
    for row, (finger, link) in zip(mapped, LINKS, strict=True):
        np.testing.assert_allclose(row, depth_mirror(x, hand, finger, link).x, atol=1e-12)


@pytest.mark.system
def test_a_finger_plane_across_the_line_of_sight_has_finite_derivatives():
    # The palm's edge towards the camera: fingers bend within the image plane.
    q = Rotation.from_euler("y", -90, degrees=True) * Rotation.from_quat(FACING, scalar_first=True)
    hand = articulated_hand(Layout(1))
    q = np.round(q.as_quat(scalar_first=True) * np.sqrt(2)) / np.sqrt(2)
    x = hand_state([0, 30, 20, 10], q=q, layout=Layout(1))
    np.testing.assert_allclose(depth_mirrors(x, hand).amplitude, 0, atol=1e-12)
    assert np.all(np.isfinite(jax.jit(jax.jacfwd(lambda x: depth_mirrors(x, hand).change))(x)))


def test_the_image_shows_lengths_of_links_near_its_plane_only():
    hand = articulated_hand(Layout(2))
    # Links at 19, 21 and 0 degrees to the image plane, then at -10, -50 and 5.
    x = hand_state([0, 19, 2, -21, 0, -10, -40, 55])
    np.testing.assert_array_equal(shows_length(x, hand), [[True, False, True], [True, False, True]])


@pytest.mark.system
def test_trigger_needs_a_small_change_within_the_uncertainty_and_the_line_of_sight_in_the_plane():
    hand = articulated_hand(Layout(2))
    # Links at 20 (first), 45 and 10 degrees to the image plane: changes of 40, 90 and 20 degrees.
    x = hand_state([0, 20, 25, -35, 0, 20, 0, 0])
    sigma = np.zeros(hand.layout.size)
    sigma[hand.layout.angles] = np.deg2rad(17)
    expected = [[True, False, True], [True, True, True]]
    np.testing.assert_array_equal(mirror_trigger(x, jnp.asarray(sigma), hand), expected)
    sigma[hand.layout.angles] = np.deg2rad(15)
    np.testing.assert_array_equal(mirror_trigger(x, jnp.asarray(sigma), hand), [[False, False, True], [False] * 3])
    sigma[hand.layout.angles] = np.deg2rad(100)
    np.testing.assert_array_equal(mirror_trigger(x, jnp.asarray(sigma), hand), expected)
    # A^2 = 1 - sin^2(tilt) sin^2(abduction) = 0.89^2.
    aside = x.at[hand.layout.angles.start].set(np.deg2rad(45))
    turned = Rotation.from_euler("x", 40, degrees=True) * Rotation.from_quat(FACING, scalar_first=True)
    aside = aside.at[hand.layout.quaternion].set(turned.as_quat(scalar_first=True))
    amplitude = np.asarray(depth_mirrors(aside, hand).amplitude)
    assert amplitude[0, 0] < 0.9 < amplitude[1, 0]
    assert not np.any(mirror_trigger(aside, jnp.asarray(sigma), hand)[0])


@pytest.mark.parametrize(("sigma_deg", "half"), [(15, 20), (22, 22), (60, 25)])
@pytest.mark.parametrize("theta", [20, -20])
def test_linearisation_points_lie_on_both_sides_of_the_middle(theta, sigma_deg, half):
    hand = articulated_hand(Layout(2))
    x = hand_state([0, theta, 0, 0, 0, 10, 10, 10])
    sigma = jnp.full(hand.layout.size, np.deg2rad(sigma_deg))
    found = np.asarray(separated_points(x, sigma, hand, 0, 0))
    np.testing.assert_allclose(np.rad2deg(found[:, 7]), [np.sign(theta) * half, -np.sign(theta) * half], atol=1e-10)
    np.testing.assert_array_equal(np.delete(found, 7, axis=1), np.stack([np.delete(x, 7)] * 2))


def test_linearisation_points_are_apart_at_the_critical_angle_itself():
    hand = articulated_hand(Layout(2))
    x = hand_state([0, 0, 0, 0, 0, 10, 10, 10])
    found = np.asarray(separated_points(x, jnp.full(hand.layout.size, 0.2), hand, 0, 0))
    np.testing.assert_allclose(np.sort(found[:, 7]), [-0.2, 0.2], atol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize("pivot_at_wrist", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_reversal_of_the_whole_hand_leaves_all_features_unchanged(seed, pivot_at_wrist, random_state):
    hand = articulated_hand(Layout(2), **({"pivot": pivot_wrist} if pivot_at_wrist else {}))
    x = jnp.asarray(random_state(np.random.default_rng(seed), hand.layout))
    reversed_x = reverse_depth(x, hand)
    np.testing.assert_allclose(observed(hand, reversed_x), observed(hand, x), atol=1e-10)
    # The points are mirrored in depth, and stay so as the hand moves on.
    flipped = np.array([1, 1, -1])
    np.testing.assert_allclose(points(hand, reversed_x), points(hand, x) * flipped, atol=1e-10)
    np.testing.assert_allclose(
        points(hand, hand.transition(reversed_x)), points(hand, hand.transition(x)) * flipped, atol=1e-10
    )
    J, M = np.diag([1, 1, -1]), np.diag([1, -1, 1])
    R, reversed_R = (Rotation.from_quat(np.asarray(s)[2:6], scalar_first=True).as_matrix() for s in (x, reversed_x))
    np.testing.assert_allclose(reversed_R, J @ R @ M, atol=1e-12)


@pytest.mark.system
def test_reversal_is_a_signed_permutation_and_its_own_inverse_up_to_the_sign_of_the_quaternion(random_state):
    hand = articulated_hand(Layout(2))
    x = jnp.asarray(random_state(np.random.default_rng(0), hand.layout))
    D = np.asarray(jax.jacfwd(lambda x: reverse_depth(x, hand))(x))
    np.testing.assert_array_equal(np.sort(np.abs(D), axis=1)[:, -2:], np.tile([0.0, 1.0], (37, 1)))
    np.testing.assert_allclose(D @ x, reverse_depth(x, hand), atol=1e-12)
    np.testing.assert_allclose(np.abs(D @ D), np.eye(37), atol=1e-15)


def test_reversal_in_perspective_is_exact_in_depth_along_the_line_of_sight():
    camera = Pinhole.from_intrinsics((500.0, 500.0), (320.0, 240.0), (480, 640))
    layout = Layout(2, 3)
    hand = articulated_hand(layout, projection=Perspective(camera))
    x = hand_state([-5, 30, 20, 10, 5, 25, 25, 20], position=(0.3, -0.2, 0.9), layout=layout)
    x = x.at[layout.static].multiply(1e-3)
    sight = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    offset = np.asarray(points(hand, x)) - [0.3, -0.2, 0.9]
    mirrored = offset - 2 * (offset @ sight)[..., None] * sight
    np.testing.assert_allclose(
        np.asarray(points(hand, reverse_depth(x, hand))) - [0.3, -0.2, 0.9], mirrored, atol=1e-12
    )


def test_mirror_in_perspective_flips_the_part_along_the_line_of_sight():
    camera = Pinhole.from_intrinsics((500.0, 500.0), (320.0, 240.0), (480, 640))
    layout = Layout(2, 3)
    hand = articulated_hand(layout, projection=Perspective(camera))
    x = hand_state([-5, 30, 20, 10, 5, 25, 25, 20], position=(0.3, -0.2, 0.9), layout=layout)
    x = x.at[layout.static].multiply(1e-3)
    for finger, link in LINKS:
        start = np.asarray(points(hand, x))[finger, link]
        sight = start / np.linalg.norm(start)
        u = link_vectors(hand, x)[finger, link]
        v = link_vectors(hand, mirror(x, hand, finger, link).x)[finger, link]
        assert v @ sight == pytest.approx(-u @ sight, abs=1e-12)


def test_reversal_is_triggered_when_all_flexions_may_be_zero():
    layout = Layout(2)
    x = hand_state([30, 5, -9, 9, 30, 0, 9, 9])
    sigma = jnp.full(layout.size, np.deg2rad(5))
    assert bool(reversal_trigger(x, sigma, layout))
    assert not bool(reversal_trigger(x.at[13].set(np.deg2rad(11)), sigma, layout))
