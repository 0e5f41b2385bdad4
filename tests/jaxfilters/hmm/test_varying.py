"""Hidden Markov models whose transitions change with time or with known inputs, against the sum over all paths."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters import hmm

Q, T = 3, 6
RNG = np.random.default_rng(2)
INITIAL, STEPS = RNG.dirichlet(np.ones(Q)), RNG.dirichlet(np.ones(Q), (T - 1, Q))
SCORES = 2 * RNG.normal(size=(T, Q))
PULL = RNG.normal(size=T)


def model(steps=STEPS):
    return hmm.from_probabilities(INITIAL, steps)


def paths_and_logs():
    paths = np.array(list(itertools.product(range(Q), repeat=T)))
    moves = np.log(STEPS)[np.arange(T - 1), paths[:, :-1], paths[:, 1:]].sum(1)
    return paths, np.log(INITIAL)[paths[:, 0]] + moves + SCORES[np.arange(T), paths].sum(1)


def test_all_recursions_agree_with_the_sum_over_all_paths(x64):
    paths, logs = paths_and_logs()
    total = np.logaddexp.reduce(logs)
    share = np.exp(logs - total)
    chain, e = model(), jnp.asarray(SCORES)
    found, best, filtered = hmm.posterior(chain, e), hmm.viterbi(chain, e), hmm.forward(chain, e)
    of = lambda t: paths[:, t, None] == np.arange(Q)
    states = np.stack([share @ of(t) for t in range(T)])
    moves = np.stack([np.einsum("p,pi,pj->ij", share, of(t), of(t + 1)) for t in range(T - 1)])
    np.testing.assert_allclose(found.log_evidence, total, atol=1e-11)
    np.testing.assert_allclose(found.states, states, atol=1e-12)
    np.testing.assert_allclose(found.transitions, moves, atol=1e-12)
    np.testing.assert_array_equal(best.states, paths[logs.argmax()])
    np.testing.assert_allclose(best.log_probability, logs.max(), atol=1e-11)
    beta = np.log(filtered.probabilities) + np.cumsum(filtered.log_evidence_per_step)[:, None] + hmm.backward(chain, e)
    np.testing.assert_allclose(np.logaddexp.reduce(beta, axis=1), np.full(T, total), atol=1e-11)

    slope = jax.grad(hmm.log_evidence)(chain, e)
    np.testing.assert_allclose(slope.log_transition, moves, atol=1e-12)
    np.testing.assert_allclose(slope.log_initial, states[0], atol=1e-12)


@pytest.mark.system
def test_long_padded_sequences_share_the_transitions_of_their_frames(x64):
    """Long enough for the blocks of `log_evidence`; each sequence on its own has the transitions of its frames."""
    rng, lengths = np.random.default_rng(3), np.array([40, 1, 23])
    steps, e = rng.dirichlet(np.ones(Q), (39, Q)), 2 * rng.normal(size=(40, Q, 3))
    found = hmm.posterior(model(steps), jnp.asarray(e), lengths)
    evidence = hmm.log_evidence(model(steps), jnp.asarray(e), lengths)
    transitions = np.zeros((39, Q, Q))
    for i, length in enumerate(lengths):
        alpha = INITIAL
        total = 0.0
        for t in range(length):
            alpha = (alpha if t == 0 else alpha @ steps[t - 1]) * np.exp(e[t, :, i])
            total, alpha = total + np.log(alpha.sum()), alpha / alpha.sum()
        np.testing.assert_allclose([evidence[i], found.log_evidence[i]], total, atol=1e-10)
        own = hmm.posterior(model(steps[: length - 1]), jnp.asarray(e[:length, :, i]))
        np.testing.assert_allclose(found.states[:length, :, i], own.states, atol=1e-12)
        transitions[: length - 1] += own.transitions
    np.testing.assert_allclose(found.transitions, transitions, atol=1e-12)


def driven(pull):
    """Transitions as a function of one known input."""
    return jax.nn.softmax(jnp.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.3, 0.0, 1.0]]) * pull, axis=1)


def test_a_function_of_the_inputs_is_online_what_its_matrices_are_at_once(x64):
    chain = hmm.from_probabilities(INITIAL, driven)
    whole = hmm.forward(chain.with_inputs(jnp.asarray(PULL)), jnp.asarray(SCORES))
    _, (states, infos) = jf.run(hmm.online(chain), jax.random.key(0), jnp.asarray(SCORES), jnp.asarray(PULL))
    np.testing.assert_allclose(np.exp(states.log_probabilities), whole.probabilities, atol=1e-12)
    np.testing.assert_allclose(infos.log_evidence.sum(), whole.log_evidence, atol=1e-12)


def test_samples_move_by_the_transitions_of_their_frames():
    """A permutation in each step leaves no choice: 0 -> 1 -> 2 -> 0 by cycles, then one state stays."""
    cycle = np.eye(3)[[1, 2, 0]]
    chain = hmm.from_probabilities([1.0, 0.0, 0.0], np.stack([cycle, cycle, np.eye(3), cycle]))
    np.testing.assert_array_equal(hmm.sample(jax.random.key(0), chain, 5)[0], [0, 1, 2, 2, 0])


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (
            lambda: hmm.forward(model(), jnp.zeros((4, Q))),
            r"\(3, 3, 3\), one for each step\); got \(3,\) and \(5,",
        ),
        (lambda: hmm.forward(hmm.from_probabilities(INITIAL, driven), jnp.zeros((4, Q))), "with_inputs"),
        (lambda: hmm.online(model()), r"\(Q,\) and \(Q, Q\); got \(3,\) and \(5, 3, 3\)"),
        (lambda: model().with_inputs(jnp.zeros(T)), "model must have a function"),
        (lambda: model(np.ones((2, 5, Q, Q))), r"\(T - 1, Q, Q\)"),
        (lambda: model(np.swapaxes(STEPS, 1, 2)), r"rows \(axis 1\) sum to 1"),
        (lambda: hmm.from_probabilities(INITIAL, lambda u: jnp.ones((3, 3))).with_inputs(jnp.zeros(T)), "sum to 1"),
        (lambda: hmm.from_probabilities(INITIAL, lambda u: jnp.ones((2, 3))).with_inputs(jnp.zeros(T)), r"\(3, 3\)"),
        (lambda: hmm.from_probabilities(INITIAL, driven).with_inputs(None), "inputs"),
    ],
)
def test_shapes_and_probabilities_that_do_not_fit_are_errors(call, named):
    with pytest.raises(ValueError, match=named):
        call()
