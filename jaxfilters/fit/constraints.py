r"""What a parameter may be, and charts of it: coordinates without limits, in which optimisers walk.

A chart has an origin, the value where the search began. Only rotations, which have no coordinates that serve
everywhere, and fixed values look at it.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.math import lie

_UNIT = 1e-3
"""How far from 1 a sum of probabilities or the length of a quaternion may be; float32 is well within."""


@runtime_checkable
class Constraint(Protocol):
    """A set of values with a chart."""

    @property
    def wanted(self) -> str:
        """What a value must be, for messages."""
        ...

    @property
    def elementwise(self) -> bool:
        """Whether every number has a coordinate of its own that grows with it."""
        ...

    def contains(self, value: np.ndarray, /) -> bool: ...

    def coordinates(self, value: Array, origin: Array, /) -> Array: ...

    def point(self, coordinates: Array, origin: Array, /) -> Array: ...


@dataclass(frozen=True)
class Free:
    """Any numbers."""

    wanted = "finite"
    elementwise = True

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all(np.isfinite(value)))

    def coordinates(self, value: Array, origin: Array) -> Array:
        del origin
        return value

    def point(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return coordinates


@dataclass(frozen=True)
class Positive:
    """Positive numbers; the coordinate is the logarithm."""

    wanted = "positive"
    elementwise = True

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all((value > 0) & np.isfinite(value)))

    def coordinates(self, value: Array, origin: Array) -> Array:
        del origin
        return jnp.log(value)

    def point(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return jnp.exp(coordinates)


@dataclass(frozen=True)
class Interval:
    """Numbers strictly between two bounds; the coordinate is the logit of the share of the way."""

    lower: float
    upper: float
    elementwise = True

    @property
    def wanted(self) -> str:
        """What a value must be."""
        return f"between {self.lower:g} and {self.upper:g}"

    def contains(self, value: np.ndarray) -> bool:
        return bool(np.all((value > self.lower) & (value < self.upper)))

    def coordinates(self, value: Array, origin: Array) -> Array:
        del origin
        return jnp.log(value - self.lower) - jnp.log(self.upper - value)

    def point(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(coordinates)


@dataclass(frozen=True)
class Box(Free):
    """Numbers from one bound to the other, both included, for methods that know bounds: their own coordinates."""

    lower: float
    upper: float


@dataclass(frozen=True)
class Simplex:
    """Probabilities along the last axis; coordinates are their logarithms relative to that of the last one."""

    wanted = "positive numbers that sum to 1 along the last axis, at least two of them"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        many = value.ndim > 0 and value.shape[-1] > 1
        return bool(many and np.all(value > 0) and np.all(abs(value.sum(-1) - 1) < _UNIT))

    def coordinates(self, value: Array, origin: Array) -> Array:
        del origin
        logs = jnp.log(value)
        return logs[..., :-1] - logs[..., -1:]

    def point(self, coordinates: Array, origin: Array) -> Array:
        del origin
        return jax.nn.softmax(jnp.pad(coordinates, [(0, 0)] * (coordinates.ndim - 1) + [(0, 1)]))


@dataclass(frozen=True)
class PositiveDefinite:
    """Symmetric positive definite matrices; coordinates are their lower root's, the diagonal by its logarithm."""

    wanted = "a symmetric positive definite matrix"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        if value.ndim != 2 or value.shape[0] != value.shape[1] or not np.all(np.isfinite(value)):
            return False
        close = np.allclose(value, value.T, rtol=1e-5, atol=1e-6 * abs(value).max())
        return close and bool(np.all(np.linalg.eigvalsh(value) > 0))

    def coordinates(self, value: Array, origin: Array) -> Array:
        del origin
        root = jnp.linalg.cholesky(value)
        root = root + jnp.diag(jnp.log(jnp.diagonal(root)) - jnp.diagonal(root))
        return root[np.tril_indices(value.shape[0])]

    def point(self, coordinates: Array, origin: Array) -> Array:
        n = origin.shape[0]
        root = jnp.zeros((n, n), coordinates.dtype).at[np.tril_indices(n)].set(coordinates)
        root = root + jnp.diag(jnp.exp(jnp.diagonal(root)) - jnp.diagonal(root))
        return jnp.matmul(root, root.T, precision="highest")


@dataclass(frozen=True)
class Rotation:
    """Unit quaternions `(w, x, y, z)`; coordinates are the rotation vector in radians that leads there."""

    wanted = "a unit quaternion (w, x, y, z)"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        return value.shape == (4,) and bool(abs(np.linalg.norm(value) - 1) < _UNIT)

    def coordinates(self, value: Array, origin: Array) -> Array:
        return lie.so3_local(origin, value)

    def point(self, coordinates: Array, origin: Array) -> Array:
        return lie.so3_retract(origin, coordinates)


@dataclass(frozen=True)
class Fixed:
    """The value where the search began, of any type; there are no coordinates."""

    wanted = "anything"
    elementwise = False

    def contains(self, value: np.ndarray) -> bool:
        del value
        return True

    def coordinates(self, value: Array, origin: Array) -> Array:
        del value, origin
        return jnp.zeros(0)

    def point(self, coordinates: Array, origin: Array) -> Array:
        del coordinates
        return origin


# To a type checker they may stand wherever a parameter stands: constraints are laid out as parameters are.
free: Any = Free()
positive: Any = Positive()
simplex: Any = Simplex()
spd: Any = PositiveDefinite()
rotation: Any = Rotation()
fixed: Any = Fixed()


def interval(lower: float | int, upper: float | int) -> Any:
    """Numbers strictly between two bounds; methods that know bounds may reach them.

    Raises:
        ValueError: If the bounds are not finite and in order.
    """
    if not -np.inf < lower < upper < np.inf:
        raise ValueError(f"interval must have finite bounds, the lower one first; got {lower!r}, {upper!r}.")
    return Interval(float(lower), float(upper))


def bounds(constraint: Constraint, coordinates: Float[Array, "..."]) -> tuple[Array, Array]:
    """Bounds of the coordinates: infinite except those of a box."""
    lower, upper = (constraint.lower, constraint.upper) if isinstance(constraint, Box) else (-jnp.inf, jnp.inf)
    return jnp.full_like(coordinates, lower), jnp.full_like(coordinates, upper)
