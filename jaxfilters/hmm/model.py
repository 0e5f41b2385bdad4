"""A hidden Markov model: its probabilities, the transitions that it allows, and draws from it."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm.emissions import Emission
from jaxfilters.typing import AnyKey


@pytree_dataclass
class HiddenMarkovModel:
    """A chain of hidden states, and what each of them lets one observe."""

    log_initial: Float[Array, "..."]
    """(Q,): log p(s_1), of the state in the first frame."""
    log_transition: Float[Array, "..."]
    """(Q, Q): log p(s_t+1 = j | s_t = i) at [i, j]; `-inf` where there is no such transition, which training keeps."""
    emission: Emission | None = None
    """p(y | s); `None` where log-likelihoods come from elsewhere."""

    def log_likelihoods(self, observations: PyTree, mask: Bool[Array, " t"] | None = None) -> Float[Array, "t q"]:
        """Log p(y_t | s_t) of one sequence: observations whose leaves have time as their first axis.

        For n sequences along the last axis: `jax.vmap(model.log_likelihoods, -1, -1)(observations)`. Frames where
        `mask` is `False` were not seen: they say nothing of the states, and time passes all the same.
        """
        if self.emission is None:
            raise ValueError("model has no emission: pass log-likelihoods (T, Q) to the recursions instead.")
        if mask is None:
            return jax.vmap(self.emission.log_likelihood)(observations)
        # What is not seen is often NaN, and NaN times zero would poison gradients.
        seen = jax.tree.map(
            lambda leaf: jnp.where(mask.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.zeros_like(leaf)), observations
        )
        return jnp.where(mask[:, None], jax.vmap(self.emission.log_likelihood)(seen), 0.0)


def from_probabilities(initial: Any, transition: Any, emission: Emission | None = None) -> HiddenMarkovModel:
    """A model from probabilities rather than their logarithms.

    Args:
        initial: (Q,), summing to 1.
        transition: (Q, Q), every row summing to 1.
        emission: p(y | s).

    Raises:
        ValueError: If shapes do not match, or something is no probability, or a sum is not 1 to 1e-4.
    """
    initial, transition = np.asarray(initial, float), np.asarray(transition, float)
    if initial.ndim != 1 or transition.shape != (len(initial), len(initial)) or not len(initial):
        raise ValueError(
            f"initial and transition must be (Q,) and (Q, Q), Q > 0; got {initial.shape} and {transition.shape}."
        )
    for name, values in (("initial", initial[None]), ("transition", transition)):
        sums = values.sum(axis=-1)
        if not (np.all(values >= 0) and np.all(abs(sums - 1) < 1e-4)):
            raise ValueError(f"{name} must be probabilities whose rows sum to 1; got sums {sums} of {values}.")
    with np.errstate(divide="ignore"):
        logs = np.log(initial), np.log(transition)
    return HiddenMarkovModel(jnp.asarray(logs[0], dtype=float), jnp.asarray(logs[1], dtype=float), emission)


def from_topology(
    allowed: Bool[np.ndarray, "q q"], emission: Emission | None = None, *, first: Bool[np.ndarray, " q"] | None = None
) -> HiddenMarkovModel:
    """A model in which every state is left, and the chain begun, in all allowed ways with equal probability.

    Args:
        allowed: Whether there is a transition from i to j, e.g. `left_right(8)`.
        emission: p(y | s).
        first: States in which the chain may begin; `None` is all of them.

    Raises:
        ValueError: If a state cannot be left, not even for itself, or the chain cannot begin.
    """
    begins = np.ones(len(allowed), bool) if first is None else np.asarray(first, bool)
    if not np.all(np.any(allowed, axis=1)) or not np.any(begins):
        raise ValueError(f"allowed must have a transition in every row, and first a state; got {allowed}, {begins}.")
    return from_probabilities(begins / begins.sum(), allowed / np.sum(allowed, axis=1, keepdims=True), emission)


def left_right(num_states: int, *, longest_step: int = 2) -> Bool[np.ndarray, "q q"]:
    """Transitions to the same state and to those up to `longest_step` after it.

    Raises:
        ValueError: If there is no state, or `longest_step < 1`.
    """
    if num_states < 1 or longest_step < 1:
        raise ValueError(f"num_states and longest_step must be at least 1; got {num_states} and {longest_step}.")
    ahead = np.arange(num_states) - np.arange(num_states)[:, None]
    return (ahead >= 0) & (ahead <= longest_step)


def ergodic(num_states: int) -> Bool[np.ndarray, "q q"]:
    """Transitions from every state to every state.

    Raises:
        ValueError: If there is no state.
    """
    if num_states < 1:
        raise ValueError(f"num_states must be at least 1; got {num_states}.")
    return np.ones((num_states, num_states), bool)


def first_only(num_states: int) -> Bool[np.ndarray, " q"]:
    """Chains that begin in state 0: the `first` of a left-right model."""
    return np.arange(num_states) == 0


@partial(jax.jit, static_argnames="num_frames")
def sample(key: AnyKey, model: HiddenMarkovModel, num_frames: int) -> tuple[Int32[Array, " t"], PyTree]:
    """States and observations of one sequence; the observations are `None` without an emission."""
    state_key, emission_key = jax.random.split(key)

    def step(state: Array, step_key: AnyKey) -> tuple[Array, Array]:
        following = jax.random.categorical(step_key, model.log_transition[state]).astype(jnp.int32)
        return following, state

    keys = jax.random.split(state_key, num_frames + 1)
    first = jax.random.categorical(keys[0], model.log_initial).astype(jnp.int32)
    _, states = jax.lax.scan(step, first, keys[1:])
    if model.emission is None:
        return states, None
    return states, jax.vmap(model.emission.sample)(jax.random.split(emission_key, num_frames), states)
