r"""Forward, backward, posterior and most probable path of a chain, from log-likelihoods of its states.

Probabilities inside a frame, logarithms between frames: with $e_t(j) = \log p(y_t \mid s_t = j)$

$$\log \alpha_t(j) = \log \sum_i \alpha_{t-1}(i) A_{ij} + e_t(j)$$

where the sum is a matrix product and $\alpha$ is shifted by its largest element anew in every frame (L. Rabiner, "A
tutorial on hidden Markov models", Proc. IEEE 77(2), 1989, equations 19-35). A state that is 147 nats behind the best
one in float32, 1000 in float64, counts as impossible; `viterbi` has no such limit.

`log_likelihoods` are `(T, Q)`, or `(T, Q, n)` for n sequences: with the sequences last this is vector arithmetic, a
third faster than `vmap` over a first axis, which works as well. NaN counts as `-inf`. `lengths` says how many frames
of each sequence there are; frames after those are padding and contribute nothing, whatever they hold. A sequence that
the model cannot produce has the log-likelihood `-inf`, and zero for posteriors and derivatives.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxfilters.hmm.model import HiddenMarkovModel

_UNROLLED = 16
Lengths = Int[Array, "*batch"] | None


class Filtered(NamedTuple):
    """What is known of the states from the frames so far."""

    log_likelihood: Float[Array, "*batch"]
    """log p(y_1:T)."""
    probabilities: Float[Array, "t q *batch"]
    """p(s_t | y_1:t); zero in padding, and from an impossible observation on."""
    log_evidence: Float[Array, "t *batch"]
    """log p(y_t | y_1:t-1), zero in padding."""


class Posterior(NamedTuple):
    """What is known of the states from the whole sequence."""

    log_likelihood: Float[Array, "*batch"]
    """log p(y_1:T)."""
    states: Float[Array, "t q *batch"]
    """p(s_t | y_1:T); zero in padding and for impossible sequences."""
    transitions: Float[Array, "q q"]
    """Expected number of transitions from i to j, summed over the sequences."""


class Path(NamedTuple):
    """The most probable sequence of states."""

    states: Int32[Array, "t *batch"]
    """-1 in padding and for impossible sequences."""
    log_probability: Float[Array, "*batch"]
    """log p(s_1:T, y_1:T)."""


@jax.jit
def log_likelihood(
    model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None
) -> Float[Array, "*batch"]:
    """Log p(y_1:T), in one pass that stores nothing.

    Its gradient is the expected sufficient statistics, by one backward pass: in `log_likelihoods` the posterior of the
    states, in `log_transition` the expected numbers of transitions. Reverse mode only.
    """
    return _log_likelihood(model.log_initial, model.log_transition, log_likelihoods, lengths)


@jax.jit
def forward(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None) -> Filtered:
    """Probabilities of the states given the frames so far."""
    total, (scaled, shifts) = _forward(model.log_initial, model.log_transition, log_likelihoods, lengths, store=True)
    inside = _inside(log_likelihoods, lengths)
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
    """Log p(y_t+1:T | s_t); zero in the last frame and after it."""
    if len(log_likelihoods) < 2:
        return jnp.zeros_like(log_likelihoods)
    A = jnp.exp(model.log_transition)
    inside = _inside(log_likelihoods, lengths)

    def step(following: Array, inputs: tuple) -> tuple[Array, Array]:
        frame, is_inside = inputs
        scaled, shift = _scaled(following + _usable(frame))
        log_beta = jnp.where(is_inside, jnp.log(_matmul(A, scaled)) + shift, 0.0)
        return log_beta, log_beta

    last = jnp.zeros_like(log_likelihoods[:1])
    _, earlier = jax.lax.scan(step, last[0], (log_likelihoods[1:], inside[1:]), reverse=True)
    return jnp.concatenate([earlier, last])


@jax.jit
def posterior(
    model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None
) -> Posterior:
    """Probabilities of the states given the whole sequence, and how often each transition is expected."""
    A = jnp.exp(model.log_transition)
    total, (scaled, _) = _forward(model.log_initial, model.log_transition, log_likelihoods, lengths, store=True)
    inside = _inside(log_likelihoods, lengths)
    states, ratios = _smoothed(A, scaled, inside)
    return Posterior(total, states, _expected_transitions(A, scaled, ratios))


@jax.jit
def viterbi(model: HiddenMarkovModel, log_likelihoods: Float[Array, "t q *batch"], lengths: Lengths = None) -> Path:
    """The most probable sequence of states, in logarithms throughout; of equally probable ones any."""
    inside = _inside(log_likelihoods, lengths)
    initial = _column(model.log_initial, log_likelihoods)

    def step(best: Array, inputs: tuple) -> tuple[Array, Array]:
        frame, is_first, is_inside = inputs
        reached, origin = best_origin(best, model.log_transition)
        after = jnp.where(is_first, initial, reached) + _usable(frame)
        return jnp.where(is_inside, after, best), origin

    def back(state: Array, inputs: tuple) -> tuple[Array, Array]:
        origin, is_inside = inputs
        earlier = jnp.take_along_axis(origin, state[None], axis=0)[0].astype(jnp.int32)
        return jnp.where(is_inside, earlier, state), state

    start = jnp.zeros((len(initial), *inside.shape[1:]), log_likelihoods.dtype)
    is_first = jnp.arange(len(log_likelihoods)) == 0
    best, origins = jax.lax.scan(step, start, (log_likelihoods, is_first, inside))
    last = jnp.argmax(best, axis=0).astype(jnp.int32)
    _, states = jax.lax.scan(back, last, (origins, inside), reverse=True)
    log_probability = jnp.max(best, axis=0)
    return Path(jnp.where(inside & (log_probability > -jnp.inf), states, -1), log_probability)


def best_origin(
    score: Float[Array, "q *batch"], log_transition: Float[Array, "q q"]
) -> tuple[Float[Array, "q *batch"], Int[Array, "q *batch"]]:
    """The best score with which each state is reached in one transition, and from where; the first of equal ones."""
    num_states = len(score)
    steps = log_transition.reshape(num_states, num_states, *[1] * (score.ndim - 1))
    if num_states > _UNROLLED:
        reached = score[:, None] + steps
        return jnp.max(reached, axis=0), jnp.argmax(reached, axis=0).astype(jnp.int32)
    # One running maximum over whole vectors; a reduction that also returns the place is not vectorised.
    best = score[0] + steps[0]
    origin = jnp.zeros(best.shape, jnp.int8)
    for i in range(1, num_states):
        candidate = score[i] + steps[i]
        better = candidate > best
        best, origin = jnp.where(better, candidate, best), jnp.where(better, jnp.int8(i), origin)
    return best, origin


@jax.custom_vjp
def _log_likelihood(log_initial, log_transition, log_likelihoods, lengths):
    return _forward(log_initial, log_transition, log_likelihoods, lengths, store=False)[0]


def _log_likelihood_forward(log_initial, log_transition, log_likelihoods, lengths):
    total, (scaled, _) = _forward(log_initial, log_transition, log_likelihoods, lengths, store=True)
    return total, (log_transition, scaled, _inside(log_likelihoods, lengths))


def _log_likelihood_backward(residuals, cotangent):
    log_transition, scaled, inside = residuals
    A = jnp.exp(log_transition)
    states, ratios = _smoothed(A, scaled, inside)
    weighted = states * cotangent
    # A frame before the first has no state; without frames nothing depends on where the chain starts.
    initial = jnp.sum(weighted[:1], axis=(0, *range(2, weighted.ndim)))
    return initial, _expected_transitions(A, scaled, ratios * cotangent), weighted, None


_log_likelihood.defvjp(_log_likelihood_forward, _log_likelihood_backward)


def _forward(log_initial, log_transition, log_likelihoods, lengths, *, store: bool) -> tuple[Array, Any]:
    """Log p(y_1:T); and of every frame the probabilities, scaled, and by how many nats."""
    batch = log_likelihoods.shape[2:]
    A_transposed = jnp.exp(log_transition).T
    initial = jnp.exp(_column(log_initial, log_likelihoods))
    inside = None if lengths is None else _inside(log_likelihoods, lengths)

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, Any]:
        scaled, total, lost = carry
        frame, is_first, is_inside = inputs
        # The first frame in the loop, too: a loop over the others would copy them all.
        predicted = jnp.where(is_first, initial, _matmul(A_transposed, scaled))
        after, shift = _scaled(jnp.log(predicted) + _usable(frame))
        if is_inside is not None:
            after, shift = jnp.where(is_inside, after, scaled), jnp.where(is_inside, shift, 0.0)
        # Compensated: over 10^4 frames a plain float32 sum is off by 0.05 nats.
        term = shift - lost
        moved = total + term
        return (after, moved, (moved - total) - term), ((after, shift) if store else None)

    zero = jnp.zeros(batch, log_likelihoods.dtype)
    # Without a frame the probability of what was observed is one.
    start = jnp.full((len(log_initial), *batch), 1 / len(log_initial), log_likelihoods.dtype)
    is_first = jnp.arange(len(log_likelihoods)) == 0
    (scaled, total, _), stored = jax.lax.scan(step, (start, zero, zero), (log_likelihoods, is_first, inside))
    total = total + jnp.log(jnp.sum(scaled, axis=0))
    if inside is not None:
        total = jnp.where(lengths > 0, total, 0.0)
    return total if len(log_likelihoods) else zero, stored


def _smoothed(A: Array, scaled: Array, inside: Array) -> tuple[Array, Array]:
    r"""Posteriors of the states from the scaled forward probabilities, and the ratios that give those of transitions.

    $\gamma_t(i) = \alpha_t(i) \sum_j A_{ij} \gamma_{t+1}(j) / \sum_k \alpha_t(k) A_{kj}$: no scale is left in it.
    """

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple[Array, Array]]:
        following, next_inside = carry
        here, is_inside = inputs
        predicted = _matmul(A.T, here)
        possible = predicted > jnp.finfo(here.dtype).tiny
        ratio = jnp.where(possible, following / jnp.where(possible, predicted, 1.0), 0.0)
        gamma = _normalized(jnp.where(next_inside, here * _matmul(A, ratio), here), axis=0)
        gamma = jnp.where(is_inside, gamma, 0.0)
        return (gamma, is_inside), (gamma, ratio)

    after_the_end = (jnp.zeros(scaled.shape[1:], scaled.dtype), jnp.zeros(inside.shape[1:], bool))
    _, found = jax.lax.scan(step, after_the_end, (scaled, inside), reverse=True)
    return found


def _expected_transitions(A: Array, scaled: Array, ratios: Array) -> Array:
    """Sum over frames and sequences; a product of two matrices."""
    axes = (0, *range(2, scaled.ndim))
    sums = jnp.tensordot(scaled, ratios, axes=(axes, axes), precision="highest")
    return jnp.where(A > 0, A * sums, 0.0)


def _scaled(log_values: Array) -> tuple[Array, Array]:
    """`exp(log_values - shift)` whose largest element has room above and below, and the shift; zeros if all are."""
    peak = jnp.max(log_values, axis=0)
    shift = jnp.where(peak > -jnp.inf, peak, 0.0) - _headroom(log_values)
    return jnp.exp(log_values - shift), shift


def _headroom(values: Array) -> float:
    # Two thirds of the exponents above one: a sum over any number of states stays finite.
    return 60.0 if jnp.finfo(values.dtype).maxexp <= 128 else 300.0


def _normalized(values: Array, axis: int) -> Array:
    total = jnp.sum(values, axis=axis, keepdims=True)
    return jnp.where(total > 0, values / jnp.where(total > 0, total, 1.0), 0.0)


def _usable(log_likelihoods: Array) -> Array:
    return jnp.where(
        jnp.isnan(log_likelihoods), -jnp.inf, jnp.minimum(log_likelihoods, jnp.finfo(log_likelihoods.dtype).max)
    )


def _inside(log_likelihoods: Array, lengths: Array | None) -> Bool[Array, "t *batch"]:
    num_frames, batch = len(log_likelihoods), log_likelihoods.shape[2:]
    if lengths is None:
        return jnp.ones((num_frames, *batch), bool)
    frames = jnp.arange(num_frames).reshape(-1, *[1] * len(batch))
    return jnp.broadcast_to(frames < lengths, (num_frames, *batch))


def _column(log_initial: Array, log_likelihoods: Array) -> Array:
    """The initial probabilities with an axis for each of the sequences' axes."""
    return log_initial.reshape(-1, *[1] * (log_likelihoods.ndim - 2))


def _matmul(a: Array, b: Array) -> Array:
    return jnp.tensordot(a, b, axes=1, precision="highest")
