"""Samplers of parameters against quadrature over a grid, and their calibration over 200 simulated data sets.

The model is a scalar autoregression, observed with noise, whose process noise has a log-normal prior. Its evidence is
that of a Gaussian vector, which SciPy evaluates in float64. One compiled program a sampler answers both questions: 200
runs on one data set, and one run on each of 200 data sets.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

A, R, LENGTH = 0.8, 0.5, 4
RUNS, DRAWS, BINS = 200, 9, 5
PRIOR_MEAN, PRIOR_SD = -0.3, 0.7
YS = jnp.array([0.3, -0.9, -1.4, 0.8])
GRID = np.exp(np.linspace(PRIOR_MEAN - 7 * PRIOR_SD, PRIOR_MEAN + 7 * PRIOR_SD, 400))
normal = jax.scipy.stats.norm.logpdf
KEY = jax.random.key(0)


def log_evidence_of_textbook(q, ys):
    """Of `ys` as a Gaussian vector: x_t is a sum of A^(t - s) times the independent x_0 and noises."""
    t, s = np.mgrid[1 : len(ys) + 1, 0 : len(ys) + 1]
    L = np.where(s <= t, A ** np.clip(t - s, 0, None).astype(float), 0.0) * np.where(s == 0, 1.0, q)
    return stats.multivariate_normal.logpdf(ys, np.zeros(len(ys)), L @ L.T + R**2 * np.eye(len(ys)))


def quadrature(ys):
    """Log evidence of the model, and the mean and standard deviation of log q given `ys`."""
    z = np.log(GRID)
    logs = np.array([log_evidence_of_textbook(q, np.asarray(ys, float)) for q in GRID])
    logs += stats.norm.logpdf(z, PRIOR_MEAN, PRIOR_SD) + np.log(z[1] - z[0])
    total = np.logaddexp.reduce(logs)
    w = np.exp(logs - total)
    return total, w @ z, np.sqrt(w @ (z - w @ z) ** 2)


LOG_EVIDENCE, MEAN, DEVIATION = quadrature(YS)


def sample_prior(key):
    return {"q": jnp.exp(PRIOR_MEAN + PRIOR_SD * jax.random.normal(key))}


def log_prior(theta):
    return normal(jnp.log(theta["q"]), PRIOR_MEAN, PRIOR_SD) - jnp.log(theta["q"])


def simulate(key, theta):
    def step(x, e):
        x = A * x + theta["q"] * e[0]
        return x, x + R * e[1]

    start_key, key = jax.random.split(key)
    return jax.lax.scan(step, jax.random.normal(start_key), jax.random.normal(key, (LENGTH, 2)))[1]


def particle_filter_of(theta, num_particles=8):
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
    return jf.bootstrap(
        prior,
        lambda e, x: A * x + theta["q"] * e,
        lambda x, y: normal(y, x[0], R),
        num_particles=num_particles,
        noise=jf.StandardNormal(1),
    )


def kalman_of(theta, noise=R):
    one = jnp.eye(1)
    return jf.kalman(jf.Gaussian(jnp.zeros(1), one), A * one, jnp.square(theta["q"]) * one, one, noise**2 * one)


def exact_log_likelihood(ys, theta):
    return jf.log_evidence(kalman_of(theta), jax.random.key(0), ys[:, None])


WALK = jf.mcmc.random_walk({"q": jf.fit.positive}, step=0.8, target_acceptance=0.4)


def pmmh(ys):
    estimate = lambda key, theta: jf.log_evidence(particle_filter_of(theta), key, ys)
    return jf.mcmc.pmmh(estimate, log_prior, proposal=WALK)


def correlated(ys):
    return jf.mcmc.pmmh(jf.mcmc.correlated(particle_filter_of, ys, correlation=0.9), log_prior, proposal=WALK)


def particle_gibbs(ys):
    def kernel_of(theta):
        join = jf.mcmc.ancestor_sampling(lambda after, x: normal(after[0], A * x[0], theta["q"]))
        return jf.mcmc.conditional_smc(particle_filter_of(theta, 6), join)

    def log_density(theta, path):
        return log_prior(theta) + normal(path[1:, 0], A * path[:-1, 0], theta["q"]).sum()

    return jf.mcmc.particle_gibbs(kernel_of, jf.mcmc.metropolis_update(log_density, proposal=WALK, num_steps=2), ys)


CHAINS = {"pmmh": pmmh, "correlated": correlated, "particle_gibbs": particle_gibbs}


def draws_of_chain(name, key, ys):
    """Every 15th state of one chain that began at a draw of the prior."""
    sampler = CHAINS[name](ys)
    keys = jax.random.split(key, 4)
    start = jax.tree.map(lambda leaf: leaf[None], sample_prior(keys[0]))
    state, _ = jf.mcmc.warm_up(keys[2], sampler, jf.mcmc.init(keys[1], sampler, start), 60)
    _, theta = jf.mcmc.sample(keys[3], sampler, state, DRAWS, thin=15, collect=jf.mcmc.keep_theta)
    return jnp.log(theta["q"][:, 0]), jnp.zeros(()), jnp.zeros((), int)


LADDER = tuple(partial(particle_filter_of, num_particles=count) for count in (2, 16))
TEMPERATURES = (0.05, 0.25, 1.0)
PROBLEM = {"num_particles": 64, "constraints": jf.fit.positive}


def smc(name, key, ys):
    """The temperatures are fixed, and the bias of a covariance that adapts to 64 particles is below the error."""
    if name in ("tempered", "waste_free"):
        temperatures = jf.mcmc.fixed_temperatures(jnp.array(TEMPERATURES))
        run, options = {
            "tempered": (jf.mcmc.tempered_smc, {"num_moves": 3}),
            "waste_free": (jf.mcmc.waste_free_smc, {"chain_length": 4}),
        }[name]
        likelihood = partial(exact_log_likelihood, ys)
        return run(key, sample_prior, log_prior, likelihood, temperatures=temperatures, **options, **PROBLEM)
    if name == "smc2":
        return jf.mcmc.smc2(key, particle_filter_of, sample_prior, log_prior, ys, num_moves=2, **PROBLEM)
    if name == "smc2_exchanged":
        # The filters of the first frame are those of another model; what is left of it are errors of the exchange.
        filters, options = (partial(kalman_of, noise=2 * R), kalman_of), {"min_acceptance": 1.0, "ess_threshold": 1.0}
        return jf.mcmc.smc2(key, filters, sample_prior, log_prior, ys[:, None], num_moves=2, **options, **PROBLEM)
    return jf.mcmc.smc2(key, kalman_of, sample_prior, log_prior, ys[:, None], num_moves=2, **PROBLEM)


def draws_of_smc(name, key, ys):
    """Particles drawn by their weights."""
    run_key, draw_key = jax.random.split(key)
    found = smc(name, run_key, ys)
    chosen = jax.random.categorical(draw_key, found.log_weights, shape=(DRAWS,))
    return jnp.log(found.theta["q"][chosen]), found.log_evidence, found.status


def check_within_error(values, expected):
    """Means over independent runs, at four standard errors: a false alarm has a probability of 6e-5."""
    values = np.asarray(values, float)
    assert np.isfinite(values).all()
    assert abs(values.mean() - expected) < 4 * values.std(ddof=1) / np.sqrt(len(values))


SAMPLERS = {name: partial(draws_of_chain, name) for name in CHAINS}
SMC = ("tempered", "waste_free", "smc2", "smc2_exchanged", "iterated_importance")
SAMPLERS |= {name: partial(draws_of_smc, name) for name in SMC}


@pytest.mark.system
@pytest.mark.parametrize("name", SAMPLERS)
def test_samplers_have_the_posterior_of_quadrature_and_are_calibrated(name):
    """The ranks of the true parameters are uniform: a false alarm of the chi-square test has a probability of 1e-3."""
    run = jax.jit(jax.vmap(SAMPLERS[name]))
    z, log_evidence, status = run(jax.random.split(jax.random.key(0), RUNS), jnp.tile(YS, (RUNS, 1)))
    z = np.asarray(z, float)
    assert not np.asarray(status).any()
    check_within_error(z.mean(1), MEAN)
    check_within_error(((z - MEAN) ** 2).mean(1), DEVIATION**2)
    if name not in CHAINS:
        check_within_error(np.exp(np.asarray(log_evidence, float) - LOG_EVIDENCE), 1.0)

    keys = jax.random.split(jax.random.key(1), (3, RUNS))
    truths = jax.vmap(sample_prior)(keys[0])
    z, *_ = run(keys[2], jax.vmap(simulate)(keys[1], truths))
    ranks = np.sum(np.asarray(z) < np.log(np.asarray(truths["q"]))[:, None], axis=1)
    counts = np.bincount(ranks * BINS // (DRAWS + 1), minlength=BINS)
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.system
def test_filters_grow_where_few_moves_are_accepted():
    """As often as there are larger ones, after moves; never with a threshold of zero, which is one filter alone."""
    ys = jnp.tile(YS, 3)
    run = lambda filter_of, share: jf.mcmc.smc2(
        KEY, filter_of, sample_prior, log_prior, ys, num_moves=2, min_acceptance=share, **PROBLEM
    )
    alone, never, grown = run(LADDER[0], 1.0), run(LADDER, 0.0), run(LADDER, 1.0)
    np.testing.assert_array_equal(alone.theta["q"], never.theta["q"])
    np.testing.assert_array_equal(alone.info.log_evidence, never.info.log_evidence)
    assert not np.asarray(never.info.filter_index).any()
    steps = np.diff(np.asarray(grown.info.filter_index))
    assert grown.info.filter_index[-1] == 1
    np.testing.assert_array_equal(steps, np.asarray(grown.info.moved)[:-1] & (np.cumsum(grown.info.moved)[:-1] <= 1))
    with pytest.raises(ValueError, match="filter_of must be a function, or a sequence of at least one"):
        run((), 0.2)


@pytest.mark.system
def test_calibration_finds_a_posterior_that_is_too_narrow():
    """Of a standard normal mean given one observation with unit noise; the right one passes with probability .999."""

    def p_value(scale):
        def sample_posterior(key, y):
            return 0.5 * y + scale * jnp.sqrt(0.5) * jax.random.normal(key, (19,))

        simulate = lambda key, theta: theta + jax.random.normal(key)
        return jf.mcmc.calibrate(
            jax.random.key(3), jax.random.normal, simulate, sample_posterior, num_runs=200, num_bins=10
        ).p_values

    assert p_value(1.0) > 1e-3
    assert p_value(0.5) < 1e-6
    assert p_value(jnp.nan) == 0


@pytest.mark.system
def test_correlated_noise_makes_estimates_that_go_together():
    """Errors of two estimates with correlated noise nearly cancel, where those of independent ones do not."""
    likelihood = jf.mcmc.correlated(partial(particle_filter_of, num_particles=32), YS, correlation=0.99)
    theta = {"q": jnp.array(0.7)}

    def pair(key):
        draw_key, perturb_key = jax.random.split(key)
        numbers = likelihood.draw(draw_key, theta)
        after = likelihood.perturb(perturb_key, numbers)
        return likelihood.evaluate(numbers, theta), likelihood.evaluate(after, theta)

    first, second = np.asarray(jax.jit(jax.vmap(pair))(jax.random.split(jax.random.key(0), 400)), float)
    exact = log_evidence_of_textbook(0.7, np.asarray(YS, float))
    check_within_error(np.exp(first - exact), 1.0)
    check_within_error(np.exp(second - exact), 1.0)
    assert np.corrcoef(first, second)[0, 1] > 0.9


@pytest.mark.system
def test_a_chain_continues_where_it_stopped_and_warm_up_reaches_its_acceptance_rate():
    """A state that was stored and read gives the same draws; .4 acceptance within 0.05 over 64 chains of 200 steps."""
    sampler = jf.mcmc.pmmh(lambda key, theta: normal(1.0, theta["q"], 0.5), log_prior, proposal=WALK)
    theta = jax.vmap(sample_prior, out_axes=-1)(jax.random.split(jax.random.key(0), 64))
    state, _ = jf.mcmc.warm_up(jax.random.key(2), sampler, jf.mcmc.init(jax.random.key(1), sampler, theta), 300)
    stored = jax.tree.map(
        lambda leaf: leaf if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.array(leaf), state
    )
    draws = [jf.mcmc.sample(jax.random.key(3), sampler, start, 200)[1] for start in (state, stored)]
    np.testing.assert_array_equal(draws[0].theta["q"], draws[1].theta["q"])
    assert abs(np.mean(draws[0].info.acceptance_probability) - 0.4) < 0.05


@pytest.mark.system
def test_fixed_parameters_keep_their_draw_and_float64_stays_float64(x64):
    """A mixture over two fixed values: the share of the one that explains the reading is that of Bayes' rule.

    Of 4000 particles, at four standard errors of a binomial with a quarter of them effective.
    """

    def sample(key):
        mean_key, model_key = jax.random.split(key)
        return {"mean": jax.random.normal(mean_key), "model": jnp.where(jax.random.bernoulli(model_key), 1, 3)}

    found = jf.mcmc.tempered_smc(
        KEY, sample, lambda theta: normal(theta["mean"]), lambda theta: normal(1.0, theta["mean"], theta["model"]),
        num_particles=4000, num_moves=3, constraints={"mean": jf.fit.free, "model": jf.fit.fixed},
    )  # fmt: skip
    evidences = stats.norm.pdf(1.0, 0.0, np.sqrt(1 + np.array([1.0, 3.0]) ** 2))
    share = evidences[0] / evidences.sum()
    assert abs(np.mean(found.theta["model"] == 1) - share) < 4 * np.sqrt(share * (1 - share) / 1000)
    np.testing.assert_allclose(found.log_evidence, np.log(evidences.mean()), atol=4 / np.sqrt(1000))
    assert (found.theta["mean"].dtype, found.log_evidence.dtype) == (jnp.float64, jnp.float64)
    sampler = jf.mcmc.pmmh(lambda key, theta: normal(1.0, theta), normal)
    state, draws = jf.mcmc.sample(KEY, sampler, jf.mcmc.init(KEY, sampler, np.zeros(2, np.float32)), 3)
    assert draws.theta.dtype == jnp.float32
    assert state.point.log_likelihood.dtype == jnp.float64
