r"""Kalman filter and smoother of long sequences in logarithmic depth, on roots of covariances.

$$x_t = F_t x_{t-1} + b_t + q_t,\ q_t \sim N(0, Q_t),\qquad y_t = H_t x_t + d_t + r_t,\ r_t \sim N(0, R_t).$$

An element summarises a run of frames; elements are combined by an associative operator, in any grouping, so that
`prefix_scan` needs about 32 log16 T rounds instead of T steps (F. Yaghoobi, A. Corenflos, S. Hassan, S. Särkkä,
"Parallel square-root statistical linear regression for inference in nonlinear state space models", 2022, sections 3 and
4). The total number of operations is several times larger: it is meant for accelerators and long sequences. On a CPU,
`kalman` and `smoothing.rts` are faster.

An element holds what its observations say about the state before them as information, which is infinite where
$H_t Q_t H_t^T + R_t$ is singular: such a frame is announced by NaN.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.prefix_scan import prefix_scan
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic.factor import UNROLLED
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.gaussian.manifold import euclidean
from jaxfilters.math.linalg import matmul, safe_norm, solve_triangular, tria, tria_of_many, tria_of_many_with_zeros


class LinearModel(NamedTuple):
    """A linear Gaussian model: every field with time as its first axis, or without time if it is constant."""

    F: Float[Array, "*t n n"]
    """Transition matrix."""
    root_Q: Float[Array, "*t n _"]
    """Any root of the process noise covariance."""
    H: Float[Array, "*t m n"]
    """Observation matrix."""
    root_R: Float[Array, "*t m _"]
    """Any root of the observation noise covariance."""
    b: Float[Array, "*t n"] | float = 0.0
    """Known input of the transition."""
    d: Float[Array, "*t m"] | float = 0.0
    """Known offset of the observation."""


class _Step(NamedTuple):
    """One frame of a model, or all of them."""

    F: Array
    root_Q: Array
    H: Array
    root_R: Array
    b: Array
    d: Array


class _FilterElement(NamedTuple):
    """Some frames, given the state x before them.

    Their last state is N(A x + b, U U^T); the likelihood of x is exp(eta^T x - |Z^T x|^2 / 2).
    """

    A: Array
    b: Array
    U: Array
    eta: Array
    Z: Array


class _SmootherElement(NamedTuple):
    """A state, given a later state x and all observations before it, is N(E x + g, L L^T)."""

    E: Array
    g: Array
    L: Array


@jax.jit
def parallel_kalman(
    prior: GaussianRoot, model: LinearModel, ys: Float[Array, "t m"], mask: Bool[Array, "t m"] | None = None
) -> tuple[GaussianRoot, Float[Array, " t"]]:
    """Kalman filter in logarithmic depth: beliefs after every observation, and the log evidence of each.

    H Q H^T + R must be positive definite over the components that are read, in every frame but the first: what would
    be known of the state before the frame without any noise has infinite information. From such a frame on beliefs are
    NaN, and log evidences after it. Digits are lost where it is nearly so: the relative error is that of rounding times
    the largest ratio of a predicted variance of an observation and this one. `kalman` has neither limit.

    Args:
        prior: Belief before the first step, with a mean of shape (n,).
        model: The model.
        ys: Observations (t, m); NaN where nothing was read.
        mask: False for components to leave out, (t, m), whatever `ys` holds there.

    Returns:
        Beliefs (t, n) and (t, n, n), and log p(y_t | y_1:t-1), (t,), in nats.

    Raises:
        ValueError: If shapes do not fit one another, or a field of `model` has another length than `ys`.
        TypeError: If an argument is of another kind.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.GaussianRoot(jnp.zeros(1), jnp.eye(1))
        >>> model = jf.smoothing.LinearModel(jnp.eye(1), 0.3 * jnp.eye(1), jnp.eye(1), jnp.eye(1))
        >>> beliefs, log_evidences = jf.smoothing.parallel_kalman(prior, model, jnp.ones((8, 1)))
        >>> smoothed = jf.smoothing.parallel_rts(beliefs, model)
        >>> smoothed.mean.shape, log_evidences.shape
        ((8, 1), (8,))
    """
    checks.belief("prior", prior, GaussianRoot)
    checks.on_manifold("prior", prior, euclidean)
    checks.floating("ys", ys)
    if ys.ndim != 2 or ys.shape[0] < 1:
        raise ValueError(f"ys must have the shape (t, m), t at least 1; got {ys.shape}.")
    if mask is not None:
        checks.boolean("mask", mask, ys.shape, ", that of ys")
    _check_model(model, prior.mean.shape[0], ys.shape[1])
    steps = _of_every_frame(model, ys)
    read = jnp.isfinite(ys) if mask is None else jnp.isfinite(ys) & mask
    steps = steps._replace(
        H=jnp.where(read[..., None], steps.H, 0.0), root_R=jnp.where(read[..., None], steps.root_R, 0.0)
    )
    residuals = jnp.where(read, jnp.where(read, ys, 0.0) - steps.d, 0.0)
    elements = jax.vmap(_of_small(_filter_element, steps), out_axes=-1)(steps, residuals)
    first = _first(prior, jax.tree.map(lambda leaf: leaf[0], steps), residuals[0])
    elements = jax.tree.map(lambda leaf, start: leaf.at[..., 0].set(start), elements, first)
    found = prefix_scan(jax.vmap(_combined, -1, -1), elements, axis=-1)
    beliefs = GaussianRoot(found.b.T, jnp.moveaxis(found.U, -1, 0))
    start = GaussianRoot(prior.mean, tria(prior.root))
    before = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many[:-1]]), start, beliefs)
    return beliefs, jax.vmap(_log_evidence)(before, steps, residuals)


@jax.jit
def parallel_rts(beliefs: GaussianRoot, model: LinearModel) -> GaussianRoot:
    """Rauch-Tung-Striebel smoother in logarithmic depth: beliefs given the whole sequence.

    Args:
        beliefs: Beliefs of `parallel_kalman`, (t, n) and (t, n, n).
        model: The same model.

    Returns:
        The smoothed beliefs, time first.

    Raises:
        ValueError: If shapes do not fit one another, or a field of `model` has another length than `beliefs`.
        TypeError: If an argument is of another kind.

    Examples:
        A constant with the prior N(0, 1), observed as 9 eight times with noise of variance 1: its mean is 72 / 9.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.GaussianRoot(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> model = jf.smoothing.LinearModel(F=one, root_Q=0.0 * one, H=one, root_R=one)
        >>> beliefs, log_evidences = jf.smoothing.parallel_kalman(prior, model, 9.0 * jnp.ones((8, 1)))
        >>> smoothed = jf.smoothing.parallel_rts(beliefs, model)
        >>> round(float(smoothed.mean[0, 0]), 3)
        8.0
    """
    if not isinstance(beliefs, GaussianRoot):
        raise TypeError(f"beliefs must be a GaussianRoot with time first; got a {type(beliefs).__name__}.")
    checks.floating("beliefs.mean", beliefs.mean)
    if beliefs.mean.ndim != 2 or jnp.shape(beliefs.root) != (*beliefs.mean.shape, beliefs.mean.shape[1]):
        raise ValueError(
            "beliefs must have a mean of shape (t, n) and a root of shape (t, n, n); "
            f"got {beliefs.mean.shape} and {jnp.shape(beliefs.root)}."
        )
    _check_model(model, beliefs.mean.shape[1], None)
    steps = _of_every_frame(model, beliefs.mean)
    following = jax.tree.map(lambda leaf: leaf[1:], steps)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], beliefs)
    last = _SmootherElement(jnp.zeros_like(beliefs.root[-1]), beliefs.mean[-1], beliefs.root[-1])
    elements = jax.vmap(_of_small(_smoother_element, steps), out_axes=-1)(earlier, following)
    elements = jax.tree.map(lambda many, one: jnp.concatenate([many, one[..., None]], axis=-1), elements, last)
    found = prefix_scan(jax.vmap(_chained, -1, -1), elements, axis=-1, reverse=True)
    return GaussianRoot(found.g.T, jnp.moveaxis(found.L, -1, 0))


def _check_model(model: LinearModel, n: int, m: int | None) -> None:
    if not isinstance(model, LinearModel):
        raise TypeError(f"model must be a LinearModel; got a {type(model).__name__}.")
    for name, rows, columns in (("F", n, n), ("root_Q", n, None), ("H", m, n), ("root_R", m, None)):
        value = getattr(model, name)
        checks.floating(f"model.{name}", value)
        shape = value.shape
        fits = len(shape) in (2, 3) and all(
            wanted is None or wanted == size for wanted, size in zip((rows, columns), shape[-2:], strict=True)
        )
        if not fits:
            wanted = f"({'m' if rows is None else rows}, {'any width' if columns is None else columns})"
            raise ValueError(f"model.{name} must have the shape {wanted}, after an axis of time if any; got {shape}.")
    for name, size in (("b", n), ("d", m)):
        shape = jnp.shape(getattr(model, name))
        if shape and (len(shape) > 2 or (size is not None and shape[-1] != size)):
            raise ValueError(f"model.{name} must have the shape ({size},), after an axis of time if any; got {shape}.")


def _of_small(function: Callable, steps: _Step) -> Callable:
    """The function of one frame, faster under `vmap` where its matrices are small."""
    rows = steps.F.shape[-1] + max(steps.F.shape[-1], steps.H.shape[-2])
    return batch_last(function) if rows <= UNROLLED else function


def _filter_element(step: _Step, y: Array) -> _FilterElement:
    """One frame, given the state before it."""
    n = step.F.shape[0]
    root, gain, rest = _conditioned(step.H, step.root_Q, step.root_R)
    innovation = y - _times(step.H, step.b)
    HF = matmul(step.H, step.F)
    root, whitened = informative(root, HF)
    Z = tria_of_many(whitened.T)
    A = step.F - matmul(gain, HF)
    eta = _times(whitened.T, solve_triangular(root, innovation))
    return _FilterElement(A, step.b + _times(gain, innovation), rest[:, :n], eta, Z)


def informative(root: Float[Array, "m m"], H: Float[Array, "m n"]) -> tuple[Float[Array, "m m"], Float[Array, "m n"]]:
    """A lower root of a noise without what is rounding error on its diagonal, and `root^-1 H`.

    NaN where a row of H has no noise that the rows before it do not have, but is another one: what it says is infinite.
    """
    tolerance = 4 * len(root) * float(jnp.finfo(root.dtype).eps)
    exact = jnp.diagonal(root) <= tolerance * safe_norm(root)
    root = jnp.where(exact, 0.0, root)
    whitened = solve_triangular(root, H)
    rest = H - matmul(root, whitened)
    infinite = jnp.any(exact & (safe_norm(rest) > 16 * tolerance * safe_norm(H)))
    return root, jnp.where(infinite, jnp.nan, whitened)


def _first(prior: GaussianRoot, step: _Step, y: Array) -> _FilterElement:
    """The first frame together with the prior: nothing depends on a state before it."""
    n = step.F.shape[0]
    mean = _times(step.F, prior.mean) + step.b
    root, gain, rest = _conditioned(step.H, _predicted(prior, step), step.root_R)
    del root
    nothing = jnp.zeros_like(step.F)
    return _FilterElement(
        nothing, mean + _times(gain, y - _times(step.H, mean)), rest[:, :n], jnp.zeros_like(mean), nothing
    )


def _combined(earlier: _FilterElement, later: _FilterElement) -> _FilterElement:
    n = earlier.b.shape[0]
    eye = jnp.eye(n, dtype=earlier.b.dtype)
    blocks = jnp.block([[matmul(earlier.U.T, later.Z), eye], [later.Z, jnp.zeros_like(eye)]])
    root = tria_of_many(blocks)
    turned = solve_triangular(root[:n, :n], earlier.U.T).T
    kept = eye - matmul(turned, root[n:, :n].T)
    through = matmul(later.A, kept)
    mean = earlier.b + _times(earlier.U, _times(earlier.U.T, later.eta))
    information = later.eta - _times(later.Z, _times(later.Z.T, earlier.b))
    return _FilterElement(
        matmul(through, earlier.A),
        _times(through, mean) + later.b,
        tria_of_many(jnp.hstack([matmul(later.A, turned), later.U])),
        _times(earlier.A.T, _times(kept.T, information)) + earlier.eta,
        tria_of_many(jnp.hstack([matmul(earlier.A.T, root[n:, n:]), earlier.Z])),
    )


def _log_evidence(before: GaussianRoot, step: _Step, y: Array) -> Array:
    ahead = _times(step.F, before.mean) + step.b
    parts = [matmul(step.H, _predicted(before, step)), step.root_R]
    root = tria(jnp.hstack(parts))
    counts = jnp.diagonal(root) > 0
    whitened = solve_triangular(root, y - _times(step.H, ahead))
    log_scale = jnp.log(jnp.where(counts, jnp.diagonal(root), 1.0)) + 0.5 * math.log(2 * math.pi) * counts
    return -0.5 * jnp.sum(whitened**2) - jnp.sum(log_scale)


def _smoother_element(belief: GaussianRoot, step: _Step) -> _SmootherElement:
    root, gain, rest = _conditioned(step.F, belief.root, step.root_Q)
    del root
    mean = belief.mean - _times(gain, _times(step.F, belief.mean) + step.b)
    return _SmootherElement(gain, mean, rest)


def _chained(later: _SmootherElement, earlier: _SmootherElement) -> _SmootherElement:
    # A reversed scan hands over what is later in time first.
    return _SmootherElement(
        matmul(earlier.E, later.E),
        _times(earlier.E, later.g) + earlier.g,
        tria_of_many(jnp.hstack([matmul(earlier.E, later.L), earlier.L])),
    )


def _conditioned(H: Array, root_P: Array, root_R: Array) -> tuple[Array, Array, Array]:
    """Root of the covariance of H x + r, the gain, and a root of the covariance of x given H x + r."""
    m, n = H.shape
    above = jnp.hstack([matmul(H, root_P), root_R])
    below = jnp.hstack([root_P, jnp.zeros((n, root_R.shape[1]), root_P.dtype)])
    joint = tria_of_many_with_zeros(jnp.vstack([above, below]))
    root = joint[:m, :m]
    return root, solve_triangular(root, joint[m:, :m].T, transpose=True).T, joint[m:, m:]


def _predicted(belief: GaussianRoot, step: _Step) -> Array:
    return jnp.hstack([matmul(step.F, belief.root), step.root_Q])


def _times(A: Array, x: Array) -> Array:
    return matmul(A, x[:, None])[:, 0]


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
