r"""Hidden semi-Markov models: states whose durations have any distribution, from log-likelihoods of the states.

A segment is a run of frames in one state. A state draws its duration when it is entered, and the chain moves on when
that is over: the explicit-duration model of S.-Z. Yu, "Hidden semi-Markov models", Artificial Intelligence 174(2),
2010, section 3. The recursions carry the state and the frames $d$ since it was entered, so that each frame costs
$O(QD + Q^2)$: with $e_t(j) = \log p(y_t \mid s_t = j)$ and $h_j(d)$ the probability that a segment of state $j$ that
has lasted $d$ frames ends there,

$$\alpha_t(j, d + 1) = \alpha_{t-1}(j, d)\,(1 - h_j(d))\, e^{e_t(j)}, \qquad
\alpha_t(j, 1) = \sum_i A_{ij} \sum_d h_i(d)\,\alpha_{t-1}(i, d)\, e^{e_t(j)}.$$

The first segment begins in the first frame; the last one may go on beyond the last frame (it is censored on the right).
Log-likelihoods are (T, Q), of `model.log_likelihoods` or any other source, such as a classifier of frames; NaN counts
as `-inf`, and a frame without an observation is a row of zeros. For n sequences of one length use `jax.vmap`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm.emissions import Emission
from jaxfilters.hmm.log_likelihoods import usable
from jaxfilters.hmm.model import HiddenMarkovModel, from_probabilities


@pytree_dataclass
class SemiMarkovModel:
    """A chain of Q states with explicit durations of up to D frames; probabilities are logarithms.

    Examples:
        A segment of one frame in a half of all cases, else of two or three frames with equal probability.

        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.semi_markov([1.0], [[1.0]], [[0.5, 0.25, 0.25]])
        >>> print(np.exp(model.log_end).round(2))
        [[0.5 0.5 1. ]]
    """

    log_initial: Float[Array, "..."]
    """(Q,): log p(s_1), for the state of the first segment."""
    log_transition: Float[Array, "..."]
    """(Q, Q): log probability that a segment of state j follows one of state i at [i, j]."""
    log_end: Float[Array, "..."]
    """(Q, D): log probability that a segment that has lasted d frames ends there, at [j, d - 1]."""
    log_stay: Float[Array, "..."]
    """(Q, D): log of its complement; in the last column that of one more frame in a segment of D frames or more."""
    emission: Emission | None = None
    """p(y | s); `None` if log-likelihoods (T, Q) come from another source."""

    def log_likelihoods(self, observations: PyTree, mask: Bool[Array, " t"] | None = None) -> Float[Array, "t q"]:
        """Log p(y_t | s_t) of every frame and state, as of `HiddenMarkovModel.log_likelihoods`."""
        return HiddenMarkovModel(self.log_initial, self.log_transition, self.emission).log_likelihoods(
            observations, mask
        )


class SemiMarkovPath(NamedTuple):
    """The most probable sequence of segments."""

    states: Int32[Array, " t"]
    """-1 for an impossible sequence."""
    starts: Bool[Array, " t"]
    """Whether a segment begins in the frame."""
    log_probability: Float[Array, ""]
    """Joint log probability of the segments and the observations."""


def semi_markov(
    initial: Any, transition: Any, durations: Any, emission: Emission | None = None, *, tail: Any = 0.0
) -> SemiMarkovModel:
    """A hidden semi-Markov model from probabilities.

    Args:
        initial: (Q,): probability of the state of the first segment, summing to 1.
        transition: (Q, Q): probability that state j follows state i at [i, j]; every row sums to 1. A state that may
            follow itself makes two segments.
        durations: (Q, D): probability that a segment of a state lasts d frames at [state, d - 1]; every row sums to 1.
        emission: p(y | s) of the Q states.
        tail: Probability, below 1, that a segment that has lasted D frames goes on for one more, and again: a
            geometric tail, one number or (Q,).

    Raises:
        ValueError: If shapes do not match, a number is not a probability, or a sum differs from 1 by more than 1e-4.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> durations = [[0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]  # three frames; one or two
        >>> model = jf.hmm.semi_markov([0.5, 0.5], [[0.0, 1.0], [1.0, 0.0]], durations)
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.4, 0.6], [0.9, 0.1], [0.1, 0.9], [0.6, 0.4]]))
        >>> print(jf.hmm.semi_markov_viterbi(model, log_likelihoods).states)
        [0 0 0 1 0]
    """
    chain = from_probabilities(initial, transition, emission)
    num_states = chain.log_initial.shape[0]
    if np.ndim(chain.log_transition) != 2:
        raise ValueError(f"transition must be (Q, Q); got {np.shape(transition)}.")
    lasting = np.asarray(durations, float)
    if lasting.ndim != 2 or lasting.shape[0] != num_states or not lasting.shape[1]:
        raise ValueError(f"durations must be ({num_states}, D), one row for each state; got {lasting.shape}.")
    sums = lasting.sum(axis=1)
    if not (np.all(lasting >= 0) and np.all(abs(sums - 1) < 1e-4)):
        raise ValueError(f"durations must be probabilities whose rows (axis 1) sum to 1; got sums {sums}.")
    going_on = np.asarray(tail, float)
    if going_on.shape not in ((), (num_states,)) or not np.all((going_on >= 0) & (going_on < 1)):
        raise ValueError(f"tail must be one probability below 1, or ({num_states},) of them; got {going_on}.")
    if lasting.shape[1] == 1:
        # One frame and a tail are one frame, or two and a tail: every column but the last has one age.
        longer = np.broadcast_to(going_on, num_states)
        lasting = np.stack([1 - longer, longer], axis=1)
    # Sums from the end keep the digits of small survival probabilities.
    surviving = np.cumsum(lasting[:, ::-1], axis=1)[:, ::-1]
    ends = np.divide(lasting, surviving, out=np.ones_like(lasting), where=surviving > 0)
    ends[:, -1] = 1 - going_on
    after = np.append(surviving[:, 1:], np.zeros((num_states, 1)), axis=1)
    stays = np.divide(after, surviving, out=np.zeros_like(lasting), where=surviving > 0)
    stays[:, -1] = going_on
    with np.errstate(divide="ignore"):
        log_end, log_stay = (jnp.asarray(np.log(values), dtype=float) for values in (ends, stays))
    return SemiMarkovModel(chain.log_initial, chain.log_transition, log_end, log_stay, emission)


@jax.jit
def semi_markov_log_evidence(model: SemiMarkovModel, log_likelihoods: Float[Array, "t q"]) -> Float[Array, ""]:
    """The marginal log-likelihood log p(y_1:T), over all segmentations.

    Its derivative with respect to `log_likelihoods` is the posterior of the states, with respect to `log_transition`
    the expected numbers of transitions.

    Args:
        model: The model.
        log_likelihoods: (T, Q): log p(y_t | s_t) of every state.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        Where all states explain a frame equally well, segments do not matter: 0.5 ** 4.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.semi_markov([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]])
        >>> total = jf.hmm.semi_markov_log_evidence(model, jnp.log(jnp.full((4, 2), 0.5)))
        >>> round(float(jnp.exp(total)), 4)
        0.0625
    """
    check_frames(model, log_likelihoods)

    def step(alive: Array, inputs: tuple[Array, Array]) -> tuple[Array, None]:
        frame, is_first = inputs
        return jnp.where(is_first, started(model), advanced(model, alive, log_sum)[0]) + frame[:, None], None

    is_first = jnp.arange(len(log_likelihoods)) == 0
    alive, _ = jax.lax.scan(step, jnp.zeros_like(model.log_end), (usable(log_likelihoods), is_first))
    return log_sum(alive, (0, 1))


def semi_markov_posterior(model: SemiMarkovModel, log_likelihoods: Float[Array, "t q"]) -> Float[Array, "t q"]:
    """The smoothing distributions p(s_t | y_1:T) of all frames; zero for an impossible sequence.

    Arguments and errors are those of `semi_markov_log_evidence`, whose derivative this is (the identity of L. Baum).

    Examples:
        State 0 lasts two frames; state 1 one frame or two, with equal probability.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.semi_markov([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]])
        >>> print(np.asarray(jf.hmm.semi_markov_posterior(model, jnp.zeros((4, 2)))).round(2))
        [[1.  0. ]
         [1.  0. ]
         [0.  1. ]
         [0.5 0.5]]
    """
    found: Array = jax.grad(semi_markov_log_evidence, argnums=1)(model, log_likelihoods)
    return found


@jax.jit
def semi_markov_viterbi(model: SemiMarkovModel, log_likelihoods: Float[Array, "t q"]) -> SemiMarkovPath:
    """The most probable sequence of segments, or any of several equally probable ones.

    Arguments and errors are those of `semi_markov_log_evidence`.

    Examples:
        State 0 lasts two frames; state 1 one frame or two.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.semi_markov([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.9, 0.1], [0.1, 0.9], [0.8, 0.2]]))
        >>> print(jf.hmm.semi_markov_viterbi(model, log_likelihoods).starts)
        [ True False  True  True]
    """
    check_frames(model, log_likelihoods)
    last_age = model.log_end.shape[1] - 1
    is_first = jnp.arange(len(log_likelihoods)) == 0

    def step(alive: Array, inputs: tuple[Array, Array]) -> tuple[Array, tuple]:
        frame, is_first = inputs
        following, origin = advanced(model, alive, jnp.max)
        age_at_end = jnp.argmax(alive + model.log_end, axis=1)
        is_tail = alive[:, -1] + model.log_stay[:, -1] > alive[:, -2] + model.log_stay[:, -2]
        pointers = (origin, age_at_end, is_tail)
        return jnp.where(is_first, started(model), following) + frame[:, None], pointers

    def back(carry: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        state, age = carry
        (origin, age_at_end, is_tail), is_first = inputs
        enters = age == 0
        before = origin[state]
        earlier = jnp.where(enters, before, state)
        waits = (age == last_age) & is_tail[state]
        age_before = jnp.where(enters, age_at_end[before], jnp.where(waits, age, age - 1))
        return (earlier, age_before.astype(jnp.int32)), (state, enters | is_first)

    alive, pointers = jax.lax.scan(step, jnp.zeros_like(model.log_end), (usable(log_likelihoods), is_first))
    best = jnp.unravel_index(jnp.argmax(alive), alive.shape)
    state, age = (index.astype(jnp.int32) for index in best)
    _, (states, starts) = jax.lax.scan(back, (state, age), (pointers, is_first), reverse=True)
    top = jnp.max(alive)
    possible = top > -jnp.inf
    return SemiMarkovPath(jnp.where(possible, states, -1), starts & possible, top)


def check_frames(model: SemiMarkovModel, log_likelihoods: Array, *, one: bool = False) -> None:
    """Reject shapes that do not match, at trace time; `one` frame has no time axis."""
    num_states = jnp.shape(model.log_initial)
    shapes = [jnp.shape(leaf) for leaf in (model.log_transition, model.log_end, model.log_stay)]
    if (
        len(num_states) != 1
        or shapes[0] != num_states * 2
        or shapes[1] != shapes[2]
        or (shapes[1][:1] != num_states or shapes[1][1] < 2)
    ):
        raise ValueError(
            "log_initial, log_transition, log_end and log_stay must be (Q,), (Q, Q), (Q, D) and (Q, D), D > 1; "
            f"got {[num_states, *shapes]}."
        )
    shape = jnp.shape(log_likelihoods)
    if len(shape) != 2 - one or shape[-1] != num_states[0]:
        expected = "(Q,)" if one else "(T, Q)"
        raise ValueError(
            f"log_likelihoods must be {expected} with the {num_states[0]} states of the model; got {shape}."
        )


def started(model: SemiMarkovModel) -> Float[Array, "q d"]:
    """Log scores of states and ages in the first frame, before its observation."""
    ages = jnp.arange(model.log_end.shape[1])
    return jnp.where(ages == 0, model.log_initial[:, None], -jnp.inf)


def advanced(
    model: SemiMarkovModel, alive: Float[Array, "q d"], reduced: Callable
) -> tuple[Float[Array, "q d"], Int32[Array, " q"]]:
    """Log scores of states and ages one frame later, and from which state each is entered best.

    Args:
        model: The model.
        alive: Log scores of states that have lasted 1 to D frames; the last ones D or more.
        reduced: `log_sum` or `jnp.max`, of scores along an axis.
    """
    ended = reduced(alive + model.log_end, axis=1)
    steps = ended[:, None] + model.log_transition
    staying = alive + model.log_stay
    entering = reduced(steps, axis=0)
    last = reduced(staying[:, -2:], axis=1)
    following = jnp.concatenate([entering[:, None], staying[:, :-2], last[:, None]], axis=1)
    return following, jnp.argmax(steps, axis=0).astype(jnp.int32)


def log_sum(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Log of a sum of exponentials, whose derivatives are finite where nothing is possible."""
    top = jax.lax.stop_gradient(jnp.max(values, axis=axis, keepdims=True))
    top = jnp.where(top > -jnp.inf, top, 0.0)
    total = jnp.sum(jnp.exp(values - top), axis=axis)
    possible = total > 0
    return jnp.where(possible, jnp.log(jnp.where(possible, total, 1.0)) + jnp.squeeze(top, axis), -jnp.inf)
