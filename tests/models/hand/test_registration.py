"""Registration: its gradient, its convergence on rendered hands, and the search without a start."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand import start as start_module
from jaxfilters.models.hand.motion import per_coordinate
from jaxfilters.models.hand.registration import (
    PosePrior,
    RegistrationConfig,
    normal_equations,
    register,
    target_from_image,
)
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_geometry, local, open_palm, retract
from jaxfilters.models.hand.start import SCALES, Hypotheses, find_starts
from jaxfilters.models.rendering.depth import render_capsules

GEOMETRY = hand_geometry()
CAMERA = Pinhole.from_intrinsics((90.0, 90.0), (15.5, 15.5), (32, 32))
NEAR_CAMERA = Pinhole.from_intrinsics((365.0, 365.0), (63.5, 63.5), (128, 128))
POSE = open_palm(jnp.array([0.0, 0.08, 0.7])).at[7:].add(0.15)
WIDE = PosePrior(POSE, jnp.diag(per_coordinate(0.05, 0.3, 0.3)))
CONFIG = RegistrationConfig(widths=(0.03,) * 3 + (0.01,) * 7)
render = jax.jit(
    lambda camera, pose, geometry=GEOMETRY: render_capsules(camera, forward_kinematics(pose, geometry).capsules)
)
pull = jax.jit(
    lambda observed, start: register(CAMERA, target_from_image(CAMERA, observed), GEOMETRY, start, WIDE, CONFIG)
)


def joint_error(pose, truth):
    difference = forward_kinematics(pose, GEOMETRY).joints - forward_kinematics(truth, GEOMETRY).joints
    return 1000 * float(jnp.linalg.norm(difference, axis=-1).mean())


@pytest.mark.system
def test_nearest_hand_pixel_by_brute_force():
    rng = np.random.default_rng(0)
    observed = np.where(rng.random((32, 32)) < 0.03, 0.7, np.where(rng.random((32, 32)) < 0.5, np.inf, np.nan))
    nearest = np.asarray(target_from_image(CAMERA, jnp.asarray(observed, dtype=float)).nearest_hand).reshape(32, 32)
    hand, (v, u) = np.argwhere(np.isfinite(observed)), np.mgrid[:32, :32]
    shortest = ((v[..., None] - hand[:, 0]) ** 2 + (u[..., None] - hand[:, 1]) ** 2).min(-1)
    np.testing.assert_array_equal((v - nearest // 32) ** 2 + (u - nearest % 32) ** 2, shortest)
    assert np.isfinite(observed.ravel()[nearest]).all()


@pytest.mark.system
def test_gradient_of_the_surface_term_against_finite_differences():
    # Outline and front off: what is left is smooth where no pixel changes its closest capsule. Weights are held fixed
    # (iteratively reweighted least squares), which a wide robust function makes exact to (residual / width)^2 = 1e-4.
    with jax.enable_x64(True):
        geometry, pose = hand_geometry(), POSE.astype(float)
        camera = Pinhole.from_intrinsics((90.0, 90.0), (15.5, 15.5), (32, 32))
        config = RegistrationConfig(outline_weight=0.0, front_weight=0.0)
        target = target_from_image(camera, render_capsules(camera, forward_kinematics(pose, geometry).capsules))
        moved = retract(pose, 0.003 * jnp.cos(jnp.arange(21.0)))
        width = jnp.asarray(1.0)
        gradient, _ = jax.jit(lambda at: normal_equations(camera, target, geometry, at, width, config))(moved)

        @jax.jit
        @jax.vmap
        def energy(delta):
            at = retract(moved, delta)
            bones = forward_kinematics(at, geometry).capsules
            points = (target.rays * jnp.where(jnp.isfinite(target.depth), target.depth, 0.0)[:, None])[:, None]
            axis = bones.end - bones.start
            share = jnp.clip(((points - bones.start) * axis).sum(-1) / (axis**2).sum(-1), 0, 1)
            distance = jnp.linalg.norm(points - bones.start - share[..., None] * axis, axis=-1) - bones.radius
            hand = jnp.isfinite(target.depth)
            scale = config.independent_pixels / config.noise_std**2 / hand.sum()
            return 0.5 * scale * jnp.sum(jnp.where(hand, distance.min(axis=1) ** 2, 0.0))

        steps = 1e-6 * jnp.eye(21)
        numeric = (energy(steps) - energy(-steps)) / 2e-6
        np.testing.assert_allclose(gradient, numeric, rtol=1e-3, atol=1e-3 * float(jnp.abs(numeric).max()))


@pytest.mark.system
@pytest.mark.parametrize("seed", range(2))
def test_a_displaced_hand_is_pulled_back(seed):
    # Displaced by 8 mm, 0.1 rad and 8 degrees in every coordinate, seen in pixels that are 8 mm wide.
    noise = per_coordinate(0.008, 0.1, np.deg2rad(8)) * jax.random.normal(jax.random.key(seed), (21,))
    start = retract(POSE, noise)
    found = pull(render(CAMERA, POSE), start)
    assert joint_error(start, POSE) > 10
    assert joint_error(found.pose, POSE) < 5


@pytest.mark.system
def test_information_is_symmetric_positive_and_smaller_for_what_is_hidden():
    information = pull(render(CAMERA, POSE), POSE).information
    np.testing.assert_allclose(information, information.T, rtol=1e-4, atol=1e-2)
    eigenvalues = np.linalg.eigvalsh(np.asarray(information, np.float64))
    assert eigenvalues.min() > -1e-4 * eigenvalues.max()
    assert information[2, 2] > 0


@pytest.mark.system
def test_nothing_seen_leaves_the_prior():
    found = pull(jnp.full((32, 32), jnp.nan, POSE.dtype), retract(POSE, jnp.full(21, 0.01)))
    np.testing.assert_allclose(local(POSE, found.pose), 0, atol=1e-5)
    np.testing.assert_allclose(found.information, 0, atol=1e-6)


PALM = [0, 5, 9, 17]


def joints(start):
    geometry = replace(GEOMETRY.scaled(start.scale), side=jnp.asarray(start.side))
    return np.asarray(forward_kinematics(jnp.asarray(start.pose), geometry).joints)


@pytest.mark.system
@pytest.mark.parametrize(("side", "roll"), [(1.0, 0.4), (-1.0, 2.8)])
def test_a_hand_of_either_side_and_of_unknown_size_is_found_without_a_start(side, roll):
    # One of them hangs down, without a forearm in sight: nothing but the fingers says which way it points.
    scale, turn = 0.9, jnp.array([np.cos(roll / 2), 0.0, 0.0, np.sin(roll / 2)])
    pose = open_palm(jnp.array([0.02, 0.0, 0.7])).at[3:7].set(turn)
    pose = pose.at[7:].set(jnp.tile(jnp.deg2rad(jnp.array([5.0, 8.0, 12.0])), 5))
    truth = forward_kinematics(pose, replace(GEOMETRY.scaled(scale), side=jnp.asarray(side)))
    observed = jax.jit(render_capsules)(NEAR_CAMERA, truth.capsules)
    palm = np.asarray(truth.joints)[[0, 5, 17]].mean(axis=0)
    starts = find_starts(NEAR_CAMERA, observed, palm, GEOMETRY, SCALES)
    assert starts[0].side == side
    assert abs(starts[0].scale - scale) < 0.051
    assert 1000 * np.linalg.norm(joints(starts[0]) - np.asarray(truth.joints), axis=-1).mean() < 12
    assert starts[0].cost < 0.01
    assert all(start.cost >= starts[0].cost for start in starts)


@pytest.mark.system
@pytest.mark.parametrize("degrees", [(100, -90, 20), (75, 45, 50), (200, 0, 65), (310, -135, 50)])
def test_a_hand_is_found_that_shows_its_edge_or_points_at_the_camera(degrees):
    # Roll, flip and tilt between those of the starting poses; the hand is larger, its place is known roughly.
    turn = np.roll(Rotation.from_euler("ZYX", degrees, degrees=True).as_quat(), 1)
    bent = jnp.deg2rad(jnp.array([15.0, 5, 10, 35, 6, 20, 25, 0, 25, 20, -4, 35, 10, -10, 30]))
    pose = open_palm(jnp.zeros(3)).at[3:7].set(turn).at[7:].set(bent)
    hand = GEOMETRY.scaled(1.06)
    middle = np.asarray(forward_kinematics(pose, hand).joints)[PALM].mean(axis=0)
    truth = forward_kinematics(pose.at[:3].set(jnp.array([0.0, 0.0, 0.6]) - middle), hand)
    noise = 0.002 * np.random.default_rng(0).normal(size=NEAR_CAMERA.shape)
    observed = jax.jit(render_capsules)(NEAR_CAMERA, truth.capsules) + noise
    starts = find_starts(NEAR_CAMERA, observed, np.array([0.01, -0.006, 0.6]), GEOMETRY, (1.0,), (1.0,))
    assert 1000 * np.linalg.norm(joints(starts[0]) - np.asarray(truth.joints), axis=-1).mean() < 25


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("outwards", [1, -1])
def test_fingers_matched_to_their_neighbours_have_a_variant_near_the_truth(count, outwards):
    # Spread fingers; in the wrong pose the outermost explains nothing, since each of `count` points at its neighbour.
    spread = np.deg2rad([20.0, 5.0, -10.0, -25.0])
    truth = open_palm(jnp.array([0.0, 0.08, 0.7])).at[jnp.array([11, 14, 17, 20])].set(spread)
    right = np.asarray(forward_kinematics(truth, GEOMETRY).joints)[[8, 12, 16, 20]]
    wrong = truth
    for finger in [4, 3, 2, 1][:count] if outwards > 0 else [1, 2, 3, 4][:count]:
        aim = right[finger - 1 - outwards] - np.asarray(GEOMETRY.bases[finger]) - np.array([0.0, 0.08, 0.7])
        wrong = wrong.at[8 + 3 * finger].set(np.arctan2(aim[0], -aim[1]))
    one = Hypotheses(np.asarray(wrong)[None], np.ones(1, np.float32), np.ones(1, np.float32))
    tried = start_module._variants(one, (1.0, -1.0))
    assert len(tried.poses) == start_module.BATCH
    tips = np.stack(
        [np.asarray(forward_kinematics(jnp.asarray(p), GEOMETRY).joints)[[8, 12, 16, 20]] for p in tried.poses]
    )
    before = np.asarray(forward_kinematics(wrong, GEOMETRY).joints)[[8, 12, 16, 20]]
    assert np.linalg.norm(before - right, axis=-1).max() > 0.03
    assert np.linalg.norm(tips - right, axis=-1).max(axis=1).min() < 0.02


@pytest.mark.system
def test_products_have_full_precision(products_at_default_precision):
    def registered(observed, start):
        return register(CAMERA, target_from_image(CAMERA, observed), GEOMETRY, start, WIDE, CONFIG)

    assert not products_at_default_precision(registered, jnp.ones((32, 32)), POSE)
