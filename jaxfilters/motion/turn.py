r"""Coordinated turn: motion in a plane at a constant rate of turn.

Y. Bar-Shalom, X. R. Li and T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section
11.7. Positive rates turn to the left, from the first axis to the second.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.motion.discretization import Step, step_length
from jaxfilters.motion.models import _not_negative, constant_velocity

_TERMS = 12
"""Of the power series below: 1 / (2 * 12)! is below the rounding of double precision."""
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Turn by a right angle."""


@pytree_dataclass
class CoordinatedTurn:
    """Turn at a known rate, with white noise acceleration in the plane; made by `coordinated_turn`.

    Examples:
        Half a turn reverses the velocity.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> F, Q = jf.motion.coordinated_turn(jnp.pi, 0.1).discretize(1.0)
        >>> [round(v, 3) for v in jnp.diagonal(F).tolist()], Q.shape
        ([1.0, 1.0, -1.0, -1.0], (4, 4))
    """

    rate: Float[Array, ""]
    """Radians per unit of time."""
    spectral_density: Float[Array, ""]
    """Variance that each component of the velocity gains per unit of time."""

    def discretize(self, dt: ArrayLike) -> Step:
        r"""F and Q of steps of the length `dt`, (...): arrays (..., 4, 4).

        With $a = \omega h$: $F$ moves the place by $h (\operatorname{sinc} a\, I + \frac{1 - \cos a}{a} J) v$ and turns
        the velocity by a. Q integrates $F L L^T F^T$ over the step, in closed form.

        Raises:
            ValueError: If a concrete `dt` is negative or not finite.
        """
        return _steps(self, step_length(dt))

    def transition(self, x: Float[Array, "4"], dt: ArrayLike) -> Float[Array, "4"]:
        """The expected state `(x, y, vx, vy)` after a step; for `jf.extended_kalman`.

        Raises:
            ValueError: If `x` is not (4,), or a concrete `dt` is negative or not finite.
        """
        checks.shaped("x", x, (4,), ", two coordinates of place and velocity")
        return jnp.matmul(self.discretize(dt).F, x, precision="highest")

    def process_noise(self, dt: ArrayLike) -> Float[Array, "4 4"]:
        """Covariance of the noise of a step; for `jf.extended_kalman`.

        Raises:
            ValueError: If a concrete `dt` is negative or not finite.
        """
        return self.discretize(dt).Q


@pytree_dataclass
class UnknownTurn:
    """Turn at a rate that is part of the state and walks at random; made by `unknown_turn`.

    Examples:
        Without a turn, a step of 2 leads straight on.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> jf.motion.unknown_turn(0.1, 0.01).transition(jnp.array([0.0, 0.0, 1.0, 3.0, 0.0]), 2.0).tolist()
        [2.0, 6.0, 1.0, 3.0, 0.0]
    """

    spectral_density: Float[Array, ""]
    """Variance that each component of the velocity gains per unit of time."""
    rate_density: Float[Array, ""]
    """Variance that the rate of turn gains per unit of time."""

    def transition(self, x: Float[Array, "5"], dt: ArrayLike) -> Float[Array, "5"]:
        """The expected state `(x, y, vx, vy, rate)` after a step, a nonlinear function; for `jf.extended_kalman`.

        Raises:
            ValueError: If `x` is not (5,), or a concrete `dt` is negative or not finite.
        """
        checks.shaped("x", x, (5,), ", two coordinates of place and velocity, and the rate of turn")
        F = CoordinatedTurn(x[4], self.spectral_density).discretize(dt).F
        return jnp.append(jnp.matmul(F, x[:4], precision="highest"), x[4]).astype(x.dtype)

    def process_noise(self, dt: ArrayLike) -> Float[Array, "5 5"]:
        """Covariance of the noise of a step, that of constant velocity and of a random walk of the rate.

        Raises:
            ValueError: If a concrete `dt` is negative or not finite.
        """
        h = step_length(dt)
        straight = constant_velocity(self.spectral_density, dims=2).process_noise(h)
        return jax.scipy.linalg.block_diag(straight, (self.rate_density.astype(h.dtype) * h)[None, None])


def coordinated_turn(rate: ArrayLike, spectral_density: ArrayLike) -> CoordinatedTurn:
    """Motion in a plane that turns at a known rate, with the state `(x, y, vx, vy)`.

    The model is linear, and its F and Q are exact for any angle, zero and many turns included.

    Args:
        rate: Radians per unit of time, to the left where positive.
        spectral_density: Variance that each component of the velocity gains per unit of time, not negative.

    Returns:
        The model.

    Raises:
        ValueError: If an argument is not one number, or a concrete one is not finite, or `spectral_density` negative.

    Examples:
        A quarter of a turn about the origin.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> turn = jf.motion.coordinated_turn(jnp.pi / 2, 0.0)
        >>> after = turn.transition(jnp.array([1.0, 0.0, 0.0, jnp.pi / 2]), 1.0)
        >>> [abs(round(value, 3)) for value in after.tolist()]
        [0.0, 1.0, 1.571, 0.0]
    """
    if jnp.shape(rate) != ():
        raise ValueError(f"rate must be one number; got the shape {jnp.shape(rate)}.")
    known = checks.concrete(rate)
    if known is not None and not np.isfinite(known):
        raise ValueError(f"rate must be finite; got {known}.")
    return CoordinatedTurn(jnp.asarray(rate, dtype=float), _one("spectral_density", spectral_density))


def unknown_turn(spectral_density: ArrayLike, rate_density: ArrayLike) -> UnknownTurn:
    """Motion in a plane that turns at an unknown rate, with the state `(x, y, vx, vy, rate)`.

    The transition is nonlinear: exact where the rate is constant during the step. The noise of place and velocity is
    that of constant velocity, which is what it is for short steps.

    Args:
        spectral_density: Variance that each component of the velocity gains per unit of time, not negative.
        rate_density: Variance that the rate of turn gains per unit of time, not negative.

    Returns:
        The model, whose `transition` and `process_noise` are those of a nonlinear filter.

    Raises:
        ValueError: If an argument is not one number, or a concrete one is negative or not finite.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> turn = jf.motion.unknown_turn(0.1, 0.01)
        >>> prior, R = jf.Gaussian(jnp.zeros(5), jnp.eye(5)), 0.01 * jnp.eye(2)
        >>> filter = jf.extended_kalman(prior, turn.transition, turn.process_noise, lambda x: x[:2], R)
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.ones((3, 2)), jnp.full(3, 0.5))
        >>> last.mean.shape
        (5,)
    """
    return UnknownTurn(_one("spectral_density", spectral_density), _one("rate_density", rate_density))


@jax.jit
def _steps(turn: CoordinatedTurn, h: Array) -> Step:
    angle = turn.rate.astype(h.dtype) * h
    eye, J = np.eye(2).astype(h.dtype), _QUARTER.astype(h.dtype)
    scalars = _turned(angle)
    sine, cosine, sinc, versine, third = (value[..., None, None] for value in scalars)
    h, angle = h[..., None, None], angle[..., None, None]
    still = jnp.zeros_like(cosine)
    moved, turned = h * (sinc * eye + angle * versine * J), cosine * eye + sine * J
    F = _blocks((1 + still) * eye, moved, still * eye, turned)
    # (1 - cos a) / a^2 and (a - sin a) / a^3 stay finite for no turn, where Q is that of constant velocity.
    cross = h**2 * (versine * eye - angle * third * J)
    Q = _blocks(2 * h**3 * third * eye, cross, jnp.swapaxes(cross, -1, -2), h * (1 + still) * eye)
    return Step(F, turn.spectral_density.astype(h.dtype) * Q)


def _one(name, value):
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must be one number; got the shape {jnp.shape(value)}.")
    return _not_negative(name, value, 1)


def _turned(a: Array) -> tuple[Array, ...]:
    """Return sin a, cos a, sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3, with derivatives, about zero too."""
    small = jnp.abs(a) < 1
    square = jnp.where(small, a * a, 0.0)
    far = jnp.where(small, 1.0, a)
    sine, cosine = jnp.sin(a), jnp.cos(a)
    sinc = jnp.where(small, _series(square, 1), sine / far)
    versine = jnp.where(small, _series(square, 2), (1 - cosine) / far**2)
    third = jnp.where(small, _series(square, 3), (far - sine) / far**3)
    return sine, cosine, sinc, versine, third


def _series(square: Array, first: int) -> Array:
    """1 / first! - square / (first + 2)! + square^2 / (first + 4)! - ..."""
    total = jnp.zeros_like(square)
    for k in reversed(range(_TERMS)):
        total = total * square + (-1) ** k / math.factorial(first + 2 * k)
    return total


def _blocks(a: Array, b: Array, c: Array, d: Array) -> Array:
    return jnp.concatenate([jnp.concatenate([a, b], axis=-1), jnp.concatenate([c, d], axis=-1)], axis=-2)
