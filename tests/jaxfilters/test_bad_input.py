"""Every public builder rejects input that it cannot use: at trace time or before, naming the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import optimistix
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


# Gaussian filters.
PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)


def extended(transition=lambda x, u: x, Q=Q, observe=lambda x: x[:1], R=R, **options):
    return jf.extended_kalman(PRIOR, transition, Q, observe, R, **options)


GAUSSIAN = [
    Case("extended, wide y", lambda: jf.run(extended(), KEY, jnp.zeros((5, 3))), ("observation", "(3,)", "(1,)")),
]

# Linear inequalities.
CONSTRAINTS: list[Case] = []

# Particle and ensemble filters.
PARTICLE: list[Case] = []


# Hidden Markov models.
def as_called_by_users(cases: list[Case]) -> list[Case]:
    """The cases without the checks of shapes that jaxtyping adds while testing."""

    def unchecked(call: Callable[[], Any]) -> Callable[[], Any]:
        def made() -> Any:
            jaxtyping.config.update("jaxtyping_disable", True)
            try:
                return call()
            finally:
                jaxtyping.config.update("jaxtyping_disable", False)

        return made

    return [case._replace(call=unchecked(case.call)) for case in cases]


LOGS = jnp.zeros((5, 2))
CHAIN = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
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
HMM = as_called_by_users(HMM)

# Fitting.
YS = jnp.ones((6, 1))


def filter_of(noise):
    return jf.extended_kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), lambda x, u: x, noise * jnp.eye(1), lambda x: x, R)


def particle_filter_of(noise):
    return jf.bootstrap(
        lambda key: jax.random.normal(key, (1,)),
        lambda key, x, u: x + noise * jax.random.normal(key, (1,)),
        lambda x, y: -0.5 * jnp.sum((y - x) ** 2),
        num_particles=8,
    )


def maximized(log_density=lambda x: -jnp.sum(x**2), start=1.0, constraints=jf.fit.free, **options):
    return jf.fit.maximize(log_density, start, constraints, **options)


FIT = [
    Case(
        "fit, NaN to a particle filter",
        lambda: maximized(jf.fit.log_evidence(KEY, particle_filter_of, YS.at[2].set(jnp.nan)), 1.0, jf.fit.positive),
        ("log_density", "start", "observations", "NaN", "frame 2", "mask"),
    ),
    Case("fit, infinite at the start", lambda: maximized(lambda x: jnp.log(x), 0.0), ("log_density", "start", "-inf")),
    Case(
        "fit, prior excludes the start",
        lambda: maximized(jf.fit.with_prior(lambda x: -(x**2), lambda x: jnp.log(x)), 0.0),
        ("log_density", "log prior", "-inf"),
    ),
    Case(
        "fit, mask length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, mask=jnp.ones(5, bool)),
        ("observations", "mask", "(6, 1)", "(5,)"),
    ),
    Case(
        "fit, controls length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, jnp.ones((4, 1))),
        ("observations", "controls", "(6, 1)", "(4, 1)"),
    ),
    Case("fit, no observations", lambda: jf.fit.log_evidence(KEY, filter_of, None), ("observations", "none")),
    Case(
        "fit, mask of other sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 3)), mask=jnp.ones((6, 2), bool)),
        ("observations", "mask", "(6, 1, 3)", "(6, 2)"),
    ),
    Case(
        "fit, mask without sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 6)), mask=jnp.ones(6, bool)),
        ("mask", "last axis", "(6,)"),
    ),
    Case("fit, start outside", lambda: maximized(start={"a": -1.0}, constraints=jf.fit.positive), ("start['a']", "-1")),
    Case("fit, start NaN", lambda: maximized(start=jnp.nan), ("start", "finite", "nan")),
    Case(
        "fit, other constraints",
        lambda: maximized(start={"a": 1.0}, constraints={"b": jf.fit.free}),
        ("constraints", "structure of start"),
    ),
    Case("fit, no constraint", lambda: maximized(constraints=3.0), ("constraints", "fit.positive", "3.0")),
    Case("fit, interval", lambda: jf.fit.interval(2.0, 1.0), ("interval", "2.0", "1.0")),
    Case(
        "fit, fresh keys with bfgs",
        lambda: maximized(jf.fit.fresh_keys(KEY, lambda key, x: -(x**2))),
        ("method", "fresh keys", "Bfgs"),
    ),
    Case("fit, least squares", lambda: maximized(method=jf.fit.least_squares()), ("log_density", "fit.residuals")),
    Case("fit, adam rate", lambda: jf.fit.adam(0.0), ("learning_rate", "0.0")),
    Case("fit, no steps", lambda: jf.fit.bfgs(max_steps=0), ("max_steps", "0")),
    Case("fit, tolerance", lambda: jf.fit.lbfgsb(tolerance=-1.0), ("tolerance", "-1.0")),
    Case("fit, patience", lambda: jf.fit.adam(patience=0), ("patience", "0")),
    Case(
        "check_gradient outside",
        lambda: jf.fit.check_gradient(lambda x: jnp.log(x), -1.0, jf.fit.positive),
        ("theta", "positive", "-1"),
    ),
]
FIT = as_called_by_users(FIT)

# Optimisation and mathematics.
COST = jnp.ones((2, 3))
PCA = jf.math.incremental_pca.start(3, 2)
TENSOR = jnp.ones((3, 4, 2))
SPLIT = jf.optimize.Split(jnp.zeros(1), jnp.zeros((4, 2)))


def solved(options=None, fn=lambda y, args: y - 3.0):
    solver = jf.optimize.BoxLevenbergMarquardt(rtol=1e-4, atol=1e-4)
    return optimistix.least_squares(fn, solver, jnp.zeros(2), None, options)


def shared(start=SPLIT, data=None, **options):
    data = jnp.zeros((4, 2)) if data is None else data
    return jf.optimize.solve_shared(lambda shared, frame, data: shared + frame - data, start, data, **options)


MATH = [
    Case("least squares, bound of another shape", lambda: solved({"lower": jnp.zeros(3)}), ("lower", "shapes of y")),
    Case("least squares, bound of another tree", lambda: solved({"upper": {"a": 0.0}}), ("upper", "structure")),
    Case("least squares, crossed bounds", lambda: solved({"lower": 2.0, "upper": 1.0}), ("lower", "2.0", "1.0")),
    Case("least squares, NaN bound", lambda: solved({"lower": float("nan")}), ("lower", "nan")),
    Case(
        "bounds, crossed",
        lambda: jf.optimize.bounds_of({"lower": jnp.array([0.0, 2.0]), "upper": 1.0}, jnp.zeros(2)),
        ("lower", "variable 1", "2.0", "1.0"),
    ),
    Case("least squares, no residuals", lambda: solved(fn=lambda y, args: y[:0]), ("fn", "residual", "none")),
    Case("huber, scale", lambda: jf.optimize.huber(jnp.ones(2), 0.0), ("scale", "0.0")),
    Case("cauchy, scale", lambda: jf.optimize.cauchy(jnp.ones(2), -1.0), ("scale", "-1.0")),
    Case("solve_shared, frames of data", lambda: shared(data=jnp.zeros((5, 2))), ("data", "(4, 2)", "(5, 2)")),
    Case("solve_shared, no frames", lambda: shared(jf.optimize.Split(jnp.zeros(1), None)), ("start.frames", "none")),
    Case(
        "solve_shared, crossed bounds",
        lambda: shared(lower=SPLIT._replace(shared=jnp.ones(1)), upper=SPLIT),
        ("lower",),
    ),
    Case("solve_shared, bound of another shape", lambda: shared(lower=SPLIT._replace(shared=jnp.ones(2))), ("lower",)),
    Case("assignment, vector", lambda: jf.math.assignment.match(jnp.ones(3)), ("cost", "(3,)")),
    Case("assignment, NaN", lambda: jf.math.assignment.match(COST.at[0, 1].set(jnp.nan)), ("cost", "NaN", "1 of 6")),
    Case("assignment, mask", lambda: jf.math.assignment.match(COST, jnp.ones(3, bool)), ("rows", "(2,)", "(3,)")),
    Case("assignment, gate", lambda: jf.math.assignment.match_noncrossing_gated(COST, -1.0), ("gate", "-1.0")),
    Case("assignment, columns", lambda: jf.math.assignment.match(jnp.ones((2, 13))), ("cost", "12", "13")),
    Case("pca, components", lambda: jf.math.incremental_pca.start(3, 4), ("num_components", "3", "4")),
    Case("pca, sample", lambda: jf.math.incremental_pca.update(PCA, jnp.ones(2)), ("deviation", "(3,)", "(2,)")),
    Case(
        "pca, sample of moments",
        lambda: jf.math.incremental_pca.update_moments(jf.math.incremental_pca.start_moments(3), jnp.ones(1)),
        ("x", "(3,)", "(1,)"),
    ),
    Case("pca, mean", lambda: jf.math.incremental_pca.running_mean(jnp.ones(3), jnp.ones(1), 2), ("x", "(3,)", "(1,)")),
    Case(
        "pca, basis",
        lambda: jf.math.incremental_pca.change_basis(
            jnp.ones((2, 5)), jnp.zeros(3), jnp.eye(3), jnp.zeros(3), jnp.eye(3)
        ),
        ("coordinates", "(2, 5)", "(3, 3)"),
    ),
    Case("diffusion, scale", lambda: jf.math.diffusion.start(jnp.array([1.0, 0.0])), ("scale", "positive")),
    Case(
        "diffusion, velocity",
        lambda: jf.math.diffusion.update(jf.math.diffusion.start(jnp.ones(2)), jnp.ones(1), jnp.ones(1)),
        ("velocity", "(2,)", "(1,)"),
    ),
    Case("lie, quaternion", lambda: jf.math.lie.quaternion_to_matrix(jnp.ones(3)), ("q", "(3,)")),
    Case("lie, product", lambda: jf.math.lie.quaternion_multiply(jnp.ones(4), jnp.ones(3)), ("q", "(3,)")),
    Case("lie, rotation vector", lambda: jf.math.lie.so3_exp(jnp.ones(4)), ("rotvec", "(4,)")),
    Case("lie, matrix", lambda: jf.math.lie.quaternion_from_matrix(jnp.ones((4, 4))), ("R", "(4, 4)")),
    Case("lie, points", lambda: jf.math.lie.RigidTransform.identity().apply(jnp.ones((5, 2))), ("points", "(5, 2)")),
    Case(
        "linalg, product", lambda: jf.math.linalg.matmul(jnp.ones((2, 3)), jnp.ones((2, 2))), ("a", "(2, 3)", "(2, 2)")
    ),
    Case("linalg, cholesky", lambda: jf.math.linalg.cholesky(jnp.ones((3, 2))), ("S", "(3, 2)")),
    Case(
        "linalg, triangular",
        lambda: jf.math.linalg.solve_triangular(jnp.eye(2), jnp.ones(3)),
        ("L", "b", "(2, 2)", "(3,)"),
    ),
    Case("tensor, rank", lambda: jf.math.multilinear.hosvd(TENSOR, {1: 5}), ("ranks", "mode 1", "5")),
    Case("tensor, mode", lambda: jf.math.multilinear.unfold(TENSOR, 3), ("mode", "3")),
    Case("tensor, NaN", lambda: jf.math.multilinear.hooi(TENSOR * jnp.nan, {0: 1}), ("X", "finite", "24")),
    Case(
        "tensor, product",
        lambda: jf.math.multilinear.mode_product(TENSOR, jnp.ones((2, 2)), 0),
        ("C", "3 columns", "(2, 2)"),
    ),
    Case(
        "tensor, observed",
        lambda: jf.math.tensor_completion.complete(TENSOR, jnp.ones((3, 4), bool), {0: 1}),
        ("observed", "(3, 4, 2)", "(3, 4)"),
    ),
]
MATH = as_called_by_users(MATH)

CASES = [*GAUSSIAN, *CONSTRAINTS, *PARTICLE, *HMM, *FIT, *MATH]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case):
    with pytest.raises((ValueError, TypeError)) as caught:
        case.call()
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"
