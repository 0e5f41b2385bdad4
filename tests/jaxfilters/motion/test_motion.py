"""Models of motion against matrix exponentials and quadrature in float64, Gaussian processes and one another."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import jaxfilters as jf

MOTION = jf.motion
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)
RATE, DENSITY, TIME, STD = 1.3, 0.4, 2.0, 3.0


def exact(A, L, dt, pieces=8):
    """F and Q by `scipy.linalg.expm` and Gauss-Legendre quadrature: 320 points, exact to rounding for these models."""
    A, L = np.asarray(A, float), np.asarray(L, float)
    h = dt / pieces
    inside = [scipy.linalg.expm(A * 0.5 * h * (1 + node)) @ L for node in NODES]
    short = sum(0.5 * h * weight * G @ G.T for weight, G in zip(WEIGHTS, inside, strict=True))
    F, Q = scipy.linalg.expm(A * h), np.zeros_like(A)
    for _ in range(pieces):
        Q = F @ Q @ F.T + short
    return np.linalg.matrix_power(F, pieces), Q


def chain(order, corner=0.0):
    A = np.eye(order + 1, k=1)
    A[-1, -1] = corner
    return A


def noise_on_last(n, density):
    return np.sqrt(density) * np.eye(n)[:, -1:]


def turning():
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2, 3], A[3, 2] = -RATE, RATE
    return A, math.sqrt(DENSITY) * np.eye(4)[:, 2:]


def matern_matrices(order):
    """As in Hartikainen and Sarkka 2010, equations 12 to 14."""
    rate = math.sqrt(2 * order + 1) / TIME
    A = np.eye(order + 1, k=1)
    A[-1] = [-math.comb(order + 1, k) * rate ** (order + 1 - k) for k in range(order + 1)]
    density = STD**2 * math.factorial(order) ** 2 * (2 * rate) ** (2 * order + 1) / math.factorial(2 * order)
    return A, noise_on_last(order + 1, density)


LINEAR = {
    "random walk": (MOTION.integrated_wiener(0, DENSITY), chain(0), noise_on_last(1, DENSITY)),
    "constant velocity": (MOTION.constant_velocity(DENSITY), chain(1), noise_on_last(2, DENSITY)),
    "constant acceleration": (MOTION.constant_acceleration(DENSITY), chain(2), noise_on_last(3, DENSITY)),
    "order 3": (MOTION.integrated_wiener(3, DENSITY), chain(3), noise_on_last(4, DENSITY)),
    "ornstein_uhlenbeck": (
        MOTION.ornstein_uhlenbeck(TIME, STD),
        chain(0, -1 / TIME),
        noise_on_last(1, 2 * STD**2 / TIME),
    ),
    "integrated ornstein_uhlenbeck": (
        MOTION.integrated_ornstein_uhlenbeck(TIME, STD),
        chain(1, -1 / TIME),
        noise_on_last(2, 2 * STD**2 / TIME),
    ),
    "singer": (MOTION.singer(TIME, STD), chain(2, -1 / TIME), noise_on_last(3, 2 * STD**2 / TIME)),
    "matern 1/2": (MOTION.matern(0.5, TIME, STD), *matern_matrices(0)),
    "matern 3/2": (MOTION.matern(1.5, TIME, STD), *matern_matrices(1)),
    "matern 5/2": (MOTION.matern(2.5, TIME, STD), *matern_matrices(2)),
    "matern 7/2": (MOTION.matern(3.5, TIME, STD), *matern_matrices(3)),
    "turn": (MOTION.coordinated_turn(RATE, DENSITY), *turning()),
    "any": (MOTION.LinearSDE(*map(jnp.asarray, matern_matrices(2))), *matern_matrices(2)),
}


@pytest.mark.parametrize("name", LINEAR)
def test_steps_of_any_length_are_those_of_the_exponential_and_of_quadrature(name):
    """In float32: to 1e-5 of each element of Q, or where the step is long to 1e-5 of the largest.

    Rounding is 6e-8; a step of 30 takes up to ten doublings, each of which adds a few roundings of what is large.
    """
    model, A, L = LINEAR[name]
    lengths = np.array([0.0, 1e-3, 0.3, 2.0, 30.0])
    F, Q = model.discretize(jnp.asarray(lengths, jnp.float32))
    np.testing.assert_array_equal(F[0], np.eye(len(A)))
    np.testing.assert_array_equal(Q[0], 0)
    for i, dt in enumerate(lengths[1:], 1):
        expected_F, expected_Q = exact(A, L, float(np.float32(dt)))
        scale = np.sqrt(np.outer(np.diag(expected_Q), np.diag(expected_Q)))
        np.testing.assert_allclose(np.asarray(Q[i], float) / scale, expected_Q / scale, atol=1e-5, err_msg=str(dt))
        tolerance = 1e-5 * max(abs(expected_F).max(), 1.0)
        np.testing.assert_allclose(np.asarray(F[i], float), expected_F, atol=tolerance, err_msg=str(dt))


def test_a_long_step_of_a_stable_system_ends_in_its_stationary_state_in_float32():
    """Van Loan's matrix holds exp(-A dt), which overflows here from 90 time constants on."""
    A, L = matern_matrices(2)
    F, Q = MOTION.discretize(A, L, jnp.array([200.0, 1e4, 1e7]))
    np.testing.assert_allclose(F, np.zeros((3, 3, 3)), atol=1e-12)
    stationary = scipy.linalg.solve_continuous_lyapunov(A, -L @ L.T)
    np.testing.assert_allclose(Q, np.broadcast_to(stationary, (3, 3, 3)), atol=1e-5 * STD**2)
    model = MOTION.matern(2.5, TIME, STD)
    np.testing.assert_allclose(model.discretize(1e9).Q, stationary, rtol=2e-5, atol=1e-4)
    np.testing.assert_allclose(model.stationary_covariance(), stationary, rtol=1e-5, atol=1e-5)


def test_a_step_is_two_half_steps(x64):
    """F(h) = F(h/2)^2 and Q(h) = F(h/2) Q(h/2) F(h/2)^T + Q(h/2), to rounding in float64."""
    for name in ("singer", "matern 7/2", "turn", "any"):
        model = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), LINEAR[name][0])
        (half_F, whole_F), (half_Q, whole_Q) = model.discretize(jnp.array([0.35, 0.7], jnp.float64))
        np.testing.assert_allclose(half_F @ half_F, whole_F, atol=1e-11)
        np.testing.assert_allclose(half_F @ half_Q @ half_F.T + half_Q, whole_Q, atol=1e-11)


def test_long_time_constants_lose_no_accuracy():
    """Singer's closed form, in float32, has no correct digit here: the limit is constant acceleration."""
    q = 2 * 0.5**2 / 1e6
    found = MOTION.singer(1e6, 0.5).discretize(0.01)
    limit = MOTION.constant_acceleration(q).discretize(0.01)
    np.testing.assert_allclose(found.F, limit.F, rtol=1e-5)
    np.testing.assert_allclose(found.Q, limit.Q, rtol=1e-5)


@pytest.mark.parametrize("dt", [0.5, jnp.array([0.5, 2.0])])
def test_coordinates_are_independent_and_laid_out_in_blocks(dt):
    one = MOTION.constant_acceleration(1.0).discretize(dt)
    model = MOTION.constant_acceleration(jnp.array([2.0, 3.0, 5.0]), dims=3)
    three = model.discretize(dt)
    np.testing.assert_allclose(three.F, np.kron(one.F, np.eye(3)), rtol=1e-6)
    np.testing.assert_allclose(three.Q, np.kron(one.Q, np.diag([2.0, 3.0, 5.0])), rtol=1e-6)
    x = jnp.arange(9.0)
    np.testing.assert_array_equal(model.position @ x, x[:3])
    np.testing.assert_allclose(model.transition(x, 0.5), np.asarray(model.discretize(0.5).F) @ np.asarray(x), rtol=1e-5)


def test_an_unknown_turn_is_the_known_one_where_the_rate_is_given(x64):
    unknown = MOTION.unknown_turn(DENSITY, 0.1)
    x = jnp.array([1.0, 2.0, 3.0, -1.0])
    moved = jax.jit(unknown.transition)
    for rate in (0.0, 1e-9, 0.7, -5.0):
        known = MOTION.coordinated_turn(rate, DENSITY).discretize(0.8)
        np.testing.assert_allclose(moved(jnp.append(x, rate), 0.8)[:4], known.F @ x)
    straight = MOTION.coordinated_turn(0.0, DENSITY).process_noise(0.8)
    np.testing.assert_allclose(unknown.process_noise(0.8)[:4, :4], straight)
    np.testing.assert_allclose(unknown.process_noise(0.8)[4], [0, 0, 0, 0, 0.08])
    jacobian = jax.jit(jax.jacfwd(unknown.transition))(jnp.append(x, 0.0), 0.8)
    h = 1e-6
    ahead, behind = (moved(jnp.append(x, rate), 0.8) for rate in (h, -h))
    np.testing.assert_allclose(jacobian[:, 4], (ahead - behind) / (2 * h), atol=1e-8)


PARAMETERS = {
    "wiener": (lambda a, b: MOTION.constant_velocity(a), 0.7, 0.3),
    "singer": (MOTION.singer, 0.7, 1.3),
    "integrated_ornstein_uhlenbeck": (MOTION.integrated_ornstein_uhlenbeck, 0.7, 1.3),
    "ornstein_uhlenbeck": (MOTION.ornstein_uhlenbeck, 0.7, 1.3),
    "matern": (lambda a, b: MOTION.matern(2.5, a, b), 0.7, 1.3),
    "turn": (lambda a, b: MOTION.coordinated_turn(a, b), 0.2, 1.3),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_gradients_are_those_of_finite_differences(x64, name):
    """Central differences of h = 1e-5 err by h^2 and 1e-16 / h, relative to terms of order one: 1e-7 is safe."""
    make, *start = PARAMETERS[name]

    @jax.jit
    def total(theta):
        F, Q = make(theta[0], theta[1]).discretize(theta[2])
        weights = jnp.cos(jnp.arange(F.size)).reshape(F.shape)
        return jnp.sum(weights * (F + 2 * Q))

    theta = jnp.array([*start, 0.9])
    slope = jax.grad(total)(theta)
    difference = [(total(theta.at[i].add(1e-5)) - total(theta.at[i].add(-1e-5))) / 2e-5 for i in range(3)]
    np.testing.assert_allclose(slope, difference, atol=1e-7)


@pytest.mark.system
@pytest.mark.parametrize("smoothness", [0.5, 1.5, 2.5, 3.5])
def test_filter_and_smoother_on_a_matern_process_are_gaussian_process_regression(x64, smoothness):
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0, 10, 25))
    y, noise = rng.normal(size=25), 0.1
    model = MOTION.matern(smoothness, jnp.float64(1.7), jnp.float64(1.3))
    P = model.stationary_covariance()
    R = noise * jnp.eye(1)
    filter = jf.extended_kalman(
        jf.Gaussian(jnp.zeros(model.size), P), model.transition, model.process_noise, lambda x: x[:1], R
    )
    dt = jnp.asarray(np.diff(times, prepend=times[0]))
    smoothed, infos = jf.smoothing.filter_and_smooth(filter, jax.random.key(0), jnp.asarray(y)[:, None], dt)
    K = covariance(smoothness, np.abs(times[:, None] - times), 1.7, 1.3)
    S = K + noise * np.eye(25)
    np.testing.assert_allclose(smoothed.mean[:, 0], K @ np.linalg.solve(S, y), atol=1e-8)
    np.testing.assert_allclose(smoothed.covariance[:, 0, 0], np.diag(K - K @ np.linalg.solve(S, K)), atol=1e-8)
    expected = -0.5 * (y @ np.linalg.solve(S, y) + np.linalg.slogdet(2 * np.pi * S)[1])
    np.testing.assert_allclose(infos.log_evidence.sum(), expected, rtol=1e-9)


def covariance(smoothness, distance, length, std):
    """Matern covariances as polynomials times an exponential (Rasmussen and Williams 2006, equation 4.16)."""
    r = np.sqrt(2 * smoothness) * distance / length
    factor = {0.5: 1.0, 1.5: 1 + r, 2.5: 1 + r + r**2 / 3, 3.5: 1 + r + 2 * r**2 / 5 + r**3 / 15}[smoothness]
    return std**2 * factor * np.exp(-r)


def test_a_negative_step_that_is_traced_gives_nan():
    models = [model for model, *_ in LINEAR.values()]
    steps = jax.jit(lambda dt: [model.discretize(dt).Q for model in models])(jnp.array([-0.1, jnp.nan, jnp.inf]))
    assert all(np.isnan(Q).any(axis=(1, 2)).all() for Q in steps)
    wrong = jax.jit(lambda time: MOTION.matern(1.5, time, 1.0).discretize(0.1).Q)(-2.0)
    assert np.isnan(wrong).any()


def pendulum(x):
    return jnp.stack([x[1], -4.0 * jnp.sin(x[0]) - 0.3 * x[1]])


class Pendulum:
    prior = jf.Gaussian(jnp.array([1.0, 0.0]), jnp.diag(jnp.array([0.05, 0.2])))
    L = jnp.array([[0.0], [0.3]])
    R = 0.01 * jnp.eye(1)
    dt = jnp.array([0.1, 0.5, 0.0, 0.3])

    @staticmethod
    def filter(drift=pendulum, prior=prior, R=R, **options):
        return jf.continuous_extended_kalman(prior, drift, Pendulum.L, lambda x: x[:1], R, **options)


@pytest.mark.parametrize("integrator", ["rk4", pytest.param("adaptive", marks=pytest.mark.system)])
def test_moments_follow_their_differential_equations(x64, integrator):
    """Predicted moments against `scipy.integrate.solve_ivp` of Jazwinski's equations, to the rule's fourth order."""
    if integrator == "adaptive":
        pytest.importorskip("diffrax")
        integrate = jf.motion.adaptive(rtol=1e-9, atol=1e-11)
    else:
        integrate = jf.motion.rk4(2)
    prior = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), Pendulum.prior)
    filter = Pendulum.filter(prior=prior, integrate=integrate, num_intervals=8)
    L = np.asarray(Pendulum.L, float)

    def rates(_, y):
        m, P = y[:2], y[2:].reshape(2, 2)
        J = np.array([[0.0, 1.0], [-4.0 * np.cos(m[0]), -0.3]])
        return np.concatenate([np.asarray(pendulum(m)), (J @ P + P @ J.T + L @ L.T).ravel()])

    start = np.concatenate([prior.mean, np.ravel(prior.covariance)])
    y = scipy.integrate.solve_ivp(rates, (0, 0.6), start, rtol=1e-10, atol=1e-12).y[:, -1]
    ahead = jf.predict(filter, jax.random.key(0), filter.params.prior, jnp.float64(0.6))
    np.testing.assert_allclose(ahead.mean, y[:2], atol=3e-6)
    np.testing.assert_allclose(ahead.covariance, y[2:].reshape(2, 2), atol=3e-6)


@pytest.mark.system
def test_a_linear_drift_is_the_discretised_model_with_its_smoother_in_every_arithmetic(x64):
    A = jnp.array([[0.0, 1.0], [-4.0, -0.3]], jnp.float64)
    L, prior = (
        jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree) for tree in (Pendulum.L, Pendulum.prior)
    )
    model, R, ys = MOTION.LinearSDE(A, L), jnp.asarray(Pendulum.R, jnp.float64), jnp.ones((4, 1))
    exactly = jf.extended_kalman(prior, model.transition, model.process_noise, lambda x: x[:1], R)
    expected, infos = jf.smoothing.filter_and_smooth(exactly, jax.random.key(0), ys, Pendulum.dt)
    drift = lambda x: A @ x
    for options in ({}, {"arithmetic": jf.arithmetic.square_root}):
        rooted = bool(options)
        start = jf.GaussianRoot(prior.mean, jnp.linalg.cholesky(prior.covariance)) if rooted else prior
        filter = Pendulum.filter(drift, start, jnp.sqrt(R) if rooted else R, num_intervals=16, **options)
        found, reports = jf.smoothing.filter_and_smooth(filter, jax.random.key(0), ys, Pendulum.dt)
        P = found.root @ jnp.swapaxes(found.root, 1, 2) if rooted else found.covariance
        np.testing.assert_allclose(found.mean, expected.mean, atol=1e-6)
        np.testing.assert_allclose(P, expected.covariance, atol=1e-7)
        np.testing.assert_allclose(reports.log_evidence, infos.log_evidence, atol=1e-4)


@pytest.mark.system
def test_the_noise_may_depend_on_the_state_and_gradients_are_finite():
    def evidence(scale):
        drift = lambda x: -scale * x
        filter = jf.continuous_extended_kalman(
            jf.Gaussian(jnp.ones(1), jnp.eye(1)), drift, lambda x: scale * x[:, None], lambda x: x, jnp.eye(1)
        )
        return jf.log_evidence(filter, jax.random.key(0), jnp.ones((3, 1)), jnp.array([0.1, 0.0, 2.0]))

    slope = jax.jit(jax.grad(evidence))(0.5)
    assert np.isfinite(slope)
    assert slope != 0
