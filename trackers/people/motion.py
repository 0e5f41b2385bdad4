"""How people move between frames: steady velocity with white acceleration, sizes that hardly change."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.motion.models import constant_velocity
from jaxfilters.trackers.people.state import HEIGHT, STATE, WIDTH, PeopleConfig

HEIGHT_DRIFT, WIDTH_DRIFT = 0.01, 0.05
"""Metres per root second: posture; arms, stride and which side is visible."""


def motion(config: PeopleConfig, dt: Float[Array, ""]) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """Transition matrix and noise covariance of `dt` seconds.

    Y. Bar-Shalom et al., "Estimation with applications to tracking and navigation", 2001, section 6.2.2.
    """
    walk = constant_velocity(config.acceleration_sd**2, dims=2).discretize(dt)
    F = jnp.eye(STATE).at[:4, :4].set(walk.F)
    Q = jnp.zeros((STATE, STATE)).at[:4, :4].set(walk.Q)
    return F, Q.at[HEIGHT, HEIGHT].set(HEIGHT_DRIFT**2 * dt).at[WIDTH, WIDTH].set(WIDTH_DRIFT**2 * dt)
