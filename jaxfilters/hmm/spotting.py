"""Online spotting of symbols in a stream, with the first and last frame of each.

All symbols are scored at once, from every possible start: the score of a symbol is the log ratio of its best path to
the best path of the null model, and a symbol is accepted if it exceeds a margin (H.-K. Lee and J. Kim, "An HMM-based
threshold model approach for gesture recognition", IEEE PAMI 21(10), 1999, sections 4-5). All paths are Viterbi paths.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.hmm.decoding import best_predecessor
from jaxfilters.hmm.model import HiddenMarkovModel, check_model
from jaxfilters.hmm.networks import Network, threshold_model
from jaxfilters.typing import AnyKey


class Candidate(NamedTuple):
    """A symbol with its first and last frame."""

    label: Int32[Array, ""]
    """Index of the part of the network; -1 is none."""
    start: Int32[Array, ""]
    """First frame, counted from 0."""
    end: Int32[Array, ""]
    """Last frame."""
    score: Float[Array, ""]
    """Log ratio to the null model, in nats."""


class SpotterState(NamedTuple):
    """The scores of all partial paths."""

    null: Float[Array, " q"]
    """(Q,): log scores of the null model; the largest is 0 after an update."""
    symbols: Float[Array, " q"]
    """(Q,): log scores of the states of the symbols, relative to the best one of the null model."""
    starts: Int32[Array, " q"]
    """(Q,): frame in which the best path to each state entered its symbol."""
    frame: Int32[Array, ""]
    """The last predicted frame; -1 at the start."""
    candidate: Candidate
    """The best symbol that has ended and is not reported yet."""


class SpotterInfo(NamedTuple):
    """Diagnostics of one frame."""

    log_evidence: Float[Array, ""]
    """Increase of the best log score of the null model; `-inf` for an impossible frame, which is then ignored."""
    scores: Float[Array, " k"]
    """(K,): log ratio of each symbol to the null model if it ends in this frame, in nats."""
    starts: Int32[Array, " k"]
    """(K,): the first frame of each such symbol."""
    reports: Bool[Array, ""]
    """Whether a symbol is reported in this frame."""
    found: Candidate
    """The reported symbol."""


@pytree_dataclass
class Spotter:
    """Parameters of a spotter."""

    network: Network
    null: HiddenMarkovModel
    log_prior: Float[Array, "..."]
    margin: Float[Array, "..."]
    patience: Int32[Array, "..."]
    min_frames: Int32[Array, "..."]


def spotter(
    network: Network,
    null: HiddenMarkovModel | None = None,
    *,
    log_prior: Float[Array, " k"] | None = None,
    margin: float = 0.0,
    patience: int = 5,
    min_frames: int = 1,
) -> Filter:
    """A filter that reports the symbols of a network in a stream of observations.

    Observations are those of the network's emission; without one, the log-likelihoods (Q,) of its states.

    Args:
        network: The symbols, made by `parallel_composition`; they end in their final states.
        null: Model of the stream between symbols, on the same states; `None` is `threshold_model(network)`.
        log_prior: (K,): added to the score of each symbol; `None` adds nothing.
        margin: Log ratio to the null model that a symbol must exceed, in nats.
        patience: Number of frames without a better end of a candidate after which it is reported. It is reported at
            once if no symbol exceeds the margin any more.
        min_frames: Least number of frames of a symbol.

    Raises:
        ValueError: If `null` has other states, `log_prior` does not have one number for each symbol, or `patience` or
            `min_frames` is less than 1.

    Examples:
        Two symbols of one state each; the threshold model starts in either of the two.

        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> symbol = jf.hmm.from_probabilities([1.0], [[1.0]])
        >>> network = jf.hmm.parallel_composition([symbol, symbol])
        >>> filter = jf.hmm.spotter(network, margin=2.0, patience=3)
        >>> print(np.exp(filter.params.null.log_initial).round(2))
        [0.5 0.5]
    """
    null = threshold_model(network) if null is None else null
    check_model(null)
    if null.log_initial.shape != network.part.shape:
        shapes = network.part.shape, null.log_initial.shape
        raise ValueError(f"null must have the states of network, {shapes[0]}; got {shapes[1]}.")
    if patience < 1 or min_frames < 1:
        raise ValueError(f"patience and min_frames must be at least 1; got {patience} and {min_frames}.")
    num_symbols = int(network.part.max()) + 1
    if log_prior is not None and jnp.shape(log_prior) != (num_symbols,):
        raise ValueError(f"log_prior must be ({num_symbols},), one number a symbol; got {jnp.shape(log_prior)}.")
    prior = jnp.zeros(num_symbols, network.model.log_initial.dtype) if log_prior is None else log_prior
    dtype = network.model.log_initial.dtype
    params = Spotter(
        network,
        null,
        prior,
        jnp.asarray(margin, dtype),
        jnp.asarray(patience, jnp.int32),
        jnp.asarray(min_frames, jnp.int32),
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Spotter, key: AnyKey) -> SpotterState:
    del key
    num_states, dtype = model.network.part.shape[0], model.log_prior.dtype
    return SpotterState(
        model.null.log_initial,
        jnp.full(num_states, -jnp.inf, dtype),
        jnp.zeros(num_states, jnp.int32),
        jnp.full((), -1, jnp.int32),
        _nothing(dtype),
    )


def _predict(model: Spotter, key: AnyKey, state: SpotterState, inputs: PyTree) -> SpotterState:
    del key, inputs
    frame, chain = state.frame + 1, model.network.model
    first = frame == 0
    # A path may enter a symbol from the best state of the null model.
    entering = jnp.where(first, 0.0, jnp.max(state.null)) + chain.log_initial + model.log_prior[model.network.part]
    inside, origin = best_predecessor(state.symbols, chain.log_transition)
    enters = entering > inside
    null, _ = best_predecessor(state.null, model.null.log_transition)
    return state._replace(
        null=jnp.where(first, state.null, null),
        symbols=jnp.where(enters, entering, inside),
        starts=jnp.where(enters, frame, state.starts[origin]),
        frame=frame,
    )


def _update(
    model: Spotter, key: AnyKey, state: SpotterState, observation: PyTree, inputs: PyTree
) -> tuple[SpotterState, SpotterInfo]:
    del key, inputs
    emission = model.network.model.emission
    scores = observation if emission is None else emission.log_likelihood(observation)
    if jnp.shape(scores) != state.null.shape:
        name = "observation, without an emission," if emission is None else "emission.log_likelihood"
        raise ValueError(f"{name} must be log-likelihoods {state.null.shape}, (Q,); got {jnp.shape(scores)}.")
    scores = jnp.where(jnp.isnan(scores), -jnp.inf, scores)
    growth = jnp.max(state.null + scores)
    # A frame that is impossible under the null model is ignored.
    scores = jnp.where(growth > -jnp.inf, scores, 0.0)
    null = state.null + scores
    state = state._replace(null=null - jnp.max(null), symbols=state.symbols + scores - jnp.max(null))
    scores, starts = _ended(model, state)
    state, found = _decided(model, state, scores, starts)
    return state, SpotterInfo(growth, scores, starts, found.label >= 0, found)


def _ended(model: Spotter, state: SpotterState) -> tuple[Array, Array]:
    """Score and first frame of each symbol if it ends now."""
    own = model.network.part == jnp.arange(model.log_prior.shape[0])[:, None]
    long_enough = state.frame - state.starts + 1 >= model.min_frames
    scores = jnp.where(own & model.network.final & long_enough, state.symbols, -jnp.inf)
    best = jnp.argmax(scores, axis=1)
    return jnp.max(scores, axis=1), state.starts[best]


def _decided(model: Spotter, state: SpotterState, scores: Array, starts: Array) -> tuple[SpotterState, Candidate]:
    """Keep the candidate, replace it by a better one, or report it."""
    label = jnp.argmax(scores).astype(jnp.int32)
    new, old = Candidate(label, starts[label], state.frame, scores[label]), state.candidate
    exceeds, exists = new.score > model.margin, old.label >= 0
    follows = exceeds & exists & (new.start > old.end)
    better = exceeds & (follows | (new.score >= old.score))
    waited = state.frame - old.end >= model.patience
    report = exists & (follows | ~exceeds | (waited & ~better))
    # Paths that overlap the reported symbol end: the next symbol starts after it.
    overlaps = report & (state.starts <= old.end)
    nothing = _nothing(scores.dtype)
    kept = _where(better, new, _where(report, nothing, old))
    state = state._replace(symbols=jnp.where(overlaps, -jnp.inf, state.symbols), candidate=kept)
    return state, _where(report, old, nothing)


def _nothing(dtype) -> Candidate:
    none = jnp.full((), -1, jnp.int32)
    return Candidate(none, none, none, jnp.full((), -jnp.inf, dtype))


def _where(condition: Bool[Array, ""], a: Candidate, b: Candidate) -> Candidate:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
