"""Bad input: smoothers and expectation-maximisation reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
BELIEFS = jf.Gaussian(jnp.zeros((5, 2)), jnp.stack([jnp.eye(2)] * 5))
YS, Q, R = jnp.zeros((5, 1)), jnp.eye(2), jnp.eye(1)
LINEAR = jf.kalman(PRIOR, jnp.eye(2), Q, jnp.eye(2)[:1], R)
POSE = jf.extended_kalman(
    jf.Gaussian(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(3)),
    lambda x: x,
    jnp.eye(3),
    lambda x: x[:1],
    R,
    manifold=jf.manifold.product(jf.manifold.rotation),
)


def extended(**options):
    return jf.extended_kalman(PRIOR, lambda x: x, **{"process_noise": Q, "observe": lambda x: x[:1]} | options)


CURVED = extended(observation_noise=R)


def samples(filter=LINEAR, beliefs=BELIEFS, inputs=None, count=3):
    return jf.smoothing.posterior_samples(filter, KEY, beliefs, inputs, num_samples=count)


def neighbours(smoothed=BELIEFS, beliefs=BELIEFS):
    return jf.smoothing.lag_one_covariances(LINEAR, beliefs, smoothed)


def iterated(filter=CURVED, ys=YS, **options):
    return jf.smoothing.iterated(filter, KEY, ys, **options)


def two_filter(filter=LINEAR, beliefs=BELIEFS, ys=YS, **options):
    return jf.smoothing.two_filter(filter, beliefs, ys, **options)


def em(model=LINEAR, ys=YS[..., None], **options):
    return jf.fit.em(model, KEY, ys, **options)


def particle_filter(**options):
    return jf.bootstrap(
        lambda key: jnp.zeros(1),
        lambda noise, x: x + noise,
        lambda x, y: -jnp.sum((x - y) ** 2),
        **{"num_particles": 8, "noise": jf.StandardNormal(1)} | options,
    )


def paris(inner=None, initial=lambda x: 0.0, increment=lambda x, x_next: x[0], density=None, bound=0.0, **options):
    density = (lambda x_next, x: -jnp.sum((x_next - x) ** 2)) if density is None else density
    inner = particle_filter() if inner is None else inner
    return jf.run(jf.smoothing.paris(inner, initial, increment, density, bound, **options), KEY, YS)


def backward(**options):
    history = jf.smoothing.History(jnp.zeros((3, 8)), jnp.zeros((3, 8)), jnp.zeros((3, 8), jnp.int32))
    return jf.smoothing.backward_sampling(KEY, history, lambda x_next, x: -((x_next - x) ** 2), num_paths=4, **options)


CODES = jf.hmm.Codes(jnp.log(jnp.array([[0.7, 0.3], [0.4, 0.6]])))
CHAIN = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], CODES)

SMOOTHING = [
    Case("posterior_samples, count", lambda: samples(count=0), ("num_samples", "0")),
    Case("posterior_samples, filter", lambda: samples(particle_filter()), ("filter", "kalman", "Bootstrap")),
    Case("posterior_samples, inputs", lambda: samples(CURVED, inputs=jnp.zeros(4)), ("inputs", "5", "4")),
    Case("posterior_samples, beliefs", lambda: samples(beliefs=PRIOR), ("beliefs", "time first", "(2,)")),
    Case(
        "lag_one_covariances, other length",
        lambda: neighbours(jax.tree.map(lambda leaf: leaf[:4], BELIEFS)),
        ("smoothed", "5", "4"),
    ),
    Case("iterated, linear", lambda: iterated(LINEAR), ("filter", "extended_kalman", "Kalman")),
    Case("iterated, manifold", lambda: iterated(POSE), ("filter", "vectors")),
    Case("iterated, counts", lambda: iterated(extended(observe=jf.emissions.poisson(lambda x: x[:1]))), ("emission",)),
    Case("iterated, none", lambda: iterated(iterations=0), ("iterations", "0")),
    Case("iterated, smoother", lambda: iterated(smoother="parallel"), ("smoother", "function", "str")),
    Case(
        "iterated, start of another length",
        lambda: iterated(start=jax.tree.map(lambda leaf: leaf[:4], BELIEFS)),
        ("start", "5", "4"),
    ),
    Case("iterated, wide observations", lambda: iterated(ys=jnp.zeros((5, 2))), ("observation", "(1,)", "(2,)")),
    Case("two_filter, filter", lambda: two_filter(particle_filter()), ("filter", "kalman", "Bootstrap")),
    Case("two_filter, manifold", lambda: two_filter(POSE), ("filter", "vectors")),
    Case("two_filter, length", lambda: two_filter(ys=YS[:4]), ("observations", "5", "4")),
    Case(
        "posterior_linearization, kalman", lambda: jf.posterior_linearization(LINEAR), ("inner", "extended", "Kalman")
    ),
    Case("posterior_linearization, none", lambda: jf.posterior_linearization(CURVED, 0), ("iterations", "0")),
    Case("posterior_linearization, manifold", lambda: jf.posterior_linearization(POSE), ("inner", "vectors")),
    Case("backward_sampling, bound", lambda: backward(log_bound=jnp.inf), ("log_bound", "finite", "inf")),
    Case("backward_sampling, candidates", lambda: backward(log_bound=0.0, max_candidates=0), ("max_candidates", "0")),
    Case("paris, filter", lambda: paris(LINEAR), ("inner", "bootstrap")),
    Case("paris, no filter", lambda: paris(PRIOR), ("inner", "Filter", "Gaussian")),
    Case("paris, draws", lambda: paris(num_draws=0), ("num_draws", "0")),
    Case("paris, bound", lambda: paris(bound=jnp.nan), ("log_bound", "finite", "nan")),
    Case("paris, increment of another shape", lambda: paris(increment=lambda x, x_next: x), ("increment", "(1, 8)")),
    Case("paris, density of another shape", lambda: paris(density=lambda x_next, x: x), ("log_transition", "(1,)")),
    Case("hmm, several sequences", lambda: jf.hmm.parallel_forward(CHAIN, jnp.zeros((5, 2, 3))), ("(5, 2, 3)", "vmap")),
    Case("hmm, other states", lambda: jf.hmm.parallel_viterbi(CHAIN, jnp.zeros((5, 3))), ("2 states", "(5, 3)")),
    Case("em, no model", lambda: em(PRIOR), ("model", "Filter", "Gaussian")),
    Case("em, another filter", lambda: em(particle_filter()), ("model", "kalman", "Bootstrap")),
    Case("em, manifold", lambda: em(POSE), ("model", "vectors")),
    Case("em, one sequence", lambda: em(ys=YS), ("observations", "(t, m, s)", "(5, 1)", "y[..., None]")),
    Case("em, nothing read", lambda: em(ys=jnp.full((5, 1, 2), jnp.nan)), ("observations", "none")),
    Case("em, unknown name", lambda: em(free=("F", "A")), ("free", "'A'")),
    Case("em, a word", lambda: em(free="F"), ("free", "tuple", "'F'")),
    Case("em, no offset", lambda: em(free=("b",)), ("free", "'b'")),
    Case(
        "em, function of the inputs",
        lambda: em(jf.kalman(PRIOR, lambda u: jnp.eye(2), Q, jnp.eye(2)[:1], R), free=("F",)),
        ("free", "'F'"),
    ),
    Case("em, function without arrays", lambda: em(CURVED, free=("transition",)), ("free", "'transition'")),
    Case("em, lengths", lambda: em(lengths=jnp.array([6])), ("lengths", "0 to 5", "6")),
    Case("em, mask", lambda: em(mask=jnp.ones(5, bool)), ("mask", "(5, 1)", "(5,)")),
    Case("em, inputs", lambda: em(CURVED, inputs=jnp.zeros((5, 2))), ("inputs", "(5, ..., 1)", "(5, 2)")),
    Case("em, no iteration", lambda: em(max_iterations=0), ("max_iterations", "0")),
    Case("em, free of a chain", lambda: em(CHAIN, jnp.zeros((5, 1), int), free=("F",)), ("free", "HiddenMarkovModel")),
]


@pytest.mark.parametrize("case", SMOOTHING, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
