"""Hidden semi-Markov models one frame at a time: the exact filter, and a spotter that reports segments."""

from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.hmm.durations import SemiMarkovModel, advanced, check_frames, log_sum, started
from jaxfilters.hmm.spotting import Candidate
from jaxfilters.typing import AnyKey


class SemiMarkovState(NamedTuple):
    """The distribution of the state and of how long it has lasted, given the observations so far."""

    log_probabilities: Float[Array, "q d"]
    """(Q, D): of each state after 1 to D frames, or more in the last column; their `logsumexp` is 0."""
    started: Bool[Array, ""]
    """Whether a prediction was made."""


class SemiMarkovInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1); `-inf` if the observation is impossible, which is then ignored."""
    states: Float[Array, " q"]
    """(Q,): p(s_t | y_1:t)."""


class SemiMarkovSpotterState(NamedTuple):
    """The best segmentations that end in each state and age."""

    scores: Float[Array, "q d"]
    """(Q, D): log scores; the largest is 0 after an update."""
    gains: Float[Array, "q d"]
    """(Q, D): log ratio of the current segment's frames to the background's."""
    starts: Int32[Array, "q d"]
    """(Q, D): first frame of the current segment."""
    finished: Candidate
    """Leaves (Q, D, patience): the last segments before it that are not background, the latest one first."""
    frame: Int32[Array, ""]
    """The last predicted frame; -1 at the start."""
    reported_end: Int32[Array, ""]
    """Last frame of the last reported segment; -1 is none."""


class SemiMarkovSpotterInfo(NamedTuple):
    """Diagnostics of one frame."""

    log_evidence: Float[Array, ""]
    """Increase of the best log score; `-inf` for an impossible frame, which is then ignored."""
    reports: Bool[Array, ""]
    """Whether a segment is reported in this frame."""
    found: Candidate
    """The reported segment; its score is the log ratio of its frames to the background, in nats."""
    current: Int32[Array, ""]
    """State of the best segmentation in this frame."""


@pytree_dataclass
class SemiMarkovSpotter:
    """Parameters of a spotter."""

    model: SemiMarkovModel
    background: Int32[Array, "..."]
    patience: int = field(metadata={"static": True})
    margin: Float[Array, "..."]


def semi_markov_online(model: SemiMarkovModel) -> Filter:
    """The exact filter of a hidden semi-Markov model, for `jaxfilters.run`.

    Args:
        model: The model. Observations are those of its emission; without one, log-likelihoods (Q,).

    Raises:
        ValueError: If the shapes of the model do not match.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.semi_markov([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]])
        >>> _, (_, infos) = jf.run(jf.hmm.semi_markov_online(model), jax.random.key(0), jnp.zeros((4, 2)))
        >>> print(infos.states.round(2))
        [[1.  0. ]
         [1.  0. ]
         [0.  1. ]
         [0.5 0.5]]
    """
    check_frames(model, model.log_initial, one=True)
    return Filter(model, _init, _predict, _update)


def semi_markov_spotter(model: SemiMarkovModel, background: int, *, patience: int = 3, margin: float = 0.0) -> Filter:
    """A filter that reports the segments of a stream, other than background, as they become certain enough.

    It is the Viterbi recursion, one frame at a time: a segment is reported once the best segmentation of the frames so
    far ended it `patience` frames ago. What is reported is never taken back, and the next segment reported starts
    later. One frame reports one segment, the earliest.

    Args:
        model: The model. Observations are those of its emission; without one, log-likelihoods (Q,).
        background: State of what lies between the segments.
        patience: Frames between the last one of a segment and its report, at least 1: the latency.
        margin: Nats by which the frames of a segment must be more likely than under the background, to be reported.

    Raises:
        ValueError: If the shapes of the model do not match, `background` is none of its states, or `patience` is less
            than 1.

    Examples:
        State 0 is background, of any length; segments of state 1 last two frames.

        >>> import jaxfilters as jf
        >>> durations = [[0.5, 0.5], [0.0, 1.0]]
        >>> model = jf.hmm.semi_markov([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]], durations, tail=[0.5, 0.0])
        >>> filter = jf.hmm.semi_markov_spotter(model, background=0, patience=2)
        >>> int(filter.params.background), int(filter.params.patience)
        (0, 2)
    """
    check_frames(model, model.log_initial, one=True)
    num_states = model.log_initial.shape[0]
    if not 0 <= background < num_states:
        raise ValueError(f"background must be a state of the model, from 0 to {num_states - 1}; got {background}.")
    if patience < 1:
        raise ValueError(f"patience must be at least 1; got {patience}.")
    least_gain = jnp.asarray(margin, model.log_initial.dtype)
    params = SemiMarkovSpotter(model, jnp.asarray(background, jnp.int32), int(patience), least_gain)
    return Filter(params, _init_spotter, _predict_spotter, _update_spotter)


def _scores_of(model: SemiMarkovModel, observation: PyTree) -> Array:
    scores: Array = observation if model.emission is None else model.emission.log_likelihood(observation)
    check_frames(model, scores, one=True)
    return jnp.where(jnp.isnan(scores), -jnp.inf, scores)


def _init(model: SemiMarkovModel, key: AnyKey) -> SemiMarkovState:
    del key
    return SemiMarkovState(started(model), jnp.zeros((), bool))


def _predict(model: SemiMarkovModel, key: AnyKey, state: SemiMarkovState, inputs: PyTree) -> SemiMarkovState:
    del key, inputs
    following, _ = advanced(model, state.log_probabilities, log_sum)
    return SemiMarkovState(jnp.where(state.started, following, state.log_probabilities), jnp.ones((), bool))


def _update(
    model: SemiMarkovModel, key: AnyKey, state: SemiMarkovState, observation: PyTree, inputs: PyTree
) -> tuple[SemiMarkovState, SemiMarkovInfo]:
    del key, inputs
    scores = state.log_probabilities + _scores_of(model, observation)[:, None]
    log_evidence = log_sum(scores, (0, 1))
    possible = log_evidence > -jnp.inf
    after = jnp.where(possible, scores - jnp.where(possible, log_evidence, 0.0), state.log_probabilities)
    return state._replace(log_probabilities=after), SemiMarkovInfo(log_evidence, jnp.sum(jnp.exp(after), axis=1))


def _init_spotter(spotter: SemiMarkovSpotter, key: AnyKey) -> SemiMarkovSpotterState:
    del key
    scores = started(spotter.model)
    zeros, outside = jnp.zeros_like(scores), jnp.full((), -1, jnp.int32)
    kept = (*scores.shape, spotter.patience)
    none = jnp.full(kept, -1, jnp.int32)
    finished = Candidate(none, none, none, jnp.zeros(kept, scores.dtype))
    return SemiMarkovSpotterState(scores, zeros, zeros.astype(jnp.int32), finished, outside, outside)


def _predict_spotter(
    spotter: SemiMarkovSpotter, key: AnyKey, state: SemiMarkovSpotterState, inputs: PyTree
) -> SemiMarkovSpotterState:
    del key, inputs
    model, frame = spotter.model, state.frame + 1
    following, origin = advanced(model, state.scores, jnp.max)
    ages = jnp.argmax(state.scores + model.log_end, axis=1)
    at = (origin, ages[origin])
    done = Candidate(origin, state.starts[at], jnp.broadcast_to(state.frame, origin.shape), state.gains[at])

    def entered(own: Array, before: Array) -> Array:
        # What follows a segment adds it to those before; what follows background has those before.
        added = jnp.concatenate([own[:, None], before[at][:, :-1]], axis=1)
        return jnp.where((origin == spotter.background)[:, None], before[at], added)

    stays = state.scores[:, -2:] + model.log_stay[:, -2:]
    longest = jnp.where(stays[:, 1] > stays[:, 0], -1, -2)

    def moved(leaf: Array, first: Array) -> Array:
        last = leaf[jnp.arange(leaf.shape[0]), longest % leaf.shape[1]][:, None]
        return jnp.concatenate([first[:, None], leaf[:, :-2], last], axis=1)

    after = SemiMarkovSpotterState(
        following,
        moved(state.gains, jnp.zeros_like(state.gains[:, 0])),
        moved(state.starts, jnp.broadcast_to(frame, origin.shape)),
        jax.tree.map(moved, state.finished, jax.tree.map(entered, done, state.finished)),
        frame,
        state.reported_end,
    )
    first = state._replace(frame=frame)
    return jax.tree.map(lambda a, b: jnp.where(frame == 0, a, b), first, after)


def _update_spotter(
    spotter: SemiMarkovSpotter, key: AnyKey, state: SemiMarkovSpotterState, observation: PyTree, inputs: PyTree
) -> tuple[SemiMarkovSpotterState, SemiMarkovSpotterInfo]:
    del key, inputs
    frame_scores = _scores_of(spotter.model, observation)
    total = state.scores + frame_scores[:, None]
    growth = jnp.max(total)
    possible = growth > -jnp.inf
    least = jnp.finfo(total.dtype).min / 1e4
    finite = jnp.maximum(frame_scores, least)
    gained = jnp.where(possible, finite - finite[spotter.background], 0.0)
    state = state._replace(
        scores=jnp.where(possible, total - jnp.where(possible, growth, 0.0), state.scores),
        gains=state.gains + gained[:, None],
    )
    best = jnp.unravel_index(jnp.argmax(state.scores), state.scores.shape)
    finished = jax.tree.map(lambda leaf: leaf[best], state.finished)
    due = (
        (finished.label >= 0)
        & (finished.start > state.reported_end)
        & (state.frame - finished.end >= spotter.patience)
        & (finished.score >= spotter.margin)
    )
    reports = jnp.any(due)
    # The earliest one that is due; where none is, the latest one.
    chosen = jnp.max(jnp.where(due, jnp.arange(spotter.patience), 0))
    found = jax.tree.map(lambda leaf: leaf[chosen], finished)
    state = state._replace(reported_end=jnp.where(reports, found.end, state.reported_end))
    return state, SemiMarkovSpotterInfo(growth, reports, found, best[0].astype(jnp.int32))
