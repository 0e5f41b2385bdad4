"""Least squares within bounds for many frames that share some variables, in time linear in the number of frames.

Bundle adjustment, camera calibration and hand-eye calibration have this form. The method is that of
`BoxLevenbergMarquardt` without its quasi-Newton correction; the normal equations are solved by the Schur complement of
the variables of the frames (B. Triggs, P. McLauchlan, R. Hartley and A. Fitzgibbon, "Bundle adjustment: a modern
synthesis", Vision Algorithms: Theory and Practice, 2000, section 6.1).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

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
from jaxfilters.optimize.least_squares import bounds_of


class Split(NamedTuple):
    """Shared variables and those of the frames, or bounds of both.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> start = jf.optimize.Split(shared=jnp.zeros(3), frames=jnp.zeros((10, 6)))  # 6 for each of 10 frames
        >>> start.frames.shape
        (10, 6)
    """

    shared: PyTree
    """Variables of all frames."""
    frames: PyTree
    """Variables of single frames: leaves with a leading axis of n frames."""


class SharedSolution(NamedTuple):
    """The solution of `solve_shared`."""

    value: Split
    """The variables."""
    energy: Float[Array, ""]
    """Half the sum of squared residuals."""
    projected_gradient: Float[Array, ""]
    """Maximum norm of the projected gradient: 0 at a solution."""
    steps: Int[Array, ""]
    """Number of steps."""
    finite: Bool[Array, ""]
    """False if residuals or derivatives became infinite or NaN; the value is then the last finite one."""


class _Blocks(NamedTuple):
    """Blocks of the normal equations: [[U, W], [W^T, V]] with a block of W and V for each frame."""

    U: Float[Array, "s s"]
    W: Float[Array, "n s f"]
    V: Float[Array, "n f f"]
    shared: Float[Array, " s"]
    """Gradient with respect to the shared variables."""
    frames: Float[Array, "n f"]
    """Gradient with respect to the variables of the frames."""

    def product(self, x: Float[Array, " s"], y: Float[Array, "n f"]) -> tuple[Array, Array]:
        """Normal matrix times (x, y)."""
        dot = lambda spec, *a: jnp.einsum(spec, *a, precision="highest")
        return dot("st,t->s", self.U, x) + dot("nsf,nf->s", self.W, y), dot("nsf,s->nf", self.W, x) + dot(
            "nfg,ng->nf", self.V, y
        )


def solve_shared(
    residuals: Callable[[Any, Any, Any], Float[Array, " rows"]],
    start: Split,
    data: PyTree,
    *,
    prior: Callable[[Any], Float[Array, " rows"]] | None = None,
    lower: Split | None = None,
    upper: Split | None = None,
    steps: int = 100,
    rtol: float = 1e-8,
    atol: float = 1e-8,
) -> SharedSolution:
    """The variables of least energy, half the sum of squared residuals, within bounds.

    Args:
        residuals: `(shared, frame, data) -> residuals` of one frame, an array or a pytree of arrays.
        start: Initial variables; a start that violates the bounds is projected onto them.
        data: Observations: leaves with a leading axis of n frames.
        prior: `shared -> residuals` of a Gaussian prior.
        lower: Lower bounds with the structure of `start`; none where absent or infinite.
        upper: Upper bounds likewise.
        steps: Upper bound on the number of steps.
        rtol: The solver has converged when no variable changes by more than `rtol (1 + max |x|)`.
        atol: It has also converged when the projected gradient is at most this in every variable.

    Raises:
        ValueError: If a bound does not have the structure of `start`, a lower bound exceeds the upper one, or the
            leaves
            of `start.frames` and `data` do not share one number of frames.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> data = jnp.array([[1.0, 2.0], [4.0, 5.0]])  # one offset a frame, and one common difference
        >>> residuals = lambda shared, frame, data: data - jnp.stack([frame, frame + shared])
        >>> start = jf.optimize.Split(shared=jnp.zeros(()), frames=jnp.zeros(2))
        >>> solution = jf.optimize.solve_shared(residuals, start, data, rtol=1e-6, atol=1e-5)
        >>> print(solution.value.shared.round(3), solution.value.frames.round(3))
        1.0 [1. 4.]
    """
    _check_frames(start, data)
    flat, whole = _flattened(start)
    _, as_tree = ravel_pytree(start)
    low, high = (_flattened(as_tree(side))[0] for side in bounds_of({"lower": lower, "upper": upper}, start))
    problem = _problem(residuals, prior, start, data)
    advance = partial(_advance, problem, low, high, rtol, atol)
    x = jnp.clip(flat, low, high)
    zero, yes = jnp.zeros((), x.dtype), jnp.ones((), bool)
    begin = _Iterate(x, problem.residuals(x), zero, zero + 2, jnp.zeros((), jnp.int32), yes, yes)
    end = jax.lax.while_loop(lambda iterate: iterate.unfinished & (iterate.steps < steps), advance, begin)
    blocks = _blocks(problem, end.x)
    remaining = projected_gradient_norm(end.x, problem.join(blocks.shared, blocks.frames), (low, high))
    return SharedSolution(whole(end.x), 0.5 * jnp.sum(jnp.square(end.residuals)), remaining, end.steps, end.finite)


class _Iterate(NamedTuple):
    """The state between two steps."""

    x: Array
    residuals: Array
    damping: Array
    """0 before the first step."""
    growth: Array
    """Factor by which the damping grows at the next failure."""
    steps: Array
    unfinished: Array
    finite: Array


def _advance(problem: "_Problem", low: Array, high: Array, rtol: float, atol: float, iterate: _Iterate) -> _Iterate:
    """One step of Levenberg-Marquardt within the bounds; the point stays if no step decreases the energy."""
    x, split, join = iterate.x, problem.split, problem.join
    blocks = _blocks(problem, x)
    gradient = join(blocks.shared, blocks.frames)
    diagonal = join(jnp.diagonal(blocks.U), jnp.diagonal(blocks.V, axis1=1, axis2=2))
    damping = current_damping(iterate.damping, diagonal)
    free = ~active_set(x, gradient, low, high)
    largest = jnp.max(diagonal)
    product = lambda step: join(*blocks.product(*split(step)))
    model = QuadraticModel(x, iterate.residuals, gradient, product, 1 / jnp.maximum(damping, largest))
    solve = lambda gradient, free: join(*_step(blocks, damping, split(gradient), split(free)))
    direction, is_definite = bounded_step(solve, model, free, (low, high))
    found = line_search(problem.residuals, model, direction, (low, high), iterate.unfinished)
    finite = jnp.all(jnp.isfinite(iterate.residuals)) & jnp.all(jnp.isfinite(gradient))
    ends = found.is_stagnant | converged(model, found, (low, high), rtol)
    ends |= projected_gradient_norm(x, gradient, (low, high)) <= atol
    return _Iterate(
        jnp.where(finite, found.point, x),
        jnp.where(finite, found.residuals, iterate.residuals),
        *updated_damping(damping, iterate.growth, found.is_success & is_definite, found.gain_ratio, largest),
        iterate.steps + 1,
        ~ends & finite,
        finite,
    )


def _flattened(start: Split) -> tuple[Array, Callable[[Array], Split]]:
    """All variables as one vector, the shared ones first and the others frame by frame, and the inverse function."""
    shared, to_shared = ravel_pytree(start.shared)
    one, to_frame = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], start.frames))
    frames = jax.vmap(lambda frame: ravel_pytree(frame)[0])(start.frames)

    def whole(x: Array) -> Split:
        return Split(to_shared(x[: shared.size]), jax.vmap(to_frame)(x[shared.size :].reshape(-1, one.size)))

    return jnp.concatenate([shared, frames.ravel()]), whole


class _Problem(NamedTuple):
    """The residuals as functions of vectors of variables."""

    of_frame: Callable[[Array, Array, Any], Array]
    of_prior: Callable[[Array], Array]
    data: PyTree
    size: int
    """Number of shared variables, which come first."""
    frames: int
    """Number of frames."""

    def split(self, x: Array) -> tuple[Array, Array]:
        """The shared variables (s,), and those of the frames (n, f), of a vector of all variables."""
        return x[: self.size], x[self.size :].reshape(self.frames, -1)

    def join(self, shared: Array, frames: Array) -> Array:
        """The inverse of `split`."""
        return jnp.concatenate([shared, frames.ravel()])

    def residuals(self, x: Array) -> Array:
        """The residuals of all frames and of the prior."""
        s, f = self.split(x)
        of_frames = jax.vmap(self.of_frame, (None, 0, 0))(s, f, self.data)
        return jnp.concatenate([of_frames.ravel(), self.of_prior(s)])


def _check_frames(start: Split, data: PyTree) -> None:
    shapes = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)
        for name, tree in (("start.frames", start.frames), ("data", data))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    if not jax.tree.leaves(start.frames):
        raise ValueError("start.frames must have at least one array with a leading axis of frames; got none.")
    if () in shapes.values() or len({shape[0] for shape in shapes.values()}) != 1:
        raise ValueError(f"start.frames and data must share one number of frames as their first axis; got {shapes}.")


def _problem(residuals, prior, start: Split, data: PyTree) -> _Problem:
    shared, to_shared = ravel_pytree(start.shared)
    _, to_frame = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], start.frames))
    of_frame = lambda s, f, data: ravel_pytree(residuals(to_shared(s), to_frame(f), data))[0]
    of_prior = (lambda s: ravel_pytree(prior(to_shared(s)))[0]) if prior else (lambda s: jnp.zeros(0, s.dtype))
    return _Problem(of_frame, of_prior, data, shared.size, jax.tree.leaves(start.frames)[0].shape[0])


def _blocks(problem: _Problem, x: Array) -> _Blocks:
    s, f = problem.split(x)

    def one(f: Array, data: Any) -> tuple[Array, Array, Array]:
        r = problem.of_frame(s, f, data)
        return r, *jax.jacfwd(problem.of_frame, (0, 1))(s, f, data)

    r, by_shared, by_frame = jax.vmap(one)(f, problem.data)
    prior, by_prior = problem.of_prior(s), jax.jacfwd(problem.of_prior)(s)
    dot = lambda spec, *a: jnp.einsum(spec, *a, precision="highest")
    return _Blocks(
        U=dot("nrs,nrt->st", by_shared, by_shared) + dot("rs,rt->st", by_prior, by_prior),
        W=dot("nrs,nrf->nsf", by_shared, by_frame),
        V=dot("nrf,nrg->nfg", by_frame, by_frame),
        shared=dot("nrs,nr->s", by_shared, r) + dot("rs,r->s", by_prior, prior),
        frames=dot("nrf,nr->nf", by_frame, r),
    )


def _step(blocks: _Blocks, damping: Array, gradient: tuple, free: tuple) -> tuple[Array, Array]:
    """The damped step of the free variables. `gradient` and `free` are pairs as `_Problem.split` returns them."""
    (of_shared, of_frames), (free_shared, free_frames) = gradient, free
    U = jnp.where(free_shared[:, None] & free_shared, blocks.U, 0.0)
    W = jnp.where(free_shared[:, None] & free_frames[:, None], blocks.W, 0.0)
    V = jnp.where(free_frames[:, :, None] & free_frames[:, None], blocks.V, 0.0)
    U += jnp.diag(jnp.where(free_shared, damping, 1.0))
    V += jax.vmap(jnp.diag)(jnp.where(free_frames, damping, 1.0))
    return schur(U, W, V, -jnp.where(free_shared, of_shared, 0.0), -jnp.where(free_frames, of_frames, 0.0))


def schur(
    U: Float[Array, "s s"],
    W: Float[Array, "frames s f"],
    V: Float[Array, "frames f f"],
    b_shared: Float[Array, " s"],
    b_frames: Float[Array, "frames f"],
) -> tuple[Float[Array, " s"], Float[Array, "frames f"]]:
    """The solution of normal equations in which frames share some variables, in time linear in the number of frames.

    It solves `[[U, W], [W^T, V]] (x, y) = (b_shared, b_frames)`, where V is block diagonal with one block for each
    frame, by the Schur complement of V.

    Args:
        U: (s, s), positive definite with W and V.
        W: (n, s, f).
        V: (n, f, f), positive definite.
        b_shared: (s,).
        b_frames: (n, f).

    Returns:
        x (s,) and y (n, f); NaN if a matrix is not positive definite.

    Examples:
        Two frames with one variable each, 2 and 3, and a shared one, 1.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> U, W, V = jnp.full((1, 1), 4.0), jnp.ones((2, 1, 1)), jnp.full((2, 1, 1), 2.0)
        >>> x, y = jax.jit(jf.optimize.schur)(U, W, V, jnp.array([9.0]), jnp.array([[5.0], [7.0]]))
        >>> round(float(x[0]), 3), [round(v, 3) for v in y[:, 0].tolist()]
        (1.0, [2.0, 3.0])
    """
    solve = lambda V, b: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(V), True), b)
    # One frame after the other: batches of matrix factorisations can deadlock on two cores.
    both = jnp.concatenate([jnp.swapaxes(W, 1, 2), b_frames[..., None]], axis=-1)
    solved = jax.lax.map(lambda frame: solve(*frame), (V, both))
    VW, Vb = solved[..., :-1], solved[..., -1]
    S = U - jnp.einsum("nsf,nft->st", W, VW, precision="highest")
    x = solve(S, b_shared - jnp.einsum("nsf,nf->s", W, Vb, precision="highest"))
    return x, Vb - jnp.einsum("nfs,s->nf", VW, x, precision="highest")
