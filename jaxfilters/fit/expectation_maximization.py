"""Expectation-maximisation: maximum likelihood by smoothing and regression in turns, without gradients."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, PyTree

from jaxfilters.filter import Filter
from jaxfilters.fit import em_linear, em_nonlinear
from jaxfilters.fit.em_moments import moments
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.hmm.model import HiddenMarkovModel
from jaxfilters.hmm.training import baum_welch
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey


class EM(NamedTuple):
    """A model estimated by expectation-maximisation, and the course of the estimation."""

    fitted: Any
    """The model, of the kind that was given: a `Filter` or a `HiddenMarkovModel`."""
    log_evidence: Float[Array, " i"]
    """(max_iterations,): log evidence of all sequences before each iteration, plus the log prior of a hidden Markov
    model that has one; after convergence the last value repeats. It never decreases where expectations are exact."""
    num_iterations: Int32[Array, ""]
    converged: Bool[Array, ""]


def em(
    model: Filter | HiddenMarkovModel,
    key: AnyKey,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    lengths: Int[Array, " s"] | Int[np.ndarray, " s"] | None = None,
    mask: Bool[Array, "t s"] | Bool[np.ndarray, "t s"] | None = None,
    free: tuple[str, ...] | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
) -> EM:
    """Maximum likelihood by expectation-maximisation, from one or several sequences.

    Every iteration smooths the sequences with the parameters so far, and takes those of the greatest expected log
    density of states and observations. The evidence never decreases, and nothing has to be tuned; close to the maximum
    `jf.fit.maximize` is faster, and gives standard errors.

    - A filter made by `jf.kalman`: in closed form (R. H. Shumway and D. S. Stoffer, "An approach to time series
      smoothing and forecasting using the EM algorithm", Journal of Time Series Analysis 3(4), 1982). Components that
      were not read are missing data, whatever R correlates them with.
    - A filter made by `jf.extended_kalman`, `jf.unscented_kalman` or `jf.cubature_kalman`, of vectors: expectations by
      sigma points (S. Särkkä and L. Svensson, "Bayesian Filtering and Smoothing", 2nd edition, 2023, section 16.3.3).
      They are approximations: near the maximum the evidence may decrease a little.
    - A `jf.hmm.HiddenMarkovModel` with an emission: Baum-Welch, as `jf.hmm.baum_welch`, which has more options.

    Args:
        model: The model to start from.
        key: Random key; none of these models uses it.
        observations: Leaves (t, ..., s), time first and the s sequences last, as `jf.hmm.pad` stacks them; one sequence
            is `y[..., None]`. Those of a filter are one array (t, m, s), NaN where nothing was read.
        inputs: Known inputs of the filter, time first and the sequences last, or `None`.
        lengths: Number of frames of each sequence, (s,); `None` is t for all.
        mask: False for frames without an observation, (t, s).
        free: Names of what is estimated. Of `kalman`: "F", "Q", "H", "R", "b", "d", and "mean" and "covariance" of the
            prior; all that the filter has by default, but for functions of the inputs and the noise beside a matrix
            that is one. Of a nonlinear filter: "process_noise", "observation_noise",
            "mean" and "covariance", the default; and "transition" and "observe", whose parameters are the arrays in
            these functions, which are then pytrees (e.g. `jax.tree_util.Partial`) and share no parameter: exactly where
            the result is linear in them, else by one damped Gauss-Newton step an iteration. One sequence cannot
            determine the covariance of its start, which then shrinks towards zero.
        max_iterations: Largest number of iterations, at least 1.
        tolerance: Relative increase of the log evidence below which the estimation has converged.

    Returns:
        The model and the log evidence before each iteration.

    Raises:
        ValueError: If the model is another kind of filter; a name in `free` is not one of its parameters; shapes do not
            match; a length is out of range; or `max_iterations < 1`.
        TypeError: If `model` is neither a filter nor a hidden Markov model.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> start = jf.kalman(prior, jnp.eye(1), jnp.eye(1), jnp.eye(1), jnp.eye(1))
        >>> y = jnp.cumsum(0.1 * jax.random.normal(jax.random.key(0), (200, 1)), axis=0)
        >>> found = jf.fit.em(start, jax.random.key(1), y[..., None], free=("Q", "R"))
        >>> bool(found.fitted.params.Q[0, 0] < 0.1)
        True
    """
    checks.count("max_iterations", max_iterations)
    if isinstance(model, HiddenMarkovModel):
        if free is not None or inputs is not None:
            raise ValueError("free and inputs must be None for a HiddenMarkovModel, all of which is estimated.")
        trained = baum_welch(model, observations, lengths, mask, max_iterations=max_iterations, tolerance=tolerance)
        return EM(trained.model, trained.objective, trained.num_iterations, trained.converged)
    checks.is_filter("model", model)
    free = _free(model, free)
    y, inside, is_partial = _data(observations, inputs, lengths, mask)
    y = y.astype(model.params.prior.mean.dtype)
    return _em(_with_square_roots(model), key, y, inputs, inside, free, is_partial, max_iterations, tolerance)


@partial(jax.jit, static_argnames=("free", "is_partial", "max_iterations"))
def _em(filter, key, y, inputs, inside, free, is_partial, max_iterations, tolerance) -> EM:
    maximized = em_linear.maximized if isinstance(filter.params, Kalman) else em_nonlinear.maximized

    def improve(state: EM, index: Array) -> EM:
        found = moments(state.fitted, key, y, inputs, inside)
        before = state.log_evidence[jnp.maximum(index - 1, 0)]
        converged = (index > 0) & (found.log_evidence - before <= tolerance * jnp.abs(found.log_evidence))
        history = jnp.where(jnp.arange(max_iterations) >= index, found.log_evidence, state.log_evidence)
        return EM(maximized(state.fitted, found, free, is_partial), history, index + 1, converged)

    def step(state: EM, index: Array) -> tuple[EM, None]:
        return jax.lax.cond(state.converged, lambda state, _: state, improve, state, index), None

    zeros = jnp.zeros(max_iterations, y.dtype)
    start = EM(filter, zeros, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    return jax.lax.scan(step, start, jnp.arange(max_iterations, dtype=jnp.int32))[0]


def _with_square_roots(filter: Filter) -> Filter:
    """The filter with roots that are square, as an M-step leaves them."""
    model = filter.params
    if isinstance(model.prior, Gaussian):
        return filter
    names = ("Q", "R") if isinstance(model, Kalman) else ("process_noise", "observation_noise")
    noises = {name: getattr(model, name) for name in names}
    square = {name: linalg.tria(noise) for name, noise in noises.items() if hasattr(noise, "shape")}
    prior = GaussianRoot(model.prior.mean, linalg.tria(model.prior.root))
    return replace(filter, params=replace(model, prior=prior, **square))


def _free(filter: Filter, free: tuple[str, ...] | None) -> tuple[str, ...]:
    """The names of the parameters to be estimated, checked."""
    model = filter.params
    if isinstance(model, Kalman):
        known = em_linear.estimable(model)
        chosen = known if free is None else free
    elif isinstance(model, ExtendedKalman):
        if not model.manifold.flat:
            raise ValueError("model must have vectors for states; expectation-maximisation is not for manifolds.")
        known = em_nonlinear.estimable(model)
        chosen = tuple(name for name in known if name not in ("transition", "observe")) if free is None else free
    else:
        raise ValueError(
            f"model must be made by kalman, extended_kalman, unscented_kalman or cubature_kalman, or be a "
            f"HiddenMarkovModel; its parameters are {type(model).__name__}."
        )
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen or isinstance(free, str):
        raise ValueError(f"free must be a tuple of names that can be estimated of this model, {known}; got {free!r}.")
    return tuple(chosen)


def _data(observations: Any, inputs: PyTree, lengths: Any, mask: Any) -> tuple[Array, Array, bool]:
    """Observations with NaN where nothing counts, frames inside of their sequences, and whether frames are partial."""
    checks.floating("observations", observations)
    shape = jnp.shape(observations)
    if len(shape) != 3 or 0 in shape:
        raise ValueError(f"observations must be (t, m, s), the sequences last; got {shape}. One is y[..., None].")
    frames, _, count = shape
    for path, leaf in jax.tree_util.tree_leaves_with_path(inputs):
        if (jnp.shape(leaf)[:1], jnp.shape(leaf)[-1:]) != ((frames,), (count,)) or jnp.ndim(leaf) < 2:
            name = f"inputs{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} must be ({frames}, ..., {count}), like observations; got {jnp.shape(leaf)}.")
    inside = jnp.ones((frames, count), bool)
    if lengths is not None:
        if jnp.shape(lengths) != (count,) or not jnp.issubdtype(jnp.result_type(lengths), jnp.integer):
            raise ValueError(f"lengths must be integers ({count},), one for each sequence; got {lengths!r}.")
        known = checks.concrete(lengths)
        if known is not None and (np.any(known < 0) or np.any(known > frames)):
            raise ValueError(f"lengths must be from 0 to {frames}, the frames of observations; got {known}.")
        inside = jnp.arange(frames)[:, None] < jnp.asarray(lengths)
    observed = inside
    if mask is not None:
        checks.boolean("mask", mask, (frames, count), ", (t, s)")
        observed = inside & mask
    y = jnp.where(observed[:, None] & jnp.isfinite(observations), observations, jnp.nan)
    known = checks.concrete(y)
    if known is None:
        return y, inside, True
    some, every = np.isfinite(known).any(1), np.isfinite(known).all(1)
    if not some.any():
        raise ValueError("observations must hold at least one number that is not masked; got none.")
    return y, inside, bool((some != every).any())
