"""The exact filter of a hidden Markov model as a `Filter`: one observation at a time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters.filter import Filter
from jaxfilters.hmm.model import HiddenMarkovModel, check_model
from jaxfilters.typing import AnyKey


class ChainState(NamedTuple):
    """The distribution of the hidden state given the observations so far."""

    log_probabilities: Float[Array, " q"]
    """(Q,): normalised, so that their `logsumexp` is 0."""
    started: Bool[Array, ""]
    """Whether a prediction was made: the first one keeps the initial distribution."""


class ChainInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1); `-inf` if the observation is impossible, and the distribution then stays as it is."""
    most_probable: Int32[Array, ""]
    """The state of greatest probability given the observations so far."""


def online(model: HiddenMarkovModel) -> Filter:
    """The exact filter of the hidden state, for `jaxfilters.run`.

    Args:
        model: The model. Observations are those of `model.emission`; without one, log-likelihoods (Q,). Transitions
            that are a function of the inputs get those of `jf.run`; those of the first frame are not used.

    Raises:
        ValueError: If `log_initial` and `log_transition` are not (Q,) and (Q, Q).

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> state, (states, infos) = jf.run(jf.hmm.online(model), jax.random.key(0), jnp.zeros((5, 2)))
        >>> states.log_probabilities.shape
        (5, 2)
    """
    if not callable(model.log_transition):
        check_model(model)
    return Filter(model, _init, _predict, _update)


def _init(model: HiddenMarkovModel, key: AnyKey) -> ChainState:
    del key
    return ChainState(model.log_initial, jnp.zeros((), bool))


def _predict(model: HiddenMarkovModel, key: AnyKey, state: ChainState, inputs: PyTree) -> ChainState:
    del key
    arriving = state.log_probabilities[:, None] + model.transition_of(inputs)
    _, ahead = jax.vmap(weights.normalize, in_axes=1)(arriving)
    return ChainState(jnp.where(state.started, ahead, state.log_probabilities), jnp.ones((), bool))


def _update(
    model: HiddenMarkovModel, key: AnyKey, state: ChainState, observation: PyTree, inputs: PyTree
) -> tuple[ChainState, ChainInfo]:
    del key, inputs
    log_likelihood = observation if model.emission is None else model.emission.log_likelihood(observation)
    if jnp.shape(log_likelihood) != model.log_initial.shape:
        name = "observation, without an emission," if model.emission is None else "emission.log_likelihood"
        expected = model.log_initial.shape
        raise ValueError(f"{name} must be log-likelihoods {expected}, (Q,); got {jnp.shape(log_likelihood)}.")
    after, log_evidence = weights.normalize(state.log_probabilities + log_likelihood)
    after = jnp.where(log_evidence > -jnp.inf, after, state.log_probabilities)
    return state._replace(log_probabilities=after), ChainInfo(log_evidence, jnp.argmax(after).astype(jnp.int32))
