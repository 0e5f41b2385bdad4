"""What the tests of blackjax and particles demand of samplers, at their tolerances.

Sources: blackjax (blackjax-devs/blackjax, tests/smc/): test_tempered_smc.py, test_waste_free_smc.py, test_smc.py,
test_smc_ess.py, test_resampling.py, with their linear regression; particles (nchopin/particles):
tests/smc_samplers/linear_reg.py and book/pmcmc/pgibbs_ecological.py, which plot what is a number here. Random walks
take the place of Hamiltonian moves.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

KEY = jax.random.key(0)
normal = jax.scipy.stats.norm.logpdf
RNG = np.random.default_rng(0)
X = RNG.normal(size=1000)
Y = jnp.asarray(3 * X + RNG.normal(size=1000), jnp.float32)
X = jnp.asarray(X, jnp.float32)


# test_tempered_smc.py, test_waste_free_smc.py: scale 1 and coefficient 3 from 1000 points, within a tenth.


def sample_prior(key):
    numbers = jax.random.normal(key, (2,))
    return {"log_scale": numbers[0], "coefficient": numbers[1]}


def log_prior(theta):
    return normal(theta["log_scale"]) + normal(theta["coefficient"])


def log_likelihood(theta):
    return normal(Y, theta["coefficient"] * X, jnp.exp(theta["log_scale"])).sum()


SAMPLERS = {
    "tempered": partial(jf.mcmc.tempered_smc, num_particles=100, num_moves=10),
    "waste_free": partial(jf.mcmc.waste_free_smc, num_particles=100, chain_length=4),
}
SCHEDULES = {
    "adaptive, half": jf.mcmc.adaptive_temperatures(0.5),
    "adaptive, three quarters": jf.mcmc.adaptive_temperatures(0.75),
    "fixed": jf.mcmc.fixed_temperatures(np.logspace(-5, 0, 10)),
}


@pytest.mark.system
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("name", SAMPLERS)
def test_a_regression_of_blackjax_is_found(name, schedule):
    found = SAMPLERS[name](KEY, sample_prior, log_prior, log_likelihood, temperatures=SCHEDULES[schedule])
    np.testing.assert_allclose(np.mean(np.exp(found.theta["log_scale"])), 1.0, rtol=0.1)
    np.testing.assert_allclose(np.mean(found.theta["coefficient"]), 3.0, rtol=0.1)


@pytest.mark.system
def test_a_normalizing_constant_of_blackjax_is_found():
    root = np.tril(np.random.default_rng(0).uniform(size=(2, 2)))
    covariance = root @ root.T
    likelihood = lambda x: jax.scipy.stats.multivariate_normal.logpdf(x, jnp.zeros(2), jnp.asarray(covariance))
    found = jf.mcmc.tempered_smc(
        KEY, lambda key: jax.random.normal(key, (2,)), lambda x: normal(x).sum(), likelihood,
        num_particles=100, num_moves=10, temperatures=jf.mcmc.adaptive_temperatures(0.9),
    )  # fmt: skip
    expected = -0.5 * np.linalg.slogdet(np.eye(2) + covariance)[1] - np.log(2 * np.pi)
    np.testing.assert_allclose(found.log_evidence, expected, rtol=0.1)


# test_smc.py: one stage turns a cloud about a quarter into a standard normal one.


@pytest.mark.system
@pytest.mark.parametrize(
    "sampler",
    [
        partial(jf.mcmc.tempered_smc, num_particles=1000, num_moves=10),
        partial(jf.mcmc.waste_free_smc, num_particles=1000, chain_length=500),
    ],
    ids=["standard", "waste-free"],
)
def test_one_stage_of_blackjax_corrects_a_cloud(sampler):
    at_quarter = lambda x: normal(x, 0.25)
    found = sampler(
        KEY, lambda key: 0.25 + jax.random.normal(key), at_quarter, lambda x: normal(x) - at_quarter(x),
        temperatures=jf.mcmc.fixed_temperatures(np.ones(1)),
    )  # fmt: skip
    np.testing.assert_allclose(found.theta.mean(), 0.0, atol=0.1)
    np.testing.assert_allclose(found.theta.std(), 1.0, atol=0.1)


# test_smc_ess.py.


def test_effective_sample_sizes_of_blackjax():
    assert jf.weights.effective_sample_size(jnp.array([-jnp.inf, -jnp.inf, 0.0, -jnp.inf])) == 1.0
    assert jf.weights.effective_sample_size(jnp.ones(12)) == pytest.approx(12)


TARGETS = {
    "one number": lambda: stats.norm.logpdf(np.random.default_rng(0).normal(size=1000), scale=0.1),
    # Ten times the density: the answer of their test is an exponent between 1 and 10, which a temperature is not.
    "two numbers": lambda: 10 * stats.norm.logpdf(np.random.default_rng(0).normal(size=(1000, 2))).sum(1),
}


@pytest.mark.parametrize("share", [0.2, 0.95])
@pytest.mark.parametrize("name", TARGETS)
def test_the_next_temperature_of_blackjax_has_its_effective_sample_size(name, share):
    log_likelihoods = jnp.asarray(TARGETS[name](), jnp.float32)
    exponent = jf.weights.temper_exponent(log_likelihoods, jnp.zeros(1000), share * 1000)
    size = jf.weights.effective_sample_size(exponent * log_likelihoods)
    np.testing.assert_allclose(size, share * 1000, atol=0.1, rtol=1e-2)


def test_a_likelihood_that_needs_no_tempering_gets_none_as_in_issue_914_of_blackjax():
    particles = jnp.tan(jnp.pi * (jax.random.uniform(KEY, (8192,)) - 0.5))
    log_likelihoods = -0.5 * jnp.square((particles - 2.0) / 0.5)
    assert jf.weights.effective_sample_size(log_likelihoods) > 0.9 * 1024
    np.testing.assert_allclose(jf.weights.temper_exponent(log_likelihoods, jnp.zeros(8192), 0.9 * 1024), 1.0, atol=1e-2)


# test_resampling.py, for the conditional schemes, which blackjax does not have.


@pytest.mark.parametrize("scheme", [jf.mcmc.conditional_systematic, jf.mcmc.conditional_multinomial])
def test_resampled_averages_of_blackjax(scheme):
    rng = np.random.default_rng(0)
    weights, x = rng.uniform(size=10_000), np.cos(rng.normal(size=10_000))
    log_weights = jnp.log(jnp.asarray(weights, jnp.float32))
    ancestors = jax.jit(jax.vmap(lambda key: scheme(key, log_weights, 17)))(jax.random.split(KEY, 100))
    drawn = x[np.asarray(ancestors)]
    mean = np.average(x, weights=weights)
    np.testing.assert_allclose(drawn.mean(), mean, atol=1e-2, rtol=1e-2)
    deviation = np.sqrt(np.average((x - mean) ** 2, weights=weights))
    np.testing.assert_allclose(drawn.std(1).mean(), deviation, atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize("scheme", [jf.mcmc.conditional_systematic, jf.mcmc.conditional_multinomial])
def test_particles_without_weight_are_never_drawn_as_in_blackjax(scheme):
    log_weights = jnp.log(jnp.array([0.0, 0.5, 0.0, 0.5, 0.0]))
    ancestors = jax.jit(jax.vmap(lambda key: scheme(key, log_weights, 1)))(jax.random.split(KEY, 100))
    assert set(np.unique(ancestors)) <= {1, 3}


# particles: tests/smc_samplers/linear_reg.py, against the closed form; over 20 runs at four standard errors.


@pytest.mark.system
def test_a_regression_of_particles_has_its_evidence_and_moments():
    rng = np.random.default_rng(0)
    features, noise, scale = rng.normal(size=(30, 3)), 0.1, 10.0
    features[:, 0] = 1.0
    answers = features @ [0.3, 1.0, -0.2] + noise * rng.normal(size=30)
    evidence = stats.multivariate_normal.logpdf(answers, cov=noise**2 * np.eye(30) + scale**2 * features @ features.T)
    covariance = np.linalg.inv(features.T @ features / noise**2 + np.eye(3) / scale**2)
    mean = covariance @ features.T @ answers / noise**2
    table, answers = jnp.asarray(features, jnp.float32), jnp.asarray(answers, jnp.float32)
    run = lambda key: jf.mcmc.waste_free_smc(
        key, lambda key: scale * jax.random.normal(key, (3,)), lambda x: normal(x, 0.0, scale).sum(),
        lambda x: normal(answers, table @ x, noise).sum(), num_particles=1000, chain_length=50,
    )  # fmt: skip
    found = jax.jit(jax.vmap(run))(jax.random.split(KEY, 20))
    for values, expected in (
        (np.asarray(found.log_evidence)[:, None], evidence),
        (np.asarray(found.theta).mean(-1), mean),
        (np.asarray(found.theta).var(-1), np.diag(covariance)),
    ):
        assert (abs(values.mean(0) - expected) < 4 * values.std(0, ddof=1) / np.sqrt(20) + 1e-6).all()


# particles: book/pmcmc/pgibbs_ecological.py, figure 16.8 of Chopin and Papaspiliopoulos (2020): update rates.


@pytest.mark.system
def test_update_rates_of_trajectories_fall_backwards_without_a_backward_step_as_in_particles():
    ys = jnp.asarray(np.cumsum(np.random.default_rng(0).normal(size=40)), jnp.float32)
    filter = jf.bootstrap(
        lambda key: jax.random.normal(key), lambda e, x: x + e[0], lambda x, y: normal(y, x, 1.0),
        num_particles=10, noise=jf.StandardNormal(1),
    )  # fmt: skip

    def rates(redraw):
        kernel = jf.mcmc.conditional_smc(filter, redraw)
        path, _ = jf.mcmc.initial_path(KEY, kernel, ys)
        sweep = lambda path, key: jf.mcmc.update_path(key, kernel, path, ys)
        return jax.lax.scan(sweep, path, jax.random.split(KEY, 200))[1].changed.mean(0)

    plain = rates(jf.mcmc.ancestral())
    backward = rates(jf.mcmc.backward_sampling(lambda after, x: normal(after, x)))
    # An outlying reading leaves few other paths, hence the lower bound of single rows.
    assert plain[:10].max() < 0.2 < 0.5 < plain[-1]
    assert backward.min() > 0.3
    assert backward.mean() > 0.6
