r"""Adaptive diffusion: the standard deviation of a velocity change as a linear function of the speed.

The error of a constant-velocity prediction is the change of the velocity. Its standard deviation grows with the speed,
$\delta = A |v| + b$, and the coefficients are estimated online from the observed changes by recursive least squares
(Y. Sugano, "User-independent techniques for real-time estimation of non-rigid 3D head motion", master's thesis, The
University of Tokyo, 2007, section 3.3; see also K. Oka, Y. Sato, Y. Nakanishi and H. Koike, "Head pose estimation
system based on particle filtering with adaptive diffusion control", IAPR Conference on Machine Vision Applications,
2005).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host

GAMMA = math.sqrt(math.pi / 2)
"""Ratio of the standard deviation of a centred Gaussian to its mean absolute value."""


@pytree_dataclass
class DiffusionFit:
    """A linear regression of the diffusion on the speed, in dimensionless numbers."""

    coefficients: Float[Array, "d+1 d"]
    """One column for each coordinate: its dependence on the d speeds, then the constant, all relative to `scale`."""
    covariance: Float[Array, "d+1 d+1"]
    """Covariance of every column of the coefficients, relative to the variance of the regressed numbers."""
    scale: Float[Array, " d"]
    """A typical speed of each coordinate, in its unit per unit of time."""
    strength: Float[Array, ""]
    """Number of observations to which the initial coefficients are equivalent."""

    @property
    def slope(self) -> Float[Array, "d d"]:
        """The matrix A of `A |v| + b`, in the units of the coordinates."""
        return self.scale[:, None] * self.coefficients[:-1].T / self.scale

    @property
    def offset(self) -> Float[Array, " d"]:
        """The vector b of `A |v| + b`, in the units of the coordinates per unit of time."""
        return self.scale * self.coefficients[-1]


def start(
    scale: Float[Array, " d"], *, slope: float = 1.0, offset: float = 1.0, strength: float = 10.0
) -> DiffusionFit:
    """The fit before the first observation: `A = slope I` and `b = offset scale`.

    Args:
        scale: (d,): a typical speed of each coordinate, in its unit per unit of time.
        slope: Initial slope; 0 together with `fixed` is a diffusion that does not depend on the speed.
        offset: Initial constant, in units of `scale`.
        strength: Number of observations at a speed of `scale` to which the initial coefficients are equivalent.

    Raises:
        ValueError: If `scale` is not a vector, or `scale` or `strength` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import diffusion
        >>> fit = diffusion.start(jnp.array([2.0]))
        >>> print(diffusion.velocity_change_std(fit, jnp.array([3.0])))
        [5.]
    """
    scale = from_host(scale)
    if scale.ndim != 1:
        raise ValueError(f"scale must be a vector (d,); got {scale.shape}.")
    check_positive("scale", scale)
    check_positive("strength", strength)
    size = scale.shape[0]
    # NumPy makes the constants: each would otherwise be a program of its own.
    last = np.zeros((size + 1, size))
    last[-1] = 1.0
    coefficients = from_host(slope * np.eye(size + 1, size) + offset * last)
    covariance = from_host(np.eye(size + 1) / strength)
    return DiffusionFit(coefficients, covariance, scale, from_host(strength))


def update(
    fit: DiffusionFit,
    velocity: Float[Array, " d"],
    velocity_change: Float[Array, " d"],
    *,
    forgetting: float | Float[Array, ""] = 1.0,
) -> DiffusionFit:
    r"""The fit after one more step, by recursive least squares.

    With $z = (|v|, 1)$ and the target $\hat\delta = \gamma |c|$, both relative to `scale`: $g = P z / (1 + z^T P z)$,
    $\Theta \leftarrow \Theta + g (\hat\delta^T - z^T \Theta)$, $P \leftarrow P - g z^T P$. Without forgetting this is
    exactly ridge regression towards the initial coefficients.

    Args:
        fit: The fit so far.
        velocity: (d,): the velocity v before the step.
        velocity_change: (d,): c, the velocity after the step minus that before it.
        forgetting: Factor by which the weight of earlier steps decreases at every step, from 0.5 to 1. The covariance
            never exceeds the initial one, $P \leftarrow P + (1 / \lambda - 1)(P - s P P)$ with the initial strength
            $s$: a target at rest yields no information about the slope, and $P / \lambda$ would overflow.

    Returns:
        The fit; the unchanged one if a velocity or a change is not finite.

    Raises:
        ValueError: If a vector is not (d,).

    Examples:
        Ten steps at rest with small changes make the constant smaller.

        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import diffusion
        >>> fit = diffusion.start(jnp.array([1.0]), strength=1.0)
        >>> for _ in range(10):
        ...     fit = diffusion.update(fit, jnp.array([0.0]), jnp.array([0.1]))
        ...
        >>> round(float(fit.offset[0]), 2)
        0.2
    """
    for name, vector in (("velocity", velocity), ("velocity_change", velocity_change)):
        if jnp.shape(vector) != fit.scale.shape:
            raise ValueError(f"{name} must be {fit.scale.shape}, the shape of scale; got {jnp.shape(vector)}.")
    z, target = _regressor(fit, velocity), GAMMA * jnp.abs(velocity_change) / fit.scale
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


def fixed(fit: DiffusionFit, velocity: Float[Array, " d"], velocity_change: Float[Array, " d"]) -> DiffusionFit:
    """The unchanged fit, in place of `update`, for coefficients that are not estimated.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import diffusion
        >>> fit = diffusion.start(jnp.array([1.0]), slope=0.0)
        >>> print(diffusion.fixed(fit, jnp.array([3.0]), jnp.array([0.5])).offset)
        [1.]
    """
    del velocity, velocity_change
    return fit


def velocity_change_std(
    fit: DiffusionFit,
    velocity: Float[Array, " d"],
    *,
    low: float | Float[Array, " d"] = 0.0,
    high: float | Float[Array, " d"] = math.inf,
) -> Float[Array, " d"]:
    """The standard deviation `A |v| + b` of the next velocity change, clipped to `low` and `high`.

    Args:
        fit: The fit.
        velocity: (d,): the present velocity v.
        low: Lower limit, in the units of the coordinates per unit of time.
        high: Upper limit.

    Returns:
        (d,).

    Raises:
        ValueError: If `velocity` is not (d,).

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import diffusion
        >>> fit = diffusion.start(jnp.array([2.0]), slope=0.5)
        >>> print(diffusion.velocity_change_std(fit, jnp.array([-4.0])))
        [4.]
        >>> print(diffusion.velocity_change_std(fit, jnp.array([-4.0]), high=3.0))
        [3.]
    """
    if jnp.shape(velocity) != fit.scale.shape:
        raise ValueError(f"velocity must be {fit.scale.shape}, the shape of scale; got {jnp.shape(velocity)}.")
    return jnp.clip(fit.scale * _product(fit.coefficients.T, _regressor(fit, velocity)), low, high)


def _regressor(fit: DiffusionFit, velocity: Array) -> Array:
    return jnp.append(jnp.abs(velocity) / fit.scale, 1.0)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def check_positive(name: str, value: float | Array) -> None:
    """Reject numbers that are not positive, where they are known before a program runs.

    Raises:
        ValueError: If a number is zero, negative or NaN.
    """
    if not isinstance(value, jax.core.Tracer) and not np.all(np.asarray(value) > 0):
        raise ValueError(f"{name} must be positive; got {value}.")
