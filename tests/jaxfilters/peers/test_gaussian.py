"""What other libraries test of their Gaussian filters, on this one, at their tolerances; each test names its source.

Models are of the same sizes, drawn anew; references are textbook recursions in numpy, where the sources have them too.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
STATE, READINGS, STEPS = 3, 2, 20


def random_model(seed, steps=STEPS):
    """A linear Gaussian model whose matrices change with time, and readings drawn from it."""
    rng = np.random.default_rng(seed)
    spd = lambda n: (lambda root: root @ root.T / n + 0.2 * np.eye(n))(rng.normal(size=(n, n)))
    model = {
        "F": rng.normal(size=(steps, STATE, STATE)) / 2,
        "Q": np.stack([spd(STATE) for _ in range(steps)]),
        "H": rng.normal(size=(steps, READINGS, STATE)),
        "R": np.stack([spd(READINGS) for _ in range(steps)]),
        "b": rng.normal(size=(steps, STATE)),
        "d": rng.normal(size=(steps, READINGS)),
    }
    return rng.normal(size=STATE), spd(STATE), model, rng.normal(size=(steps, READINGS)) * 2


def textbook(m, P, model, ys):
    """Kalman filter and Rauch-Tung-Striebel smoother: predicted, filtered and smoothed moments, and log evidence."""
    filtered, predicted, total = [], [], 0.0
    for t, y in enumerate(ys):
        F, Q, H, R, b, d = (model[name][t] for name in "FQHRbd")
        m, P = F @ m + b, F @ P @ F.T + Q
        predicted.append((m, P))
        S, e = H @ P @ H.T + R, y - H @ m - d
        K = P @ H.T @ np.linalg.inv(S)
        total -= 0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
        m, P = m + K @ e, P - K @ S @ K.T
        filtered.append((m, P))
    smoothed = [filtered[-1]]
    for t in range(len(ys) - 2, -1, -1):
        (m, P), (ahead, spread) = filtered[t], predicted[t + 1]
        G = P @ model["F"][t + 1].T @ np.linalg.inv(spread)
        smoothed.insert(0, (m + G @ (smoothed[0][0] - ahead), P + G @ (smoothed[0][1] - spread) @ G.T))
    stacked = [tuple(map(np.stack, zip(*pairs, strict=True))) for pairs in (filtered, smoothed)]
    return *stacked, total


def time_varying(m, P, arithmetic):
    """The filter whose matrices are its inputs."""
    rooted = arithmetic is jf.arithmetic.square_root
    root = jnp.linalg.cholesky if rooted else lambda covariance: covariance
    prior = (jf.GaussianRoot if rooted else jf.Gaussian)(jnp.asarray(m), root(jnp.asarray(P)))
    noise = lambda name: lambda inputs: root(inputs[name])
    taken = lambda name: lambda inputs: inputs[name]
    return jf.kalman(
        prior,
        taken("F"),
        noise("Q"),
        taken("H"),
        noise("R"),
        b=taken("b"),
        d=taken("d"),
        arithmetic=arithmetic,
    )


@pytest.mark.system
@pytest.mark.parametrize("arithmetic", [jf.arithmetic.joseph, jf.arithmetic.square_root])
def test_time_varying_filter_and_smoother_are_the_textbook(x64, arithmetic):
    """cuthbert 0.1, tests/cuthbert/gaussian/test_kalman.py: `test_offline_filter`, `test_smoother`, at 1e-10."""
    m, P, model, ys = random_model(42)
    (means, covariances), smoothed, total = textbook(m, P, model, ys)
    filter, inputs = time_varying(m, P, arithmetic), jax.tree.map(jnp.asarray, model)
    _, (beliefs, infos) = jf.run(filter, KEY, jnp.asarray(ys), inputs)
    later = jf.smoothing.rts(filter, beliefs, inputs)

    def covariance(b):
        return b.covariance if hasattr(b, "covariance") else b.root @ jnp.swapaxes(b.root, 1, 2)

    np.testing.assert_allclose(beliefs.mean, means, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(covariance(beliefs), covariances, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(infos.log_evidence.sum(), total, rtol=1e-10)
    np.testing.assert_allclose(later.mean, smoothed[0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(covariance(later), smoothed[1], rtol=1e-10, atol=1e-12)


def ensemble(m, root_P, count, transition, observe, R, **options):
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.asarray(m, float), jnp.asarray(root_P @ root_P.T, float)))
    noise = jf.StandardNormal(len(m))
    return jf.ensemble_kalman(prior, transition, observe, R, num_particles=count, noise=noise, **options)


@pytest.mark.system
@pytest.mark.optimised
def test_a_large_ensemble_is_the_kalman_filter():
    """cuthbert 0.1, tests/cuthbert/ensemble_kalman/test_enkf.py: `Test.test`, 100 000 samples, at 1e-2.

    Their model draws small covariances; ours has a standard deviation of about one, whose moments err by 4 / sqrt(N),
    four standard errors: 0.013.
    """
    m, P, model, ys = random_model(0)
    F, Q, H, R = model["F"][0], model["Q"][0], model["H"][0], model["R"][0]
    fixed = {name: np.stack([value[0]] * STEPS) for name, value in model.items() if name not in "bd"}
    fixed |= {"b": np.zeros((STEPS, STATE)), "d": np.zeros((STEPS, READINGS))}
    ys = 0.5 * ys
    (means, covariances), _, total = textbook(m, P, fixed, ys)
    root_Q = np.linalg.cholesky(Q)
    filter = ensemble(
        m, np.linalg.cholesky(P), 100_000, lambda z, x: F @ x + root_Q @ z, lambda x: H @ x, jnp.asarray(R)
    )
    keep = lambda state, info: (state.particles.mean(1), jnp.cov(state.particles), info.log_evidence)
    _, (found, spreads, evidence) = jf.run(filter, KEY, jnp.asarray(ys, jnp.float32), collect=keep)
    np.testing.assert_allclose(found, means, atol=1.3e-2, rtol=1e-2)
    np.testing.assert_allclose(spreads, covariances, atol=1.3e-2, rtol=1e-2)
    np.testing.assert_allclose(evidence.sum(), total, rtol=1e-2)


def test_an_ensemble_without_motion_and_readings_stays():
    """cuthbert 0.1, test_enkf.py: `test_filter_noop`; bit for bit up to the rounding of one subtraction."""
    filter = ensemble(np.zeros(4), np.eye(4), 50, lambda z, x: x, lambda x: x[:2], jnp.eye(2))
    before = jf.init(filter, KEY)
    after, info = jf.step(filter, KEY, before, jnp.full(2, jnp.nan))
    np.testing.assert_allclose(after.particles, before.particles, atol=1e-6)
    assert info.log_evidence == 0


def test_an_ensemble_has_two_samples():
    """cuthbert 0.1, test_enkf.py: `test_build_filter_requires_at_least_two_particles`."""
    with pytest.raises(ValueError, match="at least 2"):
        ensemble(np.zeros(1), np.eye(1), 1, lambda z, x: x, lambda x: x, jnp.eye(1))


@pytest.mark.system
def test_the_gradient_in_the_scale_of_a_localisation_is_that_of_finite_differences(x64):
    """cuthbert 0.1, test_enkf.py: `test_gaussian_taper_log_likelihood_gradient`, 6 samples of 20 states, at 1e-5."""
    points = jnp.arange(20.0)[:, None]
    F = 0.82 * np.eye(20) + 0.08 * (np.eye(20, k=1) + np.eye(20, k=-1))
    ys = jnp.asarray(np.sin(np.arange(0, 20, 2) / 3) * np.array([0.9, 0.8, 0.7, 0.6])[:, None])
    gaussian = lambda distance, scale: jnp.exp(-0.5 * jnp.square(distance / scale))

    @jax.jit
    def evidence(log_scale):
        factors = jf.ensemble.localization(points, points[::2], jnp.exp(log_scale), taper=gaussian)
        filter = ensemble(
            0.15 * np.sin(np.arange(20) / 3),
            0.45 * np.eye(20),
            6,
            lambda z, x: F @ x + 0.08 * z,
            lambda x: x[::2],
            0.04 * jnp.eye(10),
            localization=factors,
            analysis=jf.ensemble.serial,
        )
        return jf.log_evidence(filter, KEY, ys)

    at, h = jnp.log(3.0), 1e-4
    slope = jax.grad(evidence)(at)
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, (evidence(at + h) - evidence(at - h)) / (2 * h), rtol=1e-5, atol=1e-7)


def test_an_ensemble_with_nonlinear_motion_has_a_gradient():
    """cuthbert 0.1, test_enkf.py: `test_nonlinear_dynamics`."""

    def evidence(m):
        prior = jf.priors.gaussian_prior(jf.Gaussian(m, jnp.eye(3)))
        filter = jf.ensemble_kalman(prior, lambda key, x: jnp.tanh(x), lambda x: x[:2], jnp.eye(2), num_particles=100)
        return jf.log_evidence(filter, KEY, jnp.ones((5, 2)))

    assert np.isfinite(jax.grad(evidence)(jnp.array([0.5, -0.5, 1.0]))).all()


def test_gaspari_cohn_has_the_published_values(x64):
    """cuthbert 0.1, tests/cuthbertlib/ensemble_kalman/test_localization.py: `test_gaspari_cohn`, at 1e-14."""
    found = jf.ensemble.gaspari_cohn(jnp.array([0.0, 1.0, 1.5, 2.0, 3.0]), 2.0)
    np.testing.assert_allclose(found, [1.0, 5 / 24, 19 / 1152, 0.0, 0.0], rtol=1e-14, atol=1e-14)


def constant_velocity():
    """The model of dynamax's test: a place in the plane, Q of 0.001, readings of unit noise."""
    m, P = np.array([8.0, 10.0, 1.0, 0.0]), 0.1 * np.eye(4)
    F, H = np.eye(4) + np.eye(4, k=2), np.eye(2, 4)
    ys = np.array([8.0, 10.0]) + np.arange(1, 6)[:, None] * np.array([1.0, 0.0]) + np.array([[0.3, -0.8]])
    return m, P, F, 0.001 * np.eye(4), H, np.eye(2), ys


@pytest.mark.system
def test_a_linear_model_has_the_joint_posterior():
    """dynamax 1.0, linear_gaussian_ssm/inference_test.py: `test_kalman`, against a dense posterior, there at 1e-1.

    And nonlinear_gaussian_ssm/extended_kalman_filter_test.py: an extended and an unscented filter of it are the same.
    """
    m, P, F, Q, H, R, ys = constant_velocity()
    steps, n = len(ys), len(m)
    # All states as one Gaussian, conditioned on all readings.
    mean, blocks, spread = [], [], P
    for t in range(steps):
        spread = F @ spread @ F.T + Q
        mean.append(np.linalg.matrix_power(F, t + 1) @ m)
        blocks.append(spread)
    joint = np.block(
        [
            [
                np.linalg.matrix_power(F, max(i - j, 0))
                @ blocks[min(i, j)]
                @ np.linalg.matrix_power(F, max(j - i, 0)).T
                for j in range(steps)
            ]
            for i in range(steps)
        ]
    )
    observed = np.kron(np.eye(steps), H)
    S, e = observed @ joint @ observed.T + np.kron(np.eye(steps), R), ys.ravel() - observed @ np.concatenate(mean)
    K = joint @ observed.T @ np.linalg.inv(S)
    expected = (np.concatenate(mean) + K @ e).reshape(steps, n)
    spreads = (joint - K @ S @ K.T).reshape(steps, n, steps, n)[np.arange(steps), :, np.arange(steps)]
    total = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
    prior = jf.Gaussian(jnp.asarray(m, jnp.float32), jnp.asarray(P, jnp.float32))
    arrays = [jnp.asarray(a, jnp.float32) for a in (F, Q, H, R)]
    move, observe = lambda x: arrays[0] @ x, lambda x: arrays[2] @ x
    filters = (
        jf.kalman(prior, *arrays),
        jf.extended_kalman(prior, move, arrays[1], observe, arrays[3]),
        jf.unscented_kalman(prior, move, arrays[1], observe, arrays[3]),
    )
    for filter in filters:
        found, infos = jf.smoothing.filter_and_smooth(filter, KEY, jnp.asarray(ys, jnp.float32))
        np.testing.assert_allclose(found.mean, expected, atol=1e-4)
        np.testing.assert_allclose(found.covariance, spreads, atol=1e-5)
        np.testing.assert_allclose(infos.log_evidence.sum(), total, atol=1e-3)


def wave(x):
    return np.sin(x) * 0.8 + 0.3 * x if isinstance(x, np.ndarray) else jnp.sin(x) * 0.8 + 0.3 * x


def bend(x):
    return x**2 / 4 + x


@pytest.mark.system
@pytest.mark.parametrize("kind", ["extended", "unscented"])
def test_nonlinear_filters_are_the_textbook(x64, kind):
    """dynamax 1.0, nonlinear_gaussian_ssm: inference_ekf_test.py and inference_ukf_test.py `test_ukf_nonlinear`.

    There at 1e-1 against recursions of Sarkka's book, with alpha^2 = 3, beta = 2, kappa = 1; here at 1e-9.
    """
    rng = np.random.default_rng(5)
    n, Q, R = 2, 0.2 * np.eye(2), 0.5 * np.eye(2)
    m, P, total, ys = np.array([0.5, -0.3]), np.eye(2), 0.0, rng.normal(size=(15, 2))
    alpha, beta, kappa = np.sqrt(3.0), 2.0, 1.0
    scale = alpha**2 * (n + kappa)
    weights = np.full(2 * n + 1, 0.5 / scale)
    weights[0] = 1 - n / scale
    spread_weights = weights.copy()
    spread_weights[0] += 1 - alpha**2 + beta

    def moments(f, slope, m, P):
        if kind == "extended":
            J = np.diag(slope(m))
            return f(m), J @ P @ J.T, P @ J.T
        L = np.linalg.cholesky(P) * np.sqrt(scale)
        points = np.concatenate([m[None], m + L.T, m - L.T])
        values = f(points)
        mean = weights @ values
        off = values - mean
        return mean, (spread_weights * off.T) @ off, (spread_weights * (points - m).T) @ off

    for y in ys:
        m, P, _ = moments(wave, lambda x: 0.8 * np.cos(x) + 0.3, m, P)
        P = P + Q
        mean, S, cross = moments(bend, lambda x: x / 2 + 1, m, P)
        S, e = S + R, y - mean
        K = cross @ np.linalg.inv(S)
        total -= 0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])
        m, P = m + K @ e, P - K @ S @ K.T
    prior = jf.Gaussian(jnp.array([0.5, -0.3]), jnp.eye(2))
    parts = (prior, wave, jnp.asarray(Q), bend, jnp.asarray(R))
    if kind == "extended":
        filter = jf.extended_kalman(*parts)
    else:
        filter = jf.unscented_kalman(*parts, alpha=float(alpha), beta=beta, kappa=kappa)
    last, (_, infos) = jf.run(filter, KEY, jnp.asarray(ys))
    np.testing.assert_allclose(last.mean, m, atol=1e-9)
    np.testing.assert_allclose(last.covariance, P, atol=1e-9)
    np.testing.assert_allclose(infos.log_evidence.sum(), total, atol=1e-8)


def test_constant_acceleration_in_the_plane_has_the_published_noise(x64):
    """filterpy 1.4.5, common/tests/test_discretization.py: `test_linear_ode`, at 1e-17."""
    q, dt = 0.2, 0.5
    A, L = np.eye(6, k=2), np.sqrt(q) * np.eye(6, 2, -4)
    for F, Q in (
        jf.motion.discretize(A, L, dt),
        jf.motion.constant_acceleration(jnp.float64(q), dims=2).discretize(jnp.float64(dt)),
    ):
        np.testing.assert_allclose(F[0], [1, 0, dt, 0, 0.5 * dt**2, 0], atol=1e-17)
        np.testing.assert_allclose(Q[0], [dt**5 * q / 20, 0, dt**4 * q / 8, 0, dt**3 * q / 6, 0], atol=1e-17)


def test_the_oscillator_of_brown_is_discretised_as_in_the_book():
    """filterpy 1.4.5, common/discretization.py: the example of `van_loan_discretization`, y'' + y = 2 u."""
    F, Q = jf.motion.discretize(jnp.array([[0.0, 1.0], [-1.0, 0.0]]), jnp.array([[0.0], [2.0]]), 0.1)
    np.testing.assert_allclose(F, [[0.99500417, 0.09983342], [-0.09983342, 0.99500417]], atol=1e-7)
    np.testing.assert_allclose(Q, [[0.00133067, 0.01993342], [0.01993342, 0.39866933]], atol=1e-7)


def test_kinematic_models_are_those_of_filterpy(x64):
    """filterpy: `Q_continuous_white_noise` and `kinematic_state_transition`, derivatives of all dimensions together."""
    common = pytest.importorskip("filterpy.common")
    for order in (1, 2, 3):
        motion = jf.motion.integrated_wiener(order, jnp.float64(0.7), dims=3)
        F, Q = motion.discretize(jnp.float64(0.3))
        white = common.Q_continuous_white_noise(order + 1, 0.3, 0.7, block_size=3, order_by_dim=False)
        np.testing.assert_allclose(Q, white, rtol=1e-14, atol=1e-17)
        np.testing.assert_allclose(F, np.kron(common.kinematic_state_transition(order, 0.3), np.eye(3)), atol=1e-15)
