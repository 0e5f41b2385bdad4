"""What dynamax 1.0 and cuthbert 0.1 test of their smoothers, asked of this library at their tolerances.

Set-ups and expectations are theirs, the code is not; expectations are computed here, in numpy. A case names its source:
`linear_gaussian_ssm/inference_test.py` and so on are files of dynamax, `tests/cuthbert...` of cuthbert. Theirs start
with an observation: the prior here is the one whose first prediction is theirs.
"""

import itertools
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
FRAMES, SAMPLES = 15, 1000
# The constant-velocity model of dynamax.
F = np.array([[1, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], float)
H, Q, R = np.eye(2, 4), 0.001 * np.eye(4), np.eye(2)
START = 0.1 * np.eye(4)
BACK = np.linalg.inv(F)
P = BACK @ (START - Q) @ BACK.T


def simulated(frames, seed=0):
    rng = np.random.default_rng(seed)
    x, ys = rng.multivariate_normal(np.zeros(4), START), []
    for _ in range(frames):
        ys.append(H @ x + rng.normal(size=2))
        x = F @ x + np.sqrt(0.001) * rng.normal(size=4)
    return np.array(ys)


YS = simulated(FRAMES)


@cache
def dense():
    """Smoothed means, covariances and neighbours, and the log evidence, from the joint Gaussian."""
    n, carry = 4 * FRAMES, np.zeros((4 * FRAMES, 4 * FRAMES))
    noise = np.kron(np.eye(FRAMES), Q)
    noise[:4, :4] = START
    for i, j in itertools.product(range(FRAMES), repeat=2):
        if j <= i:
            carry[4 * i : 4 * i + 4, 4 * j : 4 * j + 4] = np.linalg.matrix_power(F, i - j)
    prior = carry @ noise @ carry.T
    C = np.kron(np.eye(FRAMES), H)
    S = C @ prior @ C.T + np.kron(np.eye(FRAMES), R)
    gain = prior @ C.T @ np.linalg.inv(S)
    mean, covariance = (gain @ YS.ravel()).reshape(FRAMES, 4), prior - gain @ C @ prior
    blocks = [[covariance[i : i + 4, i + lag : i + lag + 4] for i in range(0, n - lag, 4)] for lag in (0, 4)]
    evidence = -0.5 * (YS.ravel() @ np.linalg.solve(S, YS.ravel()) + np.linalg.slogdet(2 * np.pi * S)[1])
    return dict(mean=mean, covariance=np.array(blocks[0]), neighbours=np.array(blocks[1]), evidence=evidence)


def linear_filters():
    arrays = [jnp.asarray(each, jnp.float32) for each in (F, Q, H, R)]
    A, q, C, r = arrays
    prior = jf.Gaussian(jnp.zeros(4), jnp.asarray(P, jnp.float32))
    functions = prior, lambda x: A @ x, q, lambda x: C @ x, r
    return dict(
        linear=jf.kalman(prior, *arrays),
        extended=jf.extended_kalman(*functions),
        unscented=jf.unscented_kalman(*functions),
    )


@cache
def found(name):
    """All results of one of the filters, by one program."""
    filter = linear_filters()[name]

    @jax.jit
    def run(ys):
        _, (beliefs, infos) = jf.run(filter, KEY, ys)
        smoothed = jf.smoothing.rts(filter, beliefs)
        return dict(
            mean=smoothed.mean,
            covariance=smoothed.covariance,
            neighbours=jf.smoothing.lag_one_covariances(filter, beliefs, smoothed),
            evidence=infos.log_evidence.sum(),
            samples=jf.smoothing.posterior_samples(filter, KEY, beliefs, num_samples=SAMPLES),
            filtered=beliefs.mean,
        )

    return jax.tree.map(np.asarray, run(jnp.asarray(YS, jnp.float32)))


@cache
def in_parallel():
    root = lambda C: jnp.linalg.cholesky(jnp.asarray(C, jnp.float32))
    prior = jf.GaussianRoot(jnp.zeros(4), root(P))
    model = jf.smoothing.LinearModel(jnp.asarray(F, jnp.float32), root(Q), jnp.asarray(H, jnp.float32), root(R))

    @jax.jit
    def run(ys):
        beliefs, evidences = jf.smoothing.parallel_kalman(prior, model, ys)
        smoothed = jf.smoothing.parallel_rts(beliefs, model)
        covariance = smoothed.root @ jnp.swapaxes(smoothed.root, 1, 2)
        return dict(mean=smoothed.mean, covariance=covariance, evidence=evidences.sum(), filtered=beliefs.mean)

    return jax.tree.map(np.asarray, run(jnp.asarray(YS, jnp.float32)))


class Case(NamedTuple):
    """A result, what it must be, and the tolerance of the source."""

    source: str
    name: str
    part: str
    tolerance: float


LINEAR, NONLINEAR = "linear_gaussian_ssm/inference_test.py", "nonlinear_gaussian_ssm/inference_test.py"
CASES = [
    Case(f"{LINEAR}: test_kalman_vs_joint", "linear", "mean", 1e-4),
    Case(f"{LINEAR}: test_kalman_vs_joint", "linear", "covariance", 1e-4),
    Case(f"{LINEAR}: test_smoother_vs_tfp", "linear", "evidence", 1e-3),
    Case("tests/cuthbert/gaussian/test_kalman.py: test_smoother", "linear", "neighbours", 1e-4),
    Case(f"{NONLINEAR}: test_extended_kalman_smoother_linear", "extended", "mean", 1e-4),
    Case(f"{NONLINEAR}: test_extended_kalman_smoother_linear", "extended", "covariance", 1e-4),
    Case("nonlinear_gaussian_ssm/inference_ukf_test.py", "unscented", "mean", 1e-3),
    Case("nonlinear_gaussian_ssm/inference_ukf_test.py", "unscented", "covariance", 1e-3),
]
PARALLEL = "linear_gaussian_ssm/parallel_inference_test.py"
PARALLEL_CASES = [
    Case(f"{PARALLEL}: test_smoothed_means", "parallel", "mean", 1e-3),
    Case(f"{PARALLEL}: test_smoothed_covariances", "parallel", "covariance", 1e-3),
    Case(f"{PARALLEL}: test_marginal_loglik", "parallel", "evidence", 1e-4 * FRAMES),
]


@pytest.mark.system
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.name}-{case.part}")
def test_smoothers_agree_with_the_joint_gaussian(case):
    np.testing.assert_allclose(found(case.name)[case.part], dense()[case.part], atol=case.tolerance)


@pytest.mark.system
@pytest.mark.parametrize("case", PARALLEL_CASES, ids=lambda case: case.part)
def test_parallel_smoothers_agree_with_the_joint_gaussian(case):
    np.testing.assert_allclose(in_parallel()[case.part], dense()[case.part], atol=case.tolerance)


@pytest.mark.system
@pytest.mark.parametrize("name", ["linear", "extended", "unscented"])
def test_the_mean_of_samples_is_smoothed(name):
    """`test_posterior_samples` of dynamax, at its 6 standard errors."""
    error = np.sqrt(np.diagonal(dense()["covariance"], axis1=1, axis2=2) / SAMPLES)
    assert (abs(found(name)["samples"].mean(-1) - dense()["mean"]) < 6 * error).all()


@pytest.mark.system
def test_the_extended_sampler_draws_the_samples_of_the_linear_one():
    """`test_extended_kalman_sampler_linear` of dynamax: with one key, the same samples."""
    np.testing.assert_allclose(found("extended")["samples"], found("linear")["samples"], atol=1e-3)


@pytest.mark.system
def test_expectation_maximisation_never_lowers_the_evidence():
    """`linear_gaussian_ssm/models_test.py: test_sample_and_fit` of dynamax: 3 iterations from its initial model."""
    rng = np.random.default_rng(2)
    ys = jnp.asarray(np.cumsum(rng.normal(size=(100, 10)), axis=0) / 5, jnp.float32)
    prior, half = jf.Gaussian(jnp.zeros(2), jnp.eye(2)), 0.1 * jnp.eye(2)
    C = jnp.asarray(rng.normal(size=(10, 2)), jnp.float32)
    start = jf.kalman(prior, 0.99 * jnp.eye(2), half, C, 0.1 * jnp.eye(10), b=jnp.zeros(2), d=jnp.zeros(10))
    history = np.asarray(jf.fit.em(start, KEY, ys[..., None], max_iterations=3, tolerance=0.0).log_evidence)
    assert (np.diff(history) >= -1e-2).all()


def chain(frames, states, seed=0):
    """The random model of dynamax's tests."""
    rng = np.random.default_rng(seed)
    initial, transition = rng.uniform(size=states), rng.uniform(size=(states, states))
    model = jf.hmm.from_probabilities(initial / initial.sum(), transition / transition.sum(1, keepdims=True))
    return model, rng.normal(size=(frames, states))


@cache
def table(frames, states):
    """Posterior probabilities of all sequences of states, from their joint probabilities, and the evidence."""
    model, scores = chain(frames, states)
    log_initial, log_transition = np.asarray(model.log_initial), np.asarray(model.log_transition)
    joint = np.zeros([states] * frames)
    for path in itertools.product(range(states), repeat=frames):
        steps = sum(log_transition[a, b] for a, b in itertools.pairwise(path))
        joint[path] = log_initial[path[0]] + steps + sum(scores[range(frames), path])
    evidence = np.log(np.exp(joint).sum())
    return np.exp(joint - evidence), evidence


HMM = {
    "test_hmm_smoother": jf.hmm.posterior,
    "test_parallel_smoother": jf.hmm.parallel_posterior,
}


@pytest.mark.parametrize("name", HMM)
def test_posteriors_of_states_are_those_of_the_table(name):
    """`hidden_markov_model/inference_test.py` of dynamax: sums over the table of all sequences, at 1e-4."""
    posterior, evidence = table(5, 2)
    model, scores = chain(5, 2)
    result = HMM[name](model, jnp.asarray(scores, jnp.float32))
    np.testing.assert_allclose(result.log_evidence, evidence, atol=1e-4)
    axes = set(range(5))
    for t in range(5):
        np.testing.assert_allclose(result.states[t], posterior.sum(tuple(axes - {t})), atol=1e-4)
    pairs = sum(posterior.sum(tuple(axes - {t, t + 1})) for t in range(4))
    np.testing.assert_allclose(result.transitions, pairs, atol=1e-3)


@pytest.mark.parametrize("mode", [jf.hmm.viterbi, jf.hmm.parallel_viterbi], ids=["viterbi", "parallel_viterbi"])
def test_the_mode_is_that_of_the_table(mode):
    """`test_hmm_posterior_mode` of dynamax."""
    posterior, _ = table(5, 2)
    model, scores = chain(5, 2)
    np.testing.assert_array_equal(
        mode(model, jnp.asarray(scores)).states, np.unravel_index(posterior.argmax(), [2] * 5)
    )


@pytest.mark.system
def test_the_parallel_filter_is_the_sequential_one():
    """`test_parallel_filter` of dynamax, 100 frames and 3 states, at a thousandth of its tolerance of 0.1."""
    model, scores = chain(100, 3)
    parallel, sequential = (f(model, jnp.asarray(scores)) for f in (jf.hmm.parallel_forward, jf.hmm.forward))
    np.testing.assert_allclose(parallel.log_evidence / 100, sequential.log_evidence / 100, atol=1e-4)
    np.testing.assert_allclose(parallel.probabilities, sequential.probabilities, atol=1e-4)


@pytest.mark.system
@pytest.mark.parametrize("options", [{}, {"log_bound": 0.0}], ids=["all weights", "rejection"])
def test_backward_sampling_of_one_step(options):
    """`tests/cuthbertlib/smc/test_backward.py: test_backward` of cuthbert, at its tolerances of 0.1."""
    rng, count = np.random.default_rng(44), 4000
    A, c, root = rng.normal(size=(2, 2)), rng.normal(size=2), 5 * np.tril(rng.normal(size=(2, 2))) + 5 * np.eye(2)
    means, roots = rng.normal(size=(2, 2)), 0.5 * np.tril(rng.normal(size=(2, 2, 2)))
    x0, x1 = (means[i][:, None] + roots[i] @ rng.normal(size=(2, count)) for i in (0, 1))
    precision = jnp.asarray(np.linalg.inv(root @ root.T), jnp.float32)

    def log_transition(x_next, x):
        difference = x_next - jnp.asarray(A, jnp.float32) @ x - jnp.asarray(c, jnp.float32)
        return -0.5 * difference @ precision @ difference

    particles = jnp.asarray(np.stack([x0, x1]), jnp.float32)
    history = jf.smoothing.History(particles, jnp.zeros((2, count)), jnp.zeros((2, count), jnp.int32))
    paths = np.asarray(jf.smoothing.backward_sampling(KEY, history, log_transition, num_paths=count, **options))
    C0, C1 = (root @ root.T for root in roots)
    gain = C0 @ A.T @ np.linalg.inv(A @ C0 @ A.T + root @ root.T)
    mean = means[0] + gain @ (means[1] - A @ means[0] - c)
    covariance = C0 - gain @ A @ C0 + gain @ C1 @ gain.T
    np.testing.assert_allclose(paths[0].mean(axis=1), mean, atol=0.1, rtol=0.1)
    joint = np.cov(paths[0], paths[1])
    np.testing.assert_allclose(joint[:2, :2], covariance, atol=0.1, rtol=0.1)
    np.testing.assert_allclose(joint[:2, 2:], gain @ C1, atol=0.1, rtol=0.1)
