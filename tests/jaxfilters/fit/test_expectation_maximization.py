"""Expectation-maximisation against one iteration written out over the joint Gaussian of all states and observations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
RNG = np.random.default_rng(4)
N, M, T, S = 2, 3, 6, 3
F, H = 0.7 * RNG.normal(size=(N, N)), RNG.normal(size=(M, N))
B, D, MEAN = RNG.normal(size=N), RNG.normal(size=M), RNG.normal(size=N)
P, Q, R = (root @ root.T for root in (RNG.normal(size=(size, size)) for size in (N, N, M)))
YS = RNG.normal(size=(T, M, S)) + 2
READ = RNG.random((T, M, S)) < 0.7
READ[2, :, 0] = False
READ[0] = True
LENGTHS = np.array([T, T - 2, T])
INSIDE = np.arange(T)[:, None] < LENGTHS
ALL = ("F", "Q", "H", "R", "b", "d", "mean", "covariance")


def of_joint(y, read):
    """Mean and covariance of x_0, x_1, y_1, x_2, y_2, ... given what was read of one sequence, and its evidence."""
    frames, size = len(y), N + len(y) * (N + M)
    # Every state and observation is an affine function of the noises, with these columns.
    A, c, noise = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    A[:N, :N], c[:N], noise[:N, :N] = np.eye(N), MEAN, P
    for t in range(frames):
        x, before = N + t * (N + M), max(0, (t - 1) * (N + M) + N) if t else 0
        A[x : x + N], c[x : x + N] = F @ A[before : before + N], F @ c[before : before + N] + B
        A[x : x + N, x : x + N] += np.eye(N)
        A[x + N : x + N + M], c[x + N : x + N + M] = H @ A[x : x + N], H @ c[x : x + N] + D
        A[x + N : x + N + M, x + N : x + N + M] += np.eye(M)
        noise[x : x + N, x : x + N], noise[x + N : x + N + M, x + N : x + N + M] = Q, R
    C = A @ noise @ A.T
    known = np.concatenate([np.zeros(N, bool), *[np.concatenate([np.zeros(N, bool), row]) for row in read]])
    C_known, surprise = C[np.ix_(known, known)], y[read] - c[known]
    gain = C[:, known] @ np.linalg.inv(C_known)
    evidence = -0.5 * (surprise @ np.linalg.solve(C_known, surprise) + np.linalg.slogdet(2 * np.pi * C_known)[1])
    return c + gain @ surprise, C - gain @ C[known], evidence


def one_iteration():
    """Log evidence, and the parameters after one iteration from the regressions of the textbook."""
    steps, readings, starts, total = [], [], [], 0.0
    for s in range(S):
        y, read = YS[: LENGTHS[s], :, s], READ[: LENGTHS[s], :, s]
        mean, C, evidence = of_joint(y, read)
        second, total = C + np.outer(mean, mean), total + evidence
        starts.append((mean[:N], second[:N, :N]))
        at = [slice(0, N)] + [slice(N + t * (N + M), 2 * N + t * (N + M)) for t in range(len(y))]
        for t in range(len(y)):
            x, before, target = at[t + 1], at[t], slice(at[t + 1].stop, at[t + 1].stop + M)
            steps.append(pair(mean, second, before, x))
            if read[t].any():
                readings.append(pair(mean, second, x, target))
    mean = np.mean([m for m, _ in starts], axis=0)
    F_new, b, Q_new = regression(steps)
    H_new, d, R_new = regression(readings)
    covariance = np.mean([second for _, second in starts], axis=0) - np.outer(mean, mean)
    return total, dict(F=F_new, b=b, Q=Q_new, H=H_new, d=d, R=R_new, mean=mean, covariance=covariance)


def pair(mean, second, x, target):
    """Second moments of z = (x, 1) and of the target."""
    one = np.ones((1, 1))
    zz = np.block([[second[x, x], mean[x, None]], [mean[None, x], one]])
    return zz, np.hstack([second[target, x], mean[target, None]]), second[target, target]


def regression(pairs):
    zz, tz, tt = (sum(each) for each in zip(*pairs, strict=True))
    W = tz @ np.linalg.inv(zz)
    return W[:, :-1], W[:, -1], (tt - W @ tz.T) / len(pairs)


def build(arithmetic=jf.arithmetic.joseph):
    arrays = (jnp.asarray(each) for each in (F, Q, H, R))
    if arithmetic is jf.arithmetic.square_root:
        A, q, C, r = arrays
        prior = jf.GaussianRoot(jnp.asarray(MEAN), jnp.linalg.cholesky(P))
        arrays = (A, jnp.hstack([jnp.linalg.cholesky(q), jnp.zeros((N, 1))]), C, jnp.linalg.cholesky(r))
    else:
        prior = jf.Gaussian(jnp.asarray(MEAN), jnp.asarray(P))
    return jf.kalman(prior, *arrays, b=jnp.asarray(B), d=jnp.asarray(D), arithmetic=arithmetic)


def parameters(fitted):
    """Parameters of a Kalman filter by name, noises as covariances."""
    model = fitted.params
    square = lambda noise: noise @ noise.T if isinstance(model.prior, jf.GaussianRoot) else noise
    prior = model.prior
    covariance = square(prior.root) if isinstance(prior, jf.GaussianRoot) else prior.covariance
    found = {name: getattr(model, name) for name in ("F", "H", "b", "d")}
    return found | dict(Q=square(model.Q), R=square(model.R), mean=prior.mean, covariance=covariance)


def observations():
    return jnp.where(READ & INSIDE[:, None], YS, jnp.nan)


@pytest.mark.system
@pytest.mark.parametrize("name", ["joseph", "square_root"])
def test_one_iteration_is_that_of_the_joint_gaussian(x64, name):
    evidence, expected = one_iteration()
    start = build(getattr(jf.arithmetic, name))
    found = jf.fit.em(start, KEY, observations(), lengths=LENGTHS, max_iterations=1)
    np.testing.assert_allclose(found.log_evidence, [evidence], rtol=1e-10)
    for name, value in parameters(found.fitted).items():
        np.testing.assert_allclose(value, expected[name], atol=1e-9, err_msg=name)


@pytest.mark.system
def test_what_is_not_free_stays_and_the_rest_is_the_maximum_given_it(x64):
    _, expected = one_iteration()
    free = ("F", "R", "covariance")
    found = parameters(jf.fit.em(build(), KEY, observations(), lengths=LENGTHS, free=free, max_iterations=1).fitted)
    for name, value in parameters(build()).items():
        assert np.allclose(found[name], value) == (name not in free), name
    # Given b, not together with it, F is another one.
    assert not np.allclose(found["F"], expected["F"])


@pytest.mark.system
@pytest.mark.optimised
def test_the_evidence_rises_to_a_point_without_slope(x64):
    """By Fisher's identity the gradient of the log evidence is that of the surrogate, which is zero at a maximum."""
    x, ys = 0.0, []
    for noise in RNG.normal(size=(80, 2)):
        x = 0.9 * x + 0.5 * noise[0]
        ys.append([x + 0.4 * noise[1]])
    ys = jnp.asarray(ys)
    one = jnp.eye(1)
    start = jf.kalman(jf.Gaussian(jnp.zeros(1), one), 0.5 * one, one, one, one)
    found = jf.fit.em(start, KEY, ys[..., None], free=("F", "Q", "R"), max_iterations=1000, tolerance=1e-13)
    history = np.asarray(found.log_evidence)
    assert (np.diff(history) > -1e-9).all()
    assert history[-1] > history[0] + 5
    slope = jax.jit(jax.grad(lambda filter: jf.log_evidence(filter, KEY, ys)))
    before, after = slope(start).params, slope(found.fitted).params
    for name in ("F", "Q", "R"):
        assert abs(getattr(after, name)[0, 0]) < 1e-3 * abs(getattr(before, name)[0, 0]), name


@pytest.mark.system
def test_sigma_points_are_exact_for_linear_functions(x64):
    ys = jnp.where((READ[:, :1] & INSIDE[:, None]), YS, jnp.nan)
    expected = jf.fit.em(build(), KEY, ys, lengths=LENGTHS, max_iterations=2)
    affine = jax.tree_util.Partial(lambda A, c, x, u: A @ x + c, jnp.asarray(F), jnp.asarray(B))
    reading = jax.tree_util.Partial(lambda A, c, x: A @ x + c, jnp.asarray(H), jnp.asarray(D))
    filter = jf.cubature_kalman(build().params.prior, affine, jnp.asarray(Q), reading, jnp.asarray(R))
    free = ("transition", "process_noise", "observe", "observation_noise", "mean", "covariance")
    found = jf.fit.em(filter, KEY, ys, lengths=LENGTHS, free=free, max_iterations=2)
    np.testing.assert_allclose(found.log_evidence, expected.log_evidence, rtol=1e-10)
    model, named = found.fitted.params, parameters(expected.fitted)
    values = dict(zip("FbHd", (*model.transition.args, *model.observe.callback.args), strict=True))
    values |= dict(Q=model.process_noise, R=model.observation_noise, mean=model.prior.mean)
    for name, value in values.items():
        np.testing.assert_allclose(value, named[name], atol=1e-8, err_msg=name)


@pytest.mark.system
def test_a_hidden_markov_model_is_trained_by_baum_welch():
    codes = jf.hmm.Codes(jnp.log(jnp.array([[0.7, 0.3], [0.4, 0.6]])))
    model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], codes)
    observations, lengths = jf.hmm.pad([jnp.array([0, 0, 0, 1, 1, 1]), jnp.array([0, 0, 1, 1])])
    found = jf.fit.em(model, KEY, observations, lengths=lengths, max_iterations=5)
    expected = jf.hmm.baum_welch(model, observations, lengths, max_iterations=5)
    np.testing.assert_array_equal(found.log_evidence, expected.objective)
    np.testing.assert_array_equal(found.fitted.log_transition, expected.model.log_transition)
