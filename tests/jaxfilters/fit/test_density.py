import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters import fit
from jaxfilters.filter import log_evidence
from jaxfilters.fit.density import _undeclared_nan
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation, extended_kalman
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap

KEY = jax.random.key(2)
RNG = np.random.default_rng(8)
THETA = {"rate": 0.8, "drift": 0.5, "noise": 0.4}
LIMITS = {"rate": fit.interval(-1, 1), "drift": fit.positive, "noise": fit.positive}
START = {"rate": 0.3, "drift": 1.0, "noise": 1.0}


def move(rate, x, inputs):
    del inputs
    return rate * x


def see(x):
    return x


def filter_of(theta):
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    transition = jax.tree_util.Partial(move, theta["rate"])
    return extended_kalman(prior, transition, theta["drift"] ** 2 * jnp.eye(1), see, theta["noise"] ** 2 * jnp.eye(1))


def simulate(rng, shape, rate, drift, noise):
    steps, *many = shape
    x, ys = rng.normal(size=many), []
    for _ in range(steps):
        x = rate * x + drift * rng.normal(size=many)
        ys.append(x + noise * rng.normal(size=many))
    return np.array(ys)


def joint_log_density(ys, observed, rate, drift, noise):
    """Of all readings at once, from their covariance."""
    variances = [rate**2 + drift**2]
    for _ in ys[1:]:
        variances.append(rate**2 * variances[-1] + drift**2)
    steps = np.arange(len(ys))
    lag = abs(steps[:, None] - steps)
    covariance = np.array(variances)[np.minimum(steps[:, None], steps)] * rate**lag + noise**2 * np.eye(len(ys))
    return multivariate_normal(np.zeros(observed.sum()), covariance[np.ix_(observed, observed)]).logpdf(ys[observed])


def test_the_log_evidence_of_sequences_is_that_of_the_joint_gaussian(x64):
    ys = simulate(RNG, (9, 3), 0.8, 0.5, 0.4)
    observed = RNG.random((9, 3)) < 0.8
    holes = jnp.where(observed, ys, jnp.nan)[:, None]
    expected = [joint_log_density(ys[:, i], observed[:, i], 0.8, 0.5, 0.4) for i in range(3)]
    one = fit.log_evidence(KEY, filter_of, holes[..., 0], mask=jnp.asarray(observed[:, 0]))
    np.testing.assert_allclose(one(THETA), expected[0], rtol=1e-9)
    together = fit.over_sequences(KEY, filter_of, holes, mask=jnp.asarray(observed))
    np.testing.assert_allclose(together(THETA), sum(expected), rtol=1e-9)


def test_nan_is_a_missing_component_to_a_gaussian_filter_as_in_run(x64):
    ys = simulate(RNG, (9, 1), 0.8, 0.5, 0.4)
    observed = np.arange(9) != 4
    expected = joint_log_density(ys[:, 0], observed, 0.8, 0.5, 0.4)
    holes = jnp.asarray(np.where(observed[:, None], ys, np.nan))
    np.testing.assert_allclose(fit.log_evidence(KEY, filter_of, holes)(THETA), expected, rtol=1e-9)
    found = fit.maximize(fit.log_evidence(KEY, filter_of, holes), THETA, LIMITS, method=fit.bfgs(max_steps=2))
    assert np.isfinite(found.log_density)


@pytest.mark.system
@pytest.mark.parametrize("together", [False, True])
def test_a_search_says_which_observation_makes_the_start_impossible(together):
    ys = simulate(RNG, (6, 1), 0.8, 0.5, 0.4)
    ys[3] = np.nan
    observations = {"y": np.stack([ys, ys], axis=-1) if together else ys}
    build = fit.over_sequences if together else fit.log_evidence
    with pytest.raises(ValueError, match=r"finite at start; got (nan|-inf): observations\['y'\] is NaN in frame 3"):
        fit.maximize(build(KEY, named_particle_filter_of, observations), THETA, LIMITS)


def test_nan_that_a_mask_declares_is_not_blamed():
    ys = np.ones((5, 2))
    ys[3, 1] = np.nan
    assert _undeclared_nan({"y": ys}, np.arange(5) != 3) == ""
    assert _undeclared_nan(Observation(ys, ~np.isnan(ys)), None) == ""
    assert _undeclared_nan(ys[:, None], ~np.isnan(ys)) == ""
    assert _undeclared_nan({"count": np.ones(5, int)}, None) == ""
    assert "frame 3" in _undeclared_nan(Observation(ys), None)
    assert "frame 3" in _undeclared_nan(ys, np.arange(5) != 2)


def ruled_out(key, theta):
    del key
    return jnp.where(theta["rate"] > 0.5, 0.0, -jnp.inf)


@pytest.mark.system
def test_a_start_that_the_prior_or_a_frame_rules_out_is_named():
    ys = jnp.asarray(simulate(RNG, (6, 1), 0.8, 0.5, 0.4), jnp.float32)
    density = fit.with_prior(fit.log_evidence(KEY, filter_of, ys), lambda theta: ruled_out(None, theta))
    with pytest.raises(ValueError, match="got -inf: the log prior is -inf"):
        fit.maximize(density, START, LIMITS)
    density = fit.log_evidence(KEY, particle_filter_of, ys.at[2].set(jnp.inf))
    with pytest.raises(ValueError, match=r"the log evidence of frame 2 is (nan|-inf)"):
        fit.maximize(density, START, LIMITS)
    with pytest.raises(ValueError, match="must be finite at start; got -inf"):
        fit.maximize(fit.common_random_numbers(KEY, ruled_out), START, LIMITS)


def start_anywhere(key):
    return jax.random.normal(key, (1,))


def move_by_noise(rate, drift, noise, x, inputs):
    del inputs
    return rate * x + drift * noise


def log_likelihood(scale, x, y):
    return jax.scipy.stats.norm.logpdf(y, x, scale).sum()


def particle_filter_of(theta):
    transition = jax.tree_util.Partial(move_by_noise, theta["rate"], theta["drift"])
    likelihood = jax.tree_util.Partial(log_likelihood, theta["noise"])
    return bootstrap(start_anywhere, transition, likelihood, num_particles=64, noise=StandardNormal(1))


def named_particle_filter_of(theta):
    transition = jax.tree_util.Partial(move_by_noise, theta["rate"], theta["drift"])
    likelihood = jax.tree_util.Partial(named_log_likelihood, theta["noise"])
    return bootstrap(start_anywhere, transition, likelihood, num_particles=16, noise=StandardNormal(1))


def named_log_likelihood(scale, x, y):
    return log_likelihood(scale, x, y["y"])


@pytest.mark.parametrize("draws", [fit.common_random_numbers, fit.fresh_keys])
def test_a_particle_filter_draws_what_it_is_told(draws):
    ys = jnp.asarray(simulate(RNG, (6, 1), 0.8, 0.5, 0.4), jnp.float32)
    density = fit.log_evidence(KEY, particle_filter_of, ys, draws=draws)
    for step in (0, 3):
        key = KEY if draws is fit.common_random_numbers else jax.random.fold_in(KEY, step)
        expected = log_evidence(particle_filter_of(THETA), key, ys)
        found = density(THETA) if draws is fit.common_random_numbers else density.at(jnp.asarray(step), THETA)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.system
def test_the_gradient_of_the_log_evidence_agrees_with_differences():
    density = fit.over_sequences(KEY, filter_of, jnp.asarray(simulate(RNG, (9, 1, 3), 0.8, 0.5, 0.4), jnp.float32))
    assert fit.check_gradient(density, THETA, LIMITS).error < 1e-7


@pytest.mark.system
def test_truth_lies_within_three_standard_errors():
    runs = 100
    truth = {"rate": 0.8, "drift": 0.5, "noise": 0.4}
    ys = jnp.asarray(simulate(RNG, (300, 1, runs), *truth.values()), jnp.float32)

    @jax.jit
    def fitted(ys):
        return fit.maximize(fit.log_evidence(KEY, filter_of, ys), START, LIMITS, method=fit.bfgs(max_steps=60))

    found = jax.vmap(fitted, in_axes=-1)(ys)
    assert found.converged.mean() > 0.95
    for name, value in truth.items():
        within = abs(found.theta[name] - value) < 3 * found.standard_errors[name]
        assert within.mean() >= 0.95
        # The share within one standard error is 0.683 +- 0.047; at four standard deviations:
        within = abs(found.theta[name] - value) < found.standard_errors[name]
        assert abs(within.mean() - 0.683) < 0.19
