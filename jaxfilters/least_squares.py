"""Nonlinear least squares within bounds: a Levenberg-Marquardt solver for optimistix, whose own ones ignore bounds.

    solver = BoxLevenbergMarquardt(rtol=1e-8, atol=1e-8)
    options = {"lower": lower, "upper": upper}
    optimistix.least_squares(fn, solver, y0, args, options, adjoint=BoxAdjoint())

Damping follows the gain ratio (H. B. Nielsen 1999), variables that a bound holds are frozen, and a step that does not
decrease the error is shortened, or gives way to a projected gradient (C. Kanzow, N. Yamashita, M. Fukushima,
"Levenberg-Marquardt methods with strong local convergence properties for solving nonlinear equations with convex
constraints", 2004). All iterates lie within the bounds, and the error never grows.
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

_SUFFICIENT = 0.99995**2
"""Factor of the error from which on a step counts as a success without looking at the model."""
_LEAST_GAIN, _ARMIJO = 1e-3, 1e-4
_MOST_HALVINGS = 40
_FIRST_DAMPING = 1e-3
"""Of the largest diagonal element of the normal matrix."""


class _State(eqx.Module):
    damping: Float[Array, ""]
    """0 before the first step."""
    growth: Float[Array, ""]
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
        dtype = ravel_pytree(y)[0].dtype
        # equinox declares the items of an enumeration as the strings that they are written with.
        underway = cast(optimistix.RESULTS, optimistix.RESULTS.successful)
        return _State(jnp.zeros((), dtype), jnp.full((), 2.0, dtype), jnp.zeros((), bool), underway)

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[PyTree, _State, Any]:
        """One step that is taken, or none if nothing decreases the error."""
        del tags
        flat, unravel = ravel_pytree(y)
        lower, upper = bounds_of(options, y)
        x = jnp.clip(flat, lower, upper)
        residuals = lambda x: ravel_pytree(fn(unravel(x), args)[0])[0]
        r, J = residuals(x), jax.jacfwd(residuals)(x)
        gradient, normal = _product(J.T, r), _product(J.T, J)
        energy = 0.5 * jnp.sum(r * r)
        damping = jnp.where(state.damping > 0, state.damping, _FIRST_DAMPING * jnp.max(jnp.diagonal(normal)))
        # A Jacobian of zeros is the end, not a division by zero.
        damping = jnp.maximum(damping, jnp.finfo(x.dtype).tiny ** 0.5)
        free = ~held(x, gradient, lower, upper)
        direction = _damped(normal, gradient, damping, free)
        energy_at = lambda x: 0.5 * jnp.sum(jnp.square(residuals(x)))
        product = lambda step: _product(normal, step)
        taken, success, gain = searched(energy_at, x, direction, gradient, product, energy, lower, upper)
        factor = jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
        moved = jnp.max(jnp.abs(taken - x), initial=0.0) > self.rtol * (1 + jnp.max(jnp.abs(x), initial=0.0))
        small = jnp.max(jnp.abs(x - jnp.clip(x - gradient, lower, upper)), initial=0.0) <= self.atol
        finite = jnp.isfinite(energy) & jnp.all(jnp.isfinite(J)) & jnp.all(lower <= upper)
        after = _State(
            jnp.where(success, damping * factor, damping * state.growth),
            jnp.where(success, 2.0, 2 * state.growth).astype(x.dtype),
            ~moved | small | ~finite,
            optimistix.RESULTS.where(finite, optimistix.RESULTS.successful, optimistix.RESULTS.nonlinear_divergence),
        )
        best = unravel(jnp.where(small | ~finite, x, taken))
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
        wrong = ~np.asarray(lower <= upper)
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


def held(
    x: Float[Array, " n"], gradient: Float[Array, " n"], lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Bool[Array, " n"]:
    """Which variables a bound holds against the descent direction."""
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))


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
    free = ~held(flat, _product(J.T, residuals(flat)), *bounds_of(options or {}, y))
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


def schur(
    U: Float[Array, "s s"],
    W: Float[Array, "frames s f"],
    V: Float[Array, "frames f f"],
    b_shared: Float[Array, " s"],
    b_frames: Float[Array, "frames f"],
) -> tuple[Float[Array, " s"], Float[Array, "frames f"]]:
    """Solution of normal equations in which frames share some variables, in time linear in the frames.

    `[[U, W], [W^T, V]] (x, y) = (b_shared, b_frames)` with a block of V for each frame, by the Schur complement of V.
    """
    solve = lambda V, b: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(V), True), b)
    # One by one: batches of factorisations can stand still on two cores.
    both = jnp.concatenate([jnp.swapaxes(W, 1, 2), b_frames[..., None]], axis=-1)
    solved = jax.lax.map(lambda frame: solve(*frame), (V, both))
    VW, Vb = solved[..., :-1], solved[..., -1]
    S = U - jnp.einsum("nsf,nft->st", W, VW, precision="highest")
    x = solve(S, b_shared - jnp.einsum("nsf,nf->s", W, Vb, precision="highest"))
    return x, Vb - jnp.einsum("nfs,s->nf", VW, x, precision="highest")


def _damped(normal, gradient, damping, free):
    """The damped step of the free variables; the others stay."""
    both = free[:, None] & free
    matrix = jnp.where(both, normal, 0.0) + jnp.diag(jnp.where(free, damping, 1.0))
    step = -jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), jnp.where(free, gradient, 0.0))
    # Rounding can take a nearly singular matrix below zero; the gradient then leads on.
    return jnp.where(jnp.all(jnp.isfinite(step)), step, -jnp.where(free, gradient, 0.0) / damping)


def searched(
    energy_at: Callable[[Array], Array],
    x: Float[Array, " n"],
    direction: Float[Array, " n"],
    gradient: Float[Array, " n"],
    product: Callable[[Array], Array],
    energy: Float[Array, ""],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Bool[Array, ""], Float[Array, ""]]:
    """The next point within the bounds, whether the whole step was a success, and its gain ratio, 0 to 1.

    A step that fails is halved, or where it does not descend the projected gradient is, until the energy falls enough
    (L. Armijo 1966); where nothing does, the point stays.

    Args:
        energy_at: `x -> energy`, half the sum of squares.
        x: Where the step begins.
        direction: The step.
        gradient: Of the energy at `x`.
        product: `step -> N step` with the normal matrix.
        energy: At `x`.
        lower: Bounds.
        upper: Bounds.
    """
    trial = jnp.clip(x + direction, lower, upper)
    step = trial - x
    predicted = -jnp.sum(gradient * step) - 0.5 * jnp.sum(step * product(step))
    there = energy_at(trial)
    gain = (energy - there) / jnp.where(predicted > 0, predicted, 1.0)
    success = (there <= _SUFFICIENT * energy) | ((predicted > 0) & (gain > _LEAST_GAIN))
    descends = jnp.sum(gradient * step) < 0

    def at(t):
        along = x + t * step
        projected = jnp.clip(x - t * gradient, lower, upper)
        return jnp.where(descends, along, projected)

    def enough(t):
        point = at(t)
        return energy_at(point) <= energy + _ARMIJO * jnp.sum(gradient * (point - x))

    def shorten(carry):
        t, count, _ = carry
        t = 0.5 * t
        return t, count + 1, enough(t)

    start = (jnp.ones((), x.dtype), jnp.zeros((), jnp.int32), success)
    t, _, found = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[1] < _MOST_HALVINGS), shorten, start)
    point = jnp.where(success, trial, jnp.where(found, at(t), x))
    return point, success, jnp.clip(gain, 0.0, 1.0)


def _product(a, b):
    return jnp.matmul(a, b, precision="highest")
