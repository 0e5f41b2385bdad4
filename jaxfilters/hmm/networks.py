"""Compositions of several models: in parallel, in a loop, and the threshold model that a symbol has to exceed."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm.model import HiddenMarkovModel, check_model


@pytree_dataclass
class Network:
    """Several models composed in parallel: one model over the states of all of them."""

    model: HiddenMarkovModel
    """The composed model, without transitions between its parts. `log_initial` gives each part a total probability of
    1, and the rows of final states sum to 1 minus the probability of leaving the part."""
    part: Int[Array, "..."]
    """(Q,): index of the part to which each state belongs, from 0."""
    final: Bool[Array, "..."]
    """(Q,): whether a part may end in this state."""


class Segment(NamedTuple):
    """Consecutive frames that belong to one part of a network."""

    label: int
    """Index of the part."""
    start: int
    """First frame."""
    end: int
    """Last frame."""


def parallel_composition(
    models: Sequence[HiddenMarkovModel],
    final: Sequence[Bool[np.ndarray, " q"]] | None = None,
    *,
    exit_probability: float = 0.1,
) -> Network:
    """The parallel composition of models, with their emissions.

    Args:
        models: Models with any numbers of states, whose emissions are of one class with the same static options.
        final: (Q_i,) for each model: the states in which it may end; `None` is its last state.
        exit_probability: Probability of leaving a model from a final state, in (0, 1).

    Raises:
        ValueError: If there is no model, `final` does not match, a model has no final state, `exit_probability` is out
            of range, or the emissions differ in class, options or size.

    Examples:
        >>> import jaxfilters as jf
        >>> short = jf.hmm.from_probabilities([1.0], [[1.0]])
        >>> long = jf.hmm.from_topology(jf.hmm.left_right(2), initial=jf.hmm.left_right_initial(2))
        >>> network = jf.hmm.parallel_composition([short, long])
        >>> print(network.part, network.final)
        [0 1 1] [ True False  True]
    """
    if not 0 < exit_probability < 1:
        raise ValueError(f"exit_probability must be between 0 and 1; got {exit_probability!r}.")
    for model in models:
        check_model(model)
    sizes = [model.log_initial.shape[0] for model in models]
    ends = [np.arange(size) == size - 1 for size in sizes] if final is None else [np.asarray(one) for one in final]
    if not models or [len(one) for one in ends] != sizes:
        raise ValueError(f"final must have a flag for each state of models, {sizes}; got {[len(one) for one in ends]}.")
    for i, one in enumerate(ends):
        if not np.any(one):
            raise ValueError(f"final must have a state for each model; got none for model {i}.")
    kinds = {(jax.tree.structure(model), tuple(_feature_shapes(model))) for model in models}
    if len(kinds) != 1:
        raise ValueError(
            f"models must have emissions of one class with the same options and sizes; got {len(kinds)} different ones."
        )
    log_transition = jnp.full((sum(sizes), sum(sizes)), -jnp.inf, models[0].log_transition.dtype)
    for model, at in zip(models, np.cumsum([0, *sizes[:-1]]), strict=True):
        log_transition = jax.lax.dynamic_update_slice(log_transition, model.log_transition, (at, at))
    is_final = jnp.asarray(np.concatenate(ends))
    log_transition = jnp.where(is_final[:, None], log_transition + jnp.log1p(-exit_probability), log_transition)
    emission = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(model.emission for model in models))
    log_initial = jnp.concatenate([model.log_initial for model in models])
    part = np.repeat(np.arange(len(models), dtype=np.int32), sizes)
    return Network(HiddenMarkovModel(log_initial, log_transition, emission), jnp.asarray(part), is_final)


def threshold_model(network: Network) -> HiddenMarkovModel:
    """The threshold model of a network: an ergodic model of all its states with their self-transition probabilities.

    It explains any order of the symbols' states, hence better than the wrong symbol and worse than the right one
    (H.-K. Lee and J. Kim, "An HMM-based threshold model approach for gesture recognition", IEEE PAMI 21(10), 1999,
    section 4.1). Patterns that occur only between symbols need a model of their own in the network, for example of one
    state.

    Examples:
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> symbol = jf.hmm.from_probabilities([1.0], [[1.0]])
        >>> network = jf.hmm.parallel_composition([symbol, symbol], exit_probability=0.2)
        >>> print(np.exp(jf.hmm.threshold_model(network).log_transition).round(2))
        [[0.8 0.2]
         [0.2 0.8]]
    """
    num_states = network.part.shape[0]
    stays = jnp.diagonal(network.model.log_transition)
    leaves = jnp.log1p(-jnp.exp(stays)) - jnp.log(max(num_states - 1, 1))
    same = jnp.eye(num_states, dtype=bool)
    log_transition = jnp.where(same, stays[:, None], leaves[:, None])
    if num_states == 1:
        log_transition = jnp.zeros_like(log_transition)
    log_initial = jnp.full_like(network.model.log_initial, -jnp.log(num_states))
    return HiddenMarkovModel(log_initial, log_transition, network.model.emission)


def loop(network: Network, *, part_transition: Float[np.ndarray, "k k"] | None = None) -> HiddenMarkovModel:
    """One model of a stream in which the parts of a network follow each other, as in connected word recognition.

    `segments` decodes its Viterbi path.

    Args:
        network: Made by `parallel_composition`.
        part_transition: (K, K): probability that part l follows part k at [k, l], rows summing to 1; `None` is uniform.

    Raises:
        ValueError: If `part_transition` has another shape, or its rows do not sum to 1.

    Examples:
        Each symbol is left with the probability 0.2, for itself or the other one.

        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> symbol = jf.hmm.from_probabilities([1.0], [[1.0]])
        >>> network = jf.hmm.parallel_composition([symbol, symbol], exit_probability=0.2)
        >>> print(np.exp(jf.hmm.loop(network).log_transition).round(2))
        [[0.9 0.1]
         [0.1 0.9]]
    """
    num_models = int(np.asarray(network.part).max()) + 1
    uniform = np.full((num_models, num_models), 1 / num_models)
    follows = uniform if part_transition is None else np.asarray(part_transition)
    if follows.shape != (num_models, num_models):
        raise ValueError(
            f"part_transition must be ({num_models}, {num_models}), one row for each part; got {follows.shape}."
        )
    if not (np.all(follows >= 0) and np.all(abs(follows.sum(axis=1) - 1) < 1e-4)):
        raise ValueError(
            f"part_transition must be probabilities whose rows (axis 1) sum to 1; got sums {follows.sum(axis=1)}."
        )
    inside, initial = jnp.exp(network.model.log_transition), jnp.exp(network.model.log_initial)
    entering = jnp.asarray(follows, inside.dtype)[network.part][:, network.part] * initial
    leaving = jnp.where(network.final, 1 - jnp.sum(inside, axis=1), 0.0)
    transition = inside + leaving[:, None] * entering
    return HiddenMarkovModel(jnp.log(initial / num_models), jnp.log(transition), network.model.emission)


def segments(states: Int[np.ndarray, " t"], network: Network) -> list[Segment]:
    """The segments of a path through a network: consecutive frames in one part.

    A part that follows itself makes two segments, separated by a transition from a final to an initial state.

    Args:
        states: (T,): states of the network; frames with the state -1 belong to no segment.
        network: The network.

    Raises:
        ValueError: If a state is out of range.

    Examples:
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> symbol = jf.hmm.from_probabilities([1.0], [[1.0]])
        >>> network = jf.hmm.parallel_composition([symbol, symbol])
        >>> states = np.array([0, 0, 1, -1])
        >>> [(found.label, found.start, found.end) for found in jf.hmm.segments(states, network)]
        [(0, 0, 1), (1, 2, 2)]
    """
    part, final = np.asarray(network.part), np.asarray(network.final)
    if np.any(np.asarray(states) < -1) or np.any(np.asarray(states) >= len(part)):
        raise ValueError(f"states must be from -1 to {len(part) - 1}; got {np.min(states)} to {np.max(states)}.")
    starts = np.exp(np.asarray(network.model.log_initial)) > 0
    inside = np.asarray(network.model.log_transition) > -np.inf
    found: list[Segment] = []
    for frame, state in enumerate(np.asarray(states)):
        if state < 0:
            continue
        before = states[frame - 1] if frame else -1
        restarts = before >= 0 and final[before] and starts[state] and not inside[before, state]
        if before >= 0 and part[before] == part[state] and not restarts:
            found[-1] = found[-1]._replace(end=frame)
        else:
            found.append(Segment(int(part[state]), frame, frame))
    return found


def _feature_shapes(model: HiddenMarkovModel) -> list[tuple[int, ...]]:
    return [jnp.shape(leaf)[1:] for leaf in jax.tree.leaves(model.emission)]
