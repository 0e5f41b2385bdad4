"""Bootstrap particle filter against the exact Kalman filter of the same model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import keep_info, log_evidence, run
from jaxfilters.noise import StandardNormal
from jaxfilters.particle import resampling
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.tempering import AdaptiveTempering, no_tempering
from jaxfilters.particle.weighting import reweight

RATE, PROCESS_STD, PRIOR_STD = 0.9, 0.5, 1.0


@pytree_dataclass
class Walk:
    """x' = 0.9 x + q, y = x + r."""

    noise_std: jax.Array

    def log_likelihood(self, x, y):
        return norm.logpdf(y, x, self.noise_std)


def sample_prior(key):
    return PRIOR_STD * jax.random.normal(key)


def move_by_noise(noise, x, inputs):
    del inputs
    return RATE * x + PROCESS_STD * noise[0]


def move_by_key(key, x, inputs):
    return move_by_noise(jax.random.normal(key, (1,)), x, inputs)


def simulate(seed, length=25):
    rng = np.random.default_rng(seed)
    x, ys = PRIOR_STD * rng.normal(), []
    for _ in range(length):
        x = RATE * x + PROCESS_STD * rng.normal()
        ys.append(x + 0.4 * rng.normal())
    return jnp.asarray(ys, dtype=float)


def exact_log_evidence(ys, noise_std):
    """Textbook scalar Kalman filter."""
    m, P, total = 0.0, PRIOR_STD**2, 0.0
    for y in ys:
        m, P = RATE * m, RATE**2 * P + PROCESS_STD**2
        S = P + noise_std**2
        total += norm.logpdf(y, m, jnp.sqrt(S))
        m, P = m + P / S * (y - m), P - P**2 / S
    return total, m


def make_filter(noise_std=0.4, **options):
    model = Walk(jnp.asarray(noise_std, dtype=float))
    options = {"num_particles": 100, "noise": StandardNormal(1)} | options
    return bootstrap(sample_prior, move_by_noise, model.log_likelihood, **options)


@pytest.mark.system
@pytest.mark.parametrize("ess_threshold", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("scheme", [resampling.systematic, resampling.multinomial])
def test_evidence_is_unbiased(ess_threshold, scheme):
    # The evidence itself is unbiased, its logarithm is not: a z-test at 4 sigma fails by chance once in 16000.
    ys = simulate(0, 8)
    pf = make_filter(ess_threshold=ess_threshold, scheme=scheme)
    keys = jax.random.split(jax.random.key(1), 2000)
    estimates = jax.vmap(log_evidence, in_axes=(None, 0, None))(pf, keys, ys)
    ratio = np.exp(np.asarray(estimates, dtype=np.float64) - float(exact_log_evidence(ys, 0.4)[0]))
    z = (ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))
    assert abs(z) < 4


@pytest.mark.system
def test_keys_and_normals_both_give_the_posterior_mean():
    ys = simulate(1)
    _, exact_mean = exact_log_evidence(ys, 0.4)
    by_noise = make_filter(num_particles=20000)
    model = Walk(jnp.asarray(0.4))
    by_key = bootstrap(sample_prior, move_by_key, model.log_likelihood, num_particles=20000)
    for pf in (by_noise, by_key):
        state, _ = run(pf, jax.random.key(2), ys, collect=keep_info)
        # Posterior standard deviation 0.32; with 20000 particles the error of the mean stays below 6 x 0.32 /
        # sqrt(20000).
        assert abs(weights.mean(state.particles, state.log_weights) - exact_mean) < 0.014


@pytest.mark.system
def test_score_matches_the_exact_one():
    # 400 independent estimates at N = 1000; their bias is O(1/N), below the 4 sigma of the z-test.
    ys = simulate(2, 10)
    exact = float(jax.grad(lambda std: exact_log_evidence(ys, std)[0])(0.4))
    score = jax.grad(lambda pf, key: log_evidence(pf, key, ys))
    keys = jax.random.split(jax.random.key(4), 400)
    scores = jax.vmap(score, in_axes=(None, 0))(
        make_filter(num_particles=1000), keys
    ).params.log_likelihood.callback.args[0]
    estimates = np.asarray(scores.noise_std, dtype=np.float64)
    assert np.all(np.isfinite(estimates))
    z = (estimates.mean() - exact) / (estimates.std(ddof=1) / np.sqrt(estimates.size))
    assert abs(z) < 4


def test_nan_and_infinite_likelihoods_are_dropped_and_counted():
    log_weights = weights.uniform(5)
    log_likelihood = jnp.array([0.0, jnp.nan, jnp.inf, -jnp.inf, 0.0])
    normalized, info = reweight(log_weights, log_likelihood, jnp.arange(5, dtype=jnp.int32), no_tempering)
    np.testing.assert_allclose(np.exp(normalized), [0.5, 0, 0, 0, 0.5], atol=1e-7)
    assert info.num_invalid == 2
    assert not info.resampled


def test_weights_that_are_nan_show_in_the_evidence_and_are_counted():
    filter = make_filter()
    state = filter.init(filter.params, jax.random.key(0))
    state = state._replace(log_weights=state.log_weights.at[3].set(jnp.nan))
    state, infos = run(filter, jax.random.key(1), jnp.array([0.0, 0.0]), state=state, collect=keep_info)
    assert np.isnan(infos.log_evidence[0])
    assert infos.num_invalid[0] > 0
    assert np.isfinite(infos.log_evidence[1])
    assert np.all(np.isfinite(state.log_weights))


def test_when_nothing_explains_the_observation_weights_become_equal_and_evidence_says_so():
    state, infos = run(make_filter(), jax.random.key(0), jnp.array([0.0, 1e30, 0.0]), collect=keep_info)
    assert infos.log_evidence[1] == -jnp.inf
    assert infos.effective_sample_size[1] == pytest.approx(100, rel=1e-5)
    assert jnp.isfinite(infos.log_evidence[2])
    assert np.all(np.isfinite(state.particles))


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_tempering_leaves_the_share_of_the_effective_sample_size_before(share):
    ys = simulate(3) * 20
    _, infos = run(make_filter(temper=AdaptiveTempering(share)), jax.random.key(0), ys, collect=keep_info)
    left = np.asarray(infos.effective_sample_size)
    before = np.where(infos.resampled, 100, np.concatenate([[100], left[:-1]]))
    # The exponent is right to 2e-6 of itself, the sums over 100 weights to 1e-5.
    assert np.all(left >= share * before * (1 - 1e-4))
    assert np.median(left / before) == pytest.approx(share, rel=1e-3)
    plain = run(make_filter(), jax.random.key(0), ys, collect=keep_info)[1]
    assert np.min(plain.effective_sample_size) < 0.05 * 100


def test_tempering_counts_only_particles_that_are_possible():
    # 70 of 100 particles are impossible: half of an effective size of 100 could not be reached.
    log_likelihood = jnp.where(jnp.arange(100) < 70, -jnp.inf, -jnp.linspace(0, 50, 100)).at[3].set(jnp.nan)
    tempered = AdaptiveTempering(0.5)(log_likelihood, jnp.zeros(100))
    np.testing.assert_allclose(weights.effective_sample_size(tempered), 15, rtol=1e-4)
    # A power of 1 retains what is asked for.
    mild = jnp.where(log_likelihood > -jnp.inf, 0.1 * log_likelihood, -jnp.inf)
    assert weights.effective_sample_size(mild) > 15
    np.testing.assert_array_equal(AdaptiveTempering(0.5)(mild, jnp.zeros(100)), mild)
    nothing = AdaptiveTempering(0.5)(jnp.full(4, -jnp.inf), jnp.zeros(4))
    np.testing.assert_array_equal(nothing, jnp.full(4, -jnp.inf))


def test_resampling_is_reported():
    ys = simulate(4)
    always = run(make_filter(ess_threshold=1.0), jax.random.key(0), ys, collect=keep_info)[1]
    never = run(make_filter(ess_threshold=0.0), jax.random.key(0), ys, collect=keep_info)[1]
    assert np.all(always.resampled[1:])
    assert not np.any(never.resampled)


@pytest.mark.parametrize("num_particles", [0, -3])
def test_ensembles_that_cannot_be_are_rejected(num_particles):
    with pytest.raises(ValueError, match="num_particles must be an integer of at least 1"):
        make_filter(num_particles=num_particles)
    with pytest.raises(ValueError, match="ess_threshold"):
        make_filter(ess_threshold=-0.1)


def test_one_particle_runs():
    _, infos = run(make_filter(num_particles=1), jax.random.key(0), simulate(5), collect=keep_info)
    assert np.all(infos.effective_sample_size == 1)
