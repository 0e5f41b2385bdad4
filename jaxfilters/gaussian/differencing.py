r"""Gaussian filters for correlated noise alone, by measurement differencing: no additional state.

Where $y_t = h(x_t) + b_t$ has no white noise beside the Gauss-Markov process b, the difference
$y_t - \phi y_s = h(x_t) - \phi h(x_s) + q_t$ from the last observed frame s has white noise (A. E. Bryson and L. J.
Henrikson, "Estimation using sampled data containing sequentially correlated noise", Journal of Spacecraft and Rockets
5(6), 1968). It depends on two states. Here the belief about $x_s$ and the transition since then, $x_t = F x_s + w$, are
kept apart, so that neither a correlation with the process noise nor a singular covariance of both states appears. With
m independent rows and n states an update takes time of the order of $m n^2$, by adding up the information of the rows.
Rows with no noise, or hardly any, have too much of it: a frame with such rows is updated by the covariance of its m
innovations, in time of the order of $m^2 (m + n)$.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor, info, square_root
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.correlated import CorrelatedNoise, check_dt, check_inner, observed_linearly
from jaxfilters.gaussian.extended import ExtendedKalman, as_observation
from jaxfilters.gaussian.gauss_markov import GaussMarkov, check_process
from jaxfilters.gaussian.linearize import taylor
from jaxfilters.gaussian.noise_models import NonAdditiveNoise
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, only_inputs


class Clone(NamedTuple):
    """What is kept of the last observed frame s, and how the state moved since: x_t = m_t + F (x_s - m_s) + w."""

    belief: Gaussian
    """About x_s, after its update."""
    F: Float[Array, "n n"]
    Q: Float[Array, "n n"]
    """Covariance of w."""
    residual: Float[Array, " m"]
    """Observation minus prediction at the mean of x_s: the estimate of its error b."""
    H: Float[Array, "m n"]
    """Jacobian of the observation there."""
    read: Bool[Array, " m"]
    """Which rows were read in that frame."""
    ever: Bool[Array, " m"]
    """Which rows were read in any frame."""
    elapsed: Float[Array, ""]
    """Time since that frame."""


class DifferencedState(NamedTuple):
    """State of a filter made by `measurement_differencing`."""

    belief: Gaussian
    """Belief about the state now."""
    clone: Clone


class DifferencedInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    nis: Float[Array, ""]
    """Normalised innovation squared: chi-squared with `rank` degrees of freedom."""
    rank: Int[Array, ""]
    """Number of rows used. Rows without noise that were certain beforehand, or follow from others, are left out."""
    num_invalid: Int[Array, ""]
    """Number of rows, not masked, that are not finite, or whose prediction is not."""


def measurement_differencing(inner: Filter, noise: GaussMarkov, *, dt: ArrayLike | Callable = 1.0) -> Filter:
    """Gaussian filter `inner` for observations whose noise is a Gauss-Markov process and nothing else.

    For a linear model the result is that of `correlated_noise` with a white noise of zero, to rounding, with a state of
    n instead of n + m components, and in time proportional to the number m of rows, unless an error has a variance of
    zero or changes so slowly that its changes are lost in the rounding of what is known; under `vmap` frames take the
    time of both cases. The state is a `DifferencedState`, whose `belief` is that about x, and the info a
    `DifferencedInfo`.

    Rows may be missing. One that was not read in the last observed frame, but before, has no difference; it adds
    nothing in this frame, and counts again from the next one on. Frames without any observation lose nothing.

    Args:
        inner: Filter made by `kalman`, or by `extended_kalman` with `jf.linearize.taylor`, with a `Gaussian` prior, of
            vectors. Its observation noise must be an array of zeros, (m, m).
        noise: The process of the errors, with one independent component for each row: a covariance of shape (m,), and
            one time constant or m of them.
        dt: Length of a step, or a function `inputs -> length`.

    Returns:
        The filter.

    Raises:
        ValueError: If `inner` is another kind of filter or has white noise, a time constant is not positive, errors are
            not independent, or shapes do not fit one another.
        TypeError: If an argument is of another kind.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), 100.0 * jnp.eye(1))
        >>> inner = jf.kalman(prior, jnp.eye(1), 0.01 * jnp.eye(1), jnp.ones((2, 1)), jnp.zeros((2, 2)))
        >>> filter = jf.measurement_differencing(inner, jf.GaussMarkov(jnp.array(50.0), jnp.array([1.0, 1.0])))
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.broadcast_to(jnp.array([0.5, -0.5]), (30, 2)))
        >>> round(float(last.belief.covariance[0, 0]) ** 0.5, 2)
        0.66
    """
    checks.is_filter("inner", inner)
    check_inner(inner.params)
    _check_model(inner.params)
    check_process("noise", noise)
    if noise.covariance.ndim != 1 or jnp.ndim(noise.time_constant) > 1:
        raise ValueError(
            "noise must have independent components, with a covariance of shape (m,) and time constants of shape () or "
            f"(m,); got the shapes {noise.covariance.shape} and {jnp.shape(noise.time_constant)}."
        )
    R = inner.params.observation_noise
    checks.shaped("the observation noise of inner", R, (noise.size,) * 2, ", a row for each component of noise")
    check_dt(dt)
    model = CorrelatedNoise(inner.params, noise, None, only_inputs("dt", dt) if callable(dt) else dt)
    return Filter(model, _init, _predict, _update)


def _check_model(model: Any) -> None:
    if not isinstance(model.prior, Gaussian) or not model.manifold.flat:
        raise ValueError("inner must have a Gaussian prior about a vector; use correlated_noise for others.")
    if isinstance(model, ExtendedKalman) and (
        model.linearize is not taylor or isinstance(model.observe, NonAdditiveNoise)
    ):
        raise ValueError("inner must be linearised by jf.linearize.taylor, with additive noise; use correlated_noise.")
    R = model.observation_noise
    known = None if callable(R) else checks.concrete(R)
    if callable(R) or (known is not None and np.any(known != 0)):
        got = "a function" if known is None else f"elements up to {np.abs(known).max()}"
        raise ValueError(
            "the observation noise of inner must be an array of zeros, because differences of white noise are not "
            f"white; use correlated_noise. Got {got}."
        )


def _init(model: CorrelatedNoise, key: AnyKey) -> DifferencedState:
    del key
    prior = model.inner.prior
    n, m, dtype = prior.mean.shape[0], model.noise.size, prior.mean.dtype
    nothing = jnp.zeros(m, bool)
    clone = Clone(
        prior,
        jnp.eye(n, dtype=dtype),
        jnp.zeros((n, n), dtype),
        jnp.zeros(m, dtype),
        jnp.zeros((m, n), dtype),
        nothing,
        nothing,
        jnp.zeros((), dtype),
    )
    return DifferencedState(prior, clone)


def _predict(model: CorrelatedNoise, key: AnyKey, state: DifferencedState, inputs: PyTree) -> DifferencedState:
    del key
    belief, clone = state
    checks.state(belief, model.inner.prior)
    inner_inputs = model.inputs_of_inner(inputs)
    origin, step = model.inner.linear_transition(belief, inner_inputs)
    mean = origin + step.value
    noise = model.inner.process_noise_of(belief, inner_inputs) + factor.outer(step.residual_root, step.residual_root)
    F, Q = linalg.matmul(step.F, clone.F), factor.turned(step.F, clone.Q) + noise
    elapsed = clone.elapsed + model.dt_of(inputs).astype(clone.elapsed.dtype)
    ahead = Gaussian(mean, factor.turned(step.F, belief.covariance) + noise)
    return DifferencedState(ahead, clone._replace(F=F, Q=Q, elapsed=elapsed))


def _update(
    model: CorrelatedNoise, key: AnyKey, state: DifferencedState, observation: PyTree, inputs: PyTree
) -> tuple[DifferencedState, DifferencedInfo]:
    del key
    belief, clone = state
    checks.state(belief, model.inner.prior)
    raw, mask, own_noise = as_observation(observation)
    checks.shaped("the observation y", raw, (model.noise.size,), ", a row for each component of noise")
    if own_noise is not None:
        raise ValueError("Observation.noise must be None for measurement differencing, which has no white noise.")
    inner_inputs = model.inputs_of_inner(inputs)
    linear, y, _ = observed_linearly(model.inner, belief, raw, None, inner_inputs)
    given = jnp.isfinite(raw) if mask is None else jnp.isfinite(raw) & mask
    usable = given & jnp.isfinite(y - linear.value) & jnp.all(jnp.isfinite(linear.F), axis=1)
    residual = jnp.where(usable, y - linear.value, 0.0)
    H = info.observed(usable, linear.F)

    differenced, first = usable & clone.read, usable & ~clone.ever
    decay = jnp.where(differenced, model.noise.decay(clone.elapsed), 0.0)
    variance = jnp.where(differenced, model.noise.added(clone.elapsed), model.noise.covariance)
    counts = differenced | first
    rows = _Rows(
        (residual - decay * clone.residual, H, linalg.matmul(H, clone.F) - decay[:, None] * clone.H), variance, counts
    )
    posterior, found = _conditioned(belief, clone, rows)

    # What the next frame is compared with: the observation at the updated mean.
    again, y, _ = observed_linearly(model.inner, posterior, raw, None, inner_inputs)
    n, dtype = belief.mean.shape[0], belief.mean.dtype
    fresh = Clone(
        posterior,
        jnp.eye(n, dtype=dtype),
        jnp.zeros((n, n), dtype),
        jnp.where(usable, y - again.value, 0.0),
        info.observed(usable, again.F),
        usable,
        clone.ever | usable,
        jnp.zeros((), dtype),
    )
    invalid = ~usable if mask is None else mask & ~usable
    impossible = jnp.any(given & ~usable)
    report = found._replace(
        log_evidence=jnp.where(impossible, -jnp.inf, found.log_evidence), num_invalid=jnp.sum(invalid, dtype=jnp.int32)
    )
    # A frame in which nothing was read is none.
    kept = jnp.any(usable)
    chosen = Clone(*(_chosen(kept, new, old) for new, old in zip(fresh, clone, strict=True)))
    return DifferencedState(posterior, chosen), report


def _chosen(condition: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    if isinstance(new, Gaussian):
        return replace(
            new,
            mean=jnp.where(condition, new.mean, old.mean),
            covariance=jnp.where(condition, new.covariance, old.covariance),
        )
    return jnp.where(condition, new, old)


class _Rows(NamedTuple):
    """Independent rows of a measurement of w and of x_s."""

    measured: tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, "m n"]]
    """Innovation, and the coefficients of w and of x_s - m_s."""
    variance: Float[Array, " m"]
    counts: Bool[Array, " m"]


def _conditioned(belief: Gaussian, clone: Clone, rows: _Rows) -> tuple[Gaussian, DifferencedInfo]:
    """Belief about x_t = m_t + F (x_s - m_s) + w after independent rows."""
    _, by_w, by_s = rows.measured
    root = block_diag(factor.root(clone.Q), factor.root(clone.belief.covariance))
    visible = linalg.matmul(jnp.hstack([by_w, by_s]), root)
    moved = jnp.hstack([jnp.eye(belief.mean.shape[0], dtype=root.dtype), clone.F])
    # Information has the rounding error of its sharpest row, in units of the noise: the ratio of the variances.
    spread = jnp.sum(visible * visible, axis=1)
    noisy = rows.variance > float(jnp.finfo(root.dtype).eps) ** 0.5 * spread
    ready = visible, linalg.matmul(moved, root), rows._replace(counts=rows.counts & noisy)
    shift, spread_root, found = jax.lax.cond(
        jnp.any(rows.counts & ~noisy), lambda: _by_innovations(*ready[:2], rows), lambda: _by_information(*ready)
    )
    return Gaussian(belief.mean + shift, factor.outer(spread_root, spread_root)), found


_Found = tuple[Array, Array, DifferencedInfo]
"""Shift of the mean of x_t, a root of its covariance, (n, 2 n), and the diagnostics."""


def _by_innovations(visible: Float[Array, "m k"], to_x: Float[Array, "n k"], rows: _Rows) -> _Found:
    """The update by the covariance of the innovations, which may have rows without noise."""
    k, dtype = visible.shape[1], visible.dtype
    whitened = GaussianRoot(jnp.zeros(k, dtype), jnp.eye(k, dtype=dtype))
    noise = factor.diagonal_matrix(linalg.safe_sqrt(rows.variance))
    after, report = square_root.update(whitened, rows.measured[0], visible, noise, None, rows.counts)
    found = DifferencedInfo(report.log_evidence, report.nis, report.rank, jnp.zeros((), jnp.int32))
    return factor.apply(to_x, after.mean), linalg.matmul(to_x, after.root), found


def _by_information(visible: Float[Array, "m k"], to_x: Float[Array, "n k"], rows: _Rows) -> _Found:
    """The update by the information of rows with noise, in time proportional to their number."""
    scale = jnp.where(rows.counts, 1 / jnp.sqrt(jnp.where(rows.counts, rows.variance, 1.0)), 0.0)
    A, e = scale[:, None] * visible, scale * rows.measured[0]
    # C C^T = I + A^T A without forming the product, whose rounding would be that of the sharpest row.
    C = linalg.tria(jnp.hstack([jnp.eye(A.shape[1], dtype=e.dtype), A.T]))
    half = linalg.solve_triangular(C, factor.apply(A.T, e))
    u = linalg.solve_triangular(C, half, transpose=True)
    left = e - factor.apply(A, u)
    nis = jnp.sum(left * left) + jnp.sum(u * u)
    log_scales = 0.5 * np.log(2 * np.pi) - jnp.log(jnp.where(rows.counts, scale, 1.0))
    log_scale = jnp.sum(jnp.where(rows.counts, log_scales, 0.0))
    log_evidence = -0.5 * nis - log_scale - jnp.sum(jnp.log(factor.diagonal(C)))
    found = DifferencedInfo(log_evidence, nis, jnp.sum(rows.counts, dtype=jnp.int32), jnp.zeros((), jnp.int32))
    return factor.apply(to_x, u), linalg.solve_triangular(C, to_x.T).T, found
