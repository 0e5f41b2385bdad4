"""Deterministic analyses against the Kalman update of the sample moments, localisation against separate filters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.benchmarks.scenarios import ensemble as lorenz

KEY = jax.random.key(0)
SCHEMES = {"transform": jf.ensemble.transform, "serial": jf.ensemble.serial}
RNG = np.random.default_rng(2)
X = RNG.normal(size=(6, 9)) * np.array([1.0, 2.0, 0.5, 1.0, 3.0, 1.0])[:, None] + RNG.normal(size=(6, 1))
H = RNG.normal(size=(12, 6))
Y = RNG.normal(size=12)
BLOCKS = np.kron(np.eye(2), np.ones((3, 2)))
"""Factors of two groups of three numbers, each with two observations of its own."""


def updated(analysis, m, R=None, y=None, x=X, observe=None, **options):
    """Samples and info after an update with the first m observations."""
    observe = (lambda state: jnp.asarray(H[:m]) @ state) if observe is None else observe
    R = jnp.diag(jnp.linspace(0.5, 2.0, m)) if R is None else R
    filter = jf.ensemble_kalman(
        lambda key: jnp.zeros(len(x)),
        lambda key, state: state,
        observe,
        R,
        num_particles=x.shape[1],
        analysis=analysis,
        **options,
    )
    state = jf.init(filter, KEY)._replace(particles=jnp.asarray(x))
    after, info = jf.update(filter, KEY, state, jnp.asarray(Y[:m] if y is None else y))
    return np.asarray(after.particles), info


def textbook(H, R, y, x=X):
    """Mean, covariance and log density of the Kalman update of the sample moments."""
    m, P = x.mean(1), np.cov(x)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    d = y - H @ m
    return m + K @ d, P - K @ S @ K.T, -0.5 * (d @ np.linalg.solve(S, d) + np.linalg.slogdet(2 * np.pi * S)[1])


@pytest.mark.parametrize(("name", "m"), [("transform", 3), ("transform", 12), ("serial", 3), ("serial", 12)])
def test_deterministic_analyses_are_the_kalman_update_of_the_sample_moments(x64, name, m):
    """Exactly, with fewer observations than samples and with more; one reading is missing."""
    y = np.where(np.arange(m) == 1, np.nan, Y[:m])
    R, read = np.diag(np.linspace(0.5, 2.0, m)), np.arange(m) != 1
    if name == "transform":
        root = np.tril(RNG.normal(size=(m, m))) * 0.3 + np.eye(m)
        R = root @ root.T
    particles, info = updated(SCHEMES[name], m, jnp.asarray(R), y)
    mean, P, log_density = textbook(H[:m][read], R[np.ix_(read, read)], y[read])
    np.testing.assert_allclose(particles.mean(1), mean, atol=1e-10)
    np.testing.assert_allclose(np.cov(particles), P, atol=1e-10)
    np.testing.assert_allclose(info.log_evidence, log_density, atol=1e-10)


def test_the_transform_is_the_smallest_move_of_the_deviations(x64):
    """The symmetric root: X^+ X' is symmetric and positive, which no other root of the posterior has."""
    particles, _ = updated(jf.ensemble.transform, 3)
    before, after = (x - x.mean(1, keepdims=True) for x in (X, particles))
    S = np.linalg.solve(np.sqrt(np.diag(np.linspace(0.5, 2.0, 3))), H[:3] @ before) / np.sqrt(8)
    values, vectors = np.linalg.eigh(np.eye(9) + S.T @ S)
    np.testing.assert_allclose(after, before @ (vectors / np.sqrt(values)) @ vectors.T, atol=1e-10)


@pytest.mark.parametrize("analysis", [*SCHEMES.values(), jf.ensemble.perturbed_observations])
def test_groups_that_localisation_separates_are_separate_filters(x64, analysis):
    """Samples of deterministic schemes; means of perturbed observations, whose noise has no mean."""
    picked = np.array([0, 1, 3, 4])
    factors = jf.ensemble.Localization(jnp.asarray(BLOCKS), jnp.asarray(np.kron(np.eye(2), np.ones((2, 2)))))
    observe = lambda state: state[picked]
    together, info = updated(analysis, 4, observe=observe, localization=factors, inflation=1.1)
    total = 0.0
    for rows, readings in ((slice(0, 3), slice(0, 2)), (slice(3, 6), slice(2, 4))):
        R = jnp.diag(jnp.linspace(0.5, 2.0, 4)[readings])
        alone, part = updated(analysis, 2, R, Y[:4][readings], X[rows], lambda state: state[:2], inflation=1.1)
        total += part.log_evidence
        if analysis in SCHEMES.values():
            np.testing.assert_allclose(together[rows], alone, atol=1e-10)
        np.testing.assert_allclose(together[rows].mean(1), alone.mean(1), atol=1e-10)
    np.testing.assert_allclose(info.log_evidence, total, atol=1e-10)


@pytest.mark.parametrize("name", SCHEMES)
def test_factors_of_one_change_nothing(x64, name):
    ones = jf.ensemble.Localization(jnp.ones((6, 12)), jnp.ones((12, 12)))
    localised, plain = (updated(SCHEMES[name], 12, localization=factors)[0] for factors in (ones, None))
    np.testing.assert_allclose(localised, plain, atol=1e-10)


def test_relaxation_gives_back_its_share_of_the_lost_spread(x64):
    plain, _ = updated(jf.ensemble.transform, 3)
    relaxed, _ = updated(jf.ensemble.transform, 3, relaxation=0.7)
    expected = 0.3 * plain.std(1) + 0.7 * X.std(1)
    np.testing.assert_allclose(relaxed.std(1), expected, rtol=1e-10)
    np.testing.assert_allclose(relaxed.mean(1), plain.mean(1), rtol=1e-10)


@pytest.mark.parametrize(("name", "m"), [("transform", 3), ("transform", 12), ("serial", 3)])
def test_gradients_are_those_of_finite_differences(x64, name, m):
    """Where eigenvalues are equal, too: with 12 observations of 9 samples, four of the nine are one."""

    @jax.jit
    def total(scale):
        R = scale * jnp.diag(jnp.linspace(0.5, 2.0, m))
        filter = jf.ensemble_kalman(
            lambda key: jnp.zeros(6),
            lambda key, state: state,
            lambda state: jnp.asarray(H[:m]) @ state,
            R,
            num_particles=9,
            analysis=SCHEMES[name],
        )
        state = filter.init(filter.params, KEY)._replace(particles=jnp.asarray(X))
        after, _ = filter.update(filter.params, KEY, state, jnp.asarray(Y[:m]), None)
        return jnp.sum(jnp.cos(jnp.arange(54.0)).reshape(6, 9) * after.particles)

    difference = (total(1 + 1e-5) - total(1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(total)(1.0), difference, rtol=1e-6)


@pytest.mark.system
def test_correlations_fall_from_one_to_zero_and_are_possible():
    distance = np.linspace(0, 1.2, 25)
    z = 2 * distance
    near = -(z**5) / 4 + z**4 / 2 + 5 * z**3 / 8 - 5 * z**2 / 3 + 1
    with np.errstate(divide="ignore"):
        far = z**5 / 12 - z**4 / 2 + 5 * z**3 / 8 + 5 * z**2 / 3 - 5 * z + 4 - 2 / (3 * z)
    expected = np.where(z < 1, near, np.where(z < 2, far, 0.0))
    np.testing.assert_allclose(jf.ensemble.gaspari_cohn(distance, 1.0), expected, atol=1e-6)
    points = jnp.asarray(RNG.uniform(size=(20, 2)), jnp.float32)
    factors = jf.ensemble.localization(points, points[:5], 0.8)
    assert np.linalg.eigvalsh(factors.observation).min() > -1e-5
    np.testing.assert_allclose(factors.state[:5], factors.observation, atol=1e-6)
    steep = jax.grad(lambda radius: jf.ensemble.localization(points, points, radius).state.sum())(0.8)
    assert np.isfinite(steep)


@pytest.mark.system
@pytest.mark.optimised
def test_lorenz_96_is_followed_with_the_published_error():
    """300 steps after 100: published 0.18 to 0.22 for long runs; short ones vary by about 0.02."""
    problem = lorenz.simulate(jax.random.key(1), 400)
    error = lorenz.rmse(lorenz.build(problem, analysis=jf.ensemble.transform, inflation=1.02), KEY, problem, 100)
    assert 0.12 < error < 0.25
    few = lorenz.build(problem, 10, lorenz.RADIUS, analysis=jf.ensemble.serial, inflation=1.03)
    assert lorenz.rmse(few, KEY, problem, 100) < 0.35


def test_a_correlation_of_the_noise_has_its_derivative_where_it_is_zero(x64):
    # Uncorrelated noise is scaled, not multiplied by a matrix; differences say what a correlation changes.
    predicted = jax.random.normal(jax.random.key(0), (2, 30))

    def moved(correlation):
        R = jnp.array([[1.0, correlation], [correlation, 2.0]])
        spread = predicted - predicted.mean(axis=1, keepdims=True)
        root = jnp.linalg.cholesky(spread @ spread.T / 29 + R)
        forecast = jf.ensemble.Forecast(
            jnp.zeros(2), spread, predicted, jnp.ones(2), jnp.ones(2, bool), R, jnp.linalg.cholesky(R), root, None
        )
        return jf.ensemble.perturbed_observations(jax.random.key(1), forecast)

    step = 1e-5
    differences = (moved(step) - moved(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(moved)(0.0), differences, atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(lambda c: moved(c).sum())(0.0), differences.sum(), atol=1e-5)
