"""Ways to search: first order, quasi-Newton, quasi-Newton within bounds, least squares.

Each is made by a function and is compared by value: the same options, made again, compile nothing.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.search import Move
from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt
from jaxfilters.typing import as_pytree

_SMOOTHING = 0.9
_ARMIJO = 1e-4
_SHORTEST = 1e-10


class FirstOrderState(NamedTuple):
    """Of a first-order search."""

    inner: PyTree
    previous: Float[Array, " d"]
    smooth: Float[Array, ""]
    best: Float[Array, ""]
    stale: Int[Array, ""]


@dataclass(frozen=True)
class FirstOrder:
    """Steps that a gradient transformation makes; it ends when the smoothed loss has long not improved."""

    transformation: optax.GradientTransformation
    max_steps: int
    tolerance: float
    patience: int
    knows_bounds = False

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> FirstOrderState:
        """State before the first step."""
        del objective, bounds
        infinite = jnp.full((), jnp.inf, z.dtype)
        return FirstOrderState(self.transformation.init(z), z, infinite, infinite, jnp.zeros((), jnp.int32))

    def step(self, objective: Any, step: Array, z: Array, state: FirstOrderState, bounds: tuple[Array, Array]) -> Move:
        """One step along the transformed gradient."""
        del bounds
        loss, gradient = jax.value_and_grad(objective, 1)(step, z)
        update, inner = self.transformation.update(gradient, state.inner, z)
        smooth = jnp.where(jnp.isinf(state.smooth), loss, _SMOOTHING * state.smooth + (1 - _SMOOTHING) * loss)
        improved = smooth < state.best - self.tolerance
        stale = jnp.where(improved, 0, state.stale + 1)
        after = FirstOrderState(inner, z, smooth, jnp.where(improved, smooth, state.best), stale)
        return Move(z + update, after, loss, gradient, state.previous, stale >= self.patience)


class BfgsState(NamedTuple):
    """Where a quasi-Newton search stands, and where it looks next."""

    trial: Float[Array, " d"]
    loss: Float[Array, ""]
    gradient: Float[Array, " d"]
    inverse: Float[Array, "d d"]
    """Of the Hessian, approximately."""
    direction: Float[Array, " d"]
    length: Float[Array, ""]
    taken: Int[Array, ""]
    """How many points were taken, the first one included."""


@dataclass(frozen=True)
class Bfgs:
    """Quasi-Newton steps with backtracking (J. Nocedal, S. Wright, "Numerical optimization", 2006, algorithm 6.1).

    One step is one look at the loss and its gradient. It ends when the next whole step promises too little gain.
    """

    max_steps: int
    tolerance: float
    knows_bounds = False

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> BfgsState:
        """State before the first look."""
        del objective, bounds
        infinite, one = jnp.full((), jnp.inf, z.dtype), jnp.ones((), z.dtype)
        none = jnp.zeros_like(z)
        return BfgsState(z, infinite, none, jnp.eye(z.size, dtype=z.dtype), none, one, jnp.zeros((), jnp.int32))

    def step(self, objective: Any, step: Array, z: Array, state: BfgsState, bounds: tuple[Array, Array]) -> Move:
        """Look at the trial point; take it or shorten the step to it."""
        del bounds
        loss, gradient = jax.value_and_grad(objective, 1)(step, state.trial)
        descent = jnp.sum(state.gradient * state.direction)
        # Losses that differ by their own rounding are equal.
        rounding = 4 * jnp.finfo(z.dtype).eps * jnp.abs(state.loss)
        first = state.taken == 0
        take = first | (loss <= state.loss + _ARMIJO * state.length * descent + rounding)
        at = jnp.where(take, state.trial, z)
        kept, slope = jnp.where(take, loss, state.loss), jnp.where(take, gradient, state.gradient)
        inverse = jnp.where(take, _updated(state, state.trial - z, gradient), state.inverse)
        direction = jnp.where(take, -_product(inverse, slope), state.direction)
        length = jnp.where(take, 1.0, 0.5 * state.length)
        promised = -0.5 * jnp.sum(slope * direction)
        done = (take & ~first & (promised <= self.tolerance)) | (length < _SHORTEST)
        after = BfgsState(at + length * direction, kept, slope, inverse, direction, length, state.taken + take)
        return Move(at, after, kept, slope, z, done)


def _updated(state: BfgsState, step: Array, gradient: Array) -> Array:
    """The inverse Hessian after a step: equations 6.17 and, before the first update, 6.20."""
    unit = jnp.eye(step.size, dtype=step.dtype)
    change = gradient - state.gradient
    curvature, square = jnp.sum(step * change), jnp.sum(change**2)
    curved = curvature > jnp.finfo(step.dtype).eps * jnp.sqrt(jnp.sum(step**2) * square)
    rate = 1 / jnp.where(curved, curvature, 1.0)
    before = jnp.where(state.taken == 1, curvature / jnp.where(curved, square, 1.0) * unit, state.inverse)
    left = unit - rate * jnp.outer(step, change)
    after = _product(_product(left, before), left.T) + rate * jnp.outer(step, step)
    # The first step of all is at most one long.
    begun = unit / jnp.maximum(1.0, jnp.sqrt(jnp.sum(gradient**2)))
    return jnp.where(state.taken == 0, begun, jnp.where(curved, after, state.inverse))


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


@dataclass(frozen=True)
class Lbfgsb:
    """Limited-memory quasi-Newton steps within bounds, by jaxopt."""

    max_steps: int
    tolerance: float
    knows_bounds = True

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> Any:
        """State at the start."""
        return self._solver(lambda z: objective(jnp.zeros((), jnp.int32), z)).init_state(z, bounds)

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array]) -> Move:
        """One iteration, line search included."""
        moved, state = self._solver(lambda z: objective(step, z)).update(z, state, bounds)
        return Move(moved, state, state.value, state.grad, z, state.error <= self.tolerance)

    def _solver(self, fun: Callable) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            from jaxopt import LBFGSB
        return LBFGSB(fun, maxiter=self.max_steps, tol=self.tolerance, jit=True, unroll=False, implicit_diff=False)


@pytree_dataclass
class Residuals:
    """A log density that is minus half the sum of squared residuals, for `least_squares`."""

    function: Callable[[PyTree], PyTree]
    """`theta -> residuals`, each in units of its own standard deviation; a log prior is further residuals."""

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return -0.5 * jnp.sum(ravel_pytree(self.function(theta))[0] ** 2)


def residuals(function: Callable[[PyTree], PyTree]) -> Residuals:
    """The log density of residuals with unit variance, for `least_squares`."""
    return Residuals(as_pytree(function))


@dataclass(frozen=True)
class LeastSquares:
    """Levenberg-Marquardt within bounds, by optimistix and `jaxfilters.least_squares`."""

    max_steps: int
    tolerance: float
    knows_bounds = True

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> Any:
        """State before the first step."""
        del objective, bounds
        return self._solver().init(None, z, None, {}, None, None, frozenset())

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array]) -> Move:
        """One damped step."""
        options = {"lower": bounds[0], "upper": bounds[1]}
        function = lambda z, _: (objective.residuals(z), None)
        moved, state, _ = self._solver().step(function, z, None, options, state, frozenset())
        loss, gradient = jax.value_and_grad(objective, 1)(step, moved)
        return Move(moved, state, loss, gradient, z, state.terminate)

    def _solver(self) -> BoxLevenbergMarquardt:
        return BoxLevenbergMarquardt(rtol=self.tolerance, atol=self.tolerance)


@lru_cache
def adam(
    learning_rate: float = 0.03, *, max_steps: int = 500, tolerance: float = 1e-3, patience: int = 30
) -> FirstOrder:
    """Adam by optax, for large or noisy problems; arguments as `first_order`."""
    return FirstOrder(optax.adam(learning_rate), max_steps, tolerance, patience)


def first_order(
    transformation: optax.GradientTransformation, *, max_steps: int = 500, tolerance: float = 1e-3, patience: int = 30
) -> FirstOrder:
    """First-order search with any optax transformation.

    Args:
        transformation: `init(z)` and `update(gradient, state, z)`. Compared by identity: make it once.
        max_steps: Upper bound.
        tolerance: Gain of the log density, averaged over some ten steps, that counts as one.
        patience: Steps without such a gain that end the search.
    """
    return FirstOrder(transformation, max_steps, tolerance, patience)


def bfgs(*, max_steps: int = 200, tolerance: float = 1e-5) -> Bfgs:
    """Quasi-Newton search, for smooth problems of up to some hundred parameters.

    Args:
        max_steps: Upper bound of looks at the loss and its gradient.
        tolerance: Promised gain of the log density that is not worth a step.
    """
    return Bfgs(max_steps, tolerance)


def lbfgsb(*, max_steps: int = 100, tolerance: float = 1e-3) -> Lbfgsb:
    """Quasi-Newton search that may end at the bounds of an `interval`, in the units of the parameter.

    Args:
        max_steps: Upper bound of iterations.
        tolerance: Largest component of the projected gradient at the end.
    """
    return Lbfgsb(max_steps, tolerance)


def least_squares(*, max_steps: int = 50, tolerance: float = 1e-6) -> LeastSquares:
    """Levenberg-Marquardt search for `residuals`; it may end at the bounds of an `interval`.

    Args:
        max_steps: Upper bound.
        tolerance: Relative step, or component of the projected gradient, that ends the search.
    """
    return LeastSquares(max_steps, tolerance)
