"""Samplers of parameters against quadrature over a grid, and their calibration over 200 simulated data sets.

The model is a scalar autoregression, observed with noise, whose process noise has a log-normal prior. Its evidence is
that of a Gaussian vector, which NumPy evaluates in float64.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

A, R, LENGTH = 0.8, 0.5, 6
PRIOR_MEAN, PRIOR_SD = -0.3, 0.7
YS = jnp.array([0.3, -0.9, -1.4, -0.2, 0.8, 1.5])
GRID = np.exp(np.linspace(PRIOR_MEAN - 7 * PRIOR_SD, PRIOR_MEAN + 7 * PRIOR_SD, 400))
normal = jax.scipy.stats.norm.logpdf


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


def particle_filter_of(theta, num_particles=16):
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
    return jf.bootstrap(
        prior,
        lambda e, x, u: A * x + theta["q"] * e,
        lambda x, y: normal(y, x[0], R),
        num_particles=num_particles,
        noise=jf.StandardNormal(1),
    )


def kalman_of(theta):
    one = jnp.eye(1)
    return jf.kalman(jf.Gaussian(jnp.zeros(1), one), A * one, jnp.square(theta["q"]) * one, one, R**2 * one)


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
        join = jf.mcmc.ancestor_sampling(lambda after, x, u: normal(after[0], A * x[0], theta["q"]))
        return jf.mcmc.conditional_smc(particle_filter_of(theta, 8), join)

    def log_density(theta, path):
        return log_prior(theta) + normal(path[1:, 0], A * path[:-1, 0], theta["q"]).sum()

    return jf.mcmc.particle_gibbs(kernel_of, jf.mcmc.metropolis_update(log_density, proposal=WALK, num_steps=2), ys)


CHAINS = {"pmmh": pmmh, "correlated": correlated, "particle_gibbs": particle_gibbs}
SMC = {
    "tempered": lambda key, ys, prior=log_prior, **options: jf.mcmc.tempered_smc(
        key, sample_prior, prior, partial(exact_log_likelihood, ys), num_moves=4,
        constraints=jf.fit.positive, **options,
    ),
    "waste_free": lambda key, ys, prior=log_prior, **options: jf.mcmc.waste_free_smc(
        key, sample_prior, prior, partial(exact_log_likelihood, ys), chain_length=4,
        constraints=jf.fit.positive, **options,
    ),
}  # fmt: skip
NESTED = {
    "smc2": lambda key, ys, **options: jf.mcmc.smc2(
        key, particle_filter_of, sample_prior, log_prior, ys, constraints=jf.fit.positive, **options
    ),
    "smc2_of_exact_filters": lambda key, ys, **options: jf.mcmc.smc2(
        key, kalman_of, sample_prior, log_prior, ys[:, None], constraints=jf.fit.positive, **options
    ),
}


def check_within_error(values, expected):
    """Means over independent runs, at four standard errors: a false alarm has a probability of 6e-5."""
    values = np.asarray(values, float)
    assert np.isfinite(values).all()
    assert abs(values.mean() - expected) < 4 * values.std(ddof=1) / np.sqrt(len(values))


@pytest.mark.system
@pytest.mark.optimised
@pytest.mark.parametrize("name", CHAINS)
def test_chains_have_the_posterior_of_quadrature(name):
    sampler = CHAINS[name](YS)
    theta = jax.vmap(sample_prior, out_axes=-1)(jax.random.split(jax.random.key(0), 64))
    state = jf.mcmc.init(jax.random.key(1), sampler, theta)
    state, _ = jf.mcmc.warm_up(jax.random.key(2), sampler, state, 100)
    state, draws = jf.mcmc.sample(jax.random.key(3), sampler, state, 400)
    z = np.log(np.asarray(draws.theta["q"], float))
    check_within_error(z.mean(0), MEAN)
    check_within_error(((z - MEAN) ** 2).mean(0), DEVIATION**2)


@pytest.mark.system
@pytest.mark.optimised
@pytest.mark.parametrize("name", SMC | NESTED)
def test_evidences_are_unbiased_and_moments_right(name):
    """The temperatures are fixed, and the covariance of the moves adapts to 64 particles, whose bias is below error."""
    options = {"num_particles": 64}
    if name in SMC:
        options["temperatures"] = jf.mcmc.fixed_temperatures([0.05, 0.2, 0.5, 1.0])
    run = partial((SMC | NESTED)[name], ys=YS, **options)
    found = jax.jit(jax.vmap(lambda key: run(key)))(jax.random.split(jax.random.key(0), 200))
    assert (found.status == jf.mcmc.SMCStatus.FINISHED).all()
    check_within_error(np.exp(np.asarray(found.log_evidence, float) - LOG_EVIDENCE), 1.0)
    w, z = np.exp(np.asarray(found.log_weights, float)), np.log(np.asarray(found.theta["q"], float))
    check_within_error((w * z).sum(1), MEAN)
