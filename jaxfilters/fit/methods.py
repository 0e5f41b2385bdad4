"""Search methods: first order, quasi-Newton, quasi-Newton within bounds, and least squares.

Methods are compared by value: a second method with the same options does not compile again.
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
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxfilters._full_precision import PRECISION
from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.search import StepResult
from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt
from jaxfilters.typing import as_pytree

_SMOOTHING = 0.9
"""Factor of the exponential moving average of the loss by which a first-order search decides whether it improves."""
_ARMIJO = 1e-4
"""Constant of the sufficient decrease condition (Nocedal and Wright, equation 3.4)."""
_MIN_STEP_LENGTH = 1e-10
"""Step length at which the backtracking line search gives up."""
_GROWTH = 10.0
"""Factor of the next step where the last one was too short for the gradient to tell a curvature."""


class FirstOrderState(NamedTuple):
    """State of a first-order search."""

    inner: PyTree
    """State of the gradient transformation."""
    previous: Float[Array, " d"]
    """Coordinates before the last step."""
    smoothed_loss: Float[Array, ""]
    best_loss: Float[Array, ""]
    """Lowest smoothed loss so far."""
    steps_without_gain: Int[Array, ""]


@dataclass(frozen=True)
class FirstOrder:
    """Steps of a gradient transformation, until the smoothed loss has not improved for `patience` steps."""

    transformation: optax.GradientTransformation
    max_steps: int
    tolerance: float
    patience: int
    supports_bounds = False

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> FirstOrderState:
        """State before the first step."""
        del objective, bounds
        infinite = jnp.full((), jnp.inf, z.dtype)
        return FirstOrderState(self.transformation.init(z), z, infinite, infinite, jnp.zeros((), jnp.int32))

    def step(
        self, objective: Any, step: Array, z: Array, state: FirstOrderState, bounds: tuple[Array, Array]
    ) -> StepResult:
        """One step along the transformed gradient."""
        del bounds
        loss, gradient = jax.value_and_grad(objective, 1)(step, z)
        update, inner = self.transformation.update(gradient, state.inner, z)
        average = _SMOOTHING * state.smoothed_loss + (1 - _SMOOTHING) * loss
        smoothed = jnp.where(jnp.isinf(state.smoothed_loss), loss, average)
        improved = smoothed < state.best_loss - self.tolerance
        stalled = jnp.where(improved, 0, state.steps_without_gain + 1)
        after = FirstOrderState(inner, z, smoothed, jnp.where(improved, smoothed, state.best_loss), stalled)
        return StepResult(z + update, after, loss, gradient, state.previous, stalled >= self.patience)


class BfgsState(NamedTuple):
    """State of a quasi-Newton search: the last accepted point's loss and gradient, and the next trial point."""

    trial: Float[Array, " d"]
    """The point that the next step evaluates."""
    loss: Float[Array, ""]
    gradient: Float[Array, " d"]
    inverse_hessian: Float[Array, "d d"]
    """Approximation of the inverse Hessian."""
    direction: Float[Array, " d"]
    length: Float[Array, ""]
    """Step length along `direction`."""
    num_accepted: Int[Array, ""]
    """Number of accepted points, including the first one."""
    nearly: Bool[Array, ""]
    """Whether the last accepted point promised no more than the tolerance: the trial point is to confirm it."""


@dataclass(frozen=True)
class Bfgs:
    """Quasi-Newton steps with backtracking (J. Nocedal and S. Wright, "Numerical optimization", 2006, algorithm 6.1).

    One step evaluates the loss and its gradient once. The search converges when the predicted decrease of the next full
    step is at most `tolerance` and the step to it confirms this. The curvature that predicts it may be that of a steep
    wall before the last point: the step then finds a smaller curvature, or none, and the search continues.
    """

    max_steps: int
    tolerance: float
    supports_bounds = False

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> BfgsState:
        """State before the first evaluation."""
        del objective, bounds
        infinite, one = jnp.full((), jnp.inf, z.dtype), jnp.ones((), z.dtype)
        none = jnp.zeros_like(z)
        return BfgsState(
            z, infinite, none, jnp.eye(z.size, dtype=z.dtype), none, one, jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        )

    def step(self, objective: Any, step: Array, z: Array, state: BfgsState, bounds: tuple[Array, Array]) -> StepResult:
        """Evaluate the trial point, and accept it or halve the step."""
        del bounds
        loss, gradient = jax.value_and_grad(objective, 1)(step, state.trial)
        descent = jnp.sum(state.gradient * state.direction)
        # Differences below the rounding error of the loss count as zero.
        rounding = 4 * jnp.finfo(z.dtype).eps * jnp.abs(state.loss)
        first = state.num_accepted == 0
        accept = first | (loss <= state.loss + _ARMIJO * state.length * descent + rounding)
        accepted = jnp.where(accept, state.trial, z)
        loss, slope = jnp.where(accept, loss, state.loss), jnp.where(accept, gradient, state.gradient)
        updated, curved = _updated_inverse(state, state.trial - z, gradient)
        inverse = jnp.where(accept, updated, state.inverse_hessian)
        # A step too short to show a curvature confirms nothing, unless a unit curvature promises no more, either.
        steep = (0.5 * jnp.sum(slope**2) > self.tolerance) & jnp.any(state.trial != z)
        unclear = accept & state.nearly & ~curved & steep
        inverse = jnp.where(unclear, _GROWTH, 1.0) * inverse
        direction = jnp.where(accept, -_product(inverse, slope), state.direction)
        length = jnp.where(accept, 1.0, 0.5 * state.length)
        low = -0.5 * jnp.sum(slope * direction) <= self.tolerance
        # A rejected step shows that even less can be gained than predicted.
        confirmed = state.nearly & (~accept | (low & ~unclear))
        converged = confirmed | (length < _MIN_STEP_LENGTH)
        nearly = jnp.where(accept, low, state.nearly)
        after = BfgsState(
            accepted + length * direction, loss, slope, inverse, direction, length, state.num_accepted + accept, nearly
        )
        return StepResult(accepted, after, loss, slope, z, converged)


def _updated_inverse(state: BfgsState, step: Array, gradient: Array) -> tuple[Array, Bool[Array, ""]]:
    """The inverse Hessian approximation after an accepted step, and whether that shows a positive curvature.

    Nocedal and Wright, equations 6.17 and 6.20.
    """
    unit = jnp.eye(step.size, dtype=step.dtype)
    change = gradient - state.gradient
    curvature, square = jnp.sum(step * change), jnp.sum(change**2)
    curved = curvature > jnp.finfo(step.dtype).eps * jnp.sqrt(jnp.sum(step**2) * square)
    rate = 1 / jnp.where(curved, curvature, 1.0)
    # Before the first update the identity is scaled to the observed curvature: equation 6.20.
    scaled = curvature / jnp.where(curved, square, 1.0) * unit
    before = jnp.where(state.num_accepted == 1, scaled, state.inverse_hessian)
    left = unit - rate * jnp.outer(step, change)
    after = _product(_product(left, before), left.T) + rate * jnp.outer(step, step)
    # The very first step has at most unit length.
    initial = unit / jnp.maximum(1.0, jnp.sqrt(jnp.sum(gradient**2)))
    return jnp.where(state.num_accepted == 0, initial, jnp.where(curved, after, state.inverse_hessian)), curved


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


@dataclass(frozen=True)
class Lbfgsb:
    """Limited-memory quasi-Newton steps within bounds, by jaxopt (R. Byrd, P. Lu, J. Nocedal and C. Zhu, 1995)."""

    max_steps: int
    tolerance: float
    supports_bounds = True

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> Any:
        """State at the start."""
        return self._solver(lambda z: objective(jnp.zeros((), jnp.int32), z)).init_state(z, bounds)

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array]) -> StepResult:
        """One iteration, including its line search."""
        # The solver's own products have the precision of where they are traced.
        with jax.default_matmul_precision(PRECISION):
            moved, state = self._solver(lambda z: objective(step, z)).update(z, state, bounds)
        return StepResult(moved, state, state.value, state.grad, z, state.error <= self.tolerance)

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
    """The log density of residuals with unit variance, for `least_squares`.

    Args:
        function: `theta -> residuals`, a pytree of arrays in units of their standard deviations; the residuals of a
            Gaussian prior are further leaves.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> log_density = jf.fit.residuals(lambda x: x - jnp.array([1.0, 5.0]))
        >>> float(log_density(3.0))
        -4.0
    """
    return Residuals(as_pytree(function))


@dataclass(frozen=True)
class LeastSquares:
    """Levenberg-Marquardt within bounds, by optimistix and `jaxfilters.optimize`."""

    max_steps: int
    tolerance: float
    supports_bounds = True

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array]) -> Any:
        """State before the first step."""
        del objective, bounds
        return self._solver().init(None, z, None, {}, None, None, frozenset())

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array]) -> StepResult:
        """One damped step."""
        options = {"lower": bounds[0], "upper": bounds[1]}
        function = lambda z, _: (objective.residuals(z), None)
        moved, state, _ = self._solver().step(function, z, None, options, state, frozenset())
        loss, gradient = jax.value_and_grad(objective, 1)(step, moved)
        return StepResult(moved, state, loss, gradient, z, state.terminate)

    def _solver(self) -> BoxLevenbergMarquardt:
        return BoxLevenbergMarquardt(rtol=self.tolerance, atol=self.tolerance)


@lru_cache
def adam(
    learning_rate: float = 0.03, *, max_steps: int = 500, tolerance: float = 1e-3, patience: int = 30
) -> FirstOrder:
    """Adam (D. P. Kingma and J. Ba, ICLR 2015) by optax, for large or noisy problems.

    Args:
        learning_rate: Step size in the unconstrained coordinates.
        max_steps: Upper bound on the number of steps.
        tolerance: Least decrease of the smoothed loss that counts as an improvement.
        patience: Number of steps without an improvement that ends the search.

    Raises:
        ValueError: If an option is out of range.

    Examples:
        >>> import jaxfilters as jf
        >>> method = jf.fit.adam(0.1)
        >>> fit = jf.fit.maximize(lambda x: -0.5 * (x - 3.0) ** 2, 0.0, method=method, errors=jf.fit.no_errors)
        >>> round(float(fit.theta), 1)
        3.0
    """
    if not learning_rate > 0:
        raise ValueError(f"learning_rate must be positive; got {learning_rate}.")
    _check_options(max_steps, tolerance, patience)
    return FirstOrder(optax.adam(learning_rate), max_steps, tolerance, patience)


def first_order(
    transformation: optax.GradientTransformation, *, max_steps: int = 500, tolerance: float = 1e-3, patience: int = 30
) -> FirstOrder:
    """First-order search with any gradient transformation of optax.

    Args:
        transformation: `init(z)` and `update(gradient, state, z)`. It is compared by identity: a new one compiles anew.
        max_steps: Upper bound on the number of steps.
        tolerance: Least decrease of the smoothed loss that counts as an improvement.
        patience: Number of steps without an improvement that ends the search.

    Raises:
        ValueError: If an option is out of range.

    Examples:
        >>> import jaxfilters as jf
        >>> import optax
        >>> method = jf.fit.first_order(optax.sgd(0.5), tolerance=1e-6)
        >>> fit = jf.fit.maximize(lambda x: -0.5 * (x - 3.0) ** 2, 0.0, method=method, errors=jf.fit.no_errors)
        >>> round(float(fit.theta), 2)
        3.0
    """
    _check_options(max_steps, tolerance, patience)
    return FirstOrder(transformation, max_steps, tolerance, patience)


def bfgs(*, max_steps: int = 200, tolerance: float = 1e-5) -> Bfgs:
    """Quasi-Newton search (BFGS), for smooth problems of up to some hundred parameters.

    Args:
        max_steps: Upper bound on the number of evaluations of the loss and its gradient.
        tolerance: Predicted gain of the log density, in nats, below which the search has converged.

    Raises:
        ValueError: If an option is out of range.

    Examples:
        >>> import jaxfilters as jf
        >>> method = jf.fit.bfgs(max_steps=50)
        >>> fit = jf.fit.maximize(lambda x: -0.5 * (x - 3.0) ** 2, 0.0, method=method, errors=jf.fit.no_errors)
        >>> round(float(fit.theta), 2), bool(fit.converged)
        (3.0, True)
    """
    _check_options(max_steps, tolerance)
    return Bfgs(max_steps, tolerance)


def lbfgsb(*, max_steps: int = 100, tolerance: float = 1e-3) -> Lbfgsb:
    """Quasi-Newton search (L-BFGS-B) that may end at the bounds of an `interval`, in the units of the parameter.

    Args:
        max_steps: Upper bound on the number of iterations.
        tolerance: Largest component of the projected gradient at convergence.

    Raises:
        ValueError: If an option is out of range.

    Examples:
        The maximum over all numbers is 3, and the interval ends at 2.

        >>> import jaxfilters as jf
        >>> log_density, interval = lambda x: -0.5 * (x - 3.0) ** 2, jf.fit.interval(0.0, 2.0)
        >>> fit = jf.fit.maximize(log_density, 1.0, interval, method=jf.fit.lbfgsb(), errors=jf.fit.no_errors)
        >>> round(float(fit.theta), 2)
        2.0
    """
    _check_options(max_steps, tolerance)
    return Lbfgsb(max_steps, tolerance)


def least_squares(*, max_steps: int = 50, tolerance: float = 1e-6) -> LeastSquares:
    """Levenberg-Marquardt search for `residuals`; it may end at the bounds of an `interval`.

    Args:
        max_steps: Upper bound on the number of steps.
        tolerance: Relative step, or largest component of the projected gradient, at convergence.

    Raises:
        ValueError: If an option is out of range.

    Examples:
        It is an argument of `maximize`, as in `maximize(residuals(...), start, method=least_squares(max_steps=20))`.

        >>> import jaxfilters as jf
        >>> method = jf.fit.least_squares(max_steps=20)
        >>> method.max_steps, method.supports_bounds
        (20, True)
    """
    _check_options(max_steps, tolerance)
    return LeastSquares(max_steps, tolerance)


def _check_options(max_steps: int, tolerance: float, patience: int = 1) -> None:
    if max_steps < 1 or patience < 1:
        raise ValueError(f"max_steps and patience must be at least 1; got {max_steps} and {patience}.")
    if not tolerance >= 0:
        raise ValueError(f"tolerance must not be negative; got {tolerance}.")
