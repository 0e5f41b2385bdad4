from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

RNG = np.random.default_rng(0)
Q, T = 4, 37
TRANSITION = RNG.dirichlet(np.ones(Q), Q)
TRANSITION[0] = [0.5, 0.5, 0, 0]
SCORES = RNG.normal(0, 30, (T, Q))
SCORES[5, 2], SCORES[7] = -np.inf, 0.0
PARALLEL = jax.jit(
    lambda model, scores: (
        jf.hmm.parallel_forward(model, scores),
        jf.hmm.parallel_posterior(model, scores),
        jf.hmm.parallel_viterbi(model, scores),
    )
)
SEQUENTIAL = jax.jit(
    lambda model, scores: (
        jf.hmm.forward(model, scores),
        jf.hmm.posterior(model, scores),
        jf.hmm.viterbi(model, scores),
    )
)


def build():
    return jf.hmm.from_probabilities(RNG.dirichlet(np.ones(Q)), TRANSITION)


@pytest.mark.system
@pytest.mark.parametrize("varying", [False, True])
def test_it_is_the_sequential_result(x64, varying):
    model, scores = build(), jnp.asarray(SCORES)
    if varying:
        model = replace(model, log_transition=jnp.log(RNG.dirichlet(np.ones(Q), (T - 1, Q))))
    found, expected = PARALLEL(model, scores), SEQUENTIAL(model, scores)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9, rtol=1e-10), found, expected)


@pytest.mark.system
def test_an_impossible_sequence_has_no_posterior_and_no_path():
    scores = jnp.asarray(SCORES, jnp.float32).at[20].set(-jnp.inf)
    found, expected = PARALLEL(build(), scores), SEQUENTIAL(build(), scores)
    assert found[0].log_evidence == found[1].log_evidence == -jnp.inf
    assert (found[1].states == 0).all()
    assert (found[1].transitions == 0).all()
    assert (found[2].states == -1).all()
    np.testing.assert_allclose(found[0].probabilities, expected[0].probabilities, atol=1e-5)


@pytest.mark.system
def test_the_gradient_of_the_evidence_is_the_posterior(x64):
    model, scores = build(), jnp.asarray(SCORES[:6])
    slope = jax.grad(lambda scores: jf.hmm.parallel_forward(model, scores).log_evidence)(scores)
    np.testing.assert_allclose(slope, jf.hmm.posterior(model, scores).states, atol=1e-9)


def test_ties_give_one_of_the_paths():
    model = jf.hmm.from_probabilities([0.5, 0.5], [[0, 1], [1, 0]])
    path = jf.hmm.parallel_viterbi(model, jnp.zeros((5, 2))).states
    assert (np.abs(np.diff(path)) == 1).all()


def test_one_frame_has_the_posterior_of_bayes_rule():
    model = jf.hmm.from_probabilities([0.25, 0.75], [[0.9, 0.1], [0.2, 0.8]])
    found = jf.hmm.parallel_posterior(model, jnp.log(jnp.array([[0.6, 0.2]])))
    np.testing.assert_allclose(found.states, [[0.5, 0.5]], rtol=1e-6)
    np.testing.assert_allclose(found.transitions, np.zeros((2, 2)))
