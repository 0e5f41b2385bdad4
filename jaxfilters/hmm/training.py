"""Learning a model from sequences: expectation-maximisation, where it starts, and the best of several starts.

Sequences lie along the last axis of every leaf of the observations, time along the first; `pad` makes such arrays of
sequences of different lengths. Many models are trained at once by `vmap` over models and observations: give symbols of
which there are fewer examples sequences of length 0.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, PyTree

from jaxfilters.hmm.emissions import Emission
from jaxfilters.hmm.model import HiddenMarkovModel
from jaxfilters.hmm.recursions import Posterior, posterior
from jaxfilters.typing import AnyKey


class Training(NamedTuple):
    """A trained model and how it came about."""

    model: HiddenMarkovModel
    objective: Float[Array, " i"]
    """Log-likelihood of all sequences plus log prior before each iteration, `max_iterations` of them; never falls.
    After convergence its last value. Sequences that the model cannot produce are left out."""
    num_iterations: Int32[Array, ""]
    converged: Bool[Array, ""]
    num_impossible: Int32[Array, ""]
    """Sequences that the model could not produce before the last iteration: nothing was learnt from them."""


def pad(sequences: Sequence[PyTree], length: int | None = None) -> tuple[PyTree, Int32[Array, " n"]]:
    """Sequences of one kind, time first, as arrays with the sequences last; and their lengths.

    Args:
        sequences: Arrays `(t, ...)` or pytrees of them; t may be 0.
        length: Number of frames of the result; `None` is that of the longest sequence.

    Raises:
        ValueError: If there is no sequence, or `length` is less than that of one.
    """
    lengths = np.array([len(jax.tree.leaves(sequence)[0]) for sequence in sequences], np.int32)
    if not len(lengths) or (length is not None and length < lengths.max()):
        raise ValueError(f"sequences must be at least one, none longer than length = {length}; got lengths {lengths}.")
    num_frames = int(lengths.max()) if length is None else length

    def stack(*leaves: Any) -> Array:
        first = np.asarray(leaves[0])
        stacked = np.zeros((num_frames, *first.shape[1:], len(leaves)), first.dtype)
        for i, leaf in enumerate(leaves):
            stacked[: len(leaf), ..., i] = leaf
        return jnp.asarray(stacked)

    return jax.tree.map(stack, *sequences), jnp.asarray(lengths)


@partial(jax.jit, static_argnames="max_iterations")
def baum_welch(
    model: HiddenMarkovModel,
    observations: PyTree,
    lengths: Int[Array, " n"] | None = None,
    mask: Bool[Array, "t n"] | None = None,
    *,
    max_iterations: int = 30,
    tolerance: float | Float[Array, ""] = 1e-4,
    transition_pseudo_count: float | Float[Array, ""] = 0.0,
) -> Training:
    """The model after expectation-maximisation (L. Rabiner 1989, section III.C), as the mode of the posterior.

    Transitions and starts that the model rules out stay ruled out. `vmap` over models trains all of them in one loop.

    Args:
        model: Where to start; its emission says how it is trained, with which floors.
        observations: Leaves `(T, ..., n)`.
        lengths: Frames of each sequence; the rest is padding. 0 is allowed.
        mask: `False` where a frame inside a sequence was not seen.
        max_iterations: Upper bound, at least 1.
        tolerance: Stops when the objective gains less than this share of its size.
        transition_pseudo_count: Times added to those that each allowed transition, and start, is expected.

    Raises:
        ValueError: If the model has no emission.
    """
    num_frames, num_sequences = _extent(observations)
    if lengths is None:
        lengths = jnp.full(num_sequences, num_frames)
    seen = jnp.arange(num_frames)[:, None] < lengths
    if mask is not None:
        seen = seen & mask
    # Padding may hold anything.
    observations = jax.tree.map(lambda leaf: jnp.where(_along(seen, leaf), leaf, jnp.zeros_like(leaf)), observations)

    def improve(state: tuple) -> tuple:
        model, objectives, i, _, _ = state
        found = _expected(model, observations, seen, lengths)
        possible = found.log_evidence > -jnp.inf
        objective = jnp.sum(jnp.where(possible, found.log_evidence, 0.0)) + _log_prior(model, transition_pseudo_count)
        before = objectives[jnp.maximum(i - 1, 0)]
        converged = (i > 0) & (objective - before <= tolerance * jnp.abs(objective))
        objectives = jnp.where(jnp.arange(max_iterations) >= i, objective, objectives)
        better = _maximized(model, found, observations, seen, transition_pseudo_count)
        return better, objectives, i + 1, converged, jnp.sum(~possible, dtype=jnp.int32)

    def goes_on(state: tuple) -> Bool[Array, ""]:
        _, _, i, converged, _ = state
        return (i < max_iterations) & ~converged

    nothing = jnp.zeros(max_iterations, model.log_initial.dtype)
    zero = jnp.zeros((), jnp.int32)
    start = (model, nothing, zero, jnp.zeros((), bool), zero)
    return Training(*jax.lax.while_loop(goes_on, improve, start))


def best_of_restarts(
    key: AnyKey, model: HiddenMarkovModel, observations: PyTree, lengths: Int[Array, " n"], *, num_restarts: int
) -> Training:
    """The best of several trainings at once, each from emissions that `scattered` makes of random frames.

    Raises:
        ValueError: If `num_restarts < 1`.
    """
    if num_restarts < 1:
        raise ValueError(f"num_restarts must be at least 1; got {num_restarts}.")

    def train(key: AnyKey) -> Training:
        shares = scattered(key, lengths, _extent(observations)[0], model.log_initial.shape[0])
        return baum_welch(with_states(model, observations, shares), observations, lengths)

    trained = jax.vmap(train)(jax.random.split(key, num_restarts))
    best = jnp.argmax(trained.objective[:, -1])
    return jax.tree.map(lambda leaf: leaf[best], trained)


def with_states(model: HiddenMarkovModel, observations: PyTree, shares: Float[Array, "t q n"]) -> HiddenMarkovModel:
    """The model with the emission that `shares`, how probable each state is in each frame, imply.

    Raises:
        ValueError: If the model has no emission.
    """
    return replace(model, emission=_emission(model).maximized(observations, shares))


def in_turn(lengths: Int[Array, " n"], num_frames: int, num_states: int) -> Float[Array, "t q n"]:
    """Every sequence divided evenly among the states, in their order: where training of left-right models starts."""
    frames = jnp.arange(num_frames)[:, None]
    state = jnp.minimum(frames * num_states // jnp.maximum(lengths, 1), num_states - 1)
    inside = (frames < lengths)[:, None]
    return ((state[:, None] == jnp.arange(num_states)[:, None]) & inside).astype(float)


def scattered(key: AnyKey, lengths: Int[Array, " n"], num_frames: int, num_states: int) -> Float[Array, "t q n"]:
    """Every state half of one random frame and half of all frames: where the training of ergodic models starts."""
    inside = (jnp.arange(num_frames)[:, None] < lengths).astype(float)
    flat = inside.ravel()
    seeds = jax.random.choice(key, flat.size, (num_states,), p=flat / jnp.maximum(flat.sum(), 1.0))
    own = jax.nn.one_hot(seeds, flat.size, dtype=flat.dtype) * flat
    shares = own + flat / jnp.maximum(flat.sum(), 1.0)
    return jnp.moveaxis(shares.reshape(num_states, *inside.shape), 0, 1)


def _expected(model: HiddenMarkovModel, observations: PyTree, seen: Array, lengths: Array) -> Posterior:
    log_likelihoods = jax.vmap(model.log_likelihoods, -1, -1)(observations, seen)
    return posterior(model, log_likelihoods, lengths)


def _maximized(
    model: HiddenMarkovModel, found: Posterior, observations: PyTree, seen: Array, pseudo_count: Array | float
) -> HiddenMarkovModel:
    initial = jnp.sum(found.states[0], axis=1)
    return HiddenMarkovModel(
        _frequencies(initial, model.log_initial, pseudo_count),
        _frequencies(found.transitions, model.log_transition, pseudo_count),
        _emission(model).maximized(observations, found.states * seen[:, None]),
    )


def _frequencies(counts: Array, before: Array, pseudo_count: Array | float) -> Array:
    """Logarithms of relative frequencies along the last axis; as before where there are none."""
    allowed = before > -jnp.inf
    counts = jnp.where(allowed, counts + pseudo_count, 0.0)
    totals = jnp.sum(counts, axis=-1, keepdims=True)
    known, possible = totals > 0, counts > 0
    logs = jnp.log(jnp.where(possible, counts, 1.0)) - jnp.log(jnp.where(known, totals, 1.0))
    return jnp.where(known, jnp.where(possible, logs, -jnp.inf), before)


def _log_prior(model: HiddenMarkovModel, pseudo_count: Array | float) -> Array:
    logs = (model.log_initial, model.log_transition)
    chain = sum(jnp.sum(jnp.where(values > -jnp.inf, values, 0.0)) for values in logs)
    return _emission(model).log_prior() + pseudo_count * chain


def _emission(model: HiddenMarkovModel) -> Emission:
    if model.emission is None:
        raise ValueError("model has no emission to be trained.")
    return model.emission


def _along(seen: Array, leaf: Array) -> Array:
    return seen.reshape(seen.shape[0], *[1] * (leaf.ndim - 2), seen.shape[1])


def _extent(observations: PyTree) -> tuple[int, int]:
    leaf = jax.tree.leaves(observations)[0]
    return leaf.shape[0], leaf.shape[-1]
