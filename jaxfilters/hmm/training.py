"""Training by expectation-maximisation: Baum-Welch, its initialisation, and random restarts.

Observations have time as the first axis and the sequences as the last axis of every leaf; `pad` makes such arrays from
sequences of different lengths. Many models are trained at once by `vmap` over models and observations; a model with
fewer sequences than others is given sequences of length 0.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, PyTree

from jaxfilters.hmm.emissions import Emission, check_values
from jaxfilters.hmm.model import HiddenMarkovModel, check_model
from jaxfilters.hmm.recursions import Posterior, posterior
from jaxfilters.typing import AnyKey


class Training(NamedTuple):
    """A trained model and the course of its training."""

    model: HiddenMarkovModel
    objective: Float[Array, " i"]
    """(max_iterations,): log evidence of all sequences plus log prior before each iteration; after convergence the last
    value repeats. Impossible sequences are left out. It decreases only where such a sequence becomes possible."""
    num_iterations: Int32[Array, ""]
    converged: Bool[Array, ""]
    num_impossible: Int32[Array, ""]
    """Number of sequences that were impossible under the model before the last iteration and had no influence on it."""


def pad(sequences: Sequence[PyTree], length: int | None = None) -> tuple[PyTree, Int32[Array, " n"]]:
    """Sequences of different lengths as arrays with the sequences along the last axis, padded with zeros.

    Args:
        sequences: Arrays (T_i, ...) with time first, or pytrees of them; T_i may be 0.
        length: Number T of frames of the result; `None` is the length of the longest sequence.

    Returns:
        Arrays (T, ..., n), and the lengths (n,).

    Raises:
        ValueError: If there is no sequence, or one is longer than `length`.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> padded, lengths = jf.hmm.pad([jnp.array([1, 2, 3]), jnp.array([4])])
        >>> print(padded)
        [[1 4]
         [2 0]
         [3 0]]
        >>> print(lengths)
        [3 1]
    """
    lengths = np.array([len(jax.tree.leaves(sequence)[0]) for sequence in sequences], np.int32)
    if not len(lengths) or (length is not None and length < lengths.max()):
        raise ValueError(
            f"sequences must hold at least one, none longer than length = {length}; got lengths {lengths}."
        )
    num_frames = int(lengths.max()) if length is None else length

    def stack(*leaves: Any) -> Array:
        first = np.asarray(leaves[0])
        stacked = np.zeros((num_frames, *first.shape[1:], len(leaves)), first.dtype)
        for i, leaf in enumerate(leaves):
            stacked[: len(leaf), ..., i] = leaf
        return jnp.asarray(stacked)

    return jax.tree.map(stack, *sequences), jnp.asarray(lengths)


def baum_welch(
    model: HiddenMarkovModel,
    observations: PyTree,
    lengths: Int[Array, " n"] | Int[np.ndarray, " n"] | None = None,
    mask: Bool[Array, "t n"] | Bool[np.ndarray, "t n"] | None = None,
    *,
    max_iterations: int = 30,
    tolerance: float | Float[Array, ""] = 1e-4,
    transition_pseudo_count: float | Float[Array, ""] = 0.0,
) -> Training:
    """Training by expectation-maximisation (the Baum-Welch algorithm), to a maximum a posteriori estimate.

    See L. Rabiner, "A tutorial on hidden Markov models", Proc. IEEE 77(2), 1989, section III.C. Transitions and initial
    states of probability zero keep it. `vmap` over models trains all of them in one loop.

    Args:
        model: The initial model; its emission defines the M-step.
        observations: Leaves (T, ..., n) with time first and the sequences last.
        lengths: (n,): number of frames of each sequence, from 0 to T; `None` is T for all.
        mask: (T, n): `False` for frames without an observation.
        max_iterations: Upper bound on the number of iterations, at least 1.
        tolerance: Relative increase of the objective below which the training has converged.
        transition_pseudo_count: Count added to the expected number of each allowed transition and initial state.

    Returns:
        The trained model and the objective before each iteration.

    Raises:
        ValueError: If the model has no emission, shapes do not match, a length is out of range, or an observation is
            NaN or a code out of range.
        TypeError: If codes are not integers.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> codes = jf.hmm.Codes(jnp.log(jnp.array([[0.7, 0.3], [0.4, 0.6]])), pseudo_count=0.1)
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], codes)
        >>> observations, lengths = jf.hmm.pad([jnp.array([0, 0, 0, 1, 1, 1]), jnp.array([0, 0, 1, 1])])
        >>> trained = jf.hmm.baum_welch(model, observations, lengths)
        >>> bool(trained.objective[-1] > trained.objective[0])
        True
    """
    num_frames, num_sequences = _check_training(model, observations, lengths, mask)
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1; got {max_iterations}.")
    lengths = jnp.full(num_sequences, num_frames) if lengths is None else lengths
    return _baum_welch(
        model,
        observations,
        lengths,
        mask,
        max_iterations=max_iterations,
        tolerance=tolerance,
        transition_pseudo_count=transition_pseudo_count,
    )


@partial(jax.jit, static_argnames="max_iterations")
def _baum_welch(model, observations, lengths, mask, *, max_iterations, tolerance, transition_pseudo_count) -> Training:
    observed = jnp.arange(_extent(observations)[0])[:, None] < lengths
    if mask is not None:
        observed = observed & mask
    # Padding may hold NaN.
    clean = lambda leaf: jnp.where(_along(observed, leaf), leaf, jnp.zeros_like(leaf))
    observations = jax.tree.map(clean, observations)

    def improve(state: tuple) -> tuple:
        model, objectives, i, _, num_before = state
        found = _expected(model, observations, observed, lengths)
        possible = found.log_evidence > -jnp.inf
        objective = jnp.sum(jnp.where(possible, found.log_evidence, 0.0)) + _log_prior(model, transition_pseudo_count)
        before, num_impossible = objectives[jnp.maximum(i - 1, 0)], jnp.sum(~possible, dtype=jnp.int32)
        # A sequence that has become possible lowers the objective, from which it was left out.
        comparable = (i > 0) & (num_impossible == num_before)
        converged = comparable & (objective - before <= tolerance * jnp.abs(objective))
        objectives = jnp.where(jnp.arange(max_iterations) >= i, objective, objectives)
        better = _maximized(model, found, observations, observed, transition_pseudo_count)
        return better, objectives, i + 1, converged, num_impossible

    def unfinished(state: tuple) -> Bool[Array, ""]:
        _, _, i, converged, _ = state
        return (i < max_iterations) & ~converged

    objectives = jnp.zeros(max_iterations, model.log_initial.dtype)
    zero = jnp.zeros((), jnp.int32)
    start = (model, objectives, zero, jnp.zeros((), bool), zero)
    return Training(*jax.lax.while_loop(unfinished, improve, start))


def best_of_restarts(
    key: AnyKey, model: HiddenMarkovModel, observations: PyTree, lengths: Int[Array, " n"], *, num_restarts: int
) -> Training:
    """The best of several trainings, each from the emissions of `random_responsibilities`.

    Args:
        key: Random key.
        model: The model, whose emission is replaced.
        observations: Leaves (T, ..., n).
        lengths: (n,): number of frames of each sequence.
        num_restarts: Number of trainings, which run at once.

    Raises:
        ValueError: If `num_restarts` is less than 1, or as for `baum_welch`.

    Examples:
        Two states that are far apart, from 60 frames of a switching sequence.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> y = jnp.where(jnp.arange(60) // 10 % 2 == 0, 1.0, 5.0) + 0.1 * jax.random.normal(jax.random.key(0), (60,))
        >>> observations, lengths = jf.hmm.pad([y[:, None]])
        >>> emission = jf.hmm.DiagonalGaussian(jnp.zeros((2, 1)), jnp.ones((2, 1)))
        >>> model = jf.hmm.from_topology(jf.hmm.ergodic(2), emission)
        >>> trained = jf.hmm.best_of_restarts(jax.random.key(1), model, observations, lengths, num_restarts=4)
        >>> sorted(round(float(mean)) for mean in trained.model.emission.mean.ravel())
        [1, 5]
    """
    if num_restarts < 1:
        raise ValueError(f"num_restarts must be at least 1; got {num_restarts}.")

    num_frames, _ = _check_training(model, observations, lengths, None)

    def train(key: AnyKey) -> Training:
        weights = random_responsibilities(key, lengths, num_frames, model.log_initial.shape[0])
        return baum_welch(with_responsibilities(model, observations, weights), observations, lengths)

    trained = jax.vmap(train)(jax.random.split(key, num_restarts))
    last = trained.objective[:, -1]
    best = jnp.argmax(jnp.where(jnp.isnan(last), -jnp.inf, last))
    return jax.tree.map(lambda leaf: leaf[best], trained)


def with_responsibilities(
    model: HiddenMarkovModel, observations: PyTree, responsibilities: Float[Array, "t q n"]
) -> HiddenMarkovModel:
    """The model with the emission of one M-step.

    Args:
        model: The model.
        observations: Leaves (T, ..., n).
        responsibilities: (T, Q, n): probability of each state in each frame, 0 in padding.

    Raises:
        ValueError: If the model has no emission, or shapes do not match.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> emission = jf.hmm.DiagonalGaussian(jnp.zeros((2, 1)), jnp.ones((2, 1)))
        >>> model = jf.hmm.from_topology(jf.hmm.left_right(2), emission)
        >>> observations, lengths = jf.hmm.pad([jnp.array([[1.0], [1.0], [5.0], [5.0]])])
        >>> weights = jf.hmm.uniform_segmentation(lengths, 4, 2)
        >>> print(jf.hmm.with_responsibilities(model, observations, weights).emission.mean.ravel())
        [1. 5.]
    """
    num_frames, num_sequences = _extent(observations)
    expected = (num_frames, model.log_initial.shape[0], num_sequences)
    if responsibilities.shape != expected:
        raise ValueError(f"responsibilities must be {expected}, (T, Q, n); got {responsibilities.shape}.")
    return replace(model, emission=_emission(model).m_step(observations, responsibilities))


def uniform_segmentation(lengths: Int[Array, " n"], num_frames: int, num_states: int) -> Float[Array, "t q n"]:
    """Responsibilities (T, Q, n) that divide every sequence evenly among the states, in their order.

    This is the usual initialisation of left-right models.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> weights = jf.hmm.uniform_segmentation(jnp.array([4]), 4, 2)
        >>> print(weights[..., 0])
        [[1. 0.]
         [1. 0.]
         [0. 1.]
         [0. 1.]]
    """
    frames = jnp.arange(num_frames)[:, None]
    state = jnp.minimum(frames * num_states // jnp.maximum(lengths, 1), num_states - 1)
    inside = (frames < lengths)[:, None]
    return ((state[:, None] == jnp.arange(num_states)[:, None]) & inside).astype(float)


def random_responsibilities(
    key: AnyKey, lengths: Int[Array, " n"], num_frames: int, num_states: int
) -> Float[Array, "t q n"]:
    """Responsibilities (T, Q, n) that give every state a random frame and an equal part of all frames, half each.

    This is an initialisation of ergodic models.

    Examples:
        Each of three states has the weight 1 on one frame, and 1 more divided among all six frames.

        >>> import jax, jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> weights = jf.hmm.random_responsibilities(jax.random.key(0), jnp.array([4, 2]), 4, 3)
        >>> print(np.asarray(weights).sum((0, 2)).round(2))
        [2. 2. 2.]
    """
    inside = (jnp.arange(num_frames)[:, None] < lengths).astype(float)
    flat = inside.ravel()
    seeds = jax.random.choice(key, flat.size, (num_states,), p=flat / jnp.maximum(flat.sum(), 1.0))
    single = jax.nn.one_hot(seeds, flat.size, dtype=flat.dtype) * flat
    weights = single + flat / jnp.maximum(flat.sum(), 1.0)
    return jnp.moveaxis(weights.reshape(num_states, *inside.shape), 0, 1)


def _expected(model: HiddenMarkovModel, observations: PyTree, observed: Array, lengths: Array) -> Posterior:
    log_likelihoods = jax.vmap(model.log_likelihoods, -1, -1)(observations, observed)
    return posterior(model, log_likelihoods, lengths)


def _maximized(
    model: HiddenMarkovModel, found: Posterior, observations: PyTree, observed: Array, pseudo_count: Array | float
) -> HiddenMarkovModel:
    initial = jnp.sum(found.states[0], axis=1)
    return HiddenMarkovModel(
        _frequencies(initial, model.log_initial, pseudo_count),
        _frequencies(found.transitions, model.log_transition, pseudo_count),
        _emission(model).m_step(observations, found.states * observed[:, None]),
    )


def _frequencies(counts: Array, before: Array, pseudo_count: Array | float) -> Array:
    """Log relative frequencies along the last axis; the previous ones where all counts are zero."""
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


def _check_training(model: HiddenMarkovModel, observations: PyTree, lengths: Any, mask: Any) -> tuple[int, int]:
    """The numbers of frames and sequences, after checks of shapes and, unless they are traced, values."""
    check_model(model)
    emission = _emission(model)
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(observations)]
    if not shapes or any(len(shape) < 2 for shape in shapes) or len({(s[0], s[-1]) for s in shapes}) != 1:
        raise ValueError(f"observations must be (T, ..., n) with time first and the sequences last; got {shapes}.")
    num_frames, num_sequences = shapes[0][0], shapes[0][-1]
    if lengths is not None and jnp.shape(lengths) != (num_sequences,):
        raise ValueError(
            f"lengths must be ({num_sequences},), one for each sequence along the last axis of observations; "
            f"got {jnp.shape(lengths)}."
        )
    if mask is not None and jnp.shape(mask) != (num_frames, num_sequences):
        raise ValueError(f"mask must be ({num_frames}, {num_sequences}), (T, n); got {jnp.shape(mask)}.")
    if isinstance(lengths, jax.core.Tracer) or isinstance(mask, jax.core.Tracer):
        return num_frames, num_sequences
    counts = np.full(num_sequences, num_frames) if lengths is None else np.asarray(lengths)
    if np.any(counts < 0) or np.any(counts > num_frames):
        raise ValueError(f"lengths must be from 0 to {num_frames}, the frames of observations; got {counts}.")
    inside = np.arange(num_frames)[:, None] < counts
    check_values(emission, observations, inside if mask is None else inside & np.asarray(mask))
    return num_frames, num_sequences


def _along(observed: Array, leaf: Array) -> Array:
    return observed.reshape(observed.shape[0], *[1] * (leaf.ndim - 2), observed.shape[1])


def _extent(observations: PyTree) -> tuple[int, int]:
    leaf = jax.tree.leaves(observations)[0]
    return leaf.shape[0], leaf.shape[-1]
