"""How people move between frames: steady velocity with white acceleration, constant sizes, decaying biases."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.motion.models import constant_velocity
from jaxfilters.trackers.people.state import BIAS, HEIGHT, STATE, WIDTH, PeopleConfig

HEIGHT_DRIFT, WIDTH_DRIFT = 0.01, 0.05
"""Metres per root second: posture; arms, stride and which side is visible."""


def motion(config: PeopleConfig, dt: Float[Array, ""]) -> tuple[Float[Array, "9 9"], Float[Array, "9 9"]]:
    """Transition matrix and noise covariance of `dt` seconds.

    Y. Bar-Shalom et al., "Estimation with applications to tracking and navigation", 2001, section 6.2.2.
    """
    walk = constant_velocity(config.acceleration_sd**2, dims=2).discretize(dt)
    remains = jnp.exp(-dt / config.silhouette_bias_s)
    bias = jnp.zeros(STATE).at[BIAS].set(1.0)
    F = jnp.diag(1 - bias + remains * bias).at[:4, :4].set(walk.F)
    Q = jnp.diag((1 - remains**2) * bias).at[:4, :4].set(walk.Q)
    return F, Q.at[HEIGHT, HEIGHT].set(HEIGHT_DRIFT**2 * dt).at[WIDTH, WIDTH].set(WIDTH_DRIFT**2 * dt)
