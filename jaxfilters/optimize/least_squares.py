"""Nonlinear least squares within bounds: a Levenberg-Marquardt solver for optimistix, whose own ones ignore bounds.

    solver = BoxLevenbergMarquardt(rtol=1e-8, atol=1e-8)
    options = {"lower": lower, "upper": upper}
    optimistix.least_squares(fn, solver, y0, args, options, adjoint=BoxAdjoint())

Damping follows the gain ratio (H. B. Nielsen 1999) and variables that a bound holds are frozen. A step that does not
decrease the error is shortened along its way or, where that does not help or the way does not descend, damped more,
which turns it towards a projected gradient (C. Kanzow, N. Yamashita, M. Fukushima, "Levenberg-Marquardt methods with
strong local convergence properties for solving nonlinear equations with convex constraints", 2004; D. P. Bertsekas, "On
the Goldstein-Levitin-Polyak gradient projection method", 1976). All iterates lie within the bounds, and the error never
grows. Where residuals remain large `J^T J` is no good Hessian; what it lacks is learnt from the steps and used where it
predicts better (J. E. Dennis, D. M. Gay, R. E. Welsch, "An adaptive nonlinear least-squares algorithm", 1981).
"""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters.math.linalg import cholesky, safe_norm, solve_triangular
from jaxfilters.optimize.box_steps import (
    Model,
    active_set,
    boxed,
    by_gradient,
    converged,
    damped_on,
    damping_of,
    line_search,
)

_SMALL = 8
"""Variables up to which `jaxfilters.linalg` is faster than LAPACK, of batches ten times."""


class _State(eqx.Module):
    damping: Float[Array, ""]
    """0 before the first step."""
    growth: Float[Array, ""]
    lacking: Float[Array, "n n"]
    """What the normal matrix lacks of the Hessian."""
    is_corrected: Bool[Array, ""]
    """Whether the next step uses it."""
    step: Float[Array, " n"]
    """The last one, 0 where none was taken."""
    gradient: Float[Array, " n"]
    """Where it began."""
    crossed: Float[Array, " n"]
    """The residuals after it, times the Jacobian before it."""
    terminate: Bool[Array, ""]
    result: optimistix.RESULTS


class BoxLevenbergMarquardt(optimistix.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within bounds, dense, for up to some hundreds of variables.

    Understands the options `lower` and `upper`: numbers, or pytrees like `y`; absent or infinite where there is no
    bound. A start outside is moved to the nearest point within. It ends when a step changes no variable by more than
    `rtol (1 + |y|)`, or when the projected gradient is at most `atol` in every variable; where rounding allows no
    further decrease it ends with the best point. Residuals or derivatives that are not finite, and bounds that
    contradict each other, end it as divergence. Jacobians are in forward mode. To differentiate the solution, pass
    `adjoint=BoxAdjoint()`: variables at their bounds then follow the bounds.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Array] = optimistix.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """Damping is chosen in the first step, where the Jacobian is known."""
        del fn, args, options, f_struct, aux_struct, tags
        flat = ravel_pytree(y)[0]
        none, zeros, no = jnp.zeros((), flat.dtype), jnp.zeros_like(flat), jnp.zeros((), bool)
        # equinox declares the items of an enumeration as the strings that they are written with.
        underway = cast(optimistix.RESULTS, optimistix.RESULTS.successful)
        lacking = jnp.zeros((flat.size, flat.size), flat.dtype)
        return _State(none, none + 2, lacking, no, zeros, zeros, zeros, no, underway)

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[PyTree, _State, Any]:
        """One step that is taken, or none and more damping of the next one."""
        del tags
        flat, unravel = ravel_pytree(y)
        lower, upper = bounds_of(options, y)
        x = jnp.clip(flat, lower, upper)
        residuals = lambda x: ravel_pytree(fn(unravel(x), args)[0])[0]
        J, r = jax.jacfwd(lambda x: (residuals(x),) * 2, has_aux=True)(x)
        gradient, normal = _product(r, J), _product(J.T, J)
        damping = damping_of(state.damping, jnp.diagonal(normal))
        lacking = _learnt(x, state, gradient)
        hessian = jnp.where(state.is_corrected, normal + lacking, normal)
        free = ~active_set(x, gradient, lower, upper)
        largest = jnp.max(jnp.diagonal(normal), initial=0.0)
        product = lambda step: _product(normal, step) + jnp.where(state.is_corrected, _product(lacking, step), 0.0)
        model = Model(x, r, gradient, product, 1 / jnp.maximum(damping, largest))
        solve = lambda rest, free: _damped(hessian, rest, damping, free)
        direction, led = boxed(solve, model, free, (lower, upper))
        found = line_search(residuals, model, direction, (lower, upper), ~state.terminate)
        # What the whole step gained beyond what the normal matrix foresees: does what it lacks explain that?
        bent = lambda matrix: 0.5 * jnp.sum(found.tried * _product(matrix, found.tried))
        surplus = found.decrease + jnp.sum(gradient * found.tried) + bent(normal)
        small = by_gradient(x, gradient, (lower, upper)) <= self.atol
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J)) & jnp.all(lower <= upper)
        after = _State(
            *damped_on(damping, state.growth, found.is_success & led, found.gain, largest),
            lacking,
            jnp.abs(surplus + bent(lacking)) < jnp.abs(surplus),
            found.point - x,
            gradient,
            _product(found.residuals, J),
            found.is_exhausted | converged(model, found, (lower, upper), self.rtol) | small | ~finite,
            optimistix.RESULTS.where(finite, optimistix.RESULTS.successful, optimistix.RESULTS.nonlinear_divergence),
        )
        best = unravel(jnp.where(small | ~finite, x, found.point))
        return best, after, fn(best, args)[1]

    def terminate(self, fn, y, args, options, state: _State, tags) -> tuple[Array, optimistix.RESULTS]:
        """Whether the last step was the last one, and why."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[PyTree, Any, dict]:
        """The solution as it is."""
        del fn, args, options, state, tags, result
        return y, aux, {}


class BoxAdjoint(optimistix.ImplicitAdjoint):
    """Derivatives of a solution within bounds by the implicit function theorem.

    Variables at a bound that holds them move with it; the others by the stationarity of the error.
    """

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        """As `optimistix.ImplicitAdjoint`, with stationarity within the bounds."""
        del rewrite_fn
        return super().apply(primal_fn, _stationarity, inputs, tags)


def _stationarity(optimum, _, inputs):
    fn, _, _, args, options, *_ = inputs
    del inputs
    flat, unravel = ravel_pytree(optimum)
    lower, upper = bounds_of(options, optimum)
    energy = lambda x: 0.5 * jnp.sum(jnp.square(ravel_pytree(fn(unravel(x), args)[0])[0]))
    gradient = jax.grad(energy)(flat)
    fixed = jax.lax.stop_gradient(gradient)
    at_lower, at_upper = (flat <= lower) & (fixed > 0), (flat >= upper) & (fixed < 0)
    bound = jnp.where(at_lower, lower, jnp.where(at_upper, upper, 0.0))
    return unravel(jnp.where(at_lower | at_upper, flat - bound, gradient))


# What the implicit function theorem is applied to must be a plain function of a module.
_stationarity = getattr(_stationarity, "__wrapped__", _stationarity)


def bounds_of(options: dict[str, Any], y: PyTree) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Bounds of all variables, flat, infinite where none is given.

    Raises:
        ValueError: where a bound has another structure than `y`, or, if that can be known before compilation, a lower
            one is above the upper one or NaN.
    """
    lower = _flat_bound("lower", options.get("lower"), y, -jnp.inf)
    upper = _flat_bound("upper", options.get("upper"), y, jnp.inf)
    if not isinstance(lower, jax.core.Tracer) and not isinstance(upper, jax.core.Tracer):
        wrong = ~(np.asarray(lower) <= np.asarray(upper))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(f"lower must be at most upper; variable {i} has {lower[i]} and {upper[i]}.")
    return lower, upper


def _flat_bound(name, bound, y, none):
    flat, _ = ravel_pytree(y)
    if bound is None:
        return jnp.full_like(flat, none)
    if isinstance(bound, float | int):
        return jnp.full_like(flat, bound)
    try:
        full = jax.tree.map(lambda leaf, b: jnp.broadcast_to(jnp.asarray(b, leaf.dtype), leaf.shape), y, bound)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number, or have the structure and shapes of y: {error}") from None
    return ravel_pytree(full)[0]


def covariance(
    fn: Callable, y: PyTree, args: PyTree = None, options: dict[str, Any] | None = None
) -> Float[Array, "n n"]:
    """Covariance of a solution whose residuals have unit variance: the inverse normal matrix of the free variables.

    Rows and columns of variables that a bound holds are zero; directions that no residual depends on are infinite in
    truth and left out, as in a pseudo-inverse.
    """
    flat, unravel = ravel_pytree(y)
    residuals = lambda x: ravel_pytree(fn(unravel(x), args))[0]
    J = jax.jacfwd(residuals)(flat)
    free = ~active_set(flat, _product(J.T, residuals(flat)), *bounds_of(options or {}, y))
    both = free[:, None] & free
    return jnp.where(both, jnp.linalg.pinv(jnp.where(both, _product(J.T, J), 0.0), hermitian=True), 0.0)


def huber(residual: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Residuals whose half squares are Huber's loss: quadratic up to `scale`, linear beyond."""
    size = jnp.abs(residual)
    outer = jnp.sqrt(jnp.where(size > scale, 2 * scale * size - scale**2, 1.0))
    return jnp.where(size > scale, jnp.sign(residual) * outer, residual)


def cauchy(residual: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Residuals whose half squares are Cauchy's loss, `scale^2 / 2 log(1 + (residual / scale)^2)`."""
    ratio2 = jnp.square(residual / scale)
    small = ratio2 < 1e-8
    factor = jnp.sqrt(jnp.log1p(jnp.where(small, 1.0, ratio2)) / jnp.where(small, 1.0, ratio2))
    return residual * jnp.where(small, 1 - ratio2 / 4, factor)


def _damped(hessian, gradient, damping, free):
    both = free[:, None] & free
    matrix = jnp.where(both, hessian, 0.0) + jnp.diag(jnp.where(free, damping, 1.0))
    rest = jnp.where(free, gradient, 0.0)
    if rest.size > _SMALL:
        return -jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), rest)
    L = cholesky(matrix)
    return -solve_triangular(L, solve_triangular(L, rest), transpose=True)


def _learnt(x, state: _State, gradient):
    """What the normal matrix lacks of the Hessian, by one more step: the update of Dennis, Gay and Welsch (1981).

    Of all symmetric matrices that explain how the Jacobian's change turned the residuals, the nearest to the last one,
    once this is made smaller where it is too large for the step.
    """
    step, last = state.step, state.lacking
    change, turned = gradient - state.gradient, gradient - state.crossed
    by_last = _product(last, step)
    curvature, had, needed = jnp.sum(change * step), jnp.abs(jnp.sum(step * by_last)), jnp.abs(jnp.sum(step * turned))
    sized = jnp.where(had > needed, needed / jnp.where(had > 0, had, 1.0), 1.0)
    # Of short steps rounding is all that is seen.
    longest = jnp.finfo(x.dtype).eps ** 0.5 * (1 + jnp.max(jnp.abs(x), initial=0.0))
    tells = (jnp.max(jnp.abs(step), initial=0.0) > longest) & (curvature > 1e-6 * safe_norm(change) * safe_norm(step))
    along = change / jnp.where(tells, curvature, 1.0)
    missing = turned - sized * by_last
    outer = missing[:, None] * along
    after = sized * last + outer + outer.T - jnp.sum(missing * step) * along[:, None] * along
    return jnp.where(tells, after, last)


def _product(a, b):
    return jnp.matmul(a, b, precision="highest")
