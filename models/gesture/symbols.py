"""Symbols distinguished by hidden Markov models of what their strokes look like."""

from collections.abc import Sequence
from dataclasses import field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int32, PyTree
from scipy.cluster.vq import kmeans2

from jaxfilters import hmm
from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm import Emission, HiddenMarkovModel
from jaxfilters.models.gesture.rejection import threshold_log_likelihood

MIN_VARIANCE = 0.15
"""Floor of the variances of features, which have the size of 1: people differ by more than one of them shows."""

SHARPNESS = 0.25
"""Share of a log-likelihood that counts towards confidence."""
CHUNK = 128
"""Strokes that `recognise_all` judges at once."""


@pytree_dataclass
class Symbols:
    """Models of symbols, each of one or more ways to draw one."""

    models: HiddenMarkovModel
    """Leaves with the models as their first axis."""
    owner: Int32[Array, "..."]
    """(m,): the symbol that each model is a way to draw, as an index into `names`."""
    names: tuple[str, ...] = field(metadata={"static": True})
    sharpness: Any = None
    """Share of a log-likelihood that counts towards confidence, of `calibration.fitted`; `None` is `SHARPNESS`."""
    lapse: Any = None
    """Probability that a stroke may be any symbol, of `calibration.fitted`; `None` is 0."""
    margins: Any = None
    """(k,): nats a point by which each symbol has to beat the threshold model, of `calibration.fitted`; `None` is 0."""


class Recognition(NamedTuple):
    """What a stroke is taken for."""

    label: Int32[Array, "*batch"]
    """Index into `names`; -1 where the stroke is rejected."""
    confidence: Float[Array, "k *batch"]
    """Of every symbol, summing to 1."""
    log_likelihood: Float[Array, "k *batch"]
    """Of the best way to draw each symbol, in nats a point."""
    lead: Float[Array, "*batch"]
    """Nats a point by which the best symbol beats the threshold model."""


def learn(
    features: Float[Array, "n p f"],
    labels: Sequence[str],
    *,
    num_states: int = 10,
    num_variants: int = 1,
    max_iterations: int = 8,
    min_variance: float = MIN_VARIANCE,
) -> Symbols:
    """Models of the symbols in a set of strokes, trained all at once.

    Args:
        features: Of every stroke, at the same number of points.
        labels: The symbol of each.
        num_states: States of each left-right model.
        num_variants: Ways to draw each symbol, found by clustering (k-means); fewer where there are fewer strokes.
        max_iterations: Of Baum-Welch.
        min_variance: Floor of the variances of the features.

    Raises:
        ValueError: If there is no stroke, `labels` has another length, or a feature is not finite.
    """
    shown = np.asarray(features)
    if not len(features) or len(labels) != len(features):
        raise ValueError(f"labels must name each of the strokes, at least one; got {len(labels)} of {len(features)}.")
    if not np.all(np.isfinite(shown)):
        raise ValueError("features must be finite.")
    num_points, num_features = shown.shape[1:]
    blank = hmm.DiagonalGaussian(
        jnp.zeros((num_states, num_features)), jnp.ones((num_states, num_features)), float(min_variance)
    )
    lengths = np.full(len(shown), num_points, np.int32)
    groups = [(name, own[members]) for name, own in by_name(labels) for members in _variants(shown[own], num_variants)]
    return trained(blank, np.moveaxis(shown, 0, -1), lengths, groups, max_iterations=max_iterations)


def trained(
    emission: Emission,
    observations: PyTree,
    lengths: Int[np.ndarray, " n"],
    groups: Sequence[tuple[str, Int[np.ndarray, " _"]]],
    *,
    max_iterations: int = 8,
) -> Symbols:
    """Left-right models, one a group of strokes, each begun by dividing its strokes evenly among the states.

    Args:
        emission: Of as many states as a model has; what it holds is replaced.
        observations: Those of the emission, leaves `(T, ..., n)`.
        lengths: Frames of each stroke.
        groups: Name of the symbol, and which strokes are drawn in one way of drawing it.
        max_iterations: Of Baum-Welch.
    """
    names = tuple(sorted({name for name, _ in groups}))
    most = max(len(members) for _, members in groups)
    # Groups are filled up with strokes of no frame.
    chosen = np.stack([np.pad(members, (0, most - len(members))) for _, members in groups])
    counts = np.array([len(members) for _, members in groups])
    owned = np.where(np.arange(most) < counts[:, None], np.asarray(lengths)[chosen], 0)
    strokes = jax.tree.map(lambda leaf: jnp.asarray(np.moveaxis(np.asarray(leaf)[..., chosen], -2, 0)), observations)
    num_states = jax.tree.leaves(emission)[0].shape[0]
    start = hmm.from_topology(hmm.left_right(num_states), emission, initial=hmm.left_right_initial(num_states))
    models = _train(start, strokes, jnp.asarray(owned), max_iterations)
    return Symbols(models, jnp.asarray([names.index(name) for name, _ in groups], jnp.int32), names)


def extended(symbols: Symbols, others: Symbols) -> Symbols:
    """Both sets of symbols in one, e.g. one more symbol that was fitted to a few strokes.

    Raises:
        ValueError: If a name is in both, or their models have different shapes.
    """
    twice = set(symbols.names) & set(others.names)
    shapes = [jax.tree.map(lambda leaf: leaf.shape[1:], one.models) for one in (symbols, others)]
    if twice or shapes[0] != shapes[1]:
        raise ValueError(
            f"others must have new names and models of the same shape; got {sorted(twice)} again, {shapes}."
        )
    models = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), symbols.models, others.models)
    owner = jnp.concatenate([symbols.owner, others.owner + len(symbols.names)])
    margins = None
    if symbols.margins is not None or others.margins is not None:
        zeros = (np.zeros(len(one.names)) if one.margins is None else one.margins for one in (symbols, others))
        margins = jnp.concatenate([jnp.asarray(own) for own in zeros])
    # A stroke of one set may be taken for a symbol of the other, of which nothing was measured: the less certain holds.
    shares = [float(one.sharpness) for one in (symbols, others) if one.sharpness is not None]
    lapses = [float(one.lapse) for one in (symbols, others) if one.lapse is not None]
    names = symbols.names + others.names
    return Symbols(models, owner, names, min(shares, default=None), max(lapses, default=None), margins)


def network(symbols: Symbols) -> hmm.Network:
    """All models side by side, for `hmm.threshold_model`, `hmm.loop` and `hmm.spotter`."""
    return hmm.parallel_composition(
        [jax.tree.map(lambda leaf, i=i: leaf[i], symbols.models) for i in range(len(symbols.owner))]
    )


@jax.jit
def recognise(
    symbols: Symbols,
    observations: PyTree,
    threshold: HiddenMarkovModel | None = None,
    lengths: Int[Array, " n"] | None = None,
    *,
    margin: float | Float[Array, ""] = 0.0,
    distance: float | Float[Array, ""] = 0.0,
    sharpness: float | Float[Array, ""] | None = None,
) -> Recognition:
    """What strokes are, in one pass over all models.

    Args:
        symbols: Made by `learn`.
        observations: Features `(p, f, n)` of n strokes, or what else the models observe; the strokes last.
        threshold: What a symbol has to beat, `hmm.threshold_model(network(symbols))`; `None` rejects only strokes whose
            features are not finite or that no symbol can produce.
        lengths: Points of each stroke; `None` is all.
        margin: Nats a point by which it has to, beside the symbol's own margin.
        distance: Nats a point by which it has to beat every other symbol.
        sharpness: Of the confidence: share of a log-likelihood that counts. Neighbouring points say nearly the
            same, so that all of it would be certain of everything. `None` is that of the symbols.
    """
    leaf = jax.tree.leaves(observations)[0]
    lengths = jnp.full(leaf.shape[-1], leaf.shape[0]) if lengths is None else lengths
    observed = _observed(symbols, observations)
    bar = jnp.full(leaf.shape[-1], -jnp.inf, observed.dtype)
    if threshold is not None:
        bar = hmm.log_evidence(threshold, jax.vmap(threshold.log_likelihoods, -1, -1)(observations), lengths)
    return _decided(symbols, observed, bar, lengths, margin, distance, sharpness)


def recognise_all(
    symbols: Symbols,
    observations: PyTree,
    lengths: Int[np.ndarray, " n"] | None = None,
    *,
    margin: float = 0.0,
    distance: float = 0.0,
) -> Recognition:
    """What any number of strokes are, against the threshold model of the symbols themselves.

    One program for a single stroke and one for `CHUNK` of them; a stroke of no point is rejected. Arguments as of
    `recognise`.
    """
    leaf = jax.tree.leaves(observations)[0]
    num_strokes = leaf.shape[-1]
    lengths = np.full(num_strokes, leaf.shape[0], np.int32) if lengths is None else np.asarray(lengths, np.int32)
    chunk = 1 if num_strokes == 1 else CHUNK
    # One call at least, for its shapes.
    missing = -num_strokes % chunk if num_strokes else chunk
    filled = jax.tree.map(
        lambda leaf: np.pad(np.asarray(leaf), [(0, 0)] * (leaf.ndim - 1) + [(0, missing)]), observations
    )
    lengths = np.pad(lengths, (0, missing))
    parts = [
        _evaluated(
            symbols,
            jax.tree.map(lambda leaf, i=i: leaf[..., i : i + chunk], filled),
            lengths[i : i + chunk],
            margin,
            distance,
        )
        for i in range(0, num_strokes + missing, chunk)
    ]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1)[..., :num_strokes], *parts)


@jax.jit
def _evaluated(symbols, observations, lengths, margin, distance):
    observed = _observed(symbols, observations)
    bar = threshold_log_likelihood(symbols.models, observed, lengths)
    return _decided(symbols, observed, bar, lengths, margin, distance, None)


def _observed(symbols: Symbols, observations: PyTree) -> Float[Array, "m p q n"]:
    """Log-likelihoods of the states of every model."""
    return jax.vmap(lambda model: jax.vmap(model.log_likelihoods, -1, -1)(observations))(symbols.models)


def _decided(symbols, observed, bar, lengths, margin, distance, sharpness) -> Recognition:
    num_points = jnp.maximum(lengths, 1)
    by_model = jax.vmap(hmm.log_evidence, (0, 0, None))(symbols.models, observed, lengths)
    own = symbols.owner == jnp.arange(len(symbols.names))[:, None]
    totals = jnp.max(jnp.where(own[..., None], by_model, -jnp.inf), axis=1)
    best = jnp.argmax(totals, axis=0).astype(jnp.int32)
    top = jnp.max(totals, axis=0)
    possible = (top > -jnp.inf) & (lengths > 0)
    finite = jnp.where(possible, top, 0.0)
    lead = jnp.where(possible, (finite - bar) / num_points, -jnp.inf)
    others = jnp.where(jnp.arange(len(totals))[:, None] == best, -jnp.inf, totals)
    apart = (finite - jnp.max(others, axis=0)) / num_points
    usual = jnp.where(possible, totals - finite, 0.0)
    own_margin = 0.0 if symbols.margins is None else symbols.margins[best]
    accepted = possible & (lead >= own_margin + margin) & (apart >= distance)
    if sharpness is None:
        sharpness = SHARPNESS if symbols.sharpness is None else symbols.sharpness
    lapse = 0.0 if symbols.lapse is None else symbols.lapse
    confidence = (1 - lapse) * jax.nn.softmax(sharpness * usual, axis=0) + lapse / len(symbols.names)
    return Recognition(jnp.where(accepted, best, -1), confidence, totals / num_points, lead)


@partial(jax.jit, static_argnames="max_iterations")
def _train(start: HiddenMarkovModel, strokes: PyTree, lengths: Array, max_iterations: int) -> HiddenMarkovModel:
    num_states = start.log_initial.shape[0]

    def one(strokes: PyTree, lengths: Array) -> HiddenMarkovModel:
        shares = hmm.uniform_segmentation(lengths, jax.tree.leaves(strokes)[0].shape[0], num_states)
        model = hmm.with_responsibilities(start, strokes, shares)
        return hmm.baum_welch(model, strokes, lengths, max_iterations=max_iterations).model

    return jax.vmap(one)(strokes, lengths)


def by_name(labels: Sequence[str]) -> list[tuple[str, np.ndarray]]:
    """Every symbol and the indices of its strokes."""
    return [(name, np.flatnonzero(np.asarray(labels) == name)) for name in sorted(set(labels))]


def _variants(features: np.ndarray, num_variants: int) -> list[np.ndarray]:
    """Indices of the strokes of each way to draw a symbol."""
    num_groups = min(num_variants, len(features))
    if num_groups == 1:
        return [np.arange(len(features))]
    flat = features.reshape(len(features), -1).astype(float)
    _, group = kmeans2(flat, num_groups, minit="++", rng=0, missing="warn")
    return [np.flatnonzero(group == i) for i in range(num_groups) if np.any(group == i)]
