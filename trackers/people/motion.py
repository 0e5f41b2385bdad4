"""How people move between frames: steady velocity with white acceleration, sizes that hardly change."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.trackers.people.state import HEIGHT, STATE, WIDTH, PeopleConfig

HEIGHT_DRIFT, WIDTH_DRIFT = 0.01, 0.05
"""Metres per root second: posture; arms, stride and which side is visible."""


def motion(config: PeopleConfig, dt: Float[Array, ""]) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """Transition matrix and noise covariance of `dt` seconds.

    Y. Bar-Shalom et al., "Estimation with applications to tracking and navigation", 2001, section 6.2.2.
    """
    F = jnp.eye(STATE).at[0, 2].set(dt).at[1, 3].set(dt)
    block = config.acceleration_sd**2 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    Q = jnp.zeros((STATE, STATE))
    for axis in (0, 1):
        pair = jnp.array([axis, axis + 2])
        Q = Q.at[jnp.ix_(pair, pair)].set(block)
    return F, Q.at[HEIGHT, HEIGHT].set(HEIGHT_DRIFT**2 * dt).at[WIDTH, WIDTH].set(WIDTH_DRIFT**2 * dt)
