"""Hand motion with known truth: the random walks of the paper's data A and B, and a scripted gesture.

Source: Kajihara and Tanaka, section 7, equations [66], [67]. All motions start from the open palm at `START` before
the first frame and return the poses of the frames, (T, 22).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt16

from jaxfilters._xla.compiled_quickly import compiled_fully, compiled_quickly
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.skeleton import (
    ANGLE_LIMITS,
    TANGENT_SIZE,
    HandGeometry,
    forward_kinematics,
    hand_geometry,
    open_palm,
    retract,
)
from jaxfilters.models.rendering.depth import capsule_depth
from jaxfilters.models.synthetic.depth_sensor import DepthSensor
from jaxfilters.typing import AnyKey

START = (0.0, 0.09, 0.7)
"""Wrist position before the first frame, metres."""
FRAME_INTERVAL = 1 / 30
WRIST_BOUNDS = np.array([(-0.12, 0.12), (0.0, 0.16), (0.55, 0.85)])
"""Where the wrist of the random walks stays, (3, 2), metres."""

POSE_STEP_STD = np.repeat([0.002, 2 * 0.008, math.radians(2)], (3, 3, 15))
"""Noise of data A in one frame, tangent space: metres, radians. A quaternion moves by half a rotation vector."""
INITIAL_VELOCITY_STD = np.repeat([0.08, 2 * 0.15, math.radians(25)], (3, 3, 15))
"""Per second, tangent space."""
VELOCITY_STEP_STD = np.repeat([0.02, 2 * 0.05, math.radians(12)], (3, 3, 15))
"""Noise of the velocity in one frame as the filters assume it; data B moves with half of it."""
VELOCITY_DECAY = 0.97

CIRCLE_RADIUS = 0.06
FREQUENCY = 0.25
LARGEST_FLEXION = math.radians(80)


@partial(compiled_quickly, static_argnames=("num_frames", "dt"))
def simulate_poses_a(key: AnyKey, num_frames: int = 150, dt: float = FRAME_INTERVAL) -> Float[Array, "{num_frames} 22"]:
    """Data A: a random walk of the pose [66], reflected at the joint limits and at `WRIST_BOUNDS`.

    The noise in a frame of `dt` seconds has the variance `POSE_STEP_STD ** 2 * dt / FRAME_INTERVAL`.
    """
    pose = open_palm(jnp.array(START, dtype=float))
    std = jnp.asarray(POSE_STEP_STD * math.sqrt(dt / FRAME_INTERVAL), dtype=pose.dtype)

    def advance(pose, noise):
        pose, _ = _reflect_pose(retract(pose, std * noise))
        return pose, pose

    return jax.lax.scan(advance, pose, jax.random.normal(key, (num_frames, TANGENT_SIZE), pose.dtype))[1]


@partial(compiled_quickly, static_argnames=("num_frames", "dt"))
def simulate_poses_b(key: AnyKey, num_frames: int = 150, dt: float = FRAME_INTERVAL) -> Float[Array, "{num_frames} 22"]:
    """Data B: the pose integrates a damped random walk of its velocity [67], reflected at the same bounds as data A.

    A velocity that is reflected changes its sign. The pose has no noise of its own.
    """
    initial_key, walk_key = jax.random.split(key)
    pose = open_palm(jnp.array(START, dtype=float))
    velocity = jnp.asarray(INITIAL_VELOCITY_STD, pose.dtype) * jax.random.normal(
        initial_key, (TANGENT_SIZE,), pose.dtype
    )
    std = jnp.asarray(0.5 * VELOCITY_STEP_STD * math.sqrt(dt / FRAME_INTERVAL), dtype=pose.dtype)
    decay = VELOCITY_DECAY ** (dt / FRAME_INTERVAL)

    def advance(carry, noise):
        pose, velocity = carry
        pose, sign = _reflect_pose(retract(pose, dt * velocity))
        return (pose, sign * decay * velocity + std * noise), pose

    noise = jax.random.normal(walk_key, (num_frames, TANGENT_SIZE), pose.dtype)
    return jax.lax.scan(advance, (pose, velocity), noise)[1]


@partial(compiled_quickly, static_argnames=("num_frames", "dt"))
def simulate_poses_scripted(
    key: AnyKey, num_frames: int = 240, dt: float = FRAME_INTERVAL
) -> Float[Array, "{num_frames} 22"]:
    """The wrist goes round a circle of 60 mm radius in 4 s, then the fingers bend to 80 degrees and back every 4 s.

    Not the thumb. Bending are MCP and PIP of each finger, by the same angle. The same for every key.
    """
    del key
    period = 1 / FREQUENCY
    pose = open_palm(jnp.array(START, dtype=float))
    time = dt * jnp.arange(1, num_frames + 1, dtype=pose.dtype)
    phase = 2 * math.pi * FREQUENCY * time
    circling = jnp.where(time < period, 1.0, 0.0)
    across = circling * CIRCLE_RADIUS * (jnp.cos(phase) - 1)
    down = circling * CIRCLE_RADIUS * jnp.sin(phase)
    flexion = (1 - circling) * LARGEST_FLEXION * 0.5 * (1 - jnp.cos(phase))
    poses = jnp.broadcast_to(pose, (num_frames, len(pose)))
    poses = poses.at[:, 0].add(across).at[:, 1].add(down)
    for first in (10, 13, 16, 19):
        poses = poses.at[:, first].set(flexion).at[:, first + 2].set(flexion)
    return poses


def kinect_v2() -> Pinhole:
    """Depth camera of the second Kinect: 512 x 424 pixels, focal length 365."""
    return Pinhole.from_intrinsics((365.0, 365.0), (255.5, 211.5), (424, 512))


class HandSequence(NamedTuple):
    """A depth video of one hand and its truth."""

    poses: Float[Array, "t 22"]
    joints: Float[Array, "t 21 3"]
    """Metres, camera frame, in the order of `JOINT_NAMES`."""
    depth_mm: UInt16[Array, "t rows cols"]
    """Millimetres along z, 0 = no reading."""


class Motion(NamedTuple):
    """How a kind of sequence moves, how long it lasts and what sees it."""

    simulate_poses: Callable[..., Array]
    num_frames: int
    sensor: DepthSensor


MOTIONS = {
    "A": Motion(simulate_poses_a, 150, DepthSensor()),
    "B": Motion(simulate_poses_b, 150, DepthSensor()),
    "scripted": Motion(simulate_poses_scripted, 240, DepthSensor(flying_fraction=0.02, dropout_fraction=0.02)),
}
"""The experiments E1, E2 and E3."""


def simulate_sequence(
    key: AnyKey,
    kind: str,
    *,
    num_frames: int | None = None,
    dt: float = FRAME_INTERVAL,
    geometry: HandGeometry | None = None,
    camera: Pinhole | None = None,
    sensor: DepthSensor | None = None,
) -> HandSequence:
    """A sequence of one of the `MOTIONS`, rendered from capsules and observed by a depth sensor.

    Frame `i` is at time `(i + 1) * dt` seconds after the open palm at `START`. What is not given is the default of
    the kind, the average hand and a second Kinect.

    Raises:
        ValueError: if `kind` is not one of `MOTIONS`, `num_frames` < 1 or `dt` <= 0.
    """
    if kind not in MOTIONS:
        raise ValueError(f"kind must be one of {', '.join(MOTIONS)}; got {kind!r}.")
    motion = MOTIONS[kind]
    num_frames = motion.num_frames if num_frames is None else num_frames
    if num_frames < 1:
        raise ValueError(f"num_frames must be 1 or more; got {num_frames}.")
    if not dt > 0:
        raise ValueError(f"dt must be positive (seconds); got {dt}.")
    pose_key, sensor_key = jax.random.split(key)
    poses = motion.simulate_poses(pose_key, num_frames, dt)
    geometry, camera = geometry or hand_geometry(), camera or kinect_v2()
    return film_hand(sensor_key, poses, geometry, camera, sensor or motion.sensor)


@compiled_fully
def film_hand(
    key: AnyKey, poses: Float[Array, "t 22"], geometry: HandGeometry, camera: Pinhole, sensor: DepthSensor
) -> HandSequence:
    """The sequence that a depth sensor records of a hand in these poses."""

    def film(inputs):
        frame_key, pose = inputs
        kinematics = forward_kinematics(pose, geometry)
        return kinematics.joints, sensor.sense(frame_key, capsule_depth(camera, kinematics.capsules))

    joints, depth_mm = jax.lax.map(film, (jax.random.split(key, len(poses)), poses))
    return HandSequence(poses, joints, depth_mm)


def _reflect_pose(pose):
    """The pose with wrist and angles folded into their bounds, and the signs (21,) their velocities take on."""
    low, high = jnp.asarray(np.concatenate([WRIST_BOUNDS, ANGLE_LIMITS]), dtype=pose.dtype).T
    folded, sign = _reflect(jnp.concatenate([pose[:3], pose[7:]]), low, high)
    signs = jnp.concatenate([sign[:3], jnp.ones(3, pose.dtype), sign[3:]])
    return jnp.concatenate([folded[:3], pose[3:7], folded[3:]]), signs


def _reflect(value, low, high):
    """`value` folded into [low, high] as by mirrors at both ends, and the sign a velocity takes on."""
    width = high - low
    phase = jnp.mod(value - low, 2 * width)
    direct = phase < width
    return low + jnp.where(direct, phase, 2 * width - phase), jnp.where(direct, 1.0, -1.0).astype(value.dtype)
