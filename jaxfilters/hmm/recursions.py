r"""The forward, backward and forward-backward recursions, from log-likelihoods of the states.

Probabilities are scaled, and their scales are added as logarithms: with $e_t(j) = \log p(y_t \mid s_t = j)$

$$\log \alpha_t(j) = \log \sum_i \alpha_{t-1}(i) A_{ij} + e_t(j)$$

where the sum is a matrix product and $\alpha$ is rescaled by about its largest element in every frame (L. Rabiner,
"A tutorial on hidden Markov models", Proc. IEEE 77(2), 1989, equations 19-35). A state whose log probability is 147
nats below that of the best one in float32, 1000 in float64, counts as impossible; `viterbi` has no such
limit.

`model.log_transition` is `(Q, Q)`, or `(T - 1, Q, Q)` where it changes with time; sequences share it.
`log_likelihoods` are `(T, Q)`, or `(T, Q, n)` for n sequences: with the sequences last this is vector arithmetic, a
third faster than `vmap` over a first axis, which works as well. NaN counts as `-inf`. `lengths` (n,) are the numbers of
frames of the sequences; later frames are padding and contribute nothing, whatever they hold. A sequence that is
impossible under the model has the log evidence `-inf`, and its posteriors and derivatives are zero.

All functions raise a ValueError, when they are traced, if `log_likelihoods` does not have the Q states of the model
along its second axis, or `lengths` not one integer for each sequence.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.hmm.log_likelihoods import Lengths, as_column, check_shapes, inside_sequences, usable
from jaxfilters.hmm.model import HiddenMarkovModel, of_each_frame

_BLOCK = 16
"""Number of frames whose scales are added together: operations on many frames at once use longer vectors."""


def _frames_a_step() -> int:
    """Frames of the forward recursion in one step of its loop.

    For two frames a GPU copies the carried state once: 10 000 sequences of 100 frames take 0.82 ms on an H200, and
    1.42 ms otherwise. CPUs only compile for longer.
    """
    return 1 if jax.default_backend() == "cpu" else 2


class Filtered(NamedTuple):
    """The filtering distributions: those of the states given the frames so far."""

    log_evidence: Float[Array, "*batch"]
    """Marginal log-likelihood log p(y_1:T)."""
    probabilities: Float[Array, "t q *batch"]
    """p(s_t | y_1:t); zero in padding and from the first impossible observation on."""
    log_evidence_per_step: Float[Array, "t *batch"]
    """log p(y_t | y_1:t-1); zero in padding."""


class Posterior(NamedTuple):
    """The smoothing distributions: those of the states given the whole sequence."""

    log_evidence: Float[Array, "*batch"]
    """Marginal log-likelihood log p(y_1:T)."""
    states: Float[Array, "t q *batch"]
    """p(s_t | y_1:T); zero in padding and for impossible sequences."""
    transitions: Float[Array, "..."]
    """(Q, Q): expected number of transitions from i to j at [i, j], summed over the sequences; (T - 1, Q, Q), one for
    each step, where the transitions of the model change with time."""


@jax.jit
def log_evidence(
    model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None
) -> Float[Array, "*batch"]:
    """The marginal log-likelihood log p(y_1:T), in one forward pass with constant memory.

    Its gradient is the expected sufficient statistics, by one backward pass: that with respect to `log_likelihoods` is
    the posterior of the states, that with respect to `log_transition` the expected numbers of transitions. Only reverse
    mode is supported.

    Args:
        model: The model.
        log_likelihoods: (T, Q) or (T, Q, n): log p(y_t | s_t) of every state, from `model.log_likelihoods`.
        lengths: (n,): numbers of frames; `None` is T for all.

    Returns:
        () or (n,).

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        0.9 in the first frame, and 0.9 * 0.9 + 0.1 * 0.1 in the second one.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([1.0, 0.0], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.9, 0.1]]))
        >>> round(float(jnp.exp(jf.hmm.log_evidence(model, log_likelihoods))), 3)
        0.738
    """
    check_shapes(model, log_likelihoods, lengths)
    return _log_evidence(model.log_initial, model.log_transition, log_likelihoods, lengths)


@jax.jit
def forward(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None) -> Filtered:
    """The forward algorithm: probabilities of the states given the frames so far. Arguments as of `log_evidence`.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.9, 0.1], [0.1, 0.9]]))
        >>> print(jf.hmm.forward(model, log_likelihoods).probabilities.shape)
        (3, 2)
    """
    check_shapes(model, log_likelihoods, lengths)
    total, scaled, shifts = _forward(model.log_initial, model.log_transition, log_likelihoods, lengths)
    inside = inside_sequences(log_likelihoods, lengths)
    sums = jnp.sum(scaled, axis=1)
    before = jnp.concatenate([jnp.ones_like(sums[:1]), sums[:-1]])
    alive = before > 0
    log_evidence = shifts + jnp.log(sums) - jnp.log(jnp.where(alive, before, 1.0))
    return Filtered(
        total, jnp.where(inside[:, None], _normalized(scaled, axis=1), 0.0), jnp.where(inside, log_evidence, 0.0)
    )


@jax.jit
def backward(
    model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None
) -> Float[Array, "t q *batch"]:
    """The backward algorithm: log p(y_t+1:T | s_t), zero in the last frame and in padding.

    Arguments are those of `log_evidence`.

    Returns:
        An array like `log_likelihoods`.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        From state 0, the second frame has the likelihood 0.9 * 0.9 + 0.1 * 0.1.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.9, 0.1], [0.9, 0.1]]))
        >>> print(np.exp(jf.hmm.backward(model, log_likelihoods)).round(2))
        [[0.82 0.26]
         [1.   1.  ]]
    """
    check_shapes(model, log_likelihoods, lengths)
    if len(log_likelihoods) < 2:
        return jnp.zeros_like(log_likelihoods)
    A = jnp.exp(model.log_transition)
    inside = inside_sequences(log_likelihoods, lengths)

    def step(following: Array, inputs: tuple) -> tuple[Array, Array]:
        frame, is_inside, own = inputs
        scaled, shift = _scaled(following + usable(frame))
        log_beta = jnp.where(is_inside, jnp.log(_matmul(A if own is None else own, scaled)) + shift, 0.0)
        return log_beta, log_beta

    last = jnp.zeros_like(log_likelihoods[:1])
    own = A if A.ndim == 3 else None
    _, earlier = jax.lax.scan(step, last[0], (log_likelihoods[1:], inside[1:], own), reverse=True)
    return jnp.concatenate([earlier, last])


@jax.jit
def posterior(
    model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None
) -> Posterior:
    """The forward-backward algorithm: posteriors of the states and expected numbers of transitions.

    Arguments are those of `log_evidence`.

    Raises:
        ValueError: If the shapes do not match.

    Examples:
        The second frame says nothing; the first one says 0.8, of which the chain keeps 0.8 * 0.9 + 0.2 * 0.1.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.1, 0.9]])
        >>> log_likelihoods = jnp.log(jnp.array([[0.8, 0.2], [0.5, 0.5]]))
        >>> print(np.asarray(jf.hmm.posterior(model, log_likelihoods).states).round(2))
        [[0.8  0.2 ]
         [0.74 0.26]]
    """
    check_shapes(model, log_likelihoods, lengths)
    A = jnp.exp(model.log_transition)
    total, scaled, _ = _forward(model.log_initial, model.log_transition, log_likelihoods, lengths)
    inside = inside_sequences(log_likelihoods, lengths)
    states, ratios = _smoothed(A, scaled, inside)
    return Posterior(total, states, _expected_transitions(A, scaled, ratios))


@jax.custom_vjp
def _log_evidence(log_initial, log_transition, log_likelihoods, lengths):
    step = _step(log_initial, log_transition, log_likelihoods)
    num_frames, batch = len(log_likelihoods), log_likelihoods.shape[2:]
    inside = None if lengths is None else inside_sequences(log_likelihoods, lengths)
    steps = _to_each_frame(log_transition)

    def block(carry: tuple, first: Any, count: int = _BLOCK) -> tuple[tuple, None]:
        scaled, total = carry
        here = lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, count)
        frames = usable(here(log_likelihoods))
        is_inside, own = jax.tree.map(here, inside), jax.tree.map(here, steps)
        each = (frames, jnp.arange(count) + first == 0, is_inside, own)
        scaled, shifts = jax.lax.scan(step, scaled, each, unroll=_frames_a_step())
        return (scaled, _add_compensated(total, jnp.sum(shifts, axis=0))), None

    zero = jnp.zeros(batch, log_likelihoods.dtype)
    carry = (_uniform(log_initial, log_likelihoods), (zero, zero))
    whole = num_frames - num_frames % _BLOCK
    if whole:
        carry, _ = jax.lax.scan(block, carry, jnp.arange(0, whole, _BLOCK))
    if whole < num_frames:
        carry, _ = block(carry, whole, num_frames - whole)
    return _total(*carry, log_likelihoods, lengths)


def _log_evidence_forward(log_initial, log_transition, log_likelihoods, lengths):
    total, scaled, _ = _forward(log_initial, log_transition, log_likelihoods, lengths)
    return total, (log_transition, scaled, inside_sequences(log_likelihoods, lengths))


def _log_evidence_backward(residuals, cotangent):
    log_transition, scaled, inside = residuals
    A = jnp.exp(log_transition)
    states, ratios = _smoothed(A, scaled, inside)
    weighted = states * cotangent
    # Without any frame nothing depends on the initial distribution.
    initial = jnp.sum(weighted[:1], axis=(0, *range(2, weighted.ndim)))
    return initial, _expected_transitions(A, scaled, ratios * cotangent), weighted, None


_log_evidence.defvjp(_log_evidence_forward, _log_evidence_backward)


def _forward(log_initial, log_transition, log_likelihoods, lengths) -> tuple[Array, Array, Array]:
    """Log p(y_1:T), and for every frame the scaled probabilities and their log scale."""
    step = _step(log_initial, log_transition, log_likelihoods)
    inside = None if lengths is None else inside_sequences(log_likelihoods, lengths)

    def accumulate(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        scaled, total = carry
        frame, *rest = inputs
        scaled, shift = step(scaled, (usable(frame), *rest))
        return (scaled, _add_compensated(total, shift)), (scaled, shift)

    zero = jnp.zeros(log_likelihoods.shape[2:], log_likelihoods.dtype)
    start = (_uniform(log_initial, log_likelihoods), (zero, zero))
    is_first = jnp.arange(len(log_likelihoods)) == 0
    carry, stored = jax.lax.scan(accumulate, start, (log_likelihoods, is_first, inside, _to_each_frame(log_transition)))
    return _total(*carry, log_likelihoods, lengths), *stored


def _step(log_initial, log_transition, log_likelihoods) -> Callable:
    """The function that advances scaled probabilities by one frame, from usable log-likelihoods."""
    A_transposed = jnp.exp(log_transition).T
    initial = jnp.exp(as_column(log_initial, log_likelihoods))

    def step(scaled: Array, inputs: tuple) -> tuple[Array, Array]:
        frame, is_first, is_inside, own = inputs
        # The first frame is part of the loop, because a loop over the other frames would copy them.
        predicted = jnp.where(is_first, initial, _matmul(A_transposed if own is None else own.T, scaled))
        # An approximation suffices to choose a scale, and is much cheaper than logarithms.
        peak = jnp.max(jnp.where(predicted > 0, frame + _rough_log(predicted), -jnp.inf), axis=0)
        shift = jax.lax.stop_gradient(_finite(peak)) - _headroom(predicted)
        # The factors may be at opposite ends of the range of floats with their product in the middle, so the square
        # root of the second factor is applied twice. The limit matters only where the state is impossible.
        largest = _headroom(predicted) - math.log(jnp.finfo(predicted.dtype).tiny) + 1
        root = jnp.exp(0.5 * jnp.minimum(frame - shift, largest))
        after = predicted * root * root
        if is_inside is None:
            return after, shift
        return jnp.where(is_inside, after, scaled), jnp.where(is_inside, shift, 0.0)

    return step


def _to_each_frame(log_transition: Array) -> Array | None:
    """The transition probabilities to each frame where they change with time, else None."""
    steps = of_each_frame(log_transition, after=False)
    return None if steps is None else jnp.exp(steps)


def _rough_log(x: Array) -> Array:
    """Logarithm of positive numbers to 0.06, by linear interpolation between powers of 2."""
    kind = jnp.finfo(x.dtype)
    dropped = max(0, kind.bits - 32)
    bits = jax.lax.bitcast_convert_type(x, f"int{kind.bits}") >> dropped
    return math.log(2) * (bits.astype(jnp.int32).astype(x.dtype) * 2.0 ** (dropped - kind.nmant) - (kind.maxexp - 1))


def _uniform(log_initial: Array, log_likelihoods: Array) -> Array:
    # Without any frame the evidence is one.
    return jnp.full((len(log_initial), *log_likelihoods.shape[2:]), 1 / len(log_initial), log_likelihoods.dtype)


def _add_compensated(total: tuple[Array, Array], term: Array) -> tuple[Array, Array]:
    """Compensated summation (W. Kahan, CACM 8(1), 1965): a plain float32 sum of 10^4 frames is off by 0.05 nats."""
    value, error = total
    term = term - error
    return value + term, (value + term - value) - term


def _total(scaled: Array, shifts: tuple[Array, Array], log_likelihoods: Array, lengths: Array | None) -> Array:
    total = shifts[0] + jnp.log(jnp.sum(scaled, axis=0)) if len(log_likelihoods) else shifts[0]
    return total if lengths is None else jnp.where(lengths > 0, total, 0.0)


def _smoothed(A: Array, scaled: Array, inside: Array) -> tuple[Array, Array]:
    r"""Posteriors of the states from scaled forward probabilities, and the ratios for expected transitions.

    $\gamma_t(i) = \alpha_t(i) \sum_j A_{ij} \gamma_{t+1}(j) / \sum_k \alpha_t(k) A_{kj}$, in which the scales cancel.
    """

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple[Array, Array]]:
        following, next_inside = carry
        here, is_inside, own = inputs
        step_A = A if own is None else own
        predicted = _matmul(step_A.T, here)
        possible = predicted > jnp.finfo(here.dtype).tiny
        ratio = jnp.where(possible, following / jnp.where(possible, predicted, 1.0), 0.0)
        gamma = _normalized(jnp.where(next_inside, here * _matmul(step_A, ratio), here), axis=0)
        gamma = jnp.where(is_inside, gamma, 0.0)
        return (gamma, is_inside), (gamma, ratio)

    after_the_end = (jnp.zeros(scaled.shape[1:], scaled.dtype), jnp.zeros(inside.shape[1:], bool))
    # The last frame has no transition, and its element has no effect.
    own = None if A.ndim == 2 else jnp.concatenate([A, jnp.zeros((1, *A.shape[1:]), A.dtype)])
    _, found = jax.lax.scan(step, after_the_end, (scaled, inside, own), reverse=True)
    return found


def _expected_transitions(A: Array, scaled: Array, ratios: Array) -> Array:
    """Expected numbers of transitions, summed over sequences, and over frames unless each has a transition of its own.

    One matrix product, or one for each frame.
    """
    if A.ndim == 3:
        shape = (len(A), A.shape[1], math.prod(scaled.shape[2:]))
        earlier, later = (leaf[:-1].reshape(shape) for leaf in (scaled, ratios))
        sums = jnp.einsum("tin,tjn->tij", earlier, later, precision="highest")
        return jnp.where(A > 0, A * sums, 0.0)
    axes = (0, *range(2, scaled.ndim))
    sums = jnp.tensordot(scaled, ratios, axes=(axes, axes), precision="highest")
    return jnp.where(A > 0, A * sums, 0.0)


def _scaled(log_values: Array) -> tuple[Array, Array]:
    """`exp(log_values - shift)` far from overflow and underflow, and the shift; zeros if all values are `-inf`."""
    peak = jnp.max(log_values, axis=0)
    shift = _finite(peak) - _headroom(log_values)
    return jnp.exp(log_values - shift), shift


def _finite(peak: Array) -> Array:
    return jnp.where(peak > -jnp.inf, peak, 0.0)


def _headroom(values: Array) -> float:
    # Two thirds of the largest exponent: a sum over any number of states stays finite.
    return 60.0 if jnp.finfo(values.dtype).maxexp <= 128 else 300.0


def _normalized(values: Array, axis: int) -> Array:
    total = jnp.sum(values, axis=axis, keepdims=True)
    return jnp.where(total > 0, values / jnp.where(total > 0, total, 1.0), 0.0)


def _matmul(a: Array, b: Array) -> Array:
    return jnp.tensordot(a, b, axes=1, precision="highest")
