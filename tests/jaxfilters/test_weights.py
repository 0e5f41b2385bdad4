import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import weights

INF = np.inf


def test_normalised_weights_and_their_log_sum(x64):
    log_weights = jnp.array([-1000.0, -1001.0, -INF, jnp.nan, -1002.5])
    normalised, log_sum = weights.normalize(log_weights)
    shifted = np.exp([0.0, -1.0, -INF, -INF, -2.5])
    np.testing.assert_allclose(np.exp(normalised), shifted / shifted.sum(), rtol=1e-12)
    assert np.isnan(log_sum)
    np.testing.assert_allclose(weights.normalize(log_weights[:3])[1], -1000 + np.log(shifted[:3].sum()), rtol=1e-14)
    np.testing.assert_allclose(weights.linear(log_weights), shifted / shifted.sum(), rtol=1e-14)


def test_an_ensemble_without_weight_counts_as_even():
    dead = jnp.full(4, -INF)
    normalised, log_sum = weights.normalize(dead)
    np.testing.assert_allclose(normalised, -np.log(4), rtol=1e-6)
    assert log_sum == -INF
    assert weights.effective_sample_size(dead) == 4
    np.testing.assert_allclose(weights.mean(jnp.arange(4.0), dead), 1.5)


def test_infinite_weights_share_everything():
    np.testing.assert_allclose(weights.linear(jnp.array([INF, 3.0, INF, -INF])), [0.5, 0, 0.5, 0])


@pytest.mark.system
def test_derivative_of_the_log_sum_is_the_weights_also_beside_dead_particles(x64):
    log_weights = jnp.array([0.3, -INF, -2.0, 1.0])
    gradient = jax.grad(lambda lw: weights.normalize(lw)[1])(log_weights)
    np.testing.assert_allclose(gradient, weights.linear(log_weights), rtol=1e-14)
    np.testing.assert_array_equal(jax.grad(lambda lw: weights.normalize(lw)[0][0])(jnp.full(3, -INF)), 0)


def test_effective_sample_size():
    assert weights.effective_sample_size(jnp.log(jnp.array([0.0, 1.0, 0.0]))) == 1
    np.testing.assert_allclose(weights.effective_sample_size(jnp.log(jnp.array([0.5, 0.25, 0.25])) + 7), 1 / 0.375)


def test_moments_agree_with_numpy_and_ignore_weightless_particles(x64):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(3, 20))
    log_weights = np.append(rng.normal(size=20), -INF)
    w = np.exp(log_weights[:-1]) / np.exp(log_weights[:-1]).sum()
    particles = {"x": jnp.asarray(np.column_stack([x, [np.nan, INF, 0]])), "on": jnp.arange(21) < 10}
    mean = weights.mean(particles, jnp.asarray(log_weights))
    np.testing.assert_allclose(mean["x"], np.average(x, axis=1, weights=w), rtol=1e-13)
    np.testing.assert_allclose(mean["on"], w[:10].sum(), rtol=1e-13)
    covariance = weights.covariance(particles["x"], jnp.asarray(log_weights))
    np.testing.assert_allclose(covariance, np.cov(x, aweights=w, bias=True), rtol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize(("probability", "expected"), [(0.0, 1), (0.2, 1), (0.201, 2), (0.5, 2), (0.9, 4), (1.0, 4)])
def test_quantile_is_the_smallest_value_with_enough_weight_below(probability, expected):
    # Values 1, 2, 3, 4 weigh 0.2, 0.3, 0.3, 0.2 parts; 0 and 9 weigh nothing.
    x = jnp.array([9.0, 4.0, 1.0, 0.0, 2.0, 3.0])
    log_weights = jnp.log(jnp.array([0.0, 2.0, 2.0, 0.0, 3.0, 3.0]))
    assert weights.quantile(x, log_weights, probability) == expected
    np.testing.assert_array_equal(weights.quantile(jnp.stack([x, -x]), log_weights, 0.5), [2, -3])


def test_tempering_reaches_the_target_and_no_less(x64):
    log_likelihood = 50 * jax.random.normal(jax.random.key(1), (400,))
    even = jnp.zeros(400)
    exponent = weights.temper_exponent(log_likelihood, even, 80.0)
    ess = lambda beta: weights.effective_sample_size(beta * log_likelihood)
    assert ess(exponent) >= 80 > ess(exponent * 1.00001)
    assert weights.temper_exponent(1e-3 * log_likelihood, even, 80.0) == 1
    assert weights.temper_exponent(jnp.full(400, -INF), even, 80.0) == 1


def test_tempering_copes_with_huge_and_impossible_likelihoods():
    log_likelihood = jnp.where(jnp.arange(100) % 3 == 0, -INF, -1e6 * jnp.linspace(0, 1, 100))
    exponent = weights.temper_exponent(log_likelihood, jnp.zeros(100), 20.0)
    assert 0 < exponent < 1
    np.testing.assert_allclose(weights.effective_sample_size(exponent * log_likelihood), 20, rtol=1e-4)
    assert exponent.dtype == jnp.float32
    one_left = jnp.where(jnp.arange(100) == 7, 0.0, -INF)
    assert 0 < weights.temper_exponent(jnp.zeros(100), one_left, 20.0) <= 1


def test_the_mean_around_the_mode_is_that_of_the_particles_near_the_heaviest(x64):
    rng = np.random.default_rng(2)
    scale, log_weights = np.array([5.0, 0.1]), rng.normal(size=300)
    x = scale[:, None] * 3 * rng.normal(size=(2, 300))
    x, log_weights = np.insert(x, 7, [np.nan, INF], axis=1), np.insert(log_weights, 7, -INF)
    heaviest = np.argmax(log_weights)
    near = np.hypot(*((x - x[:, [heaviest]]) / scale[:, None])) < 1.5
    expected = np.average(x[:, near], axis=1, weights=np.exp(log_weights[near]))
    arguments = (jnp.asarray(x), jnp.asarray(log_weights) - 1e4, jnp.asarray(scale))
    assert 1 < np.sum(near) < 100
    np.testing.assert_allclose(weights.mean_around_mode(*arguments, distance=1.5), expected, rtol=1e-12)
    np.testing.assert_allclose(weights.mean_around_mode(*arguments, distance=1e-9), x[:, heaviest], rtol=1e-12)
    everywhere = weights.mean_around_mode(*arguments, distance=1e9)
    np.testing.assert_allclose(everywhere, weights.mean(*arguments[:2]), rtol=1e-12)


def test_of_two_peaks_the_higher_one_is_the_estimate():
    x = jnp.array([[0.0, 0.1, 0.2, 10.0, 10.1]])
    log_weights = jnp.log(jnp.array([0.25, 0.2, 0.15, 0.3, 0.1]))
    estimate = weights.mean_around_mode(x, log_weights, jnp.ones(1))
    np.testing.assert_allclose(estimate, 10.025, rtol=1e-6)
    assert np.isfinite(weights.mean_around_mode(x, jnp.full(5, -INF), jnp.ones(1))).all()
    gradient = jax.grad(lambda x: weights.mean_around_mode(x, log_weights, jnp.ones(1)).sum())(x)
    np.testing.assert_allclose(gradient, [[0, 0, 0, 0.75, 0.25]], rtol=1e-6)
