r"""Sets of admissible parameter values, each with a smooth bijection to unconstrained coordinates.

The bijections are relative to an origin, the value from which the search started. Only rotations, which have no global
coordinates, and fixed values depend on it.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.math import lie

_UNIT_TOLERANCE = 1e-3
"""Tolerance for the sum of probabilities and the norm of a quaternion, well above float32 rounding."""


@runtime_checkable
class Constraint(Protocol):
    """A set of admissible values and a bijection between them and unconstrained coordinates."""

    @property
    def description(self) -> str:
        """The condition on a value, as it completes "must be ..." in an error message."""
        ...

    @property
    def elementwise(self) -> bool:
        """Whether every number has its own coordinate, of which it is an increasing function."""
        ...

    def contains(self, value: np.ndarray, /) -> bool:
        """Whether the value satisfies the constraint."""
        ...

    def unconstrain(self, value: Array, origin: Array, /) -> Array:
        """The coordinates of a value."""
        ...

    def constrain(self, coordinates: Array, origin: Array, /) -> Array:
        """The value with these coordinates."""
        ...


@dataclass(frozen=True)
class Free:
    """Any finite numbers."""

    description = "finite"
    elementwise = True

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all(np.isfinite(value)))

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del origin
        return value

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return coordinates


@dataclass(frozen=True)
class Positive:
    """Positive numbers; the coordinate is the natural logarithm."""

    description = "positive"
    elementwise = True

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all((value > 0) & np.isfinite(value)))

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del origin
        return jnp.log(value)

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return jnp.exp(coordinates)


@dataclass(frozen=True)
class Interval:
    """Numbers strictly between two bounds; the coordinate is the logit of the relative position."""

    lower: float
    upper: float
    elementwise = True

    @property
    def description(self) -> str:
        """The condition on a value."""
        return f"between {self.lower:g} and {self.upper:g}"

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all((value > self.lower) & (value < self.upper)))

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del origin
        return jnp.log(value - self.lower) - jnp.log(self.upper - value)

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(coordinates)


@dataclass(frozen=True)
class Box(Free):
    """Numbers in a closed interval, for methods that support bounds; each number is its own coordinate."""

    lower: float
    upper: float


@dataclass(frozen=True)
class Simplex:
    """Probabilities along the last axis; the coordinates are log ratios to the last one (additive log ratio)."""

    description = "positive numbers that sum to 1 along the last axis, at least two of them"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        has_two = value.ndim > 0 and value.shape[-1] > 1
        return bool(has_two and np.all(value > 0) and np.all(abs(value.sum(-1) - 1) < _UNIT_TOLERANCE))

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del origin
        logs = jnp.log(value)
        return logs[..., :-1] - logs[..., -1:]

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return jax.nn.softmax(jnp.pad(coordinates, [(0, 0)] * (coordinates.ndim - 1) + [(0, 1)]))


@dataclass(frozen=True)
class PositiveDefinite:
    """Symmetric positive definite matrices; the coordinates are the log-Cholesky factor.

    That is the lower triangle of the Cholesky factor with the logarithm of its diagonal (J. Pinheiro and D. Bates,
    "Unconstrained parametrizations for variance-covariance matrices", Statistics and Computing 6, 1996, section 2.2).
    """

    description = "a symmetric positive definite matrix"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        if value.ndim != 2 or value.shape[0] != value.shape[1] or not np.all(np.isfinite(value)):
            return False
        close = np.allclose(value, value.T, rtol=1e-5, atol=1e-6 * abs(value).max())
        return close and bool(np.all(np.linalg.eigvalsh(value) > 0))

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del origin
        root = jnp.linalg.cholesky(value)
        root = root + jnp.diag(jnp.log(jnp.diagonal(root)) - jnp.diagonal(root))
        return root[np.tril_indices(value.shape[0])]

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        n = origin.shape[0]
        root = jnp.zeros((n, n), coordinates.dtype).at[np.tril_indices(n)].set(coordinates)
        root = root + jnp.diag(jnp.exp(jnp.diagonal(root)) - jnp.diagonal(root))
        return jnp.matmul(root, root.T, precision="highest")


@dataclass(frozen=True)
class Rotation:
    """Unit quaternions `(w, x, y, z)`; the coordinates are the rotation vector from the origin, in radians."""

    description = "a unit quaternion (w, x, y, z)"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        return value.shape == (4,) and bool(abs(np.linalg.norm(value) - 1) < _UNIT_TOLERANCE)

    def unconstrain(self, value: Array, origin: Array) -> Array:
        return lie.so3_local(origin, value)

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        return lie.so3_retract(origin, coordinates)


@dataclass(frozen=True)
class Fixed:
    """A constant of any type, the value at the start; it has no coordinates."""

    description = "anything"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        del value
        return True

    def unconstrain(self, value: Array, origin: Array) -> Array:
        del value, origin
        return jnp.zeros(0)

    def constrain(self, coordinates: Array, origin: Array) -> Array:
        del coordinates
        return origin


# Typed as Any because constraints take the place of parameters in a tree of the same structure.
free: Any = Free()
positive: Any = Positive()
simplex: Any = Simplex()
spd: Any = PositiveDefinite()
rotation: Any = Rotation()
fixed: Any = Fixed()


def interval(lower: float | int, upper: float | int) -> Any:
    """Numbers strictly between two bounds; methods that support bounds may end on them.

    Args:
        lower: The lower bound, finite.
        upper: The upper bound, finite and greater than `lower`.

    Raises:
        ValueError: If the bounds are not finite, or `lower` is not less than `upper`.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> interval = jf.fit.interval(2, 4)
        >>> float(interval.constrain(jnp.array(0.0), jnp.array(3.0)))  # the coordinate 0 is the middle
        3.0
    """
    if not -np.inf < lower < upper < np.inf:
        raise ValueError(f"interval must have finite bounds, the lower one first; got {lower!r}, {upper!r}.")
    return Interval(float(lower), float(upper))


def coordinate_bounds(constraint: Constraint, size: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Lower and upper bounds of `size` coordinates: infinite except for those of a box."""
    lower, upper = (constraint.lower, constraint.upper) if isinstance(constraint, Box) else (-jnp.inf, jnp.inf)
    return jnp.full(size, lower, float), jnp.full(size, upper, float)
