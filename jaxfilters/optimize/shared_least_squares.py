"""Least squares within bounds where many frames share some variables: steps in time linear in the frames.

    residuals = lambda shared, frame, data: ...          # of one frame
    solution = solve_shared(residuals, Split(shared, frames), data, steps=50)

Bundle adjustment, calibration and hand-eye problems are of this form. Steps are those of `BoxLevenbergMarquardt`; the
normal equations are solved by the Schur complement of the frames' own variables.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

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
from jaxfilters.optimize.least_squares import bounds_of


class Split(NamedTuple):
    """Variables, or bounds of them."""

    shared: PyTree
    frames: PyTree
    """Leaves with a leading axis of n frames."""


class SharedSolution(NamedTuple):
    """How it ended."""

    value: Split
    energy: Float[Array, ""]
    """Half of the sum of squared residuals."""
    projected_gradient: Float[Array, ""]
    """Largest change of a variable by a gradient step within the bounds: 0 at a solution."""
    steps: Int[Array, ""]
    finite: Bool[Array, ""]
    """False if residuals or derivatives became infinite or NaN; the value is the last good one."""


class _Blocks(NamedTuple):
    """Normal equations, a block for each frame."""

    U: Float[Array, "s s"]
    W: Float[Array, "n s f"]
    V: Float[Array, "n f f"]
    shared: Float[Array, " s"]
    """Gradient."""
    frames: Float[Array, "n f"]

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
    """Variables of least energy within their bounds, by at most so many steps.

    Args:
        residuals: `(shared, frame, data of the frame) -> residuals`.
        start: Moved to the nearest point within the bounds if outside.
        data: Leaves with a leading axis of n frames.
        prior: `shared -> residuals`.
        lower: Bounds with the structure of `start`; none where absent or infinite.
        upper: The same.
        steps: Largest number of steps.
        rtol: It ends when no variable moves by more than `rtol (1 + |x|)`, with the largest |x|.
        atol: Or when the projected gradient is at most this.

    Raises:
        ValueError: if a bound has another structure than `start`, or a lower one is above the upper one.
    """
    flat, whole = _flattened(start)
    _, as_tree = ravel_pytree(start)
    low, high = (_flattened(as_tree(side))[0] for side in bounds_of({"lower": lower, "upper": upper}, start))
    problem = _problem(residuals, prior, start, data)
    advance = partial(_advance, problem, low, high, rtol, atol)
    x = jnp.clip(flat, low, high)
    zero, yes = jnp.zeros((), x.dtype), jnp.ones((), bool)
    begin = _Walk(x, problem.residuals(x), zero, zero + 2, jnp.zeros((), jnp.int32), yes, yes)
    end = jax.lax.while_loop(lambda walk: walk.goes_on & (walk.steps < steps), advance, begin)
    blocks = _blocks(problem, end.x)
    rest = by_gradient(end.x, problem.join(blocks.shared, blocks.frames), (low, high))
    return SharedSolution(whole(end.x), 0.5 * jnp.sum(jnp.square(end.residuals)), rest, end.steps, end.finite)


class _Walk(NamedTuple):
    """Between two steps."""

    x: Array
    residuals: Array
    damping: Array
    """0 before the first step."""
    growth: Array
    steps: Array
    goes_on: Array
    finite: Array


def _advance(problem: "_Problem", low: Array, high: Array, rtol: float, atol: float, walk: _Walk) -> _Walk:
    """One step of Levenberg-Marquardt within the bounds, or none if nothing decreases the energy."""
    x, split, join = walk.x, problem.split, problem.join
    blocks = _blocks(problem, x)
    gradient = join(blocks.shared, blocks.frames)
    diagonal = join(jnp.diagonal(blocks.U), jnp.diagonal(blocks.V, axis1=1, axis2=2))
    damping = damping_of(walk.damping, diagonal)
    free = ~active_set(x, gradient, low, high)
    largest = jnp.max(diagonal)
    product = lambda step: join(*blocks.product(*split(step)))
    model = Model(x, walk.residuals, gradient, product, 1 / jnp.maximum(damping, largest))
    solve = lambda gradient, free: join(*_step(blocks, damping, split(gradient), split(free)))
    direction, leads = boxed(solve, model, free, (low, high))
    found = line_search(problem.residuals, model, direction, (low, high), walk.goes_on)
    finite = jnp.all(jnp.isfinite(walk.residuals)) & jnp.all(jnp.isfinite(gradient))
    ends = found.is_exhausted | converged(model, found, (low, high), rtol)
    ends |= by_gradient(x, gradient, (low, high)) <= atol
    return _Walk(
        jnp.where(finite, found.point, x),
        jnp.where(finite, found.residuals, walk.residuals),
        *damped_on(damping, walk.growth, found.is_success & leads, found.gain, largest),
        walk.steps + 1,
        ~ends & finite,
        finite,
    )


def _flattened(start: Split) -> tuple[Array, Callable[[Array], Split]]:
    """All variables, the shared ones first and the others frame by frame, and the way back."""
    shared, to_shared = ravel_pytree(start.shared)
    one, to_frame = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], start.frames))
    frames = jax.vmap(lambda frame: ravel_pytree(frame)[0])(start.frames)

    def whole(x: Array) -> Split:
        return Split(to_shared(x[: shared.size]), jax.vmap(to_frame)(x[shared.size :].reshape(-1, one.size)))

    return jnp.concatenate([shared, frames.ravel()]), whole


class _Problem(NamedTuple):
    """Residuals as functions of flat variables."""

    of_frame: Callable[[Array, Array, Any], Array]
    own: Callable[[Array], Array]
    """The prior's."""
    data: PyTree
    size: int
    """Of the shared variables, which come first."""
    frames: int

    def split(self, x: Array) -> tuple[Array, Array]:
        """Shared variables (s,), and those of the frames (n, f)."""
        return x[: self.size], x[self.size :].reshape(self.frames, -1)

    def join(self, shared: Array, frames: Array) -> Array:
        """The other way round."""
        return jnp.concatenate([shared, frames.ravel()])

    def residuals(self, x: Array) -> Array:
        """All of them."""
        s, f = self.split(x)
        of_frames = jax.vmap(self.of_frame, (None, 0, 0))(s, f, self.data)
        return jnp.concatenate([of_frames.ravel(), self.own(s)])


def _problem(residuals, prior, start: Split, data: PyTree) -> _Problem:
    shared, to_shared = ravel_pytree(start.shared)
    _, to_frame = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], start.frames))
    of_frame = lambda s, f, data: ravel_pytree(residuals(to_shared(s), to_frame(f), data))[0]
    own = (lambda s: ravel_pytree(prior(to_shared(s)))[0]) if prior else (lambda s: jnp.zeros(0, s.dtype))
    return _Problem(of_frame, own, data, shared.size, jax.tree.leaves(start.frames)[0].shape[0])


def _blocks(problem: _Problem, x: Array) -> _Blocks:
    s, f = problem.split(x)

    def one(f: Array, data: Any) -> tuple[Array, Array, Array]:
        r = problem.of_frame(s, f, data)
        return r, *jax.jacfwd(problem.of_frame, (0, 1))(s, f, data)

    r, by_shared, by_frame = jax.vmap(one)(f, problem.data)
    own, by_own = problem.own(s), jax.jacfwd(problem.own)(s)
    dot = lambda spec, *a: jnp.einsum(spec, *a, precision="highest")
    return _Blocks(
        U=dot("nrs,nrt->st", by_shared, by_shared) + dot("rs,rt->st", by_own, by_own),
        W=dot("nrs,nrf->nsf", by_shared, by_frame),
        V=dot("nrf,nrg->nfg", by_frame, by_frame),
        shared=dot("nrs,nr->s", by_shared, r) + dot("rs,r->s", by_own, own),
        frames=dot("nrf,nr->nf", by_frame, r),
    )


def _step(blocks: _Blocks, damping: Array, gradient: tuple, free: tuple) -> tuple[Array, Array]:
    """The damped step of the free variables; the others stay. Both arguments as `_Problem.split` has them."""
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
