"""The Viterbi algorithm: the most probable sequence of states, from log-likelihoods of the states."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32

from jaxfilters.hmm.log_likelihoods import Lengths, as_column, check_shapes, inside_sequences, usable
from jaxfilters.hmm.model import HiddenMarkovModel, of_each_frame

_UNROLLED = 16
"""Largest number of states for which the Viterbi maximum is written out as operations on vectors."""


class Path(NamedTuple):
    """The most probable sequence of states, the Viterbi path."""

    states: Int32[Array, "t *batch"]
    """-1 in padding and for impossible sequences."""
    log_probability: Float[Array, "*batch"]
    """Joint log probability log p(s_1:T, y_1:T) of the path and the observations."""


@jax.jit
def viterbi(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None) -> Path:
    """The Viterbi algorithm: the most probable sequence of states, or any of several equally probable ones.

    Arguments are those of `log_evidence`.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.6, 0.4], [0.01, 0.99]]))
        >>> print(jf.hmm.viterbi(model, log_likelihoods).states)
        [0 0 1]
    """
    check_shapes(model, log_likelihoods, lengths)
    inside = inside_sequences(log_likelihoods, lengths)
    initial = as_column(model.log_initial, log_likelihoods)

    def step(best: Array, inputs: tuple) -> tuple[Array, Array]:
        frame, is_first, is_inside, log_transition = inputs
        log_transition = model.log_transition if log_transition is None else log_transition
        reached, origin = best_predecessor(best, log_transition)
        after = jnp.where(is_first, initial, reached) + usable(frame)
        return jnp.where(is_inside, after, best), origin

    def back(state: Array, inputs: tuple) -> tuple[Array, Array]:
        origin, is_inside = inputs
        earlier = jnp.take_along_axis(origin, state[None], axis=0)[0].astype(jnp.int32)
        return jnp.where(is_inside, earlier, state), state

    start = jnp.zeros((len(initial), *inside.shape[1:]), log_likelihoods.dtype)
    is_first = jnp.arange(len(log_likelihoods)) == 0
    best, origins = jax.lax.scan(
        step, start, (log_likelihoods, is_first, inside, of_each_frame(model.log_transition, after=False))
    )
    last = jnp.argmax(best, axis=0).astype(jnp.int32)
    _, states = jax.lax.scan(back, last, (origins, inside), reverse=True)
    log_probability = jnp.max(best, axis=0)
    return Path(jnp.where(inside & (log_probability > -jnp.inf), states, -1), log_probability)


def best_predecessor(
    score: Float[Array, "q *batch"], log_transition: Float[Array, "q q"]
) -> tuple[Float[Array, "q *batch"], Int[Array, "q *batch"]]:
    """The best score with which each state is reached in one transition, and its predecessor, the first of equals."""
    num_states = len(score)
    steps = log_transition.reshape(num_states, num_states, *[1] * (score.ndim - 1))
    if num_states > _UNROLLED:
        reached = score[:, None] + steps
        return jnp.max(reached, axis=0), jnp.argmax(reached, axis=0).astype(jnp.int32)
    # A running maximum over whole vectors, because a reduction that also returns the index is not vectorised.
    best = score[0] + steps[0]
    origin = jnp.zeros(best.shape, jnp.int8)
    for i in range(1, num_states):
        candidate = score[i] + steps[i]
        better = candidate > best
        best, origin = jnp.where(better, candidate, best), jnp.where(better, jnp.int8(i), origin)
    return best, origin
