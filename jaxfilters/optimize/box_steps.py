"""One step of least squares within bounds: its direction, a line search along it, and the damping of the next one."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_SUFFICIENT = 0.99995**2
"""A step that reduces the energy to this fraction or less is successful whatever the quadratic model predicts."""
_MIN_GAIN_RATIO = 1e-3
"""Gain ratio above which a full step is successful."""
_ARMIJO = 1e-4
"""Constant of the sufficient decrease condition for shortened steps."""
_MAX_HALVINGS = 4
"""Halvings of a step before the next one is damped more. Few, because a batch waits for the slowest of its problems."""
_FIRST_DAMPING = 1e-3
"""Initial damping, relative to the largest diagonal element of the normal matrix."""

Bounds = tuple[Float[Array, " n"], Float[Array, " n"]]
"""Lower and upper bounds (n,)."""


class QuadraticModel(NamedTuple):
    """The energy, half the sum of squared residuals, and its quadratic model about a point."""

    x: Float[Array, " n"]
    residuals: Float[Array, " rows"]
    gradient: Float[Array, " n"]
    product: Callable[[Array], Array]
    """`step -> H step` with the undamped Hessian approximation H."""
    gradient_scale: Float[Array, ""]
    """Step length along the negative gradient: the inverse of the largest curvature or of the damping."""


class StepOutcome(NamedTuple):
    """The result of a line search."""

    point: Float[Array, " n"]
    """The next point, within the bounds; the previous one if the energy did not decrease."""
    residuals: Float[Array, " rows"]
    """Residuals at `point`."""
    full_step: Float[Array, " n"]
    """The full step after projection onto the bounds."""
    decrease: Float[Array, ""]
    """Decrease of the energy by the full step."""
    is_success: Bool[Array, ""]
    """Whether the full step was accepted."""
    gain_ratio: Float[Array, ""]
    """Actual over predicted decrease of the full step, clipped to 0 to 1."""
    is_stagnant: Bool[Array, ""]
    """Whether there was no decrease and the predicted one is below rounding error."""


def line_search(
    residuals_at: Callable[[Array], Array],
    model: QuadraticModel,
    direction: Float[Array, " n"],
    bounds: Bounds,
    is_active: Bool[Array, ""],
) -> StepOutcome:
    """The next point within the bounds, by backtracking along a step.

    A step that fails is halved up to four times until the energy decreases sufficiently (L. Armijo, "Minimization of
    functions having Lipschitz continuous first partial derivatives", Pacific J. Math. 16(1), 1966). A step that is not
    a descent direction is replaced by a projected gradient step. If all fail, the point stays.

    Args:
        residuals_at: `x -> residuals`.
        model: The quadratic model about the start of the step.
        direction: The step.
        bounds: Lower and upper bounds.
        is_active: False for a problem of a batch that has ended: it is not searched, so that the others need not wait.
    """
    x, r, gradient, product, gradient_scale = model
    energy_of = lambda residuals: 0.5 * jnp.sum(jnp.square(residuals))
    energy = energy_of(r)
    trial = jnp.clip(x + direction, *bounds)
    step = trial - x
    slope = jnp.sum(gradient * step)
    predicted = -slope - 0.5 * jnp.sum(step * product(step))
    gain_ratio_of = lambda decrease: decrease / jnp.where(predicted > 0, predicted, 1.0)
    rounding = 4 * jnp.finfo(x.dtype).eps * energy
    below_rounding = (predicted > 0) & (predicted <= rounding)

    def succeeds(decrease: Array) -> Array:
        success = (decrease >= (1 - _SUFFICIENT) * energy) | (
            (predicted > 0) & (gain_ratio_of(decrease) > _MIN_GAIN_RATIO)
        )
        return success | (below_rounding & (decrease >= 0))

    def attempt(search: _Search) -> _Search:
        is_full, t = search.attempts == 0, search.share
        shortened = jnp.where(slope < 0, x + t * step, jnp.clip(x - 2 * t * gradient_scale * gradient, *bounds))
        point = jnp.where(is_full, trial, shortened)
        residuals = residuals_at(point)
        reached = energy_of(residuals)
        decrease = jnp.where(is_full, energy - reached, search.decrease)
        sufficient = reached <= energy + _ARMIJO * jnp.sum(gradient * (point - x))
        ends = jnp.where(is_full, succeeds(decrease) | below_rounding | ~is_active, sufficient)
        return _Search(0.5 * t, point, residuals, decrease, ends, search.attempts + 1)

    # The full step is the first round of the loop, so that the residuals are in the compiled program only once.
    start = _Search(jnp.ones_like(slope), x, r, jnp.zeros_like(energy), jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(lambda search: ~search.ends & (search.attempts <= _MAX_HALVINGS), attempt, start)
    success = succeeds(last.decrease)
    accepted = success | (last.ends & ~below_rounding & is_active)
    pick = lambda new, old: jnp.where(accepted, new, old)
    is_stagnant = below_rounding & ~success
    gain_ratio = jnp.clip(gain_ratio_of(last.decrease), 0.0, 1.0)
    return StepOutcome(
        pick(last.point, x), pick(last.residuals, r), step, last.decrease, success, gain_ratio, is_stagnant
    )


class _Search(NamedTuple):
    """The attempts of a line search so far."""

    share: Float[Array, ""]
    """Of the step, for the next attempt."""
    point: Float[Array, " n"]
    residuals: Float[Array, " rows"]
    decrease: Float[Array, ""]
    """Of the energy, by the full step."""
    ends: Bool[Array, ""]
    attempts: Int[Array, ""]


def current_damping(last: Float[Array, ""], diagonal: Float[Array, " n"]) -> Float[Array, ""]:
    """The damping of the next step: `last` or, if that is 0, a value relative to the normal matrix's diagonal.

    It is bounded from below by rounding error, below which it has no effect and would take long to grow again, and is
    never 0, so that a Jacobian of zeros leads to no division by zero.
    """
    largest, limits = jnp.max(diagonal, initial=0.0), jnp.finfo(diagonal.dtype)
    damping = jnp.where(last > 0, last, _FIRST_DAMPING * largest)
    return jnp.maximum(damping, jnp.maximum(limits.eps * largest, limits.tiny**0.5))


def updated_damping(
    damping: Float[Array, ""],
    growth: Float[Array, ""],
    success: Bool[Array, ""],
    gain_ratio: Float[Array, ""],
    largest: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The damping after a step, and the factor by which it grows at the next failure.

    See H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, Technical University of Denmark,
    1999.

    Args:
        damping: The damping of the step.
        growth: The factor of growth so far.
        success: Whether the full step was accepted.
        gain_ratio: Actual over predicted decrease of the full step, 0 to 1.
        largest: Largest diagonal element of the normal matrix; after a failure the damping is not negligible beside it.
    """
    reduced = damping * jnp.maximum(1 / 3, 1 - (2 * gain_ratio - 1) ** 3)
    raised = jnp.maximum(damping * growth, jnp.finfo(damping.dtype).eps ** 0.5 * largest)
    return jnp.where(success, reduced, raised), jnp.where(success, jnp.full_like(growth, 2), 2 * growth)


def projected_gradient_norm(x: Float[Array, " n"], step: Float[Array, " n"], bounds: Bounds) -> Float[Array, ""]:
    """Maximum norm of `x - clip(x - step)`, where `step` is a positive multiple of the gradient: 0 at a solution."""
    return jnp.max(jnp.abs(x - jnp.clip(x - step, *bounds)), initial=0.0)


def converged(model: QuadraticModel, outcome: StepOutcome, bounds: Bounds, rtol: float) -> Bool[Array, ""]:
    """Whether both the full step and a projected gradient step change no variable by more than `rtol (1 + max |x|)`."""
    size = jnp.max(jnp.abs(model.x), initial=0.0)
    change = jnp.maximum(
        jnp.max(jnp.abs(outcome.full_step), initial=0.0),
        projected_gradient_norm(model.x, model.gradient_scale * model.gradient, bounds),
    )
    return change <= rtol * (1 + size)


def bounded_step(
    solve: Callable[[Array, Array], Array], model: QuadraticModel, free: Bool[Array, " n"], bounds: Bounds
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The damped step of the free variables, in which variables that would cross a bound stop on it.

    The remaining variables are then solved for again, once, given the truncated changes of those on bounds. If the
    damped matrix is not positive definite, because of rounding or the quasi-Newton correction, the step is a gradient
    step.

    Args:
        solve: `(gradient, free) -> step`, which is zero for variables that are not free.
        model: The quadratic model about the start of the step.
        free: Variables that are not in the active set.
        bounds: Lower and upper bounds.

    Returns:
        The step (n,), and whether the damped matrix was positive definite.
    """
    x, gradient = model.x, model.gradient
    step = solve(gradient, free)
    is_definite = jnp.all(jnp.isfinite(step))
    step = jnp.where(is_definite, step, jnp.where(free, -model.gradient_scale * gradient, 0.0))
    crosses = free & ((x + step < bounds[0]) | (x + step > bounds[1]))
    truncated = jnp.where(crosses, jnp.clip(x + step, *bounds) - x, 0.0)
    again = lambda: truncated + solve(gradient + model.product(truncated), free & ~crosses)
    return jax.lax.cond(is_definite & jnp.any(crosses), again, lambda: step), is_definite


def active_set(
    x: Float[Array, " n"], gradient: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Bool[Array, " n"]:
    """The variables on a bound beyond which the energy would decrease."""
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
