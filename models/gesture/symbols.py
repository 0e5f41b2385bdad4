"""Symbols told apart by hidden Markov models of the features of their strokes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32
from scipy.cluster.vq import kmeans2

from jaxfilters import hmm
from jaxfilters.hmm import HiddenMarkovModel

MIN_VARIANCE = 0.15
"""Floor of the variances of features, which have the size of 1: people differ by more than one of them shows."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
@no_type_check  # JAX rebuilds pytrees from leaves of any kind
class Symbols:
    """Models of symbols, each of one or more ways to draw one."""

    models: HiddenMarkovModel
    """Leaves with the models as their first axis."""
    owner: Int32[Array, "..."]
    """(m,): the symbol that each model is a way to draw, as an index into `names`."""
    names: tuple[str, ...] = field(metadata={"static": True})


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
    if not len(features) or len(labels) != len(features):
        raise ValueError(f"labels must name each of the strokes, at least one; got {len(labels)} of {len(features)}.")
    if not np.all(np.isfinite(features)):
        raise ValueError("features must be finite.")
    names = tuple(sorted(set(labels)))
    groups, owner = [], []
    for i, name in enumerate(names):
        own = np.flatnonzero(np.asarray(labels) == name)
        for members in _variants(np.asarray(features)[own], num_variants):
            groups.append(own[members])
            owner.append(i)
    num_points, num_features = features.shape[1:]
    most = max(len(group) for group in groups)
    strokes = np.zeros((len(groups), num_points, num_features, most), np.asarray(features).dtype)
    lengths = np.zeros((len(groups), most), np.int32)
    for i, group in enumerate(groups):
        strokes[i, ..., : len(group)] = np.moveaxis(np.asarray(features)[group], 0, -1)
        lengths[i, : len(group)] = num_points
    blank = hmm.DiagonalGaussian(
        jnp.zeros((num_states, num_features)), jnp.ones((num_states, num_features)), float(min_variance)
    )
    start = hmm.from_topology(hmm.left_right(num_states), blank, first=hmm.first_only(num_states))
    models = _train(start, jnp.asarray(strokes), jnp.asarray(lengths), max_iterations)
    return Symbols(models, jnp.asarray(owner, jnp.int32), names)


def extended(symbols: Symbols, others: Symbols) -> Symbols:
    """Both sets of symbols in one, e.g. one more symbol that was learnt of a few strokes.

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
    return Symbols(models, owner, symbols.names + others.names)


def network(symbols: Symbols) -> hmm.Network:
    """All models side by side, for `hmm.threshold`, `hmm.loop` and `hmm.spotter`."""
    return hmm.side_by_side(
        [jax.tree.map(lambda leaf, i=i: leaf[i], symbols.models) for i in range(len(symbols.owner))]
    )


@jax.jit
def recognise(
    symbols: Symbols,
    features: Float[Array, "p f n"],
    threshold: HiddenMarkovModel | None = None,
    *,
    margin: float | Float[Array, ""] = 0.0,
    sharpness: float | Float[Array, ""] = 0.25,
) -> Recognition:
    """What strokes are, in one pass over all models.

    Args:
        symbols: Made by `learn`.
        features: Of n strokes, the strokes last.
        threshold: What a symbol has to beat, `hmm.threshold(network(symbols))`; `None` rejects only strokes whose
            features are not finite or that no symbol can produce.
        margin: Nats a point by which it has to.
        sharpness: Of the confidence: share of a log-likelihood that counts. Neighbouring points say nearly the
            same, so that all of it would be certain of everything.
    """
    num_points = features.shape[0]
    by_model = jax.vmap(partial(_score, features))(symbols.models)
    own = symbols.owner == jnp.arange(len(symbols.names))[:, None]
    totals = jnp.max(jnp.where(own[..., None], by_model, -jnp.inf), axis=1)
    best = jnp.argmax(totals, axis=0).astype(jnp.int32)
    bar = jnp.full(totals.shape[1:], -jnp.inf) if threshold is None else _score(features, threshold)
    top = jnp.max(totals, axis=0)
    possible = top > -jnp.inf
    lead = jnp.where(possible, (jnp.where(possible, top, 0.0) - bar) / num_points, -jnp.inf)
    usual = jnp.where(possible, totals - jnp.where(possible, top, 0.0), 0.0)
    accepted = possible & (lead >= margin)
    return Recognition(
        jnp.where(accepted, best, -1), jax.nn.softmax(sharpness * usual, axis=0), totals / num_points, lead
    )


def _score(features: Array, model: HiddenMarkovModel) -> Float[Array, " n"]:
    return hmm.log_likelihood(model, jax.vmap(model.log_likelihoods, -1, -1)(features))


@partial(jax.jit, static_argnames="max_iterations")
def _train(start: HiddenMarkovModel, strokes: Array, lengths: Array, max_iterations: int) -> HiddenMarkovModel:
    num_states = start.log_initial.shape[0]

    def one(strokes: Array, lengths: Array) -> HiddenMarkovModel:
        shares = hmm.in_turn(lengths, strokes.shape[0], num_states)
        model = hmm.with_states(start, strokes, shares)
        return hmm.baum_welch(model, strokes, lengths, max_iterations=max_iterations).model

    return jax.vmap(one)(strokes, lengths)


def _variants(features: np.ndarray, num_variants: int) -> list[np.ndarray]:
    """Indices of the strokes of each way to draw a symbol."""
    num_groups = min(num_variants, len(features))
    if num_groups == 1:
        return [np.arange(len(features))]
    flat = features.reshape(len(features), -1).astype(float)
    _, group = kmeans2(flat, num_groups, minit="++", rng=0, missing="warn")
    return [np.flatnonzero(group == i) for i in range(num_groups) if np.any(group == i)]
