r"""Kalman filter and smoother of long sequences in logarithmic depth, on roots of covariances.

$$x_t = F_t x_{t-1} + b_t + q_t,\ q_t \sim N(0, Q_t),\qquad y_t = H_t x_t + d_t + r_t,\ r_t \sim N(0, R_t).$$

What all frames from one to another say is an element; elements are combined by an associative operator, in any
grouping, so that `jax.lax.associative_scan` needs about 2 log2 T rounds instead of T steps (F. Yaghoobi, A. Corenflos,
S. Hassan, S. Särkkä, "Parallel square-root statistical linear regression for inference in nonlinear state space
models", 2022, sections 3 and 4). There is more to compute, several times over: for accelerators and long sequences. On
a CPU the filters of `jaxfilters.extended` are faster.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.math import linalg
from jaxfilters.math.linalg import tria


class LinearModel(NamedTuple):
    """The steps of a linear Gaussian model: every field with time first, or without time if it never changes."""

    F: Float[Array, "*t n n"]
    root_Q: Float[Array, "*t n _"]
    """Any root of the process noise covariance."""
    H: Float[Array, "*t m n"]
    root_R: Float[Array, "*t m _"]
    """Any root of the observation noise covariance."""
    b: Float[Array, "*t n"] | float = 0.0
    d: Float[Array, "*t m"] | float = 0.0


class _Step(NamedTuple):
    """One frame of a model, or all of them."""

    F: Array
    root_Q: Array
    H: Array
    root_R: Array
    b: Array
    d: Array


class _Past(NamedTuple):
    """What some frames say of the state x before them, and of their last state given x.

    The latter is N(A x + b, U U^T); the likelihood of x is exp(eta^T x - |Z^T x|^2 / 2).
    """

    A: Array
    b: Array
    U: Array
    eta: Array
    Z: Array


class _Future(NamedTuple):
    """A state given a later one, and all observations until then, is N(E x + g, L L^T)."""

    E: Array
    g: Array
    L: Array


@jax.jit
def parallel_kalman(
    prior: GaussianRoot, model: LinearModel, ys: Float[Array, "t m"], mask: Bool[Array, "t m"] | None = None
) -> tuple[GaussianRoot, Float[Array, " t"]]:
    """Beliefs after every observation, time first, and the log evidence of each given those before it.

    Args:
        prior: Belief before the first step.
        model: The steps.
        ys: Observations; NaN where nothing was read.
        mask: False for components that were not seen, whatever `ys` holds there.

    Raises:
        ValueError: If a field of `model` has another length than `ys`.
    """
    steps = _of_every_frame(model, ys)
    seen = jnp.isfinite(ys) if mask is None else jnp.isfinite(ys) & mask
    steps = steps._replace(
        H=jnp.where(seen[..., None], steps.H, 0.0), root_R=jnp.where(seen[..., None], steps.root_R, 0.0)
    )
    residuals = jnp.where(seen, jnp.where(seen, ys, 0.0) - steps.d, 0.0)
    elements = jax.vmap(_past)(steps, residuals)
    first = _first(prior, jax.tree.map(lambda leaf: leaf[0], steps), residuals[0])
    elements = jax.tree.map(lambda leaf, start: leaf.at[0].set(start), elements, first)
    found = jax.lax.associative_scan(jax.vmap(_combined), elements)
    beliefs = GaussianRoot(found.b, found.U)
    start = GaussianRoot(prior.mean, linalg.tria(prior.root))
    before = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many[:-1]]), start, beliefs)
    return beliefs, jax.vmap(_log_evidence)(before, steps, residuals)


@jax.jit
def parallel_rts(beliefs: GaussianRoot, model: LinearModel) -> GaussianRoot:
    """Beliefs given the whole sequence, from those of `filter_in_parallel`, time first.

    Raises:
        ValueError: If a field of `model` has another length than `beliefs`.
    """
    steps = _of_every_frame(model, beliefs.mean)
    following = jax.tree.map(lambda leaf: leaf[1:], steps)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], beliefs)
    last = _Future(jnp.zeros_like(beliefs.root[-1]), beliefs.mean[-1], beliefs.root[-1])
    elements = jax.vmap(_future)(earlier, following)
    elements = jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), elements, last)
    found = jax.lax.associative_scan(jax.vmap(_chained), elements, reverse=True)
    return GaussianRoot(found.g, found.L)


def _past(step: _Step, y: Array) -> _Past:
    """One frame, given the state before it."""
    n = step.F.shape[0]
    root, gain, rest = _conditioned(step.H, step.root_Q, step.root_R)
    surprise = y - _times(step.H, step.b)
    seen = linalg.matmul(step.H, step.F)
    whitened = linalg.solve_triangular(root, seen)
    Z = linalg.tria(whitened.T)
    A = step.F - linalg.matmul(gain, seen)
    eta = _times(whitened.T, linalg.solve_triangular(root, surprise))
    return _Past(A, step.b + _times(gain, surprise), rest[:, :n], eta, Z)


def _first(prior: GaussianRoot, step: _Step, y: Array) -> _Past:
    """The first frame, with the prior in it: what comes before does not matter."""
    n = step.F.shape[0]
    mean = _times(step.F, prior.mean) + step.b
    root, gain, rest = _conditioned(step.H, _predicted(prior, step), step.root_R)
    del root
    nothing = jnp.zeros_like(step.F)
    return _Past(nothing, mean + _times(gain, y - _times(step.H, mean)), rest[:, :n], jnp.zeros_like(mean), nothing)


def _combined(past: _Past, then: _Past) -> _Past:
    n = past.b.shape[0]
    eye = jnp.eye(n, dtype=past.b.dtype)
    blocks = jnp.block([[_product(past.U.T, then.Z), eye], [then.Z, jnp.zeros_like(eye)]])
    root = tria(blocks)
    turned = solve_triangular(root[:n, :n], past.U.T, lower=True).T
    kept = eye - _product(turned, root[n:, :n].T)
    through = _product(then.A, kept)
    mean = past.b + _product(past.U, _product(past.U.T, then.eta))
    information = then.eta - _product(then.Z, _product(then.Z.T, past.b))
    return _Past(
        _product(through, past.A),
        _product(through, mean) + then.b,
        tria(jnp.hstack([_product(then.A, turned), then.U])),
        _product(past.A.T, _product(kept.T, information)) + past.eta,
        tria(jnp.hstack([_product(past.A.T, root[n:, n:]), past.Z])),
    )


def _log_evidence(before: GaussianRoot, step: _Step, y: Array) -> Array:
    ahead = _times(step.F, before.mean) + step.b
    parts = [linalg.matmul(step.H, _predicted(before, step)), step.root_R]
    root = linalg.tria(jnp.hstack(parts))
    counts = jnp.diagonal(root) > 0
    whitened = linalg.solve_triangular(root, y - _times(step.H, ahead))
    log_scale = jnp.log(jnp.where(counts, jnp.diagonal(root), 1.0)) + 0.5 * math.log(2 * math.pi) * counts
    return -0.5 * jnp.sum(whitened**2) - jnp.sum(log_scale)


def _future(belief: GaussianRoot, step: _Step) -> _Future:
    root, gain, rest = _conditioned(step.F, belief.root, step.root_Q)
    del root
    mean = belief.mean - _times(gain, _times(step.F, belief.mean) + step.b)
    return _Future(gain, mean, rest)


def _chained(later: _Future, earlier: _Future) -> _Future:
    # A reversed scan hands over what is later in time first.
    return _Future(
        _product(earlier.E, later.E),
        _product(earlier.E, later.g) + earlier.g,
        tria(jnp.hstack([_product(earlier.E, later.L), earlier.L])),
    )


def _product(a: Array, b: Array) -> Array:
    # The operator is compiled anew for every round of the scan: algebra on elements would take minutes. For the same
    # reason it triangularises without looking for rows of zeros first.
    return jnp.matmul(a, b, precision="highest")


def _conditioned(H: Array, root_P: Array, root_R: Array) -> tuple[Array, Array, Array]:
    """Root of the covariance of H x + r, the gain, and the root of what is not known of x after that was seen."""
    m, n = H.shape
    above = jnp.hstack([linalg.matmul(H, root_P), root_R])
    below = jnp.hstack([root_P, jnp.zeros((n, root_R.shape[1]), root_P.dtype)])
    joint = linalg.tria(jnp.vstack([above, below]))
    root = joint[:m, :m]
    return root, linalg.solve_triangular(root, joint[m:, :m].T, transpose=True).T, joint[m:, m:]


def _predicted(belief: GaussianRoot, step: _Step) -> Array:
    return jnp.hstack([linalg.matmul(step.F, belief.root), step.root_Q])


def _times(A: Array, x: Array) -> Array:
    return linalg.matmul(A, x[:, None])[:, 0]


def _of_every_frame(model: LinearModel, frames: Array) -> _Step:
    length = frames.shape[0]
    n, m = model.F.shape[-1], model.H.shape[-2]
    model = model._replace(b=jnp.broadcast_to(model.b, (*jnp.shape(model.b)[:-1], n)))
    model = model._replace(d=jnp.broadcast_to(model.d, (*jnp.shape(model.d)[:-1], m)))

    def spread(name: str, leaf: Array, size: int) -> Array:
        if leaf.ndim == size:
            return jnp.broadcast_to(leaf, (length, *leaf.shape))
        if leaf.shape[0] != length:
            raise ValueError(f"model.{name} must have the {length} frames of the sequence; got {leaf.shape[0]}.")
        return leaf

    sizes = (2, 2, 2, 2, 1, 1)
    return _Step(*(spread(*each) for each in zip(model._fields, map(jnp.asarray, model), sizes, strict=True)))
