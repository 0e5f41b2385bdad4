"""The interacting multiple model filter against loops in float64, filterpy, and the cases in which it is exact."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

pytestmark = pytest.mark.system

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)
F = [np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1.0, 0.5], [0.0, 0.4]]), np.eye(2)]
Q = [np.diag([0.01, 0.02]), np.array([[0.3, 0.1], [0.1, 0.5]]), 0.5 * np.eye(2)]
H, R = np.array([[1.0, 0.3]]), np.array([[0.2]])
MEANS = [np.array([0.0, 1.0]), np.array([0.2, -1.0]), np.zeros(2)]
COVARIANCES = [np.eye(2), np.array([[2.0, 0.3], [0.3, 1.0]]), 0.5 * np.eye(2)]
CHAIN = np.array([[0.9, 0.1, 0.0], [0.2, 0.7, 0.1], [0.3, 0.3, 0.4]])
INITIAL = np.array([0.6, 0.0, 0.4])
YS = np.cumsum(RNG.normal(size=(12, 1)), axis=0)


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


class Textbook:
    """The recursion of the paper, mode by mode and matrix by matrix; `convert` maps the states of modes."""

    def __init__(self, models, chain, initial, convert=lambda i, j, m, P: (m, P)):
        self.models, self.chain, self.mu, self.convert = models, chain, initial, convert
        self.beliefs = [(m, P) for m, P, *_ in models]
        self.log_evidence = 0.0

    def mixed(self, w, j):
        parts = [self.convert(i, j, *belief) for i, belief in enumerate(self.beliefs)]
        mean = sum(w[i] * m for i, (m, _) in enumerate(parts))
        return mean, sum(w[i] * (P + np.outer(m - mean, m - mean)) for i, (m, P) in enumerate(parts))

    def step(self, y):
        ahead = self.mu @ self.chain
        starts = [self.mixed(self.chain[:, j] * self.mu / ahead[j], j) for j in range(len(ahead))]
        likelihoods = []
        for j, ((m, P), (_, _, A, B, C)) in enumerate(zip(starts, self.models, strict=True)):
            m, P = A @ m, A @ P @ A.T + B
            S, e = C @ P @ C.T + R, y - C @ m
            likelihoods.append(np.exp(-0.5 * e @ np.linalg.solve(S, e)) / np.sqrt(np.linalg.det(2 * np.pi * S)))
            K = P @ C.T @ np.linalg.inv(S)
            self.beliefs[j] = m + K @ e, P - K @ S @ K.T
        joint = ahead * likelihoods
        self.log_evidence += np.log(joint.sum())
        self.mu = joint / joint.sum()


MODELS = [(m, P, A, B, H) for m, P, A, B in zip(MEANS, COVARIANCES, F, Q, strict=True)]


def gaussian(i):
    return jf.Gaussian(jnp.asarray(MEANS[i]), jnp.asarray(COVARIANCES[i]))


def linear(i, F=F, Q=Q):
    return jf.kalman(gaussian(i), F[i], Q[i], H, R)


def rooted(i):
    belief = jf.GaussianRoot(jnp.asarray(MEANS[i]), jnp.asarray(np.linalg.cholesky(COVARIANCES[i])))
    roots = [jnp.asarray(np.linalg.cholesky(noise)) for noise in (Q[i], R)]
    return jf.kalman(belief, F[i], roots[0], H, roots[1], arithmetic=jf.arithmetic.square_root)


def nonlinear(i):
    build = (jf.extended_kalman, jf.unscented_kalman, jf.cubature_kalman)[i]
    return build(gaussian(i), lambda x: F[i] @ x, jnp.asarray(Q[i]), lambda x: H @ x, jnp.asarray(R))


def covariance(belief):
    return belief.covariance if isinstance(belief, jf.Gaussian) else belief.root @ belief.root.T


def check_agreement(filter, oracle, maps=None):
    last, (_, infos) = jf.run(filter, KEY, jnp.asarray(YS))
    for y in YS:
        oracle.step(y)
    np.testing.assert_allclose(infos.log_evidence.sum(), oracle.log_evidence, rtol=1e-9)
    np.testing.assert_allclose(last.probabilities, oracle.mu, atol=1e-10)
    for belief, (m, P) in zip(last.beliefs, oracle.beliefs, strict=True):
        np.testing.assert_allclose(belief.mean, m, atol=1e-8)
        np.testing.assert_allclose(covariance(belief), P, atol=1e-8)
    if maps is None:
        m, P = oracle.mixed(oracle.mu, 0)
        np.testing.assert_allclose(last.combined.mean, m, atol=1e-8)
        np.testing.assert_allclose(covariance(last.combined), P, atol=1e-8)


@pytest.mark.parametrize("build", [linear, rooted, nonlinear])
def test_it_is_the_recursion_of_the_paper(build):
    filter = jf.imm([build(i) for i in range(3)], CHAIN, INITIAL)
    check_agreement(filter, Textbook(list(MODELS), CHAIN, INITIAL))


def test_it_agrees_with_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    theirs = []
    for m, P, A, B, C in MODELS:
        one = kalman.KalmanFilter(2, 1)
        one.x, one.P, one.F, one.Q, one.H, one.R = m.copy(), P.copy(), A, B, C, R
        theirs.append(one)
    estimator = kalman.IMMEstimator(theirs, INITIAL, CHAIN)
    for y in YS:
        estimator.predict()
        estimator.update(y)
    last, _ = jf.run(jf.imm([linear(i) for i in range(3)], CHAIN, INITIAL), KEY, jnp.asarray(YS))
    np.testing.assert_allclose(last.probabilities, estimator.mu, atol=1e-10)
    np.testing.assert_allclose(last.combined.mean, estimator.x, atol=1e-8)
    np.testing.assert_allclose(last.combined.covariance, estimator.P, atol=1e-8)


def test_one_model_is_its_filter():
    last, (_, infos) = jf.run(jf.imm([linear(1)], [[1.0]], [1.0]), KEY, jnp.asarray(YS))
    single, (_, alone) = jf.run(linear(1), KEY, jnp.asarray(YS))
    np.testing.assert_allclose(infos.log_evidence, alone.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(last.combined.covariance, single.covariance, rtol=1e-12)


def test_modes_that_do_not_switch_are_averaged_by_bayes_rule():
    """Exactly, also where one mode falls 100 decades behind and then wins."""
    ys = jnp.concatenate([jnp.zeros((6, 1)), 40.0 * (-1.0) ** jnp.arange(6)[:, None]])
    filters = [linear(i, F=[np.eye(2)] * 3, Q=[1e-4 * np.eye(2), 1e4 * np.eye(2), np.eye(2)]) for i in range(3)]
    weights = jnp.log(jnp.asarray([0.5, 0.3, 0.2]))
    _, (states, infos) = jf.run(jf.imm(filters, np.eye(3), jnp.exp(weights)), KEY, ys)
    alone = jnp.stack([jf.run(filter, KEY, ys)[1][1].log_evidence for filter in filters], axis=1)
    joint = weights + jnp.cumsum(alone, axis=0)
    np.testing.assert_allclose(infos.log_evidence.sum(), jax.nn.logsumexp(joint[-1]), rtol=1e-10)
    np.testing.assert_allclose(states.log_probabilities, jax.nn.log_softmax(joint, axis=1), rtol=1e-6, atol=1e-6)


SHORT, LONG = [1, 0], [0, 1, 2]
FILL_MEAN, FILL = np.array([9.0, 8.0, 0.3]), np.diag([1.0, 1.0, 0.7])


def of_other_sizes():
    """Velocity and place; place, velocity and acceleration."""
    A = np.array([[1.0, 0.5, 0.125], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    swap = np.eye(2)[::-1]
    first = (MEANS[0], COVARIANCES[0], swap @ F[0] @ swap, Q[0], H[:, ::-1])
    second = (np.array([0.0, 1.0, 0.1]), np.diag([1.0, 2.0, 0.5]), A, np.diag([0.01, 0.02, 0.3]), np.c_[H, 0.0])
    return [first, second]


def converted(i, j, m, P):
    if i == j:
        return m, P
    if i == 1:
        return m[SHORT], P[np.ix_(SHORT, SHORT)]
    mean, spread = FILL_MEAN.copy(), FILL.copy()
    mean[SHORT], spread[np.ix_(SHORT, SHORT)] = m, P
    return mean, spread


@pytest.mark.parametrize("root", [False, True])
def test_states_of_different_size_are_mapped(root):
    kind = (lambda m, P: jf.GaussianRoot(m, jnp.linalg.cholesky(P))) if root else jf.Gaussian
    noise = np.linalg.cholesky if root else np.asarray
    arithmetic = jf.arithmetic.square_root if root else jf.arithmetic.joseph
    filters = [
        jf.kalman(
            kind(jnp.asarray(m), jnp.asarray(P)),
            A,
            jnp.asarray(noise(B)),
            C,
            jnp.asarray(noise(R)),
            arithmetic=arithmetic,
        )
        for m, P, A, B, C in of_other_sizes()
    ]
    maps = jf.mode_maps.components([SHORT, LONG], kind(jnp.asarray(FILL_MEAN), jnp.asarray(FILL)))
    chain, initial = CHAIN[:2, :2] / CHAIN[:2, :2].sum(1, keepdims=True), np.array([0.3, 0.7])
    oracle = Textbook(of_other_sizes(), chain, initial, converted)
    filter = jf.imm(filters, chain, initial, maps=maps)
    check_agreement(filter, oracle, maps)
    between = lambda i, j, belief: maps.convert(i, j, belief)
    same = jf.imm(filters, chain, initial, maps=jf.mode_maps.pairwise(between, common=1))
    last, _ = jf.run(same, KEY, jnp.asarray(YS))
    oracle.beliefs = [converted(i, 1, *belief) for i, belief in enumerate(oracle.beliefs)]
    oracle.convert = lambda i, j, m, P: (m, P)
    m, P = oracle.mixed(oracle.mu, 1)
    np.testing.assert_allclose(last.combined.mean, m, atol=1e-8)
    np.testing.assert_allclose(covariance(last.combined), P, atol=1e-8)


def test_rotations_are_mixed_where_they_are():
    """Two modes of one model are that model, whatever the probabilities; means of quaternions would be shorter."""
    space = jf.manifold.product(jf.manifold.rotation)
    belief = jf.Gaussian(jnp.array([1.0, 0.0, 0.0, 0.0]), 0.5 * jnp.eye(3))
    turn = lambda x: jf.manifold.rotation.manifold.retract(x, jnp.array([0.3, 0.1, 0.0]))
    one = jf.extended_kalman(belief, turn, 0.1 * jnp.eye(3), lambda x: x[1:], 0.05 * jnp.eye(3), manifold=space)
    ys = 0.3 * jnp.asarray(RNG.normal(size=(5, 3)))
    # Of other numbers, so that the two beliefs about one step differ.
    two = jf.extended_kalman(
        belief, turn, 1e-9 * jnp.eye(3) + 0.1 * jnp.eye(3), lambda x: x[1:], 0.05 * jnp.eye(3), manifold=space
    )
    last, (_, infos) = jf.run(jf.imm([one, two], [[0.5, 0.5], [0.1, 0.9]], [0.2, 0.8]), KEY, ys)
    single, (_, alone) = jf.run(one, KEY, ys)
    np.testing.assert_allclose(infos.log_evidence, alone.log_evidence, atol=1e-6)
    np.testing.assert_allclose(last.combined.mean, single.mean, atol=1e-6)
    np.testing.assert_allclose(last.combined.covariance, single.covariance, atol=1e-6)


def test_inputs_reach_the_chain_and_the_models():
    """A sensor that moves: its place is an input of the observation; the chain of a step is one as well."""
    places = jnp.asarray(RNG.normal(size=(len(YS), 1)))
    observe = lambda x, inputs: H @ x + inputs[1]
    filters = [
        jf.extended_kalman(gaussian(i), lambda x, *, i=i: F[i] @ x, jnp.asarray(Q[i]), observe, jnp.asarray(R))
        for i in range(3)
    ]
    filter = jf.imm(filters, lambda inputs: inputs[0], INITIAL)
    chains = jnp.broadcast_to(jnp.asarray(CHAIN), (len(YS), 3, 3))
    last, _ = jf.run(filter, KEY, YS + places, (chains, places))
    plain, _ = jf.run(jf.imm([linear(i) for i in range(3)], CHAIN, INITIAL), KEY, jnp.asarray(YS))
    np.testing.assert_allclose(last.combined.mean, plain.combined.mean, rtol=1e-9)


def test_gradients_are_those_of_finite_differences():
    """With a transition of probability zero and a mode that is impossible at first."""

    def evidence(theta):
        scaled = [jf.kalman(gaussian(i), F[i], jnp.exp(theta[0]) * Q[i], H, R * theta[1]) for i in range(3)]
        chain = jnp.asarray(CHAIN).at[1].set(jnp.array([0.3 - theta[2], 0.7, theta[2]]))
        return jf.log_evidence(jf.imm(scaled, chain, INITIAL), KEY, jnp.asarray(YS))

    theta, step = jnp.array([0.1, 1.2, 0.1]), 1e-5
    slope = jax.jit(jax.grad(evidence))(theta)
    value = jax.jit(jax.vmap(evidence))
    ahead, behind = (value(theta + sign * step * jnp.eye(3)) for sign in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6)


def test_what_no_mode_explains_leaves_the_prediction():
    filter = jf.imm([linear(i) for i in range(3)], CHAIN, INITIAL)
    predicted = jf.predict(filter, KEY, jf.init(filter, KEY))
    impossible = jf.Observation(jnp.array([1.0]), noise=jnp.array([[jnp.nan]]))
    after, info = jf.update(filter, KEY, predicted, impossible)
    assert info.log_evidence == -jnp.inf
    for got, expected in zip(jax.tree.leaves(after), jax.tree.leaves(predicted), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_moments_of_a_mixture_ignore_what_has_no_weight():
    beliefs = jf.Gaussian(jnp.array([[1.0, 3.0, jnp.nan]]), jnp.array([[[0.5, 1.5, jnp.inf]]]))
    found = jf.mixture_moments(beliefs, jnp.array([0.0, 0.0, -jnp.inf]))
    np.testing.assert_allclose([found.mean[0], found.covariance[0, 0]], [2.0, 2.0])


@pytest.mark.parametrize("combined", [jf.imm, partial(jf.switching, num_particles=3**4)], ids=["imm", "switching"])
def test_filters_in_single_precision_run_where_double_precision_is_the_default(combined):
    """The transition matrix is then in double precision, and the state stays in single precision."""

    def evidence(dtype):
        convert = partial(jnp.asarray, dtype=dtype)
        priors = [jf.Gaussian(convert(MEANS[i]), convert(COVARIANCES[i])) for i in range(3)]
        filters = [jf.kalman(priors[i], *map(convert, (F[i], Q[i], H, R))) for i in range(3)]
        return jf.log_evidence(combined(filters, CHAIN, INITIAL), KEY, convert(YS[:4]))

    assert evidence(np.float32).dtype == np.float32
    np.testing.assert_allclose(evidence(np.float32), evidence(np.float64), rtol=1e-5)
