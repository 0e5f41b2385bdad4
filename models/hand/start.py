"""Find a hand without knowing where it was: many hypotheses, each pulled onto the image, the best one kept."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.math.lie import quaternion_multiply, quaternion_to_matrix, so3_exp
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.motion import per_coordinate
from jaxfilters.models.hand.observation import REACH, HandLikelihood, hand_image
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, register, target_from_image

PALM_TO_WRIST = 0.055
"""Metres from the middle of the palm to the wrist of an average hand."""
WRIST_TO_CUT = 0.065
"""Metres from the middle of the palm beyond which a reading is forearm."""
GESTURES = np.deg2rad(
    [
        [0.0] * 15,
        [10.0, 10.0, 0.0] + [25.0, 0.0, 35.0] * 4,
        [30.0, 30.0, 0.0] + [75.0, 0.0, 90.0] * 4,
    ]
)
"""Joint angles of an open, a relaxed and a closed hand, (3, 15)."""
NUM_ROLLS = 12
SCALES = (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15)
NUM_FINALISTS = 8
REGISTRATION_STRIDE, JUDGING_STRIDE = 4, 2
"""Every how many pixels of the window one is used."""
SIZE_STD = 0.1
"""Of the logarithm of the size of hands."""
UNUSUAL_SIZE = 0.002
"""Metres of cost that a hand one such standard deviation off the average must gain."""
COARSE = RegistrationConfig(widths=(0.04,) * 6 + (0.02,) * 6)
FINE = RegistrationConfig(widths=(0.02,) * 3 + (0.01,) * 5)


class Sighting(NamedTuple):
    """What a detector says about a hand in a frame."""

    center: Float[Array, " 3"]
    """Middle of the palm, metres, camera frame."""
    forearm: Float[Array, " 3"]
    """Unit vector from the palm to the forearm; zero where none was observed."""


class Start(NamedTuple):
    """The best hypothesis."""

    pose: Float[Array, " 22"]
    scale: Float[Array, ""]
    """Size of the hand relative to the average one."""
    cost: Float[Array, ""]
    """Metres; the largest possible where nothing fits."""


def isolate_sighting(
    camera: Pinhole, observed: Float[Array, "rows cols"], sighting: Sighting
) -> Float[Array, "rows cols"]:
    """The readings near the palm, without the forearm; background where they are farther away, else unknown."""
    points = camera.rays() * jnp.where(jnp.isfinite(observed), observed, 0.0)[..., None]
    offset = points - sighting.center
    outside = jnp.sum(offset**2, axis=-1) > REACH**2
    arm = offset @ sighting.forearm > WRIST_TO_CUT
    kept = jnp.where(outside | arm, jnp.nan, observed)
    return jnp.where(observed > sighting.center[2] + REACH, jnp.inf, kept)


def starting_poses(sighting: Sighting) -> Float[Array, "h 22"]:
    """Hypotheses: rolls about the optical axis, palm or back to the camera, three gestures.

    With a forearm in view the rolls stay within 50 degrees of it, else they go all the way round.
    """
    forearm = sighting.forearm
    seen = jnp.any(forearm != 0)
    toward = jnp.where(seen, jnp.arctan2(-forearm[0], jnp.where(seen, forearm[1], 1.0)), 0.0)
    fan = jnp.linspace(-1.0, 1.0, NUM_ROLLS) * math.radians(50)
    circle = jnp.arange(NUM_ROLLS) * (2 * math.pi / NUM_ROLLS)
    rolls = toward + jnp.where(seen, fan, circle)

    def hypothesis(roll: Array, flip: Array, angles: Array) -> Array:
        rotation = quaternion_multiply(
            so3_exp(roll * jnp.array([0.0, 0.0, 1.0])), so3_exp(flip * jnp.array([0.0, 1.0, 0.0]))
        )
        wrist = sighting.center + PALM_TO_WRIST * quaternion_to_matrix(rotation)[:, 1]
        return jnp.concatenate([wrist, rotation, angles])

    over_gestures = jax.vmap(hypothesis, in_axes=(None, None, 0))
    over_flips = jax.vmap(over_gestures, in_axes=(None, 0, None))
    poses = jax.vmap(over_flips, in_axes=(0, None, None))(
        rolls, jnp.array([0.0, math.pi]), jnp.asarray(GESTURES, dtype=float)
    )
    return poses.reshape(-1, poses.shape[-1])


def find_start(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    sighting: Sighting,
    likelihood: HandLikelihood,
    scales: Float[Array, " s"],
) -> Start:
    """The hypothesis and the size of hand, one of `scales`, that explain the image best after registration.

    `observed` is a window of `camera`, metres, NaN without a reading; `likelihood` that of the average hand. Every
    hypothesis is registered on every fourth pixel and judged on every second one: coarser pixels mistake the back of a
    hand for its palm.
    """
    observed = isolate_sighting(camera, observed, sighting)
    coarse_camera, coarse = _every(REGISTRATION_STRIDE, camera, observed)
    target = target_from_image(coarse_camera, coarse)
    image = hand_image(*_every(JUDGING_STRIDE, camera, observed))
    root = jnp.diag(per_coordinate(0.06, 0.6, 0.6))

    def pull(pose: Array, scale: Array, config: RegistrationConfig) -> Array:
        geometry = likelihood.geometry.scaled(scale)
        return register(coarse_camera, target, geometry, pose, PosePrior(pose, root), config).pose

    def judge(pose: Array, scale: Array) -> Array:
        return likelihood.scaled(scale).cost(pose, image)

    middle = scales[len(scales) // 2]
    poses = jax.vmap(lambda pose: pull(pose, middle, COARSE))(starting_poses(sighting))
    costs = jax.lax.map(lambda pose: judge(pose, middle), poses)
    finalists = poses[jnp.argsort(costs)[:NUM_FINALISTS]]
    over_sizes = jax.vmap(lambda pose, size: pull(pose, size, FINE), in_axes=(None, 0))
    poses = jax.vmap(over_sizes, in_axes=(0, None))(finalists, scales).reshape(-1, finalists.shape[-1])
    tried = jnp.tile(scales, NUM_FINALISTS)
    costs = jax.lax.map(lambda inputs: judge(*inputs), (poses, tried))
    best = jnp.argmin(costs + UNUSUAL_SIZE * (jnp.log(tried) / SIZE_STD) ** 2)
    return Start(poses[best], tried[best], costs[best])


def _every(stride: int, camera: Pinhole, observed: Array) -> tuple[Pinhole, Array]:
    shape = tuple(size // stride for size in observed.shape)
    return camera.crop(jnp.zeros(2), shape, stride), observed[::stride, ::stride]
