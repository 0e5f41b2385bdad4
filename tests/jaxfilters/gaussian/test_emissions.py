"""Counts and classes in Gaussian filters, against quadrature, a particle filter and dynamax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

KEY = jax.random.key(0)
M, P = 0.4, 0.5
CASES = {
    "poisson": (
        lambda: jf.emissions.poisson(lambda x: x + 1.0),
        [5],
        lambda x: stats.poisson.logpmf(5, np.exp(x + 1)),
    ),
    "binomial": (
        lambda: jf.emissions.binomial(lambda x: 2 * x, 10),
        [3],
        lambda x: stats.binom.logpmf(3, 10, 1 / (1 + np.exp(-2 * x))),
    ),
    "bernoulli": (lambda: jf.emissions.bernoulli(lambda x: 2 * x), [False], lambda x: -np.logaddexp(0, 2 * x)),
    "categorical": (
        lambda: jf.emissions.categorical(lambda x: jnp.stack([x[0], jnp.zeros(()), -2 * x[0]])),
        2,
        lambda x: -2 * x - np.logaddexp.reduce([x, 0 * x, -2 * x]),
    ),
}


def still(x):
    return x


def by_quadrature(log_likelihood):
    """Mean, variance and log evidence of the posterior in one dimension."""
    x, w = np.polynomial.hermite_e.hermegauss(100)
    x, w = M + np.sqrt(P) * x, w / w.sum()
    w = w * np.exp(log_likelihood(x))
    mean = w @ x / w.sum()
    return mean, w @ (x - mean) ** 2 / w.sum(), np.log(w.sum())


def mode_by_search(log_likelihood):
    """Mode on a fine grid, the curvature there by differences, and Laplace's log evidence."""
    cost = lambda x: 0.5 * (x - M) ** 2 / P - log_likelihood(x)
    x = np.linspace(-4, 4, 8001)
    for width in (1e-3, 1e-6):
        x = np.linspace(-width, width, 8001) + x[np.argmin(cost(x))]
    mode, h = x[np.argmin(cost(x))], 1e-4
    curvature = (cost(mode + h) - 2 * cost(mode) + cost(mode - h)) / h**2
    return mode, 1 / curvature, -cost(mode) - 0.5 * np.log(P * curvature)


def one_update(name, root=False, **options):
    emission, y, _ = CASES[name]
    prior = jf.Gaussian(jnp.array([M]), jnp.array([[P]]))
    if root:
        prior, options = (
            jf.GaussianRoot(prior.mean, jnp.sqrt(prior.covariance)),
            {**options, "arithmetic": jf.arithmetic.square_root},
        )
    filter = jf.extended_kalman(prior, still, jnp.zeros((1, 1)), emission(), **options)
    belief, info = jf.step(filter, KEY, prior, jnp.asarray(y))
    variance = belief.root[0, 0] ** 2 if root else belief.covariance[0, 0]
    return np.array([belief.mean[0], variance, info.log_evidence])


@pytest.mark.parametrize(
    "name", ["bernoulli", *(pytest.param(name, marks=pytest.mark.system) for name in CASES if name != "bernoulli")]
)
def test_the_mode_and_its_evidence_are_those_of_laplace(x64, name):
    """Newton's steps for a parameter that is linear in the state; the differences of the oracle have 1e-7."""
    found = one_update(name, iterations=12, iterate_to="mode")
    np.testing.assert_allclose(found, mode_by_search(CASES[name][2]), rtol=0, atol=3e-6)
    np.testing.assert_allclose(one_update(name, True, iterations=12, iterate_to="mode"), found, rtol=0, atol=1e-6)
    exact = by_quadrature(CASES[name][2])
    np.testing.assert_allclose(found, exact, rtol=0, atol=0.1 * np.sqrt(P))


@pytest.mark.parametrize(
    "name", ["bernoulli", *(pytest.param(name, marks=pytest.mark.system) for name in CASES if name != "bernoulli")]
)
def test_conditional_moments_give_the_best_linear_update(x64, name):
    """With the Taylor polynomial by hand; on sigma points near the exact posterior, at a tenth of the prior's width."""
    emission, y, log_likelihood = CASES[name]
    family, natural = emission().family, emission().of_step(None)
    mean_of = lambda x: family.mean(natural(x))
    at = jnp.array([M])
    code = np.asarray(family.encoded(jnp.asarray(y), natural(at))[0])
    H, R = np.asarray(jax.jacfwd(mean_of)(at)), np.asarray(family.covariance(natural(at)))
    K = P * H.T @ np.linalg.inv(P * H @ H.T + R)
    mean, variance = M + K @ (code - mean_of(at)), P - K @ H * P
    found = one_update(name)
    np.testing.assert_allclose(found[:2], [mean[0], variance[0, 0]], rtol=1e-10)
    # |P'| / |P| = 1 / (1 + P H^T R^-1 H), and the prior and the likelihood at the posterior mean.
    gain = 1 + P * (H.T @ np.linalg.inv(R) @ H)[0, 0]
    log_evidence = log_likelihood(mean)[0] - 0.5 * (mean[0] - M) ** 2 / P - 0.5 * np.log(gain)
    np.testing.assert_allclose(found[2], log_evidence, rtol=1e-10)

    exact = by_quadrature(log_likelihood)
    points = one_update(name, linearize=jf.linearize.unscented())
    np.testing.assert_allclose(points, exact, rtol=0, atol=0.2 * np.sqrt(P))
    np.testing.assert_allclose(one_update(name, True), found, rtol=0, atol=1e-9)


def test_values_that_are_not_counts_are_impossible_and_missing_ones_are_left_out():
    emission = jf.emissions.binomial(lambda x: jnp.stack([x[0], -x[0]]), jnp.array([4, 2]))
    prior = jf.Gaussian(jnp.array([M]), jnp.array([[P]]))
    filter = jf.extended_kalman(prior, still, jnp.zeros((1, 1)), emission)
    update = lambda *y, mask=None: jf.update(filter, KEY, prior, jf.Observation(jnp.array(y), mask))
    for y in ((-1.0, 1.0), (1.5, 1.0), (1.0, 3.0)):
        _, info = update(*y)
        assert info.log_evidence == -jnp.inf
        assert info.num_invalid == 1
    alone = update(3.0, 1.0, mask=jnp.array([True, False]))
    missing = update(3.0, jnp.nan)
    assert np.isfinite(alone[1].log_evidence)
    np.testing.assert_allclose(alone[0].mean, missing[0].mean, rtol=1e-6)
    np.testing.assert_allclose(alone[0].covariance, missing[0].covariance, rtol=1e-6)
    np.testing.assert_allclose(alone[1].log_evidence, missing[1].log_evidence, rtol=1e-6)
    nothing, info = update(jnp.nan, jnp.nan)
    np.testing.assert_allclose(nothing.mean, prior.mean, rtol=1e-6)
    np.testing.assert_allclose(info.log_evidence, 0.0)


A, Q = np.array([[0.95, 0.1], [-0.1, 0.95]]), 0.02 * np.eye(2)
C = np.array([[1.0, 0.0], [0.0, 1.0], [0.7, -0.7]])


def rates(x):
    return jnp.asarray(C) @ x + 1.0


def spikes(num_steps):
    rng = np.random.default_rng(4)
    x, counts = np.array([0.5, 0.0]), []
    for _ in range(num_steps):
        x = A @ x + 0.14 * rng.normal(size=2)
        counts.append(rng.poisson(np.exp(C @ x + 1)))
    return jnp.asarray(np.array(counts))


@pytest.mark.system
def test_a_sequence_of_counts_agrees_with_a_large_particle_filter():
    """Against 1e5 particles, whose Monte Carlo error is below 0.02 in the log evidence and 0.005 in the means."""
    ys, prior = spikes(30), jf.Gaussian(jnp.zeros(2), 0.3 * jnp.eye(2))
    move = lambda noise, x: jnp.asarray(A, jnp.float32) @ x + np.sqrt(0.02) * noise
    likelihood = lambda x, y: jax.scipy.stats.poisson.logpmf(y, jnp.exp(rates(x).astype(jnp.float32))).sum()
    pf = jf.bootstrap(
        jf.priors.gaussian_prior(prior), move, likelihood, num_particles=100_000, noise=jf.StandardNormal(2)
    )
    mean = lambda state, info: (jf.weights.mean(state.particles, state.log_weights), info.log_evidence)
    _, (means, logs) = jf.run(pf, KEY, ys, collect=mean)
    F = jnp.asarray(A, jnp.float32)
    for options, tolerance in (({"iterations": 8, "iterate_to": "mode"}, 0.25), ({}, 0.4)):
        filter = jf.extended_kalman(
            prior, lambda x: F @ x, jnp.asarray(Q, jnp.float32), jf.emissions.poisson(rates), **options
        )
        _, (beliefs, infos) = jf.run(filter, KEY, ys)
        spread = jnp.sqrt(jnp.diagonal(beliefs.covariance, axis1=1, axis2=2))
        # In posterior deviations; the errors of the approximations are 0.15 and 0.30 of them, and 0.1 nats in all.
        assert jnp.max(jnp.abs(beliefs.mean - means) / spread) < tolerance
        assert jnp.abs(infos.log_evidence.sum() - logs.sum()) < 0.2


@pytest.mark.system
def test_dynamax_agrees_on_conditional_moments(x64):
    cmgf = pytest.importorskip("dynamax.generalized_gaussian_ssm", reason="dynamax is not installed")
    ys = spikes(20).astype(float)
    params = cmgf.ParamsGGSSM(
        initial_mean=jnp.zeros(2),
        initial_covariance=0.3 * jnp.eye(2),
        dynamics_function=lambda x: jnp.asarray(A) @ x,
        dynamics_covariance=jnp.asarray(Q),
        emission_mean_function=lambda x: jnp.exp(rates(x)),
        emission_cov_function=lambda x: jnp.diag(jnp.exp(rates(x))),
    )
    theirs = cmgf.conditional_moments_gaussian_filter(params, cmgf.EKFIntegrals(), ys)
    # Their first observation updates the prior, which is not predicted before it.
    prior = jf.Gaussian(jnp.zeros(2), 0.3 * jnp.eye(2))
    ours = jf.extended_kalman(prior, lambda x: jnp.asarray(A) @ x, jnp.asarray(Q), jf.emissions.poisson(rates))
    first, _ = jf.update(ours, KEY, prior, ys[0])
    _, (beliefs, _) = jf.run(ours, KEY, ys[1:], state=first)
    np.testing.assert_allclose(beliefs.mean, theirs.filtered_means[1:], rtol=0, atol=1e-8)
    np.testing.assert_allclose(beliefs.covariance, theirs.filtered_covariances[1:], rtol=0, atol=1e-8)


@pytest.mark.system
def test_the_log_evidence_has_a_right_gradient(x64):
    ys = spikes(4)

    def log_evidence(theta):
        prior = jf.Gaussian(jnp.zeros(2), 0.3 * jnp.eye(2))
        emission = jf.emissions.poisson(lambda x: theta * rates(x))
        filter = jf.extended_kalman(
            prior, lambda x: theta * x, jnp.asarray(Q), emission, iterations=4, iterate_to="mode"
        )
        return jf.log_evidence(filter, KEY, ys)

    value, slope = jax.value_and_grad(log_evidence)(0.9)
    difference = (log_evidence(0.9 + 1e-5) - log_evidence(0.9 - 1e-5)) / 2e-5
    assert np.isfinite(value)
    np.testing.assert_allclose(slope, difference, rtol=1e-4)
