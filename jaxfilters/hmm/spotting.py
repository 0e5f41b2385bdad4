"""Finding symbols in a stream as it comes, with the frames in which each began and ended.

All symbols are followed at once, from every possible start: the score of a symbol is that of its best path behind the
best path of the null model, and it competes with the null model alone (H.-K. Lee and J. Kim, "An HMM-based threshold
model approach for gesture recognition", IEEE PAMI 21(10), 1999, sections 4-5). Paths are Viterbi's, in logarithms.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.hmm.model import HiddenMarkovModel
from jaxfilters.hmm.networks import Network, threshold
from jaxfilters.hmm.recursions import best_origin
from jaxfilters.typing import AnyKey


class Candidate(NamedTuple):
    """A symbol between its first and last frame."""

    label: Int32[Array, ""]
    """Which model; -1 is none."""
    start: Int32[Array, ""]
    """First frame, counted from 0."""
    end: Int32[Array, ""]
    """Last frame."""
    score: Float[Array, ""]
    """Nats by which it beats the null model."""


class SpotterState(NamedTuple):
    """All paths that may still become a symbol."""

    null: Float[Array, " q"]
    """Log scores of the null model; the largest is 0 after an update."""
    symbols: Float[Array, " q"]
    """Log scores of the symbols' states beside the null model's best one."""
    starts: Int32[Array, " q"]
    """Frame in which the path to each state entered its symbol."""
    frame: Int32[Array, ""]
    """The last one predicted; -1 before."""
    candidate: Candidate
    """The best symbol that has ended so far and was not reported."""


class SpotterInfo(NamedTuple):
    """What one frame says."""

    log_evidence: Float[Array, ""]
    """Growth of the null model's best log score; `-inf` if it cannot produce the frame: that counts as not seen."""
    scores: Float[Array, " k"]
    """Nats by which each symbol, ended in this frame, beats the null model."""
    starts: Int32[Array, " k"]
    """Frame in which each would have begun."""
    reports: Bool[Array, ""]
    """Whether a symbol is certain from this frame on."""
    found: Candidate
    """That symbol."""


@pytree_dataclass
class Spotter:
    """Parameters of a spotter."""

    network: Network
    null: HiddenMarkovModel
    log_prior: Float[Array, "..."]
    margin: Float[Array, "..."]
    patience: Int32[Array, "..."]
    shortest: Int32[Array, "..."]


def spotter(
    network: Network,
    null: HiddenMarkovModel | None = None,
    *,
    log_prior: Float[Array, " k"] | None = None,
    margin: float = 0.0,
    patience: int = 5,
    shortest: int = 1,
) -> Filter:
    """Filter that reports symbols of `network` in a stream of observations.

    Observations are those of the network's emission; without one, the log-likelihoods (Q,) of its states.

    Args:
        network: The symbols, made by `side_by_side`; they end in their final states.
        null: What the stream is made of between symbols, on the same states; `None` is `threshold(network)`.
        log_prior: Added to the score of each symbol; `None` adds nothing.
        margin: Nats by which a symbol has to beat the null model.
        patience: Frames for which no better end of a candidate has come, before it is reported. It is reported at
            once where no symbol beats the null model any more.
        shortest: Least number of frames of a symbol.

    Raises:
        ValueError: If `null` has other states, or `patience` or `shortest` is less than 1.
    """
    null = threshold(network) if null is None else null
    if null.log_initial.shape != network.owner.shape:
        shapes = network.owner.shape, null.log_initial.shape
        raise ValueError(f"null must have the states of network, {shapes[0]}; got {shapes[1]}.")
    if patience < 1 or shortest < 1:
        raise ValueError(f"patience and shortest must be at least 1; got {patience} and {shortest}.")
    num_symbols = int(network.owner.max()) + 1
    prior = jnp.zeros(num_symbols, network.model.log_initial.dtype) if log_prior is None else log_prior
    dtype = network.model.log_initial.dtype
    params = Spotter(
        network,
        null,
        prior,
        jnp.asarray(margin, dtype),
        jnp.asarray(patience, jnp.int32),
        jnp.asarray(shortest, jnp.int32),
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Spotter, key: AnyKey) -> SpotterState:
    del key
    num_states, dtype = model.network.owner.shape[0], model.log_prior.dtype
    return SpotterState(
        model.null.log_initial,
        jnp.full(num_states, -jnp.inf, dtype),
        jnp.zeros(num_states, jnp.int32),
        jnp.full((), -1, jnp.int32),
        _nothing(dtype),
    )


def _predict(model: Spotter, key: AnyKey, state: SpotterState, control: PyTree) -> SpotterState:
    del key, control
    frame, chain = state.frame + 1, model.network.model
    first = frame == 0
    # A path may enter a symbol from wherever the null model is best.
    entering = jnp.where(first, 0.0, jnp.max(state.null)) + chain.log_initial + model.log_prior[model.network.owner]
    inside, origin = best_origin(state.symbols, chain.log_transition)
    enters = entering > inside
    null, _ = best_origin(state.null, model.null.log_transition)
    return state._replace(
        null=jnp.where(first, state.null, null),
        symbols=jnp.where(enters, entering, inside),
        starts=jnp.where(enters, frame, state.starts[origin]),
        frame=frame,
    )


def _update(model: Spotter, key: AnyKey, state: SpotterState, observation: PyTree) -> tuple[SpotterState, SpotterInfo]:
    del key
    emission = model.network.model.emission
    seen = observation if emission is None else emission.log_likelihood(observation)
    seen = jnp.where(jnp.isnan(seen), -jnp.inf, seen)
    growth = jnp.max(state.null + seen)
    # What the null model cannot produce counts as not seen.
    seen = jnp.where(growth > -jnp.inf, seen, 0.0)
    null = state.null + seen
    state = state._replace(null=null - jnp.max(null), symbols=state.symbols + seen - jnp.max(null))
    scores, starts = _ended(model, state)
    state, found = _decided(model, state, scores, starts)
    return state, SpotterInfo(growth, scores, starts, found.label >= 0, found)


def _ended(model: Spotter, state: SpotterState) -> tuple[Array, Array]:
    """Score and start of each symbol, were it to end now."""
    own = model.network.owner == jnp.arange(model.log_prior.shape[0])[:, None]
    long_enough = state.frame - state.starts + 1 >= model.shortest
    scores = jnp.where(own & model.network.final & long_enough, state.symbols, -jnp.inf)
    best = jnp.argmax(scores, axis=1)
    return jnp.max(scores, axis=1), state.starts[best]


def _decided(model: Spotter, state: SpotterState, scores: Array, starts: Array) -> tuple[SpotterState, Candidate]:
    """Replace the candidate by a better one, or report it."""
    label = jnp.argmax(scores).astype(jnp.int32)
    new, held = Candidate(label, starts[label], state.frame, scores[label]), state.candidate
    beats, holds = new.score > model.margin, held.label >= 0
    follows = beats & holds & (new.start > held.end)
    better = beats & (follows | (new.score >= held.score))
    waited = state.frame - held.end >= model.patience
    report = holds & (follows | ~beats | (waited & ~better))
    # The next symbol begins after this one.
    over = report & (state.starts <= held.end)
    nothing = _nothing(scores.dtype)
    kept = _where(better, new, _where(report, nothing, held))
    state = state._replace(symbols=jnp.where(over, -jnp.inf, state.symbols), candidate=kept)
    return state, _where(report, held, nothing)


def _nothing(dtype) -> Candidate:
    none = jnp.full((), -1, jnp.int32)
    return Candidate(none, none, none, jnp.full((), -jnp.inf, dtype))


def _where(condition: Bool[Array, ""], a: Candidate, b: Candidate) -> Candidate:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
