"""Models that change with time, and noise that depends on the state or is not additive, against independent numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
RNG = np.random.default_rng(5)
T = 6
DTS = RNG.uniform(0.2, 1.5, T)
COMMANDS = RNG.normal(size=T)
YS = RNG.normal(size=(T, 1))
F = lambda u: jnp.array([[1.0, u["dt"]], [0.0, 1.0 - 0.1 * u["dt"]]])
Q = lambda u: u["dt"] * jnp.array([[0.3, 0.1], [0.1, 0.4]])
H = lambda u: jnp.stack([jnp.ones(()), jnp.sin(u["dt"])])[None]
R = lambda u: (0.2 + u["dt"])[None, None]
DRIVE = lambda u: jnp.array([0.0, 1.0]) * u["command"]
OFFSET = lambda u: u["command"][None] ** 2
INPUTS = {"dt": DTS, "command": COMMANDS}


def textbook():
    """Kalman filter and Rauch-Tung-Striebel smoother of the same matrices in float64 numpy."""
    m, P, total, stored = np.array([1.0, -1.0]), np.diag([2.0, 0.5]), 0.0, []
    for t, y in enumerate(YS):
        A, B, C, D, b, d = (
            np.asarray(part({"dt": DTS[t], "command": COMMANDS[t]}), float) for part in (F, Q, H, R, DRIVE, OFFSET)
        )
        ahead = A @ m + b, A @ P @ A.T + B
        S = C @ ahead[1] @ C.T + D
        innovation, K = y - C @ ahead[0] - d, ahead[1] @ C.T @ np.linalg.inv(S)
        total += float(-0.5 * innovation @ np.linalg.solve(S, innovation) - 0.5 * np.log(2 * np.pi * S[0, 0]))
        m, P = ahead[0] + K @ innovation, ahead[1] - K @ S @ K.T
        stored.append((A, ahead, m, P))
    means, (_, _, ms, Ps) = [m], stored[-1]
    for (_, _, m, P), (A, ahead, _, _) in zip(stored[-2::-1], stored[:0:-1], strict=True):
        G = P @ A.T @ np.linalg.inv(ahead[1])
        ms, Ps = m + G @ (ms - ahead[0]), P + G @ (Ps - ahead[1]) @ G.T
        means.append(ms)
    return np.array([m for *_, m, _ in stored]), Ps, total, np.array(means[::-1])


@pytest.mark.system
@pytest.mark.parametrize("kind", ["joseph", "square_root"])
def test_a_linear_model_that_changes_with_its_inputs_is_that_of_the_textbook(x64, kind):
    prior, options, of = jf.Gaussian(jnp.array([1.0, -1.0]), jnp.diag(jnp.array([2.0, 0.5]))), {}, lambda part: part
    if kind == "square_root":
        prior = jf.GaussianRoot(prior.mean, jnp.sqrt(prior.covariance))
        options, of = {"arithmetic": jf.arithmetic.square_root}, lambda part: lambda u: jnp.linalg.cholesky(part(u))
    filter = jf.kalman(prior, F, of(Q), H, of(R), b=DRIVE, d=OFFSET, **options)
    beliefs, infos = jf.smoothing.filter_and_smooth(filter, KEY, jnp.asarray(YS), INPUTS)
    means, first, total, smoothed = textbook()
    np.testing.assert_allclose(infos.log_evidence.sum(), total, rtol=1e-10)
    np.testing.assert_allclose(beliefs.mean, smoothed, rtol=0, atol=1e-10)
    covariance = beliefs.covariance if kind == "joseph" else beliefs.root @ beliefs.root.swapaxes(1, 2)
    np.testing.assert_allclose(covariance[0], first, rtol=0, atol=1e-10)

    nonlinear = jf.extended_kalman(
        prior, lambda x, u: F(u) @ x + DRIVE(u), of(Q), lambda x, u: H(u) @ x + OFFSET(u), of(R), **options
    )
    _, (found, _) = jf.run(nonlinear, KEY, jnp.asarray(YS), INPUTS)
    np.testing.assert_allclose(found.mean, means, rtol=0, atol=1e-10)


def pull(x, noise, u):
    """A transition into which the noise enters nonlinearly."""
    return jnp.array([x[0] + u * x[1] * (1 + noise[0]), jnp.sin(x[1] + noise[1]) + 0.1 * noise[0] ** 2])


def sight(x, noise):
    return jnp.array([jnp.exp(0.3 * noise[0]) * x[0], x[0] * x[1] + noise[0]])


NOISE_Q, NOISE_R = np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[0.3]])
MEAN, COVARIANCE = np.array([0.7, 0.4]), np.array([[0.3, 0.1], [0.1, 0.2]])


def transformed(f, m, P, alpha=1.0, beta=2.0, kappa=0.0):
    """Mean, covariance and cross-covariance of f(x) by the scaled unscented transform (Wan and van der Merwe 2000)."""
    n = len(m)
    spread = alpha**2 * (n + kappa)
    L = np.linalg.cholesky(P)
    points = [m, *(m + np.sqrt(spread) * L.T), *(m - np.sqrt(spread) * L.T)]
    w = np.full(2 * n + 1, 0.5 / spread)
    w[0] = 1 - n / spread
    wc = w.copy()
    wc[0] += 1 - alpha**2 + beta
    values = np.array([np.asarray(f(point)) for point in points])
    mean = w @ values
    return mean, (wc * (values - mean).T) @ (values - mean), (wc * (np.array(points) - m).T) @ (values - mean)


def augmented_unscented(u, y):
    """One step of the unscented filter whose state is augmented by the noise (Särkkä and Svensson 2023, alg. 8.16)."""
    join = lambda P, S: np.block([[P, np.zeros((2, len(S)))], [np.zeros((len(S), 2)), S]])
    joint = np.concatenate([MEAN, np.zeros(2)])
    m, P, _ = transformed(lambda z: pull(z[:2], z[2:], u), joint, join(COVARIANCE, NOISE_Q))
    y_hat, S, C = transformed(lambda z: sight(z[:2], z[2:]), np.append(m, 0.0), join(P, NOISE_R))
    K = C[:2] @ np.linalg.inv(S)
    return m + K @ (y - y_hat), P - K @ S @ K.T


@pytest.mark.parametrize("kind", ["joseph", pytest.param("square_root", marks=pytest.mark.system)])
def test_noise_that_is_not_additive_is_a_part_of_the_augmented_state(x64, kind):
    y = np.array([0.9, 0.2])
    prior, options, of = jf.Gaussian(jnp.asarray(MEAN), jnp.asarray(COVARIANCE)), {}, jnp.asarray
    if kind == "square_root":
        prior, of = jf.GaussianRoot(prior.mean, jnp.linalg.cholesky(prior.covariance)), jnp.linalg.cholesky
        options = {"arithmetic": jf.arithmetic.square_root}
    filter = jf.unscented_kalman(
        prior, jf.NonAdditiveNoise(pull), of(NOISE_Q), jf.NonAdditiveNoise(sight), of(NOISE_R), **options
    )
    belief, info = jf.step(filter, KEY, jf.init(filter, KEY), jnp.asarray(y), 0.5)
    mean, P = augmented_unscented(0.5, y)
    covariance = belief.covariance if kind == "joseph" else belief.root @ belief.root.T
    np.testing.assert_allclose(belief.mean, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(covariance, P, rtol=0, atol=1e-10)
    assert np.isfinite(info.log_evidence)


@pytest.mark.parametrize(
    "linearize",
    [
        jf.linearize.taylor,
        *(pytest.param(one, marks=pytest.mark.system) for one in (jf.linearize.cubature, jf.linearize.second_order)),
    ],
)
def test_linear_noise_is_exact_whichever_way_it_is_written(x64, linearize):
    """`F x + G w` with w ~ N(0, W) is additive noise of covariance G W G^T, in the filter and in the smoother."""
    A, C = jnp.array([[1.0, 0.4], [-0.2, 0.9]]), jnp.array([[1.0, 0.3]])
    G, g = jnp.array([[0.5], [1.0]]), jnp.array([[2.0, 1.0]])
    W, V = jnp.array([[0.4]]), jnp.array([[0.2, 0.1], [0.1, 0.3]])
    prior = jf.Gaussian(jnp.asarray(MEAN), jnp.asarray(COVARIANCE))
    written = jf.extended_kalman(
        prior,
        jf.NonAdditiveNoise(lambda x, w: A @ x + G @ w),
        W,
        jf.NonAdditiveNoise(lambda x, v: C @ x + g @ v),
        V,
        linearize=linearize,
    )
    ys = jf.Observation(jnp.asarray(YS).at[2].set(jnp.nan), jnp.ones((T, 1), bool), jnp.tile(1.5 * V, (T, 1, 1)))
    found, infos = jf.smoothing.filter_and_smooth(written, KEY, ys)
    additive = jf.kalman(prior, A, G @ W @ G.T, C, 1.5 * g @ V @ g.T)
    wanted, expected = jf.smoothing.filter_and_smooth(additive, KEY, ys.y)
    for one, other in zip(jax.tree.leaves((found, infos)), jax.tree.leaves((wanted, expected)), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11)


def on_a_grid(m, variance, y):
    """Moments of x and y jointly, by quadrature over x: the best linear update, in one dimension."""
    x, w = np.polynomial.hermite_e.hermegauss(30)
    x, w = m + np.sqrt(variance) * x, w / w.sum()
    h, r = x + 0.2 * x**2, 0.1 + 0.3 * x**2
    y_hat = w @ h
    S, C = w @ (h - y_hat) ** 2 + w @ r, w @ ((x - m) * (h - y_hat))
    return m + C / S * (y - y_hat), variance - C**2 / S


@pytest.mark.parametrize("kind", ["unscented", pytest.param("square_root", marks=pytest.mark.system)])
def test_noise_that_depends_on_the_state_enters_by_its_expected_variance(x64, kind):
    """Polynomials of degree two, whose moments up to the variance of h are exact on three points in one dimension.

    With beta = 2 the unscented rule has the exact variance of a quadratic function.
    """
    root = kind == "square_root"
    variance = lambda value: jnp.sqrt(value) if root else value
    prior = (jf.GaussianRoot if root else jf.Gaussian)(jnp.array([0.6]), variance(jnp.array([[0.5]])))
    filter = jf.unscented_kalman(
        prior,
        lambda x: x,
        lambda x, u: variance((u + 0.1 * x**2)[None]),
        lambda x: x + 0.2 * x**2,
        lambda x, u: variance((0.1 + 0.3 * x**2)[None]),
        arithmetic=jf.arithmetic.square_root if root else jf.arithmetic.joseph,
    )
    belief, _ = jf.step(filter, KEY, jf.init(filter, KEY), jnp.array([1.4]), 0.05)
    ahead = 0.5 + 0.05 + 0.1 * (0.6**2 + 0.5)
    mean, after = on_a_grid(0.6, ahead, 1.4)
    np.testing.assert_allclose(belief.mean[0], mean, rtol=1e-9)
    np.testing.assert_allclose(belief.root[0, 0] ** 2 if root else belief.covariance[0, 0], after, rtol=1e-9)


def test_the_extended_filter_takes_the_noise_at_the_mean(x64):
    prior = jf.Gaussian(jnp.array([0.6]), jnp.array([[0.5]]))
    noise = lambda x, u: (0.1 + 0.3 * x**2)[None]
    of_state = jf.extended_kalman(prior, jnp.sin, noise, lambda x: x, noise)
    ahead, (before, after) = np.sin(0.6), (0.1 + 0.3 * v**2 for v in (0.6, np.sin(0.6)))
    belief, _ = jf.step(of_state, KEY, prior, jnp.array([0.3]))
    P = np.cos(0.6) ** 2 * 0.5 + before
    np.testing.assert_allclose(belief.mean[0], ahead + P / (P + after) * (0.3 - ahead), rtol=1e-12)


@pytest.mark.system
def test_gradients_reach_the_parameters_of_every_kind_of_noise(x64):
    ys = jnp.asarray(YS)

    def log_evidence(theta):
        prior = jf.Gaussian(jnp.array([0.6]), jnp.array([[0.5]]))
        driven = jf.NonAdditiveNoise(lambda x, w: jnp.sin(x) + theta * x * w)
        filter = jf.cubature_kalman(prior, driven, jnp.eye(1), lambda x: x, lambda x, u: (theta**2 + u * x**2)[None])
        return jf.log_evidence(filter, KEY, ys, jnp.asarray(DTS))

    value, slope = jax.value_and_grad(log_evidence)(0.7)
    difference = (log_evidence(0.7 + 1e-6) - log_evidence(0.7 - 1e-6)) / 2e-6
    assert np.isfinite(value)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_lasting_constraints_accept_noises_whose_values_are_not_known():
    """Whether a row moves can be verified for constant matrices only; here it is the caller's duty."""
    prior = jf.Gaussian(jnp.ones(2), jnp.eye(2))
    rows = jf.constraints.linear_constraints([[1.0, 0.0]], [0.0], [jnp.inf])
    rule = jf.EPConstraints(rows, jnp.array([True]))
    driven = jf.NonAdditiveNoise(lambda x, w: x.at[1].add(w[0]))
    for transition, noise in ((lambda x: x, lambda x, u: jnp.eye(2)), (driven, jnp.eye(2)), (driven, lambda u: u)):
        inner = jf.extended_kalman(prior, transition, noise, lambda x: x, jnp.eye(2))
        assert isinstance(jf.constrained(inner, rule), jf.Filter)
