"""One step of a least squares solver within bounds: which way, how far, and how much damping the next one needs."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_SUFFICIENT = 0.99995**2
"""Factor of the error from which on a step counts as a success without looking at the model."""
_LEAST_GAIN, _ARMIJO = 1e-3, 1e-4
_MOST_HALVINGS = 4
"""Of one step, before the next one is damped more. Batches wait for the last of their problems."""
_FIRST_DAMPING = 1e-3
"""Of the largest diagonal element of the normal matrix."""


class Model(NamedTuple):
    """The energy, half the sum of squared residuals, about a point."""

    x: Float[Array, " n"]
    residuals: Float[Array, " rows"]
    gradient: Float[Array, " n"]
    product: Callable[[Array], Array]
    """`step -> H step` with the Hessian that the step was computed with, but for damping."""
    short: Float[Array, ""]
    """What to multiply a gradient with for a step that is not too long."""


class Found(NamedTuple):
    """Where a step led."""

    point: Float[Array, " n"]
    """The next one, within the bounds; the same one where nothing was gained."""
    residuals: Float[Array, " rows"]
    """There."""
    tried: Float[Array, " n"]
    """The whole step, within the bounds."""
    decrease: Float[Array, ""]
    """Of the energy by the whole step."""
    is_success: Bool[Array, ""]
    """Of the whole step."""
    gain: Float[Array, ""]
    """The decrease over that foreseen, 0 to 1."""
    is_exhausted: Bool[Array, ""]
    """Nothing was gained, and what was foreseen drowns in rounding."""


def line_search(
    residuals_at: Callable[[Array], Array],
    model: Model,
    direction: Float[Array, " n"],
    bounds: tuple[Float[Array, " n"], Float[Array, " n"]],
    goes_on: Bool[Array, ""],
) -> Found:
    """The next point within the bounds, by a step or a part of it.

    A step that fails is halved a few times, or where it does not descend a projected gradient is, until the energy
    falls enough (L. Armijo 1966); where that does not help the point stays.

    Args:
        residuals_at: `x -> residuals`.
        model: About where the step begins.
        direction: The step.
        bounds: Lower and upper ones.
        goes_on: False for a problem of a batch that has ended: then nothing is halved, so that no other one waits.
    """
    x, r, gradient, product, short = model
    energy_of = lambda residuals: 0.5 * jnp.sum(jnp.square(residuals))
    energy = energy_of(r)
    trial = jnp.clip(x + direction, *bounds)
    step, there = trial - x, residuals_at(trial)
    slope = jnp.sum(gradient * step)
    foreseen = -slope - 0.5 * jnp.sum(step * product(step))
    decrease = energy - energy_of(there)
    gain = decrease / jnp.where(foreseen > 0, foreseen, 1.0)
    rounding = 4 * jnp.finfo(x.dtype).eps * energy
    drowned = (foreseen > 0) & (foreseen <= rounding)
    success = (decrease >= (1 - _SUFFICIENT) * energy) | ((foreseen > 0) & (gain > _LEAST_GAIN))
    success |= drowned & (decrease >= 0)

    def shorten(carry: tuple) -> tuple:
        t, _, _, halvings, _ = carry
        t = 0.5 * t
        point = jnp.where(slope < 0, x + t * step, jnp.clip(x - 2 * t * short * gradient, *bounds))
        residuals = residuals_at(point)
        enough = energy_of(residuals) <= energy + _ARMIJO * jnp.sum(gradient * (point - x))
        return t, point, residuals, halvings + 1, enough

    fails = ~success & ~drowned & goes_on
    start = jnp.ones((), x.dtype), trial, there, jnp.zeros((), jnp.int32), ~fails
    _, point, residuals, _, enough = jax.lax.while_loop(
        lambda carry: ~carry[4] & (carry[3] < _MOST_HALVINGS), shorten, start
    )
    taken = success | (fails & enough)
    pick = lambda new, old: jnp.where(taken, new, old)
    return Found(
        pick(point, x), pick(residuals, r), step, decrease, success, jnp.clip(gain, 0.0, 1.0), drowned & ~success
    )


def damping_of(last: Float[Array, ""], diagonal: Float[Array, " n"]) -> Float[Array, ""]:
    """Damping of the next step, from that of the last one or, where this is 0, from the normal matrix's diagonal.

    It is never less than rounding, which would only cost time where it has to rise again, and never 0: a Jacobian of
    zeros is the end, not a division by zero.
    """
    largest, limits = jnp.max(diagonal, initial=0.0), jnp.finfo(diagonal.dtype)
    damping = jnp.where(last > 0, last, _FIRST_DAMPING * largest)
    return jnp.maximum(damping, jnp.maximum(limits.eps * largest, limits.tiny**0.5))


def damped_on(
    damping: Float[Array, ""],
    growth: Float[Array, ""],
    success: Bool[Array, ""],
    gain: Float[Array, ""],
    largest: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Damping after a step, and the factor by which it grows when one fails (Nielsen 1999).

    Args:
        damping: Of the step.
        growth: The factor so far.
        success: Whether the whole step was one.
        gain: Its decrease over that foreseen, 0 to 1.
        largest: Diagonal element of the normal matrix; damping that is needed is felt beside it.
    """
    eased = damping * jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
    raised = jnp.maximum(damping * growth, jnp.finfo(damping.dtype).eps ** 0.5 * largest)
    return jnp.where(success, eased, raised), jnp.where(success, jnp.full_like(growth, 2), 2 * growth)


def by_gradient(
    x: Float[Array, " n"], step: Float[Array, " n"], bounds: tuple[Float[Array, " n"], Float[Array, " n"]]
) -> Float[Array, ""]:
    """Largest change of a variable by a step within the bounds down the gradient: 0 at a solution."""
    return jnp.max(jnp.abs(x - jnp.clip(x - step, *bounds)), initial=0.0)


def converged(
    model: Model, found: Found, bounds: tuple[Float[Array, " n"], Float[Array, " n"]], rtol: float
) -> Bool[Array, ""]:
    """Whether no variable moves by more than `rtol (1 + |x|)`, neither by the step nor down the gradient."""
    size = jnp.max(jnp.abs(model.x), initial=0.0)
    reach = jnp.maximum(
        jnp.max(jnp.abs(found.tried), initial=0.0), by_gradient(model.x, model.short * model.gradient, bounds)
    )
    return reach <= rtol * (1 + size)


def boxed(
    solve: Callable[[Array, Array], Array],
    model: Model,
    free: Bool[Array, " n"],
    bounds: tuple[Float[Array, " n"], Float[Array, " n"]],
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The damped step of the free variables, of which those that it would take beyond a bound stop there.

    The others are then solved for again, once: without that they would answer to steps that are not taken. Where the
    damped matrix is not positive, by rounding or by what was learnt, it does not lead on: a step along the gradient
    stands in, and False is returned with it.

    Args:
        solve: `(gradient, free) -> step`, zero for the variables that are not free.
        model: About where the step begins.
        free: Not held by a bound.
        bounds: Lower and upper ones.
    """
    x, gradient = model.x, model.gradient
    step = solve(gradient, free)
    leads = jnp.all(jnp.isfinite(step))
    step = jnp.where(leads, step, jnp.where(free, -model.short * gradient, 0.0))
    met = free & ((x + step < bounds[0]) | (x + step > bounds[1]))
    stopped = jnp.where(met, jnp.clip(x + step, *bounds) - x, 0.0)
    again = lambda: stopped + solve(gradient + model.product(stopped), free & ~met)
    return jax.lax.cond(leads & jnp.any(met), again, lambda: step), leads


def active_set(
    x: Float[Array, " n"], gradient: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Bool[Array, " n"]:
    """Which variables a bound holds against the descent direction."""
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
