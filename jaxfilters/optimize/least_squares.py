"""Nonlinear least squares within bounds: a Levenberg-Marquardt solver for optimistix, whose own solvers ignore bounds.

The damping follows the gain ratio (H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, 1999),
and variables of the active set are fixed during a step. A step that does not decrease the error is shortened or, if
that fails or it is not a descent direction, damped more, which turns it towards a projected gradient step (C. Kanzow,
N. Yamashita and M. Fukushima, "Levenberg-Marquardt methods with strong local convergence properties for solving
nonlinear equations with convex constraints", J. Computational and Applied Mathematics 172(2), 2004; D. P. Bertsekas,
"On the Goldstein-Levitin-Polyak gradient projection method", IEEE Trans. Automatic Control 21(2), 1976). All iterates
satisfy the bounds, and the error never increases.

If the residuals at the solution are large, `J^T J` is a poor approximation of the Hessian. A quasi-Newton correction of
it is estimated from the steps, and used if it predicts the decrease better (J. E. Dennis, D. M. Gay and R. E. Welsch,
"An adaptive nonlinear least-squares algorithm", ACM Trans. Mathematical Software 7(3), 1981).
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
    QuadraticModel,
    active_set,
    bounded_step,
    converged,
    current_damping,
    line_search,
    projected_gradient_norm,
    updated_damping,
)

_SMALL = 8
"""Number of variables up to which `jaxfilters.math.linalg` is faster than LAPACK, ten times for batches."""


class _State(eqx.Module):
    damping: Float[Array, ""]
    """0 before the first step."""
    growth: Float[Array, ""]
    """Factor by which the damping grows at the next failure."""
    correction: Float[Array, "n n"]
    """Quasi-Newton estimate of the Hessian minus the normal matrix."""
    use_correction: Bool[Array, ""]
    """Whether the next step uses the correction."""
    step: Float[Array, " n"]
    """The last step, 0 if it was rejected."""
    gradient: Float[Array, " n"]
    """The gradient before the last step."""
    mixed_gradient: Float[Array, " n"]
    """The Jacobian before the last step, transposed, times the residuals after it."""
    terminate: Bool[Array, ""]
    result: optimistix.RESULTS


class BoxLevenbergMarquardt(optimistix.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within bounds with dense matrices, for up to some hundreds of variables.

    The `options` of `optimistix.least_squares` take `lower` and `upper`: numbers, or pytrees like `y`; absent or
    infinite where there is no bound. A start that violates them is projected onto them. The solver has converged when a
    step changes no variable by more than `rtol (1 + max |y|)`, when the projected gradient is at most `atol` in every
    variable, or when rounding error permits no further decrease. Residuals or derivatives that are not finite, and
    contradictory bounds that are known only at run time, end it with the result `nonlinear_divergence`. Jacobians are
    computed in forward mode. To differentiate the solution, pass `adjoint=BoxAdjoint()`: variables on their bounds then
    depend on the bounds.

    Raises:
        ValueError: When it is traced, if a bound does not match `y`, a lower bound exceeds the upper one, or there are
            no residuals.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> import optimistix
        >>> solver = jf.optimize.BoxLevenbergMarquardt(rtol=1e-6, atol=1e-6)
        >>> residuals = lambda y, args: jnp.array([y[0] - 3.0, y[1] + 1.0])
        >>> options = {"lower": 0.0, "upper": jnp.array([2.0, jnp.inf])}
        >>> print(optimistix.least_squares(residuals, solver, jnp.ones(2), None, options).value)
        [2. 0.]
    """

    rtol: float
    """Relative tolerance of the step."""
    atol: float
    """Absolute tolerance of the projected gradient."""
    norm: Callable[[PyTree], Array] = optimistix.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """State before the first step, which chooses the damping."""
        del fn, args, options, f_struct, aux_struct, tags
        flat = ravel_pytree(y)[0]
        none, zeros, no = jnp.zeros((), flat.dtype), jnp.zeros_like(flat), jnp.zeros((), bool)
        # equinox declares the items of an enumeration as the strings that they are written with.
        underway = cast(optimistix.RESULTS, optimistix.RESULTS.successful)
        correction = jnp.zeros((flat.size, flat.size), flat.dtype)
        return _State(none, none + 2, correction, no, zeros, zeros, zeros, no, underway)

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[PyTree, _State, Any]:
        """One accepted step, or a rejected one and more damping of the next one."""
        del tags
        flat, unravel = ravel_pytree(y)
        lower, upper = bounds_of(options, y)
        x = jnp.clip(flat, lower, upper)
        residuals = lambda x: ravel_pytree(fn(unravel(x), args)[0])[0]
        J, r = jax.jacfwd(lambda x: (residuals(x),) * 2, has_aux=True)(x)
        if not r.size:
            raise ValueError("fn must return at least one residual; got none.")
        gradient, normal = _product(r, J), _product(J.T, J)
        damping = current_damping(state.damping, jnp.diagonal(normal))
        correction = _updated_correction(x, state, gradient)
        hessian = jnp.where(state.use_correction, normal + correction, normal)
        free = ~active_set(x, gradient, lower, upper)
        largest = jnp.max(jnp.diagonal(normal), initial=0.0)
        corrected = lambda step: jnp.where(state.use_correction, _product(correction, step), 0.0)
        product = lambda step: _product(normal, step) + corrected(step)
        model = QuadraticModel(x, r, gradient, product, 1 / jnp.maximum(damping, largest))
        solve = lambda gradient, free: _damped_step(hessian, gradient, damping, free)
        direction, is_definite = bounded_step(solve, model, free, (lower, upper))
        found = line_search(residuals, model, direction, (lower, upper), ~state.terminate)
        # The error of the decrease that the normal matrix predicts; the correction is used if it would reduce this
        # error.
        full_step = found.full_step
        curvature = lambda matrix: 0.5 * jnp.sum(full_step * _product(matrix, full_step))
        error = found.decrease + jnp.sum(gradient * full_step) + curvature(normal)
        small = projected_gradient_norm(x, gradient, (lower, upper)) <= self.atol
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J)) & jnp.all(lower <= upper)
        after = _State(
            *updated_damping(damping, state.growth, found.is_success & is_definite, found.gain_ratio, largest),
            correction,
            jnp.abs(error + curvature(correction)) < jnp.abs(error),
            found.point - x,
            gradient,
            _product(found.residuals, J),
            found.is_stagnant | converged(model, found, (lower, upper), self.rtol) | small | ~finite,
            optimistix.RESULTS.where(finite, optimistix.RESULTS.successful, optimistix.RESULTS.nonlinear_divergence),
        )
        best = unravel(jnp.where(small | ~finite, x, found.point))
        return best, after, fn(best, args)[1]

    def terminate(self, fn, y, args, options, state: _State, tags) -> tuple[Array, optimistix.RESULTS]:
        """Whether the last step was the last one, and why."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[PyTree, Any, dict]:
        """The solution, unchanged."""
        del fn, args, options, state, tags, result
        return y, aux, {}


class BoxAdjoint(optimistix.ImplicitAdjoint):
    """Derivatives of a solution within bounds by the implicit function theorem.

    Variables of the active set are equal to their bounds; the others satisfy the stationarity of the error.
    """

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        """As `optimistix.ImplicitAdjoint`, with the stationarity condition of the bounded problem."""
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


# Optimistix requires a plain function of a module, not one that a type checker has wrapped.
_stationarity = getattr(_stationarity, "__wrapped__", _stationarity)


def bounds_of(options: dict[str, Any], y: PyTree) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Lower and upper bounds of all variables as vectors (n,), infinite where none is given.

    Args:
        options: May have the keys `lower` and `upper`: numbers, or pytrees like `y`.
        y: The variables.

    Raises:
        ValueError: If a bound does not have the structure and shapes of `y`, or, unless it is traced, a lower bound
            exceeds the upper one or is NaN.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> lower, upper = jf.optimize.bounds_of({"lower": 0.0}, jnp.ones(2))
        >>> lower.tolist(), upper.tolist()
        ([0.0, 0.0], [inf, inf])
    """
    numbers = options.get("lower"), options.get("upper")
    lowest, highest = (
        n if isinstance(n, int | float) else none for n, none in zip(numbers, (-np.inf, np.inf), strict=True)
    )
    if not lowest <= highest:
        raise ValueError(f"lower must be at most upper; got {numbers[0]} and {numbers[1]}.")
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
    """The covariance of a solution whose residuals have unit variance: the inverse normal matrix of the free variables.

    Rows and columns of variables in the active set are zero. Directions on which no residual depends have infinite
    variance; the pseudo-inverse gives them zero.

    Args:
        fn: `(y, args) -> residuals`.
        y: The solution, a pytree of n numbers.
        args: Passed to `fn`.
        options: `lower` and `upper` as for the solver.

    Returns:
        (n, n), in the order of `jax.flatten_util.ravel_pytree`.

    Examples:
        The mean of four numbers.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> residuals = lambda y, args: y - jnp.array([1.0, 2.0, 3.0, 6.0])
        >>> covariance = jax.jit(lambda mean: jf.optimize.covariance(residuals, mean))(jnp.array(3.0))
        >>> round(float(covariance[0, 0]), 3)
        0.25
    """
    flat, unravel = ravel_pytree(y)
    residuals = lambda x: ravel_pytree(fn(unravel(x), args))[0]
    J = jax.jacfwd(residuals)(flat)
    free = ~active_set(flat, _product(J.T, residuals(flat)), *bounds_of(options or {}, y))
    both = free[:, None] & free
    information = jnp.where(both, _product(J.T, J), 0.0)
    # Scaled to ones on the diagonal: variables have different units, and the pseudo-inverse drops what is small.
    diagonal = jnp.diagonal(information)
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    inverse = jnp.linalg.pinv(scale[:, None] * information * scale, hermitian=True)
    return jnp.where(both, scale[:, None] * inverse * scale, 0.0)


def huber(residual: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Residuals whose half squares are Huber's loss: quadratic up to `scale`, linear beyond.

    See P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35(1), 1964.

    Args:
        residual: Residuals of any shape.
        scale: Positive, in the unit of the residuals.

    Raises:
        ValueError: If `scale` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> small, large = jf.optimize.huber(jnp.array([0.5, 5.0]), scale=1.0)
        >>> round(float(small), 3), round(float(large), 3)  # sqrt(2 * 5 - 1) = 3
        (0.5, 3.0)
    """
    _check_scale(scale)
    size = jnp.abs(residual)
    outer = jnp.sqrt(jnp.where(size > scale, 2 * scale * size - scale**2, 1.0))
    return jnp.where(size > scale, jnp.sign(residual) * outer, residual)


def cauchy(residual: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Residuals whose half squares are Cauchy's loss, `scale^2 / 2 log(1 + (residual / scale)^2)`.

    Args:
        residual: Residuals of any shape.
        scale: Positive, in the unit of the residuals.

    Raises:
        ValueError: If `scale` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> round(float(jf.optimize.cauchy(jnp.array(1.0), scale=1.0) ** 2), 3)  # log(2)
        0.693
    """
    _check_scale(scale)
    ratio2 = jnp.square(residual / scale)
    small = ratio2 < 1e-8
    factor = jnp.sqrt(jnp.log1p(jnp.where(small, 1.0, ratio2)) / jnp.where(small, 1.0, ratio2))
    return residual * jnp.where(small, 1 - ratio2 / 4, factor)


def _check_scale(scale: float | Array) -> None:
    if not isinstance(scale, jax.core.Tracer) and not np.all(np.asarray(scale) > 0):
        raise ValueError(f"scale must be positive; got {scale}.")


def _damped_step(hessian, gradient, damping, free):
    both = free[:, None] & free
    matrix = jnp.where(both, hessian, 0.0) + jnp.diag(jnp.where(free, damping, 1.0))
    masked = jnp.where(free, gradient, 0.0)
    if masked.size > _SMALL:
        return -jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), masked)
    L = cholesky(matrix)
    return -solve_triangular(L, solve_triangular(L, masked), transpose=True)


def _updated_correction(x, state: _State, gradient):
    """The quasi-Newton correction after one more step (Dennis, Gay and Welsch 1981).

    It is the symmetric matrix nearest to the last correction, scaled down if that is too large, that satisfies the
    secant equation `S step = (J_new - J_old)^T r_new`.
    """
    step, last = state.step, state.correction
    change, secant = gradient - state.gradient, gradient - state.mixed_gradient
    product = _product(last, step)
    curvature = jnp.sum(change * step)
    size, required = jnp.abs(jnp.sum(step * product)), jnp.abs(jnp.sum(step * secant))
    scale = jnp.where(size > required, required / jnp.where(size > 0, size, 1.0), 1.0)
    # The secants of very short steps consist of rounding error.
    shortest = jnp.finfo(x.dtype).eps ** 0.5 * (1 + jnp.max(jnp.abs(x), initial=0.0))
    usable = jnp.max(jnp.abs(step), initial=0.0) > shortest
    usable &= curvature > 1e-6 * safe_norm(change) * safe_norm(step)
    along = change / jnp.where(usable, curvature, 1.0)
    defect = secant - scale * product
    outer = defect[:, None] * along
    after = scale * last + outer + outer.T - jnp.sum(defect * step) * along[:, None] * along
    return jnp.where(usable, after, last)


def _product(a, b):
    return jnp.matmul(a, b, precision="highest")
