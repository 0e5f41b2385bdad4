"""How a hand moves between two frames: a pose driven by a velocity that is damped and pushed at random."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host
from jaxfilters.models.hand.skeleton import TANGENT_SIZE
from jaxfilters.particle.rao_blackwell import MixedDynamics

PER_COORDINATE = (3, 3, 15)
"""Tangent coordinates of wrist position, wrist rotation and joint angles."""


@pytree_dataclass
class HandMotion:
    """Pose and velocity as the nonlinear and the linear state of a Rao-Blackwellized filter.

    The velocity is a damped random walk, Kajihara and Tanaka eqs. [44]-[46] where the damping rates are zero. Arrays
    are `(21,)`, in the tangent space of the pose: metres, radians, radians.
    """

    pose_variance_rate: Float[Array, "..."]
    """Q_n, per second."""
    velocity_variance_rate: Float[Array, "..."]
    """Q_l, per second."""
    damping_rate: Float[Array, "..."]
    """1 / tau: the velocity falls to 1/e in `tau` seconds."""

    def dynamics(self, pose: Float[Array, " 22"], dt: Float[Array, ""]) -> MixedDynamics:
        """One step of `dt` seconds."""
        decay = jnp.exp(-self.damping_rate * dt)
        damped = self.damping_rate * dt > 1e-4
        # The distance covered by a damped unit velocity; long gaps between frames stay bounded.
        reach = jnp.where(damped, (1 - decay) / jnp.where(damped, self.damping_rate, 1.0), dt)
        return MixedDynamics(
            f_n=pose,
            A_n=jnp.diag(reach),
            Q_n=jnp.diag(dt * self.pose_variance_rate),
            f_l=jnp.zeros(TANGENT_SIZE, pose.dtype),
            A_l=jnp.diag(decay),
            Q_l=jnp.diag(dt * self.velocity_variance_rate),
        )

    def walk(self, pose: Float[Array, " 22"], dt: Float[Array, ""]) -> MixedDynamics:
        """One step of `dt` seconds of the pose alone: the same model with a linear state of no dimensions."""
        step = self.dynamics(pose, dt)
        none = jnp.zeros((0, 0), pose.dtype)
        return step._replace(A_n=jnp.zeros((TANGENT_SIZE, 0), pose.dtype), f_l=none[0:0].reshape(0), A_l=none, Q_l=none)


def per_coordinate(position: float, rotation: float, angle: float) -> Float[Array, " 21"]:
    """One number for each of wrist position, wrist rotation and joint angles, spread over the tangent space."""
    return from_host(np.repeat([position, rotation, angle], PER_COORDINATE))


def paper_motion(frame_interval: float = 1 / 30) -> HandMotion:
    """The noise of the synthetic recordings, with undamped velocities: 2 mm, 0.016 rad and 2 degrees a frame."""
    return HandMotion(
        per_coordinate(0.002, 0.016, math.radians(2)) ** 2 / frame_interval,
        per_coordinate(0.02, 0.1, math.radians(12)) ** 2 / frame_interval,
        per_coordinate(0.0, 0.0, 0.0),
    )
