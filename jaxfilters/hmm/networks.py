"""Several models as one: side by side, in a loop, and the ergodic threshold that a symbol has to beat."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm.model import HiddenMarkovModel


@pytree_dataclass
class Network:
    """The states of several models in one row."""

    model: HiddenMarkovModel
    """Without transitions between the models. `log_initial` starts each of them with the probability 1, and what the
    rows of final states lack of 1 is the probability of leaving the model."""
    owner: Int[Array, "..."]
    """(Q,): which model each state belongs to, from 0."""
    final: Bool[Array, "..."]
    """(Q,): whether a model may end in this state."""


class Segment(NamedTuple):
    """A run of frames in which one model was at work."""

    label: int
    start: int
    """First frame."""
    end: int
    """Last frame."""


def side_by_side(
    models: Sequence[HiddenMarkovModel],
    final: Sequence[Bool[np.ndarray, " q"]] | None = None,
    *,
    leaving: float = 0.1,
) -> Network:
    """The models in one row, with their emissions.

    Args:
        models: Of any numbers of states; their emissions are of one kind with the same settings.
        final: States in which each model may end; `None` is the last state of each.
        leaving: Probability with which a model in a final state ends, in (0, 1).

    Raises:
        ValueError: If there is no model, `final` does not fit, `leaving` is no such probability, or the emissions are
            not of one kind.
    """
    if not 0 < leaving < 1:
        raise ValueError(f"leaving must be a probability between 0 and 1; got {leaving!r}.")
    sizes = [model.log_initial.shape[0] for model in models]
    ends = [np.arange(size) == size - 1 for size in sizes] if final is None else [np.asarray(one) for one in final]
    if not models or [len(one) for one in ends] != sizes:
        raise ValueError(f"final must have a flag for each state of models, {sizes}; got {[len(one) for one in ends]}.")
    if len({jax.tree.structure(model) for model in models}) != 1:
        raise ValueError("models must have emissions of one kind with the same settings.")
    log_transition = jnp.full((sum(sizes), sum(sizes)), -jnp.inf, models[0].log_transition.dtype)
    for model, at in zip(models, np.cumsum([0, *sizes[:-1]]), strict=True):
        log_transition = jax.lax.dynamic_update_slice(log_transition, model.log_transition, (at, at))
    ended = jnp.asarray(np.concatenate(ends))
    log_transition = jnp.where(ended[:, None], log_transition + jnp.log1p(-leaving), log_transition)
    emission = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(model.emission for model in models))
    log_initial = jnp.concatenate([model.log_initial for model in models])
    owner = np.repeat(np.arange(len(models), dtype=np.int32), sizes)
    return Network(HiddenMarkovModel(log_initial, log_transition, emission), jnp.asarray(owner), ended)


def threshold(network: Network) -> HiddenMarkovModel:
    """The model that a symbol has to beat: all states, each kept as long as in its symbol, then any other one.

    It can produce whatever the symbols are made of, in any order, hence better than the wrong symbol and worse than
    the right one (H.-K. Lee and J. Kim, "An HMM-based threshold model approach for gesture recognition", IEEE PAMI
    21(10), 1999, section 4.1). What occurs only between symbols needs a model of its own in the network, e.g. of one
    state.
    """
    num_states = network.owner.shape[0]
    stays = jnp.diagonal(network.model.log_transition)
    leaves = jnp.log1p(-jnp.exp(stays)) - jnp.log(max(num_states - 1, 1))
    same = jnp.eye(num_states, dtype=bool)
    log_transition = jnp.where(same, stays[:, None], leaves[:, None])
    if num_states == 1:
        log_transition = jnp.zeros_like(log_transition)
    log_initial = jnp.full_like(network.model.log_initial, -jnp.log(num_states))
    return HiddenMarkovModel(log_initial, log_transition, network.model.emission)


def loop(network: Network, *, between: Float[np.ndarray, "k k"] | None = None) -> HiddenMarkovModel:
    """One model of a stream in which models follow each other; its Viterbi path, cut by `segments`, says which.

    Args:
        network: Made by `side_by_side`.
        between: Probability that model l follows model k, at [k, l], rows summing to 1; `None` is even.

    Raises:
        ValueError: If `between` has another shape.
    """
    num_models = int(np.asarray(network.owner).max()) + 1
    follows = np.full((num_models, num_models), 1 / num_models) if between is None else np.asarray(between)
    if follows.shape != (num_models, num_models):
        raise ValueError(f"between must be ({num_models}, {num_models}), one row a model; got {follows.shape}.")
    inside, initial = jnp.exp(network.model.log_transition), jnp.exp(network.model.log_initial)
    entering = jnp.asarray(follows, inside.dtype)[network.owner][:, network.owner] * initial
    leaving = jnp.where(network.final, 1 - jnp.sum(inside, axis=1), 0.0)
    transition = inside + leaving[:, None] * entering
    return HiddenMarkovModel(jnp.log(initial / num_models), jnp.log(transition), network.model.emission)


def segments(states: Int[np.ndarray, " t"], network: Network) -> list[Segment]:
    """Runs of frames with one owner along a path through the network; frames with the state -1 belong to none.

    A model that follows itself makes two segments: its state steps back from a final one.
    """
    owner, final = np.asarray(network.owner), np.asarray(network.final)
    starts = np.exp(np.asarray(network.model.log_initial)) > 0
    inside = np.asarray(network.model.log_transition) > -np.inf
    found: list[Segment] = []
    for frame, state in enumerate(np.asarray(states)):
        if state < 0:
            continue
        before = states[frame - 1] if frame else -1
        again = before >= 0 and final[before] and starts[state] and not inside[before, state]
        if before >= 0 and owner[before] == owner[state] and not again:
            found[-1] = found[-1]._replace(end=frame)
        else:
            found.append(Segment(int(owner[state]), frame, frame))
    return found
