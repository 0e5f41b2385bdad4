"""The chain as a `Filter`: one observation at a time, as they come."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters.filter import Filter
from jaxfilters.hmm.model import HiddenMarkovModel
from jaxfilters.typing import AnyKey


class ChainState(NamedTuple):
    """What is known of the state."""

    log_probabilities: Float[Array, " q"]
    """`logsumexp` is 0."""
    started: Bool[Array, ""]
    """Whether a frame has been predicted: the first one finds the chain where it begins."""


class ChainInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1); `-inf` if the observation is impossible, which then changes nothing."""
    most_probable: Int32[Array, ""]
    """State, given the observations so far."""


def online(model: HiddenMarkovModel) -> Filter:
    """Exact filter of the hidden state.

    Observations are those of `model.emission`; without one, the log-likelihoods (Q,) of the states themselves.
    """
    return Filter(model, _init, _predict, _update)


def _init(model: HiddenMarkovModel, key: AnyKey) -> ChainState:
    del key
    return ChainState(model.log_initial, jnp.zeros((), bool))


def _predict(model: HiddenMarkovModel, key: AnyKey, state: ChainState, control: PyTree) -> ChainState:
    del key, control
    arriving = state.log_probabilities[:, None] + model.log_transition
    _, ahead = jax.vmap(weights.normalize, in_axes=1)(arriving)
    return ChainState(jnp.where(state.started, ahead, state.log_probabilities), jnp.ones((), bool))


def _update(
    model: HiddenMarkovModel, key: AnyKey, state: ChainState, observation: PyTree
) -> tuple[ChainState, ChainInfo]:
    del key
    seen = observation if model.emission is None else model.emission.log_likelihood(observation)
    after, log_evidence = weights.normalize(state.log_probabilities + seen)
    after = jnp.where(log_evidence > -jnp.inf, after, state.log_probabilities)
    return state._replace(log_probabilities=after), ChainInfo(log_evidence, jnp.argmax(after).astype(jnp.int32))
