"""How a fingertip moves in the image, and what is known of it: a Kalman filter in units of the measurement noise.

After K. Oka, Y. Sato, H. Koike, "Real-time fingertip tracking and gesture recognition", IEEE Computer Graphics and
Applications 22(6), 2002, and a report of Oka and Sato of 2006, whose equations are cited.

State (x, y, vx, vy) in pixels and pixels a frame; every
covariance is divided by the variance of a measured coordinate, so that it has no unit but frames, a measurement has
the identity as noise, and `q` is the variance of the drive by that of the measurement.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.arithmetic import KalmanInfo
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import linalg
from jaxfilters.motion.models import constant_velocity

STATE = 4
H = np.eye(2, STATE)
"""Oka and Sato 2006, equation 6: a measurement is the position."""
H_VELOCITY = np.eye(2, STATE, 2)
"""Of a measurement of the velocity."""


class Motion(NamedTuple):
    """One frame ahead: `x' = F x + G w`, w ~ N(0, sigma_w^2 I) (Oka and Sato 2006, equation 2)."""

    F: Float[Array, "4 4"]
    G: Float[Array, "4 2"]


def velocity_driven(dt: float | Float[Array, ""] = 1.0) -> Motion:
    """The published motion: noise changes the velocity, and the position only through it.

    Oka and Sato 2006, equations 4 and 5.
    """
    F = constant_velocity(0.0, dims=2).discretize(dt).F
    return Motion(F, jnp.asarray(np.eye(STATE, 2, -2), dtype=float))


def new_belief(
    position: Float[Array, "2"],
    *,
    max_speed: float | Float[Array, ""] = 60.0,
    measurement_sd: float | Float[Array, ""] = 1.5,
) -> Gaussian:
    """Belief in a finger that was measured once: at rest, give or take a uniform speed up to `max_speed`.

    Args:
        position: Pixels.
        max_speed: Of each coordinate, pixels a frame.
        measurement_sd: Of a measured coordinate, pixels.
    """
    speed = jnp.square(jnp.asarray(max_speed, dtype=float) / measurement_sd) / 3
    variances = jnp.stack([jnp.ones_like(speed), jnp.ones_like(speed), speed, speed])
    return Gaussian(jnp.concatenate([position, jnp.zeros_like(position)]), jnp.diag(variances))


def predict(motion: Motion, belief: Gaussian, q: float | Float[Array, ""]) -> Gaussian:
    """Belief one frame later (Oka and Sato 2006, equations 8 and 9); all there is to do in a frame without a match."""
    return arithmetic.joseph.predict(belief, motion.F, _drive(motion, q))


def correct(
    belief: Gaussian, position: Float[Array, "2"], is_observed: Bool[Array, ""] | None = None
) -> tuple[Gaussian, KalmanInfo]:
    """Belief after a measured position, and its diagnostics; as it was where `is_observed` is False.

    Oka and Sato 2006, equations 7 and 8.

    The covariance has Joseph's form, which stays symmetric. `nis` is in units of the measurement's variance.
    """
    mask = None if is_observed is None else jnp.broadcast_to(is_observed, (2,))
    return arithmetic.joseph.update(belief, position, jnp.asarray(H, dtype=float), jnp.eye(2), mask=mask)


def correct_velocity(
    belief: Gaussian, velocity: Float[Array, "2"], variance: float | Float[Array, ""], is_observed: Bool[Array, ""]
) -> Gaussian:
    """Belief after a hint at the velocity, as from the palm that carries the finger; as it was where there is none.

    Args:
        belief: In the state.
        velocity: Pixels a frame.
        variance: Of a coordinate of the hint, divided by that of a measured position.
        is_observed: Whether there is a hint.
    """
    innovation = jnp.where(is_observed, velocity - belief.mean[2:], 0.0)
    found = arithmetic.joseph.condition(
        belief.covariance, jnp.asarray(H_VELOCITY, dtype=float), jnp.eye(2) * variance, innovation
    )
    return Gaussian(belief.mean + found.shift, jnp.where(is_observed, found.covariance, belief.covariance))


def ahead(motion: Motion, belief: Gaussian, q: float | Float[Array, ""], frames: int) -> Gaussian:
    """Belief several frames after a corrected one (Oka and Sato 2006, equations 10 and 11).

    Raises:
        ValueError: If `frames` is not at least 1.
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1; got {frames}.")
    powers = [jnp.eye(STATE)]
    for _ in range(frames):
        powers.append(linalg.matmul(motion.F, powers[-1]))
    driven = jnp.stack([linalg.matmul(power, motion.G) for power in powers[:-1]])
    noise = q * jnp.einsum("lik,ljk->ij", driven, driven, precision="highest")
    return arithmetic.joseph.predict(belief, powers[-1], noise)


def uncertainty(belief: Gaussian) -> Float[Array, "*batch"]:
    """U, the variance of x by that of a measurement, which is that of y too: what confirms and ends a track."""
    return belief.covariance[..., 0, 0]


def innovation_distance(
    belief: Gaussian, position: Float[Array, "2"], measurement_sd: float | Float[Array, ""]
) -> Float[Array, ""]:
    """Squared distance of a measurement from a prediction in standard deviations, chi-square of two (section 2.3).

    Valid because the coordinates do not depend on each other and are equally uncertain.
    """
    difference = position - belief.mean[:2]
    return jnp.sum(jnp.square(difference / measurement_sd)) / (1 + uncertainty(belief))


def _drive(motion, q):
    return q * linalg.matmul(motion.G, motion.G.T)
