import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.skeleton import ANGLE_LIMITS, forward_kinematics, hand_geometry, local, mirrored, open_palm
from jaxfilters.models.synthetic.depth_sensor import DepthSensor
from jaxfilters.models.synthetic.hand import (
    FRAME_INTERVAL,
    INITIAL_VELOCITY_STD,
    POSE_STEP_STD,
    START,
    VELOCITY_DECAY,
    VELOCITY_STEP_STD,
    WRIST_BOUNDS,
    kinect_v2,
    simulate_poses_a,
    simulate_poses_b,
    simulate_poses_scripted,
    simulate_sequence,
)

RANDOM_WALKS = {"A": simulate_poses_a, "B": simulate_poses_b}
MOTIONS = {**RANDOM_WALKS, "scripted": simulate_poses_scripted}


def displacements(poses):
    """Tangent vectors from each pose to the next, the first from the start: (t, 21)."""
    poses = jnp.concatenate([open_palm(jnp.asarray(START, poses.dtype))[None], poses])
    return jax.vmap(local)(poses[:-1], poses[1:])


@pytest.mark.system
@pytest.mark.parametrize("kind", MOTIONS)
def test_quaternions_are_unit_and_bounds_are_kept(kind):
    poses = np.asarray(MOTIONS[kind](jax.random.key(1), 600))
    assert poses.shape == (600, 22)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:7], axis=1), 1, atol=1e-6)
    rounding = 1e-6
    angles, wrist = poses[:, 7:], poses[:, :3]
    assert np.all((angles >= ANGLE_LIMITS[:, 0] - rounding) & (angles <= ANGLE_LIMITS[:, 1] + rounding))
    assert np.all((wrist >= WRIST_BOUNDS[:, 0] - rounding) & (wrist <= WRIST_BOUNDS[:, 1] + rounding))


@pytest.mark.system
@pytest.mark.parametrize("kind", RANDOM_WALKS)
def test_a_key_decides_the_motion(kind):
    simulate = RANDOM_WALKS[kind]
    np.testing.assert_array_equal(simulate(jax.random.key(1), 20), simulate(jax.random.key(1), 20))
    assert not np.allclose(simulate(jax.random.key(1), 20), simulate(jax.random.key(2), 20))


def test_data_a_spreads_with_time_whatever_the_frame_interval():
    keys = jax.random.split(jax.random.key(1), 2000)
    ends = jax.vmap(lambda key: simulate_poses_a(key, 6, FRAME_INTERVAL / 2)[-1, :3] - jnp.array(START))(keys)
    ratio = np.mean(np.asarray(ends) ** 2, axis=0) / (3 * POSE_STEP_STD[:3] ** 2)
    np.testing.assert_allclose(ratio, 1, atol=4 * np.sqrt(2 / 2000))


@pytest.mark.system
def test_data_b_integrates_a_damped_random_walk_of_its_velocity():
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(2), 40)
        poses = jax.vmap(lambda key: simulate_poses_b(key, 50))(keys)
        velocity = np.asarray(jax.vmap(displacements)(poses)) / FRAME_INTERVAL
    # Wrist and rotation only: there are reflections among the angles from the first frame on.
    velocity = velocity[..., :6]
    change = velocity[:, 1:] - VELOCITY_DECAY * velocity[:, :-1]
    inside = np.abs(change) < 6 * 0.5 * VELOCITY_STEP_STD[:6]
    # What is left out are reflections of the wrist, no noise: 6 sigma happen once in 5e8 draws.
    assert inside.mean() > 0.98
    for i in range(6):
        noise = change[..., i][inside[..., i]]
        ratio = np.mean(noise**2) / (0.5 * VELOCITY_STEP_STD[i]) ** 2
        assert abs(ratio - 1) < 4 * np.sqrt(2 / noise.size), (i, ratio)
    # 40 sequences: their first displacement is the initial velocity.
    np.testing.assert_allclose(
        np.mean(velocity[:, 0] ** 2, axis=0) / INITIAL_VELOCITY_STD[:6] ** 2, 1, atol=4 * np.sqrt(2 / 40)
    )


def test_scripted_motion_is_the_circle_and_then_the_fist():
    poses = np.asarray(simulate_poses_scripted(jax.random.key(0), 240))
    circle, bending = poses[:119], poses[120:]
    center = np.array(START) - (0.06, 0, 0)
    np.testing.assert_allclose(np.linalg.norm(circle[:, :3] - center, axis=1), 0.06, atol=1e-6)
    assert np.all(circle[:, 7:] == 0)
    speed = np.linalg.norm(np.diff(circle[:, :3], axis=0), axis=1) / FRAME_INTERVAL
    # A chord is shorter than its arc by 1 / 24 of the square of the angle, 2.7e-3 here at 0.052 rad: below 2e-4.
    np.testing.assert_allclose(speed, 2 * np.pi * 0.25 * 0.06, rtol=2e-4)
    np.testing.assert_allclose(bending[:, :3], np.broadcast_to(START, (120, 3)), atol=1e-6)
    fingers = bending[:, 10:].reshape(120, 4, 3)
    assert np.rad2deg(fingers[59, :, [0, 2]]) == pytest.approx(80, abs=1e-3)
    assert np.all(fingers[..., 1] == 0)
    assert np.all(bending[:, 7:10] == 0)
    assert np.abs(fingers[-1]).max() < 1e-5


@pytest.mark.system
@pytest.mark.parametrize("kind", MOTIONS)
def test_sequence_shows_the_true_hand_before_a_wall(kind):
    sequence = simulate_sequence(jax.random.key(3), kind, num_frames=3)
    camera = kinect_v2()
    assert sequence.depth_mm.shape == (3, 424, 512)
    assert sequence.depth_mm.dtype == jnp.uint16
    for pose, joints, image in zip(sequence.poses, sequence.joints, np.asarray(sequence.depth_mm), strict=True):
        np.testing.assert_allclose(joints, forward_kinematics(pose, hand_geometry()).joints, atol=1e-6)
        digits = joints[1:]
        uv = np.round(np.asarray(camera.project(digits))).astype(int)
        observed = image[uv[:, 1], uv[:, 0]] / 1000.0
        # Each joint is at most a radius (14 mm) and the noise behind the surface, and nothing of the hand is 60 mm
        # before another part in an almost open hand. A dropped or flying pixel may lie on one of the 20 joints.
        behind = np.asarray(digits[:, 2]) - observed
        assert np.sum((behind > -0.01) & (behind < 0.06)) >= 19
        hand = (image > 400) & (image < 1000)
        assert 3000 < hand.sum() < 8000
        assert abs(np.mean(image > 2900) - 1) < 0.06


@pytest.mark.system
def test_sequence_takes_another_hand_camera_and_sensor():
    camera = kinect_v2().crop(jnp.array([150.0, 100.0]), (200, 220))
    sequence = simulate_sequence(
        jax.random.key(3),
        "scripted",
        num_frames=1,
        geometry=mirrored(hand_geometry()),
        camera=camera,
        sensor=DepthSensor(noise_std=0.0, background=2.0),
    )
    image = np.asarray(sequence.depth_mm[0])
    assert image.shape == (200, 220)
    assert np.all((image == 2000) | (image < 750))
    wrist_u = float(camera.project(sequence.joints[0, 0])[0])
    columns = np.nonzero((image < 1000).any(axis=0))[0]
    # The thumb of a left hand is on the left: the silhouette reaches farther out there.
    assert wrist_u - columns.min() > columns.max() - wrist_u


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("C", {}, "kind must be one of A, B, scripted"),
        ("A", dict(num_frames=0), "num_frames must be 1 or more"),
        ("B", dict(dt=0.0), "dt must be positive"),
        ("B", dict(dt=float("nan")), "dt must be positive"),
    ],
)
def test_bad_options_are_refused(kind, options, message):
    with pytest.raises(ValueError, match=message):
        simulate_sequence(jax.random.key(1), kind, **options)
