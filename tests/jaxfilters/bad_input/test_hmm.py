"""Bad input: Hidden Markov models reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


LOGS = jnp.zeros((5, 2))
CHAIN = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
LASTING = jf.hmm.semi_markov([0.5, 0.5], [[0.0, 1.0], [1.0, 0.0]], [[0.5, 0.5], [0.0, 1.0]])
CODED = jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), jf.hmm.Codes(jnp.log(jnp.full((2, 3), 1 / 3))))
VECTORS = jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), jf.hmm.DiagonalGaussian(jnp.zeros((2, 1)), jnp.ones((2, 1))))
WRONG_VARIANCE = jf.hmm.DiagonalGaussian(jnp.zeros((2, 3)), jnp.ones((2, 1)))
MISMATCHED = jf.hmm.HiddenMarkovModel(jnp.zeros(3), jnp.zeros((2, 2)))
THREE_STATES = jf.hmm.Codes(jnp.zeros((3, 4)))


def network():
    return jf.hmm.parallel_composition([CHAIN, CHAIN])


def trained(observations=None, lengths=None, model=CODED, **options):
    observations = jnp.zeros((4, 2), int) if observations is None else observations
    return jf.hmm.baum_welch(model, observations, lengths, **options)


HMM = [
    Case("hmm, wrong sizes", lambda: jf.hmm.forward(MISMATCHED, LOGS), ("log_initial", "(3,)", "(2, 2)")),
    Case(
        "hmm, wrong Q", lambda: jf.hmm.log_evidence(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "2 states", "(5, 3)")
    ),
    Case("hmm, wrong Q backward", lambda: jf.hmm.backward(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, wrong Q posterior", lambda: jf.hmm.posterior(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, wrong Q viterbi", lambda: jf.hmm.viterbi(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, lengths of one sequence", lambda: jf.hmm.forward(CHAIN, LOGS, jnp.array([5, 5])), ("lengths",)),
    Case(
        "hmm, initial and transition",
        lambda: jf.hmm.from_probabilities([1.0], np.eye(2)),
        ("initial", "(1,)", "(2, 2)"),
    ),
    Case(
        "hmm, transposed transition",
        lambda: jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.2], [0.1, 0.8]]),
        ("transition", "rows (axis 1)", "row 0", "1.1", "axis 0", "transpose"),
    ),
    Case("hmm, initial sum", lambda: jf.hmm.from_probabilities([0.5, 0.6], np.eye(2)), ("initial", "1.1")),
    Case(
        "hmm, emission states",
        lambda: jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), THREE_STATES),
        ("emission", "2"),
    ),
    Case(
        "hmm, emission states of a model",
        lambda: jf.hmm.HiddenMarkovModel(jnp.zeros(2), jnp.zeros((2, 2)), THREE_STATES).log_likelihoods(
            jnp.zeros(4, int)
        ),
        ("emission", "2 states", "(4, 3)"),
    ),
    Case(
        "semi-Markov, durations of other states",
        lambda: jf.hmm.semi_markov([0.5, 0.5], np.eye(2), np.ones((3, 1))),
        ("durations", "(2, D)", "(3, 1)"),
    ),
    Case(
        "semi-Markov, durations that are counts",
        lambda: jf.hmm.semi_markov([0.5, 0.5], np.eye(2), [[3, 1], [1, 1]]),
        ("durations", "sum to 1", "4"),
    ),
    Case(
        "semi-Markov, NaN durations",
        lambda: jf.hmm.semi_markov([0.5, 0.5], np.eye(2), [[np.nan, 1], [1, 0]]),
        ("durations", "nan"),
    ),
    Case(
        "semi-Markov, endless tail",
        lambda: jf.hmm.semi_markov([0.5, 0.5], np.eye(2), np.ones((2, 1)), tail=1.0),
        ("tail", "1.0"),
    ),
    Case(
        "semi-Markov, varying transitions",
        lambda: jf.hmm.semi_markov([0.5, 0.5], np.stack([np.eye(2)] * 3), np.ones((2, 1))),
        ("transition", "(Q, Q)", "(3, 2, 2)"),
    ),
    *(
        Case(f"semi-Markov, wrong Q, {call.__name__}", lambda call=call: call(LASTING, jnp.zeros((5, 3))), ("(5, 3)",))
        for call in (jf.hmm.semi_markov_log_evidence, jf.hmm.semi_markov_posterior, jf.hmm.semi_markov_viterbi)
    ),
    Case(
        "semi-Markov, frame of other states",
        lambda: jf.run(jf.hmm.semi_markov_online(LASTING), KEY, jnp.zeros((5, 3))),
        ("log_likelihoods", "2 states", "(3,)"),
    ),
    Case("semi-Markov, background", lambda: jf.hmm.semi_markov_spotter(LASTING, 2), ("background", "2")),
    Case("semi-Markov, patience", lambda: jf.hmm.semi_markov_spotter(LASTING, 0, patience=0), ("patience", "0")),
    Case("hmm, topology", lambda: jf.hmm.from_topology(np.ones((2, 3), bool)), ("allowed", "(2, 3)")),
    Case(
        "hmm, topology, initial",
        lambda: jf.hmm.from_topology(np.eye(2, dtype=bool), initial=np.ones(3, bool)),
        ("initial",),
    ),
    Case("codes, float", lambda: CODED.log_likelihoods(jnp.zeros(4)), ("observations", "integers", "float32")),
    Case(
        "codes, out of range",
        lambda: CODED.log_likelihoods(jnp.array([0, 3])),
        ("observations", "0 to 2", "3", "frame 1"),
    ),
    Case("codes, two columns", lambda: CODED.log_likelihoods(jnp.zeros((4, 2), int)), ("observation", "(2,)")),
    Case(
        "gaussian, 1-D data", lambda: VECTORS.log_likelihoods(jnp.zeros(4)), ("observation", "(1,)", "()", "last axis")
    ),
    Case("gaussian, wide data", lambda: VECTORS.log_likelihoods(jnp.zeros((4, 3))), ("observation", "(1,)", "(3,)")),
    Case(
        "gaussian, NaN",
        lambda: VECTORS.log_likelihoods(jnp.array([[0.0], [jnp.nan]])),
        ("observations", "nan", "frame 1"),
    ),
    Case("gaussian, variance", lambda: WRONG_VARIANCE.log_likelihood(jnp.zeros(3)), ("variance", "(2, 3)", "(2, 1)")),
    Case(
        "gaussian, covariance",
        lambda: jf.hmm.FullGaussian(jnp.zeros((2, 3)), jnp.ones((2, 3))).log_likelihood(jnp.zeros(3)),
        ("covariance", "(2, 3, 3)", "(2, 3)"),
    ),
    Case(
        "hmm, mask length",
        lambda: CODED.log_likelihoods(jnp.zeros(4, int), jnp.ones(3, bool)),
        ("mask", "(3,)", "(4,)"),
    ),
    Case("hmm, online", lambda: jf.run(jf.hmm.online(CHAIN), KEY, jnp.zeros((5, 3))), ("observation", "(2,)", "(3,)")),
    Case("hmm, online model", lambda: jf.hmm.online(MISMATCHED), ("log_initial", "(3,)", "(2, 2)")),
    Case("baum_welch, lengths", lambda: trained(lengths=jnp.array([4, 5])), ("lengths", "0 to 4", "5")),
    Case("baum_welch, number of lengths", lambda: trained(lengths=jnp.array([4])), ("lengths", "(2,)", "(1,)")),
    Case("baum_welch, mask", lambda: trained(mask=jnp.ones((4, 1), bool)), ("mask", "(4, 2)", "(4, 1)")),
    Case("baum_welch, one sequence", lambda: trained(jnp.zeros(4, int)), ("observations", "(T, ..., n)", "(4,)")),
    Case("baum_welch, iterations", lambda: trained(max_iterations=0), ("max_iterations", "0")),
    Case("baum_welch, codes", lambda: trained(jnp.array([[0, 0], [7, 0]])), ("observations", "7", "frame 1")),
    Case("baum_welch, no emission", lambda: trained(model=CHAIN), ("emission",)),
    Case(
        "hmm, responsibilities",
        lambda: jf.hmm.with_responsibilities(CODED, jnp.zeros((4, 2), int), jnp.ones((4, 3, 2))),
        ("responsibilities", "(4, 2, 2)", "(4, 3, 2)"),
    ),
    Case(
        "hmm, no final state", lambda: jf.hmm.parallel_composition([CHAIN], [np.zeros(2, bool)]), ("final", "model 0")
    ),
    Case(
        "hmm, loop",
        lambda: jf.hmm.loop(network(), part_transition=np.ones((2, 2))),
        ("part_transition", "rows (axis 1)", "2"),
    ),
    Case("hmm, segments", lambda: jf.hmm.segments(np.array([0, 4]), network()), ("states", "3", "4")),
    Case(
        "hmm, spotter prior", lambda: jf.hmm.spotter(network(), log_prior=jnp.zeros(4)), ("log_prior", "(2,)", "(4,)")
    ),
]


@pytest.mark.parametrize("case", HMM, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
