"""Diagnostics against SciPy, brute force, and numbers of ArviZ 0.23.4 and properscoring 0.1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats

import jaxfilters as jf

D = jf.diagnostics


def beliefs(rng, count, n):
    roots = rng.normal(size=(count, n, n)) + 2 * np.eye(n)
    return rng.normal(size=(count, n)), roots


def test_normalised_errors_are_squared_lengths_in_units_of_the_covariance(x64):
    rng = np.random.default_rng(0)
    mean, roots = beliefs(rng, 5, 3)
    truth, P = rng.normal(size=(5, 3)), roots @ np.swapaxes(roots, 1, 2)
    expected = [e @ np.linalg.solve(C, e) for e, C in zip(truth - mean, P, strict=True)]
    arrays = [jnp.asarray(a) for a in (truth, mean, P, roots)]
    np.testing.assert_allclose(jax.jit(D.nees)(arrays[0], jf.Gaussian(arrays[1], arrays[2])), expected)
    np.testing.assert_allclose(jax.jit(D.nees)(arrays[0], jf.GaussianRoot(arrays[1], arrays[3])), expected)
    grid = jnp.asarray((truth - mean)[:, None]), jnp.asarray(P[:, None])
    np.testing.assert_allclose(jax.jit(D.nis)(*grid)[:, 0], expected)


def test_chi_square_quantiles_are_those_of_scipy():
    p, dof = np.meshgrid([1e-4, 0.025, 0.5, 0.975, 0.9999], [1.0, 2.0, 3.5, 20.0, 3000.0])
    found = D.chi_square_quantile(jnp.asarray(p, jnp.float32), jnp.asarray(dof, jnp.float32))
    np.testing.assert_allclose(found, scipy.stats.chi2.ppf(p, dof), rtol=2e-4)
    low, high = D.chi_square_band(4, probability=0.9, num_runs=25)
    np.testing.assert_allclose([low, high], scipy.stats.chi2.ppf([0.05, 0.95], 100) / 25, rtol=1e-4)


def test_autocorrelations_and_their_test_find_a_correlation(x64):
    rng = np.random.default_rng(1)
    white = rng.normal(size=(400, 2))
    x = white.copy()
    x[1:, 1] += 0.3 * white[:-1, 1]
    rho = D.autocorrelation(jnp.asarray(x), 12)
    expected = [[np.sum(c[k:] * c[: 400 - k]) / np.sum(c * c) for c in x.T] for k in range(13)]
    np.testing.assert_allclose(rho, expected, atol=1e-12)
    test = D.whiteness(jnp.asarray(x), 12)
    statistic = 400 * 402 * np.sum(np.square(expected[1:]) / (400 - np.arange(1, 13))[:, None], axis=0)
    np.testing.assert_allclose(test.statistic, statistic)
    np.testing.assert_allclose(test.p_value, scipy.stats.chi2.sf(statistic, 12), rtol=1e-8)
    assert test.p_value[0] > 0.01 > test.p_value[1]
    np.testing.assert_allclose(D.autocorrelation_band(400), scipy.stats.norm.ppf(0.975) / 20)


@pytest.mark.system
def test_gaps_leave_autocorrelations_and_their_test_as_they_are(x64):
    rng = np.random.default_rng(8)
    x = rng.normal(size=(300, 3))
    x[:150, 0] = np.nan
    x[rng.random(300) < 0.5, 1] = np.nan
    x[::2, 2] = np.nan
    rho, test = D.autocorrelation(jnp.asarray(x), 6), D.whiteness(jnp.asarray(x), 6)
    for i, c in enumerate(x.T):
        pairs = [(c[k:] * c[: 300 - k])[np.isfinite(c[k:] * c[: 300 - k])] for k in range(7)]
        expected = [(1 - k / 300) * np.mean(p) / np.mean(pairs[0]) if len(p) else np.nan for k, p in enumerate(pairs)]
        np.testing.assert_allclose(rho[:, i], expected, atol=1e-12)
        n, some = len(pairs[0]), [p for p in pairs[1:] if len(p)]
        statistic = n * (n + 2) * sum(p.sum() ** 2 / len(p) for p in some) / np.sum(pairs[0]) ** 2
        np.testing.assert_allclose(test.statistic[i], statistic)
        np.testing.assert_allclose(test.p_value[i], scipy.stats.chi2.sf(statistic, len(some)), rtol=1e-8)
    # A gap at an end changes nothing of the test.
    np.testing.assert_allclose(test.p_value[0], D.whiteness(jnp.asarray(x[150:, :1]), 6).p_value[0], rtol=1e-12)
    assert jnp.all(jnp.isnan(D.whiteness(jnp.full((9, 1), jnp.nan), 2).p_value))
    assert jnp.isnan(D.whiteness(jnp.asarray([[1.0], [jnp.nan]]), 1).p_value[0])


@pytest.mark.system
def test_the_test_of_whiteness_keeps_its_level_over_gaps():
    e = np.random.default_rng(9).normal(size=(400, 2000)).astype(np.float32)
    e[:200] = np.nan
    share = np.mean(D.whiteness(jnp.asarray(e), 10).p_value < 0.05)
    # Of 2000 tests at 0.05 the share has the standard deviation 0.005; the statistic is chi-square to 0.01.
    assert abs(share - 0.05) < 0.03


@pytest.mark.system
def test_missing_frames_take_no_draws_from_lasting_errors():
    # The variance of the mean of n frames at times t_i is sum_ij phi^|t_i - t_j| / n^2: the reciprocal is what counts.
    phi, length, count = 0.95, 4000, 50
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(length, count)) * np.sqrt(1 - phi**2)
    x = scipy.signal.lfilter([1.0], [1.0, -phi], noise, axis=0).astype(np.float32)
    for known in (np.ones(length, bool), rng.random(length) < 0.5, np.arange(length) % 2 == 0):
        times = np.flatnonzero(known)
        expected = times.size**2 / np.sum(phi ** np.abs(times[:, None] - times))
        found = D.effective_draws(jnp.asarray(np.where(known[:, None], x, np.nan)))
        # The correlation over 50 recordings has a standard error of 0.0007, one of 1.5 percent of the number, and a
        # negative bias of 2 percent: four standard errors and the bias.
        np.testing.assert_allclose(np.mean(found.number), expected, rtol=0.09)
    few = jnp.asarray([[jnp.nan, 2.0, jnp.nan], [jnp.nan, jnp.nan, 1.0], [jnp.nan, jnp.nan, 1.0]])
    np.testing.assert_allclose(D.effective_draws(few).number, [np.nan, 1.0, 1.0])


def test_transforms_and_their_uniformity(x64):
    rng = np.random.default_rng(2)
    y, mean, std = rng.normal(size=50), rng.normal(size=50), rng.uniform(0.5, 2, 50)
    p = D.pit(jnp.asarray(y), mean, std)
    np.testing.assert_allclose(p, scipy.stats.norm.cdf(y, mean, std), atol=1e-12)
    for n, shift in ((10, 0.0), (200, 0.0), (200, 0.15)):
        u = rng.uniform(size=n) ** (1 + shift)
        found, expected = D.uniformity(jnp.asarray(u)), scipy.stats.kstest(u, "uniform", method="exact")
        np.testing.assert_allclose(found.statistic, expected.statistic)
        np.testing.assert_allclose(found.p_value, expected.pvalue, atol=0.03)
    samples, log_weights = jnp.asarray(rng.normal(size=(50, 7))), jnp.asarray(rng.normal(size=7))
    w = np.exp(log_weights) / np.exp(log_weights).sum()
    below = [np.sum(w[np.asarray(row) < value]) for row, value in zip(samples, y, strict=True)]
    np.testing.assert_allclose(D.pit_ensemble(jnp.asarray(y), samples, log_weights), below, atol=1e-12)
    within, expected = D.sigma_coverage(jnp.asarray(y), 0.0, 1.0)
    np.testing.assert_allclose(within, [np.mean(abs(y) < k) for k in (1, 2, 3)])
    np.testing.assert_allclose(expected, scipy.stats.chi2.cdf([1, 4, 9], 1))


def test_scores_are_their_definitions(x64):
    """The first three numbers are those of `properscoring.crps_gaussian` and `crps_ensemble`."""
    assert abs(D.crps(jnp.array(0.7), 0.2, 1.5) - PROPERSCORING[0]) < 1e-12
    samples = jnp.asarray([0.3, -1.2, 2.0, 0.9, 0.3])
    weights = jnp.asarray([0.1, 0.3, 0.2, 0.25, 0.15])
    assert abs(D.crps_ensemble(jnp.array(0.7), samples) - PROPERSCORING[1]) < 1e-12
    assert abs(D.crps_ensemble(jnp.array(0.7), samples, jnp.log(weights)) - PROPERSCORING[2]) < 1e-12
    x = np.linspace(-15, 15, 30_001)
    integral = np.sum(np.square(scipy.stats.norm.cdf(x, 0.2, 1.5) - (x >= 0.7))) * 1e-3
    np.testing.assert_allclose(D.crps(jnp.array(0.7), 0.2, 1.5), integral, atol=1e-3)
    np.testing.assert_allclose(D.log_score(jnp.array(0.7), 0.2, 1.5), -scipy.stats.norm.logpdf(0.7, 0.2, 1.5))
    slope = jax.grad(lambda std: D.crps(jnp.array(0.7), 0.2, std))(1.5)
    ahead, behind = (D.crps(jnp.array(0.7), 0.2, std) for std in (1.5 + 1e-6, 1.5 - 1e-6))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-6)


def test_a_common_offset_costs_scores_of_ensembles_no_accuracy():
    samples = jnp.asarray(np.random.default_rng(3).integers(0, 64, 40) / 8, jnp.float32)
    near, far = (D.crps_ensemble(jnp.float32(3.0) + offset, samples + offset) for offset in (0.0, 65536.0))
    np.testing.assert_allclose(far, near, rtol=1e-5)


def chains():
    """Autoregressive, antithetic, heavy-tailed, and one chain apart from the others."""
    rng = np.random.default_rng(11)
    noise, slow = rng.normal(size=(4, 300)), np.zeros((4, 300))
    for t in range(1, 300):
        slow[:, t] = 0.7 * slow[:, t - 1] + noise[:, t]
    anti, noise = np.zeros((2, 200)), rng.normal(size=(2, 200))
    for t in range(1, 200):
        anti[:, t] = -0.5 * anti[:, t - 1] + noise[:, t]
    heavy = rng.standard_t(1.5, size=(3, 251))
    return slow, anti, heavy, slow + np.array([0, 0, 0, 1.5])[:, None]


ARVIZ_CHAINS = (
    (245.3860595172911, 244.6077202600218, 1.0014615722186322),
    (1040.823996531185, 1040.823996531185, 1.0034007147915112),
    (644.8096102225223, 753.2485442150046, 0.9983560525120962),
    (34.9672357377589, 35.074579843489886, 1.0985646489932432),
)
"""`az.ess(method="bulk")`, `az.ess(method="mean")` and `az.rhat` of `chains()`."""

ARVIZ_TAILS = (
    (0.2595205689661769, 179.13118110339448, -3.75054638),
    (1.0826172121892492, 6.539149462591685, -1.01759588),
    (0.35361532698378334, 363.9174869039598, -4.49075482),
)
"""`az.psislw`: k, effective sample size of the smoothed weights, and the largest of their logarithms."""
PROPERSCORING = (0.4164239675755813, 0.28, 0.34049999999999997)


@pytest.mark.system
def test_effective_sample_sizes_of_chains_are_those_of_arviz(x64):
    for draws, (bulk, mean, scale) in zip(chains(), ARVIZ_CHAINS, strict=True):
        draws = jnp.asarray(draws)
        np.testing.assert_allclose(D.mcmc_effective_sample_size(draws), bulk, rtol=1e-9)
        np.testing.assert_allclose(D.mcmc_effective_sample_size(draws, rank_normalised=False), mean, rtol=1e-9)
        np.testing.assert_allclose(D.r_hat(draws), scale, rtol=1e-9)


def test_pareto_smoothed_weights_are_those_of_arviz(x64):
    rng = np.random.default_rng(12)
    cases = (rng.normal(size=400), 3 * rng.normal(size=1000), 0.4 * rng.exponential(size=500))
    for log_weights, (k, size, largest) in zip(cases, ARVIZ_TAILS, strict=True):
        smoothed, found = D.pareto_smoothed(jnp.asarray(log_weights))
        np.testing.assert_allclose(found, k, rtol=1e-9)
        np.testing.assert_allclose(D.effective_sample_size(smoothed), size, rtol=1e-9)
        np.testing.assert_allclose(smoothed.max(), largest, rtol=1e-8)
    assert D.pareto_k(jnp.zeros(100)) == jnp.inf
    assert D.pareto_k(jnp.zeros(10)) == jnp.inf


@pytest.mark.system
def test_a_consistent_filter_passes_and_an_overconfident_one_fails():
    """100 runs of 40 steps: bands of 99.99 percent, so that one false alarm in 5000 is expected of each of the two."""
    F, Q, H, R = jnp.array([[1.0, 0.5], [0.0, 1.0]]), 0.1 * jnp.eye(2), jnp.array([[1.0, 0.0]]), jnp.eye(1)
    prior = jf.Gaussian(jnp.zeros(2), jnp.eye(2))

    def simulate(key):
        keys = jax.random.split(key, 3)
        start, noise = jax.random.normal(keys[0], (2,)), jax.random.normal(keys[1], (40, 2)) * jnp.sqrt(0.1)
        truth = jax.lax.scan(lambda x, q: (F @ x + q,) * 2, start, noise)[1]
        return truth, truth[:, :1] + jax.random.normal(keys[2], (40, 1))

    @jax.jit
    def statistics(scale):
        def one(key):
            truth, y = simulate(key)
            _, (found, infos) = jf.run(jf.kalman(prior, F, scale * Q, H, R), key, y)
            return (
                D.nees(truth[-1:], jax.tree.map(lambda leaf: leaf[-1:], found))[0],
                infos.nis,
                D.pit(infos.innovation / infos.innovation_root[..., 0], 0.0, 1.0),
            )

        return jax.vmap(one)(jax.random.split(jax.random.key(7), 100))

    errors, squares, transforms = statistics(1.0)
    band, wide = (
        D.chi_square_band(2, probability=0.9999, num_runs=100),
        D.chi_square_band(1, probability=0.9999, num_runs=4000),
    )
    assert band.low < errors.mean() < band.high
    assert wide.low < squares.mean() < wide.high
    assert D.uniformity(transforms.ravel()).p_value > 1e-4
    errors, squares, transforms = statistics(0.1)
    assert errors.mean() > band.high
    assert squares.mean() > wide.high
    assert D.uniformity(transforms.ravel()).p_value < 1e-4


def test_truths_that_are_not_known_do_not_count_in_the_coverage():
    truth = jnp.array([0.5, jnp.nan, -1.5, 0.1, jnp.nan, 2.5])
    np.testing.assert_allclose(jf.diagnostics.sigma_coverage(truth, 0.0, 1.0)[0], [0.5, 0.75, 1.0])
    assert np.isnan(jf.diagnostics.sigma_coverage(jnp.array([jnp.nan]), 0.0, 1.0)[0]).all()
