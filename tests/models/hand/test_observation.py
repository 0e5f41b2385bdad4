"""What is cut out of a frame, and the likelihood made of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import gibbs_abs, gibbs_sq
from jaxfilters.models.hand.observation import (
    HOLE,
    HandLikelihood,
    crop,
    hand_image,
    hidden_digits,
    isolate,
    rendered,
    union,
)
from jaxfilters.models.hand.skeleton import TANGENT_SIZE, forward_kinematics, hand_geometry, open_palm, retract
from jaxfilters.models.hand.surface import CapsuleHand, triangle_hand
from jaxfilters.models.rendering.depth import render_capsules

GEOMETRY = hand_geometry()
POSE = open_palm(jnp.array([0.0, 0.09, 0.7]))
CAMERA = Pinhole.from_intrinsics((90.0, 95.0), (64.0, 52.0), (106, 128))
render = jax.jit(lambda camera, pose: render_capsules(camera, forward_kinematics(pose, GEOMETRY).capsules))


@pytest.mark.system
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("center", [(0.0, 0.0, 0.7), (0.45, -0.3, 0.7)])
def test_a_window_holds_the_pixels_its_camera_says(stride, center):
    rows, cols = np.mgrid[:106, :128].astype(np.float32)
    frame = jnp.asarray(1000 * rows + cols)
    camera, window = crop(CAMERA, frame, jnp.asarray(center), (20, 30), stride)
    corner = np.asarray(CAMERA.center - camera.center * stride)
    v, u = np.mgrid[:20, :30] * stride
    v, u = v + round(corner[1]), u + round(corner[0])
    inside = (v >= 0) & (v < 106) & (u >= 0) & (u < 128)
    np.testing.assert_array_equal(np.isnan(window), ~inside)
    np.testing.assert_array_equal(np.asarray(window)[inside], (1000 * v + u)[inside])
    middle = np.asarray(CAMERA.project(jnp.asarray(center)))
    assert np.all(np.abs(corner + stride * np.array([14.5, 9.5]) - middle) <= 0.5 + 1e-3)


@pytest.mark.system
def test_only_the_hand_is_left():
    depth = np.array(render(CAMERA, POSE))
    scene = np.where(np.isinf(depth), 2.0, depth)
    arm = (slice(66, 75), slice(60, 68))  # below the wrist, at its depth
    scene[arm] = 0.7
    scene[0:3, 0:3] = 0.3  # something near the camera, far from the hand
    scene[50, 64] = np.nan
    kept = np.asarray(jax.jit(isolate)(CAMERA, jnp.asarray(scene), POSE))
    assert np.isnan(kept[arm]).all()
    assert np.isnan(kept[0:3, 0:3]).all()
    assert np.isnan(kept[50, 64])
    assert np.isposinf(kept[scene == 2.0]).all()
    hand = np.isfinite(depth) & np.isfinite(kept)
    assert hand.sum() > 0.95 * (np.isfinite(depth).sum() - 1)
    np.testing.assert_array_equal(kept[hand], scene[hand])


@pytest.mark.system
@pytest.mark.parametrize("cost_of", [union, rendered])
def test_the_true_pose_is_the_most_likely(cost_of):
    image = hand_image(CAMERA, render(CAMERA, POSE))
    both = [HandLikelihood(CapsuleHand(GEOMETRY), jnp.asarray(0.002), 0.1, cost_of, f) for f in (gibbs_abs, gibbs_sq)]
    evaluate = jax.jit(jax.vmap(lambda pose: jnp.stack([one.log_likelihood(pose, image) for one in both]), in_axes=-1))
    deltas = jnp.concatenate([jnp.zeros((TANGENT_SIZE, 1)), 0.02 * jnp.eye(TANGENT_SIZE)[:, :6]], axis=1)
    values = np.asarray(evaluate(jax.vmap(retract, in_axes=(None, -1), out_axes=-1)(POSE, deltas)))
    assert values[0] == pytest.approx([0.0, 0.0], abs=0.01)
    assert np.all(values[1:] < values[0] - 0.03)


@pytest.mark.system
def test_angles_beyond_their_limits_are_unlikely():
    image = hand_image(CAMERA, render(CAMERA, POSE))
    likelihood = HandLikelihood(CapsuleHand(GEOMETRY), jnp.asarray(1.0), 0.1, union, gibbs_abs)
    bent_back = POSE.at[12].set(jnp.deg2rad(-9.0))  # PIP: 9 degrees beyond 0, softness 3 degrees
    both = jax.jit(lambda pose: (likelihood.log_likelihood(pose, image), likelihood.cost(pose, image)))
    (bent, bent_cost), (straight, cost) = both(bent_back), both(POSE)
    np.testing.assert_allclose(bent - straight, -0.5 * 3.0**2 - (bent_cost - cost), rtol=1e-4)


@pytest.mark.system
def test_a_triangle_hand_is_likeliest_where_the_capsules_are_and_grows_with_its_scale():
    image = hand_image(CAMERA, render(CAMERA, POSE))
    mesh = HandLikelihood(triangle_hand(GEOMETRY), jnp.asarray(1.0), 0.1, union, gibbs_abs)
    evaluate = jax.jit(jax.vmap(lambda pose, scale: mesh.scaled(scale).cost(pose, image), in_axes=(-1, 0)))
    moved = jax.vmap(retract, in_axes=(None, -1), out_axes=-1)(
        POSE, jnp.concatenate([jnp.zeros((TANGENT_SIZE, 3)), 0.02 * jnp.eye(TANGENT_SIZE)[:, :3]], axis=1)
    )
    costs = np.asarray(evaluate(moved, jnp.array([1.0, 1.1, 0.9, *[1.0] * 3])))
    # A tessellated hand of the same volume differs from the capsules by a millimetre, and by a pixel along its edge.
    assert costs[0] < 0.012
    assert np.all(costs[1:] > costs[0] + 0.01)
    # Scaled by hand: the mesh of a scaled geometry.
    larger = HandLikelihood(triangle_hand(GEOMETRY.scaled(1.1)), jnp.asarray(1.0), 0.1, union, gibbs_abs)
    np.testing.assert_allclose(jax.jit(larger.cost)(POSE, image), costs[1], atol=1e-5)


@pytest.mark.parametrize("digit", range(5))
def test_a_digit_whose_outer_joints_have_no_reading_is_hidden_and_no_other(digit):
    joints = forward_kinematics(POSE, GEOMETRY).joints
    camera = Pinhole.from_intrinsics((270.0, 285.0), (192.0, 156.0), (318, 384))  # fingers are more than a hole apart
    depth = np.array(render(camera, POSE))
    u, v = np.moveaxis(np.asarray(camera.project(joints[2 + 4 * digit : 5 + 4 * digit])), -1, 0)
    rows, cols = np.mgrid[: depth.shape[0], : depth.shape[1]]
    for at in zip(u, v, strict=True):
        depth[np.hypot(cols - at[0], rows - at[1]) < HOLE] = np.nan
    hidden = np.asarray(hidden_digits(hand_image(camera, jnp.asarray(depth)), joints))
    np.testing.assert_array_equal(hidden, np.arange(5) == digit)


@pytest.mark.parametrize(("move", "expected"), [((0.0, 0.0, 0.0), False), ((1.0, 0.0, 0.0), True)])
def test_a_hand_that_is_read_is_not_hidden_and_one_beyond_the_window_is(move, expected):
    joints = forward_kinematics(POSE, GEOMETRY).joints + jnp.asarray(move)
    depth = np.array(render(CAMERA, POSE))
    depth[::2] = np.nan  # rows that a sensor has left out
    assert np.all(hidden_digits(hand_image(CAMERA, jnp.asarray(depth)), joints) == expected)
