r"""Diffusion that follows the speed: how far a coasting target may stray from where it was headed.

A target that is predicted to go on as it went is wrong by how much its velocity changes. The standard deviation of that
change grows with the speed, $\delta = A |v| + b$, and the regression is learnt from the changes that were seen, while
tracking (K. Oka, Y. Sato et al. 2006, equations 21-24).
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass

GAMMA = math.sqrt(math.pi / 2)
"""Standard deviation of a centred Gaussian over its mean absolute value."""


@pytree_dataclass
class DiffusionFit:
    """A regression of diffusion on speed, in numbers without units."""

    coefficients: Float[Array, "d+1 d"]
    """Of each coordinate, a column: its dependence on every speed, then the constant; everything over `scale`."""
    covariance: Float[Array, "d+1 d+1"]
    """Of every column of the coefficients, over the variance of what is regressed."""
    scale: Float[Array, " d"]
    """Size of a typical velocity in each coordinate's own unit per unit of time."""
    strength: Float[Array, ""]
    """Of the first guess, as `start` was given it."""

    @property
    def slope(self) -> Float[Array, "d d"]:
        """`A` of `A |v| + b`, in the coordinates' own units."""
        return self.scale[:, None] * self.coefficients[:-1].T / self.scale

    @property
    def offset(self) -> Float[Array, " d"]:
        """`b` of `A |v| + b`, in the coordinates' own units per unit of time."""
        return self.scale * self.coefficients[-1]


def start(
    scale: Float[Array, " d"], *, slope: float = 1.0, offset: float = 1.0, strength: float = 10.0
) -> DiffusionFit:
    """The fit before anything was seen: `A = slope I`, and `b = offset scale`.

    Args:
        scale: Size of a typical velocity of each coordinate, in its unit per unit of time.
        slope: Of the first guess; 0 with the fixed fit of `keep` is a diffusion that never adapts.
        offset: Of the first guess, in units of `scale`.
        strength: How many observations at a speed of `scale` the first guess is worth.

    Raises:
        ValueError: If `scale` or `strength` is not positive.
    """
    scale = jnp.asarray(scale, dtype=float)
    check_positive("scale", scale)
    check_positive("strength", strength)
    size = scale.shape[0]
    coefficients = jnp.concatenate([slope * jnp.eye(size, dtype=float), jnp.full((1, size), offset, dtype=float)])
    covariance = jnp.eye(size + 1, dtype=float) / strength
    return DiffusionFit(coefficients, covariance, scale, jnp.asarray(strength, dtype=float))


def update(
    fit: DiffusionFit,
    velocity: Float[Array, " d"],
    change: Float[Array, " d"],
    *,
    forgetting: float | Float[Array, ""] = 1.0,
) -> DiffusionFit:
    r"""The fit after one more step, by recursive least squares.

    With $z = (|v|, 1)$ and the target $\hat\delta = \gamma |c|$, both over `scale`: $g = P z / (1 + z^T P z)$,
    $\Theta \leftarrow \Theta + g (\hat\delta^T - z^T \Theta)$, $P \leftarrow P - g z^T P$ (equations 23 and
    24). Without forgetting this is ridge regression towards the first guess, exactly.

    Args:
        fit: Fit so far.
        velocity: `v` before the step.
        change: `c`, the velocity after the step less that before it: the error of the prediction over the time it took.
        forgetting: Weight of each step for the next one, from 0.5 to 1. Forgetting ends where coefficients are as
            uncertain as they were at first, $P \leftarrow P + (1 / \lambda - 1)(P - s P P)$ with the strength $s$ of
            the first guess: a target that rests for long says nothing of speed, and $P / \lambda$ would overflow.

    Returns:
        The fit; as it was where a velocity or a change is not finite.
    """
    z, target = _regressor(fit, velocity), GAMMA * jnp.abs(change) / fit.scale
    usable = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(target))
    z, target = jnp.where(usable, z, 0.0), jnp.where(usable, target, 0.0)
    Pz = _product(fit.covariance, z)
    gain = Pz / (1 + _product(z, Pz))
    coefficients = fit.coefficients + gain[:, None] * (target - _product(fit.coefficients.T, z))
    covariance = fit.covariance - gain[:, None] * Pz
    forgotten = covariance - fit.strength * _product(covariance, covariance)
    covariance = covariance + (1 / forgetting - 1) * forgotten
    covariance = 0.5 * (covariance + covariance.T)
    return DiffusionFit(
        jnp.where(usable, coefficients, fit.coefficients),
        jnp.where(usable, covariance, fit.covariance),
        fit.scale,
        fit.strength,
    )


def keep(fit: DiffusionFit, velocity: Float[Array, " d"], change: Float[Array, " d"]) -> DiffusionFit:
    """The fit as it is: `A` and `b` are given, not learnt."""
    del velocity, change
    return fit


def spread(
    fit: DiffusionFit,
    velocity: Float[Array, " d"],
    *,
    low: float | Float[Array, " d"] = 0.0,
    high: float | Float[Array, " d"] = math.inf,
) -> Float[Array, " d"]:
    """Standard deviation `A |v| + b` of the next change of velocity, between `low` and `high`."""
    return jnp.clip(fit.scale * _product(fit.coefficients.T, _regressor(fit, velocity)), low, high)


def _regressor(fit: DiffusionFit, velocity: Array) -> Array:
    return jnp.append(jnp.abs(velocity) / fit.scale, 1.0)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def check_positive(name: str, value: float | Array) -> None:
    """Reject what is not above zero.

    Raises:
        ValueError: If any number is zero, negative or NaN.
    """
    if not np.all(np.asarray(value) > 0):
        raise ValueError(f"{name} must be positive; got {value}.")
