r"""Hidden Markov models in logarithmic depth: the forward-backward and Viterbi algorithms by associative scans.

An element summarises a run of frames as a matrix, $M_{ij} = p(y_{a:b}, s_b = j \mid s_{a-1} = i)$, scaled, and elements
are combined by products of matrices: sums of products for probabilities, maxima of sums for the most probable path
(S. Hassan, S. Särkkä and A. F. Garcia-Fernandez, "Temporal parallelization of inference in hidden Markov models", IEEE
Transactions on Signal Processing 69, 2021). About 32 log16 T rounds take the place of T steps, with Q times as many
operations: they are meant for accelerators, few states and long sequences. The results are those of `forward`,
`posterior` and `viterbi`, to rounding; a state whose probability is 1e-38 of the best one's in float32 counts as
impossible.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._xla.prefix_scan import prefix_scan
from jaxfilters.hmm.decoding import Path
from jaxfilters.hmm.log_likelihoods import check_shapes, usable
from jaxfilters.hmm.model import HiddenMarkovModel
from jaxfilters.hmm.recursions import Filtered, Posterior


class _Run(NamedTuple):
    """A run of frames: `matrix` times exp(`log_scale`)."""

    matrix: Array
    log_scale: Array


@jax.jit
def parallel_forward(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q"]) -> Filtered:
    """The forward algorithm in logarithmic depth: probabilities of the states given the frames so far.

    Args:
        model: The model.
        log_likelihoods: (T, Q): log p(y_t | s_t), from `model.log_likelihoods`. For n sequences use `jax.vmap`.

    Returns:
        What `forward` returns for one sequence.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.9, 0.1], [0.1, 0.9]]))
        >>> jf.hmm.parallel_forward(model, log_likelihoods).probabilities.shape
        (3, 2)
    """
    _check(model, log_likelihoods)
    ahead = _ahead(model, log_likelihoods)
    log_totals = jnp.log(ahead.matrix.sum(axis=1)) + ahead.log_scale
    before = jnp.concatenate([jnp.zeros_like(log_totals[:1]), log_totals[:-1]])
    possible = log_totals > -jnp.inf
    # After an impossible frame nothing is known; that frame itself has the probability zero.
    steps = jnp.where(before > -jnp.inf, log_totals - jnp.where(before > -jnp.inf, before, 0.0), -jnp.inf)
    return Filtered(log_totals[-1], jnp.where(possible[:, None], _normalized(ahead.matrix), 0.0), steps)


@jax.jit
def parallel_posterior(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q"]) -> Posterior:
    """The forward-backward algorithm in logarithmic depth: posteriors of states, and expected transitions.

    Arguments and errors are those of `parallel_forward`; the result is that of `posterior` for one sequence.

    Examples:
        The second frame says nothing; the first one says 0.8, of which the chain keeps 0.8 * 0.9 + 0.2 * 0.1.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.1, 0.9]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.8, 0.2], [0.5, 0.5]]))
        >>> print(np.asarray(jf.hmm.parallel_posterior(model, log_likelihoods).states).round(2))
        [[0.8  0.2 ]
         [0.74 0.26]]
    """
    _check(model, log_likelihoods)
    A = jnp.exp(model.log_transition)
    frames = usable(log_likelihoods)
    ahead = _ahead(model, log_likelihoods)
    peaks = _peaks(frames)
    emission = jnp.exp(frames - peaks[:, None])
    # What follows frame t, from the states of frame t: runs of the frames after it, summed over their last state.
    later = prefix_scan(lambda b, a: _joined(a, b), _runs(A, emission[1:], peaks[1:]), reverse=True)
    beta = jnp.concatenate([later.matrix.sum(axis=2), jnp.ones_like(emission[:1])])
    states = _normalized(ahead.matrix * beta)
    following = _normalized(emission[1:] * beta[1:])
    pairs = ahead.matrix[:-1, :, None] * A * following[:, None]
    totals = pairs.sum(axis=(1, 2), keepdims=True)
    transitions = jnp.where(totals > 0, pairs / jnp.where(totals > 0, totals, 1.0), 0.0)
    transitions = transitions if A.ndim == 3 else transitions.sum(axis=0)
    total = jnp.log(ahead.matrix[-1].sum()) + ahead.log_scale[-1]
    possible = total > -jnp.inf
    return Posterior(total, jnp.where(possible, states, 0.0), jnp.where(possible, transitions, 0.0))


@jax.jit
def parallel_viterbi(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q"]) -> Path:
    """The Viterbi algorithm in logarithmic depth: a most probable sequence of states.

    Arguments and errors are those of `parallel_forward`. The scores of all frames come from a scan of maxima of sums,
    and the path from a scan that composes the tables of best predecessors.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.6, 0.4], [0.01, 0.99]]))
        >>> print(jf.hmm.parallel_viterbi(model, log_likelihoods).states)
        [0 0 1]
    """
    _check(model, log_likelihoods)
    frames = usable(log_likelihoods)
    first = jnp.broadcast_to(model.log_initial + frames[0], (1, *[len(model.log_initial)] * 2))
    elements = jnp.concatenate([first, model.log_transition + frames[1:, None]])
    scores = prefix_scan(_best, elements)[:, 0]
    reached = scores[:-1, :, None] + model.log_transition
    origins = jnp.argmax(reached, axis=1).astype(jnp.int32)
    last = jnp.argmax(scores[-1]).astype(jnp.int32)
    end = jnp.broadcast_to(last, (1, len(model.log_initial)))
    compose = lambda later, earlier: jnp.take_along_axis(earlier, later, axis=-1)
    states = prefix_scan(compose, jnp.concatenate([origins, end]), reverse=True)[:, 0]
    log_probability = scores[-1, last]
    return Path(jnp.where(log_probability > -jnp.inf, states, -1), log_probability)


def _check(model: HiddenMarkovModel, log_likelihoods: Array) -> None:
    check_shapes(model, log_likelihoods, None)
    if jnp.ndim(log_likelihoods) != 2 or not len(log_likelihoods):
        raise ValueError(
            f"log_likelihoods must be (T, Q) with at least one frame, for one sequence; got "
            f"{jnp.shape(log_likelihoods)}. For several sequences use jax.vmap."
        )


def _ahead(model: HiddenMarkovModel, log_likelihoods: Array) -> _Run:
    """Scaled p(s_t, y_1:t) of all frames, as vectors (t, q)."""
    frames = usable(log_likelihoods)
    peaks = _peaks(frames)
    emission = jnp.exp(frames - peaks[:, None])
    # The first frame has no state before it: every row of its matrix is the same.
    first = jnp.broadcast_to(jnp.exp(model.log_initial) * emission[0], (1, *[len(model.log_initial)] * 2))
    later = _runs(jnp.exp(model.log_transition), emission[1:], peaks[1:])
    runs = jax.tree.map(lambda one, many: jnp.concatenate([one, many]), _rescaled(_Run(first, peaks[:1])), later)
    found = prefix_scan(_joined, runs)
    return _Run(found.matrix[:, 0], found.log_scale)


def _runs(A, emission, peaks):
    return _rescaled(_Run(A * emission[:, None], peaks))


def _joined(early: _Run, late: _Run) -> _Run:
    product = jnp.matmul(early.matrix, late.matrix, precision="highest")
    return _rescaled(_Run(product, early.log_scale + late.log_scale))


def _rescaled(run: _Run) -> _Run:
    largest = jax.lax.stop_gradient(run.matrix.max(axis=(-2, -1)))
    scale = jnp.where(largest > 0, largest, 1.0)
    return _Run(run.matrix / scale[..., None, None], run.log_scale + jnp.log(scale))


def _best(early: Array, late: Array) -> Array:
    return jnp.max(early[..., :, :, None] + late[..., None, :, :], axis=-2)


def _peaks(frames: Array) -> Array:
    peaks = jax.lax.stop_gradient(frames.max(axis=1))
    return jnp.where(peaks > -jnp.inf, peaks, 0.0)


def _normalized(values: Array) -> Array:
    totals = values.sum(axis=1, keepdims=True)
    return jnp.where(totals > 0, values / jnp.where(totals > 0, totals, 1.0), 0.0)
