"""Time constants, biases and scales of noise from recordings, and how far their claims hold on recordings left out."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters import filter as filters
from jaxfilters._struct import pytree_dataclass
from jaxfilters.diagnostics.clusters import cluster_interval
from jaxfilters.diagnostics.consistency import Band, chi_square_band
from jaxfilters.diagnostics.innovations import whiteness
from jaxfilters.filter import Filter
from jaxfilters.fit.constraints import free
from jaxfilters.fit.density import common_random_numbers, over_sequences
from jaxfilters.fit.maximum import maximize
from jaxfilters.fit.parametrization import Parametrization
from jaxfilters.fit.result import Fit
from jaxfilters.fit.score_errors import with_score_errors
from jaxfilters.gaussian.arithmetic import KalmanInfo
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.correlated import CorrelatedNoise
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, as_pytree

_MAX_LAG = 10
"""Largest lag of the test of whiteness."""


class Recording(NamedTuple):
    """One recording: what a filter is run on, and the truth where there is some."""

    observations: PyTree
    """Arrays with time as their first axis, NaN for what is missing."""
    inputs: PyTree = None
    """Known inputs, time first."""
    truth: Float[Array, "t d"] | None = None
    """True values of what `believed` gives, NaN where they are not known."""


class Coverage(NamedTuple):
    """How often the truth was within two standard deviations, on recordings left out of the fit."""

    share: Float[Array, " d"]
    interval: Band
    """95 % interval, (d,) each, by drawing whole recordings."""
    log_score: Float[Array, ""]
    """Mean negative log density of the truth, in nats a frame; smaller is better."""


class Calibration(NamedTuple):
    """What recordings say about the noise, and what they say about these claims."""

    fit: Fit
    """The maximum over all recordings; its `theta` are the parameters to use."""
    num_draws: float
    """Effective number of draws of the lasting errors in all recordings: what their covariance rests on."""
    held_out_log_evidence: np.ndarray
    """(r,): log evidence of each recording under the parameters of the others, in nats a frame."""
    whiteness: np.ndarray
    """(m,): p-values of Ljung and Box of the whitened innovations of recordings left out; small ones say that errors
    are correlated in a way that the model has not."""
    nis: float
    """Mean normalised innovation squared a component on recordings left out; 1 is right."""
    nis_band: Band
    """Where it is with a probability of 95 % if the model is right."""
    coverage: Coverage | None
    """With truth."""

    def __str__(self) -> str:
        low, high = (float(end) for end in self.nis_band)
        lines = [
            str(self.fit),
            f"effective draws of lasting errors: {self.num_draws:.1f}",
            f"left out: log evidence a frame {np.mean(self.held_out_log_evidence):.4g}, NIS a component {self.nis:.3g} "
            f"({low:.3g} .. {high:.3g} if right), least p-value of whiteness {np.min(self.whiteness):.2g}",
        ]
        if self.coverage is not None:
            ends = zip(self.coverage.share, *self.coverage.interval, strict=True)
            shown = ", ".join(f"{100 * share:.0f} % ({100 * low:.0f} .. {100 * high:.0f})" for share, low, high in ends)
            lines.append(f"left out: within 2 standard deviations {shown}")
        return "\n".join(lines)


def calibrate(
    key: AnyKey,
    filter_of: Callable[[PyTree], Filter],
    recordings: Sequence[Recording],
    start: PyTree,
    constraints: PyTree = free,
    *,
    believed: Callable[[PyTree], Gaussian] | None = None,
    by_score: bool = False,
    min_draws: float = 8.0,
    method: Any = None,
) -> Calibration:
    """Parameters of lasting and white noise from recordings, checked on each recording left out of the fit.

    The parameters have maximum evidence over all recordings, which needs no truth; or, with `by_score`, the best log
    score of the truth. Then each recording is left out in turn: the others are fitted again, and the recording says
    whether its innovations are white (Ljung-Box) and of the size that is claimed (NIS) and, with truth, how often it
    lies within two standard deviations. Frames of a recording are not independent, so that the interval of the coverage
    is drawn over whole recordings.

    A recording holds about 1 + T / (2 tau) independent draws of an error that lasts for tau. Recordings that are too
    short cannot tell a large error from a small one, and are refused. The number, the checks and their limits are
    derived in `docs/derivations/correlated_noise.md`, section 7.

    Standard errors by evidence are those of the curvature J of the log evidence. The log scores of frames are
    correlated, so that standard errors by score are J^-1 K J^-1, with the covariance K of the sum of their derivatives
    (Godambe 1960; Newey and West 1987), like those of `godambe`. They are asymptotic, and still somewhat too small for
    a few recordings.

    Args:
        key: Random key of the intervals; and of the filter, where it has randomness.
        filter_of: `theta -> Filter`, made by `correlated_noise` with a `Gaussian` prior, or a `schmidt_kalman` around
            it (its innovations are then those of the inner filter).
        recordings: At least two, of any lengths, of equal structure.
        start: Parameters from which to start.
        constraints: As for `maximize`, e.g. `fit.positive`.
        believed: `state -> Gaussian` about the components that `Recording.truth` holds. Needed with truth only.
        by_score: Whether to maximise the log score of the truth instead of the evidence. It tells less of the same
            parameters if the model is right, and what matters for the claims if it is not.
        min_draws: Least effective number of draws of the slowest error, in all recordings together.
        method: As for `maximize`.

    Returns:
        The calibration; printed, it is a table.

    Raises:
        ValueError: If there are fewer than two recordings, they differ in structure, no filter with lasting errors is
            made, truth is missing where it is needed, or the recordings are too short to tell; the message says how
            long they would have to be.
        TypeError: If a recording is no `Recording`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> def filter_of(theta):
        ...     prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        ...     inner = jf.kalman(prior, jnp.eye(1), jnp.eye(1), jnp.ones((2, 1)), 0.01 * jnp.eye(2))
        ...     return jf.correlated_noise(inner, jf.GaussMarkov(theta["tau"], theta["B"] * jnp.ones(2)))
        >>> ys = jax.random.normal(jax.random.key(1), (4, 60, 2))
        >>> recordings = [jf.fit.Recording(y) for y in ys]
        >>> found = jf.fit.calibrate(
        ...     jax.random.key(0), filter_of, recordings, {"tau": 1.0, "B": 0.5}, jf.fit.positive
        ... )
        >>> bool(found.fit.theta["tau"] < 2.0), found.held_out_log_evidence.shape
        (True, (4,))
    """
    recordings = list(recordings)
    _check(recordings, believed, by_score)
    filter_of = as_pytree(filter_of)
    data = _stacked(recordings)
    believed = None if believed is None else as_pytree(believed)
    density = partial(_density, key, filter_of, believed if by_score else None, data)
    fit = maximize(density(data.mask), start, constraints, method=method)
    if by_score and believed is not None:
        score = _Score(filter_of, believed, data, data.mask)
        fit = with_score_errors(fit, _slopes(score, key, fit.parametrization, fit.search.z), data.mask)
    num_draws = _check_draws(filter_of(fit.theta), data, min_draws)

    # One mask a fold: all fits are one program, that of the fit to all recordings.
    count, thetas = len(recordings), []
    for left_out in range(count):
        mask = data.mask & (jnp.arange(count) != left_out)
        thetas.append(maximize(density(mask), fit.theta, constraints, method=method).theta)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *thetas)
    folds = _evaluated(filter_of, believed, key, stacked, data)
    return _summary(key, fit, num_draws, folds, data)


@pytree_dataclass
class _Data:
    """Recordings along the last axis, padded to one length."""

    observations: PyTree
    inputs: PyTree
    mask: Bool[Array, "t r"]
    truth: Any


def _check(recordings: list[Recording], believed: Callable | None, by_score: bool) -> None:
    for index, recording in enumerate(recordings):
        if not isinstance(recording, Recording):
            raise TypeError(f"recordings[{index}] must be a Recording; got a {type(recording).__name__}.")
    if len(recordings) < 2:
        raise ValueError(f"recordings must be at least two, of which one is left out; got {len(recordings)}.")
    structures = {jax.tree.structure(recording) for recording in recordings}
    if len(structures) > 1:
        raise ValueError(f"recordings must have one structure, all with or without truth; got {len(structures)}.")
    has_truth = recordings[0].truth is not None
    if has_truth != (believed is not None):
        raise ValueError(
            "believed and the truth of recordings must both be given, or neither; "
            f"got {'no' if believed is None else 'a'} function and {'a' if has_truth else 'no'} truth."
        )
    if by_score and not has_truth:
        raise ValueError("by_score needs recordings with truth; got none.")


def _stacked(recordings: list[Recording]) -> _Data:
    lengths = []
    for index, recording in enumerate(recordings):
        found = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(recording)}
        if len(found) != 1 or found == {()}:
            raise ValueError(f"recordings[{index}] must have arrays of one length, time first; got {sorted(found)}.")
        lengths.append(found.pop()[0])
    longest = max(lengths)

    def padded(*leaves: Array) -> Array:
        return jnp.stack(
            [jnp.concatenate([leaf, jnp.repeat(leaf[-1:], longest - len(leaf), axis=0)]) for leaf in leaves], axis=-1
        )

    whole = jax.tree.map(padded, *recordings)
    mask = np.arange(longest)[:, None] < np.asarray(lengths)
    return _Data(whole.observations, whole.inputs, jnp.asarray(mask), whole.truth)


def _density(key: AnyKey, filter_of: Callable, believed: Callable | None, data: _Data, mask: Array) -> Callable:
    if believed is None:
        return over_sequences(key, filter_of, data.observations, data.inputs, mask=mask)
    return common_random_numbers(key, _Score(filter_of, believed, data, mask))


@pytree_dataclass
class _Score:
    """Log density of the truth under the beliefs of the filter, summed over frames, recordings apart."""

    filter_of: Callable
    believed: Callable
    data: _Data
    mask: Bool[Array, "t r"]

    def __call__(self, key: AnyKey, theta: PyTree) -> Float[Array, ""]:
        return jnp.sum(self.terms(key, theta))

    def terms(self, key: AnyKey, theta: PyTree) -> Float[Array, "t r"]:
        """Log density of each frame of each recording."""
        filter = self.filter_of(theta)

        def one(observations: PyTree, inputs: PyTree, mask: Array, truth: Array) -> Array:
            _, (states, _) = filters.run(filter, key, observations, inputs, mask=mask)
            return jnp.where(mask, _log_densities(self.believed, states, truth), 0.0)

        data = (self.data.observations, self.data.inputs, self.mask, self.data.truth)
        return jax.vmap(one, in_axes=-1, out_axes=-1)(*data)


@jax.jit
def _slopes(score: _Score, key: AnyKey, parametrization: Parametrization, z: Float[Array, " d"]) -> Array:
    """Derivatives of the terms of the score by the coordinates, (t, r, d)."""
    return jax.jacfwd(lambda z: score.terms(key, parametrization.constrain(z)))(z)


def _log_densities(believed: Callable, states: PyTree, truth: Float[Array, "t d"]) -> Float[Array, " t"]:
    """Of each frame over the components whose truth is known."""

    def one(state: PyTree, truth: Array) -> Array:
        belief, known = believed(state), jnp.isfinite(truth)
        both = known[:, None] & known
        return Gaussian(belief.mean, jnp.where(both, belief.covariance, 0.0)).logpdf(
            jnp.where(known, truth, belief.mean)
        )

    return jax.vmap(one)(states, truth)


def _processes(filter: Filter) -> list[CorrelatedNoise]:
    is_one = lambda node: isinstance(node, CorrelatedNoise)
    return [node for node in jax.tree.leaves(filter.params, is_leaf=is_one) if is_one(node)]


def _check_draws(filter: Filter, data: _Data, min_draws: float) -> float:
    """Effective number of draws of the slowest error; an error where they are too few."""
    processes = _processes(filter)
    if not processes:
        raise ValueError("filter_of must return a filter made by correlated_noise, maybe within others; it has none.")
    model = processes[0]
    tau = np.asarray(model.noise.time_constant, float)
    slowest = float(np.max(tau if tau.ndim < 2 else 1 / np.linalg.eigvals(np.linalg.inv(tau)).real))
    if callable(model.dt):
        steps = jax.vmap(jax.vmap(model.dt_of, in_axes=-1), in_axes=0)(data.inputs)
    else:
        steps = jnp.full(data.mask.shape, model.dt_of(None))
    durations = np.sum(np.where(data.mask, steps, 0.0), axis=0)
    count = len(durations)
    num_draws = float(np.sum(1 + durations / (2 * slowest)))
    if num_draws < min_draws:
        each = 2 * slowest * (min_draws / count - 1)
        longer = f"{count} recordings of {each:.4g} each (in the unit of dt), or " if np.isfinite(each) else ""
        raise ValueError(
            f"recordings are too short to tell errors with a time constant of {slowest:.4g}: the {count} of them, of "
            f"{np.sum(durations):.4g} in all, hold {num_draws:.1f} draws of them, and min_draws is {min_draws:g}. "
            f"Needed are {longer}{int(np.ceil(min_draws))} recordings of any length."
        )
    return num_draws


class _Folds(NamedTuple):
    """Each recording under the parameters of the others, recordings first."""

    log_evidence: Float[Array, "r t"]
    nis: Float[Array, "r t"]
    rank: Float[Array, "r t"]
    whitened: Float[Array, "r t m"]
    """NaN for frames and components that do not count."""
    within: Any
    log_density: Any


@jax.jit
def _evaluated(filter_of: Callable, believed: Callable | None, key: AnyKey, thetas: PyTree, data: _Data) -> _Folds:
    def one(theta: PyTree, observations: PyTree, inputs: PyTree, mask: Array, truth: Any) -> _Folds:
        filter = filter_of(theta)
        _, (states, infos) = filters.run(filter, key, observations, inputs, mask=mask)
        info = infos if isinstance(infos, KalmanInfo) else infos.inner
        whitened = jax.vmap(linalg.solve_triangular)(info.innovation_root, info.innovation)
        counts = jnp.diagonal(info.innovation_root, axis1=1, axis2=2) > 0
        within = density = None
        if believed is not None:
            beliefs = jax.vmap(believed)(states)
            std = jnp.sqrt(jnp.diagonal(beliefs.covariance, axis1=1, axis2=2))
            known = jnp.isfinite(truth) & mask[:, None]
            within = jnp.where(known, jnp.abs(truth - beliefs.mean) <= 2 * std, jnp.nan)
            density = jnp.where(jnp.any(known, axis=1), _log_densities(believed, states, truth), jnp.nan)
        used = jnp.where(counts & mask[:, None], whitened, jnp.nan)
        return _Folds(infos.log_evidence, info.nis, info.rank, used, within, density)

    return jax.vmap(one, in_axes=(0, -1, -1, -1, -1))(thetas, data.observations, data.inputs, data.mask, data.truth)


def _summary(key: AnyKey, fit: Fit, num_draws: float, folds: _Folds, data: _Data) -> Calibration:
    frames = np.sum(np.asarray(data.mask), axis=0)
    total = float(np.sum(folds.rank))
    # One chain of innovations after the other: a gap of the largest lag keeps recordings apart.
    gap = np.full((_MAX_LAG, folds.whitened.shape[-1]), np.nan, np.float32)
    pieces = [part for one, length in zip(folds.whitened, frames, strict=True) for part in (one[:length], gap)]
    chain = np.concatenate(pieces)
    p_values = whiteness(jnp.asarray(chain), min(_MAX_LAG, len(chain) - 1)).p_value
    coverage = None
    if folds.within is not None:
        within = np.asarray(folds.within, float)
        known = np.isfinite(within)
        counts = known.sum(axis=1)
        means = np.where(known, within, 0.0).sum(axis=1) / np.maximum(counts, 1)
        interval = cluster_interval(key, jnp.asarray(means, jnp.float32), jnp.asarray(counts.max(axis=1), jnp.float32))
        share = np.where(known, within, 0.0).sum(axis=(0, 1)) / np.maximum(counts.sum(axis=0), 1)
        coverage = Coverage(jnp.asarray(share), interval, -jnp.nanmean(folds.log_density))
    return Calibration(
        fit,
        num_draws,
        np.asarray(folds.log_evidence).sum(axis=1) / frames,
        np.asarray(p_values),
        float(np.sum(folds.nis)) / total,
        chi_square_band(1.0, num_runs=total),
        coverage,
    )
