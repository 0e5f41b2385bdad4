"""Every filter by its public name: built, run and differentiated with nothing imported but `jaxfilters as jf`.

In float64: derivatives are compared with finite differences.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
DT, NOISE = 0.5, 0.3
with jax.enable_x64(True):
    F = jnp.array([[1.0, DT], [0.0, 1.0]])
    Q = jnp.diag(jnp.array([0.02, 0.05]))
    H = jnp.array([[1.0, 0.0]])
    PRIOR = jf.Gaussian(jnp.array([0.0, 1.0]), jnp.diag(jnp.array([0.5, 0.3])))
    YS = jnp.asarray(np.random.default_rng(0).normal(np.arange(1, 16) * DT, 0.5)[:, None])
COUNT, KEYS = 1000, jax.random.split(jax.random.key(1), 16)


def evidence_of_textbook(noise):
    """Log evidence of the linear model by the Kalman filter in float64 numpy."""
    m, P, total = np.asarray(PRIOR.mean, float), np.asarray(PRIOR.covariance, float), 0.0
    A, B, C = np.asarray(F, float), np.asarray(Q, float), np.asarray(H, float)
    for y in np.asarray(YS, float):
        m, P = A @ m, A @ P @ A.T + B
        S = C @ P @ C.T + noise**2 * np.eye(1)
        innovation, K = y - C @ m, P @ C.T @ np.linalg.inv(S)
        total -= 0.5 * float(innovation @ np.linalg.solve(S, innovation) + np.log(2 * np.pi * np.linalg.det(S)))
        m, P = m + K @ innovation, P - K @ S @ K.T
    return total


def move(x, inputs):
    del inputs
    return F @ x


def observe(x):
    return H @ x


def sample_prior(key):
    return PRIOR.mean + jnp.sqrt(jnp.diag(PRIOR.covariance)) * jax.random.normal(key, (2,))


def sample_transition(z, x, inputs):
    return move(x, inputs) + jnp.linalg.cholesky(Q) @ z


def log_likelihood_of(noise):
    return lambda x, y: jax.scipy.stats.norm.logpdf(y - observe(x), 0.0, noise).sum()


def covariance(noise):
    return jnp.square(noise)[None, None]


def extended(noise):
    return jf.extended_kalman(PRIOR, move, Q, observe, covariance(noise))


def rao_blackwell_model(noise):
    """The place is sampled, and the velocity integrated out."""
    dynamics = lambda x, inputs: jf.MixedDynamics(x, F[:1, 1:], Q[:1, :1], jnp.zeros(1), F[1:, 1:], Q[1:, 1:])
    prior = lambda key: sample_prior(key)[:1]
    likelihood = lambda x, y: jax.scipy.stats.norm.logpdf(y - x, 0.0, noise).sum()
    return prior, jf.Gaussian(PRIOR.mean[1:], PRIOR.covariance[1:, 1:]), dynamics, likelihood


def linear(noise):
    return move, Q, observe, covariance(noise)


def marginal(build, noise, share):
    return build(*rao_blackwell_model(noise), num_particles=COUNT, noise_dim=1, ess_threshold=share)


def guided_model(noise):
    return sample_prior, sample_transition, log_likelihood_of(noise)


def log_transition(x_next, x):
    return jf.Gaussian(move(x, None), Q).logpdf(x_next)


SIZES = {"num_particles": COUNT, "noise": jf.StandardNormal(2)}
SPACIOUS = jf.constraints.linear_constraints(jnp.eye(2), lower=jnp.full(2, -1e3), upper=jnp.full(2, 1e3))
EXACT = {
    "kalman": lambda noise: jf.kalman(PRIOR, F, Q, H, covariance(noise)),
    "extended_kalman": extended,
    "unscented_kalman": lambda noise: jf.unscented_kalman(PRIOR, move, Q, observe, covariance(noise)),
    "cubature_kalman": lambda noise: jf.cubature_kalman(PRIOR, move, Q, observe, covariance(noise)),
    "posterior_linearization": lambda noise: jf.posterior_linearization(extended(noise), iterations=2),
    "gaussian_sum": lambda noise: jf.gaussian_sum(extended(noise), capacity=2),
    "constrained": lambda noise: jf.constrained(
        extended(noise), jf.TruncateEachStep(SPACIOUS, jf.constraints.cut.sequential_intervals)
    ),
    "schmidt_kalman": lambda noise: jf.schmidt_kalman(extended(noise), observe, jnp.zeros(2, bool), 1e-3),
    "kalman of inputs": lambda noise: jf.kalman(PRIOR, F, lambda _: Q, H, lambda _: covariance(noise)),
    "noise as an argument": lambda noise: jf.unscented_kalman(
        PRIOR,
        jf.NonAdditiveNoise(lambda x, w: F @ x + jnp.sqrt(Q) @ w),
        jnp.eye(2),
        jf.NonAdditiveNoise(lambda x, w: observe(x) + noise * w),
        jnp.eye(1),
    ),
    "student_t": lambda noise: jf.student_t(jf.kalman(PRIOR, F, Q, H, covariance(noise)), 1e6),
    # Errors that last for a thousandth of a step are white.
    "correlated_noise": lambda noise: jf.correlated_noise(
        jf.kalman(PRIOR, F, Q, H, jnp.zeros((1, 1))), jf.GaussMarkov(jnp.array(1e-3), jnp.square(noise)[None])
    ),
    "measurement_differencing": lambda noise: jf.measurement_differencing(
        jf.kalman(PRIOR, F, Q, H, jnp.zeros((1, 1))), jf.GaussMarkov(jnp.array(1e-3), jnp.square(noise)[None])
    ),
    "robust": lambda noise: jf.robust(extended(noise), 1e-7, jnp.array([[25.0]])),
    # Two modes of one model are that model.
    "imm": lambda noise: jf.imm([extended(noise)] * 2, [[0.9, 0.1], [0.4, 0.6]], [0.3, 0.7]),
    "switching": lambda noise: jf.switching(
        [extended(noise)] * 2, [[0.9, 0.1], [0.4, 0.6]], [0.3, 0.7], num_particles=4
    ),
}
"""Filters that are exact for a linear Gaussian model."""

SAMPLED = {
    "ensemble_kalman": lambda noise, share: jf.ensemble_kalman(
        sample_prior, sample_transition, observe, covariance(noise), num_particles=COUNT, noise=jf.StandardNormal(2)
    ),
    "bootstrap": lambda noise, share: jf.bootstrap(
        sample_prior, sample_transition, log_likelihood_of(noise), ess_threshold=share, **SIZES
    ),
    "correlated_bootstrap": lambda noise, share: jf.correlated_bootstrap(
        sample_prior,
        sample_transition,
        observe,
        jnp.zeros(1),
        jf.GaussMarkov(jnp.array(1e-3), jnp.square(noise)[None]),
        ess_threshold=share,
        **SIZES,
    ),
    "guided": lambda noise, share: jf.guided(
        *guided_model(noise),
        log_transition=log_transition,
        proposal=jf.proposals.linearized(*linear(noise)),
        ess_threshold=share,
        **SIZES,
    ),
    "auxiliary": lambda noise, share: jf.auxiliary(
        *guided_model(noise),
        log_first_stage=lambda x, y: log_likelihood_of(2 * noise)(move(x, None), y),
        ess_threshold=share,
        **SIZES,
    ),
    "locally_optimal": lambda noise, share: jf.locally_optimal(
        PRIOR, *linear(noise), num_particles=COUNT, ess_threshold=share
    ),
    "rao_blackwell": lambda noise, share: marginal(jf.rao_blackwell, noise, share),
    "rao_blackwell_shared": lambda noise, share: marginal(jf.rao_blackwell_shared, noise, share),
    "guided_rao_blackwell": lambda noise, share: jf.guided_rao_blackwell(
        marginal(jf.rao_blackwell_shared, noise, share),
        lambda particles, log_weights, y: jf.Guidance(y, 1 / covariance(noise)),
    ),
}
"""Filters whose log evidence has a Monte Carlo error."""


def value_and_slope(build, key):
    """Log evidence of the data, and its derivative with respect to the standard deviation of the observations."""
    return jax.jit(jax.value_and_grad(lambda noise: jf.log_evidence(build(noise), key, YS)))


STEP = 1e-5
EXPECTED = evidence_of_textbook(NOISE)
SLOPE = (evidence_of_textbook(NOISE + STEP) - evidence_of_textbook(NOISE - STEP)) / (2 * STEP)


def difference(function):
    """Central finite difference of the values of a function that returns derivatives, too."""
    (above, _), (below, _) = (function(NOISE + step) for step in (STEP, -STEP))
    return (np.asarray(above) - np.asarray(below)) / (2 * STEP)


@pytest.mark.system
@pytest.mark.parametrize("name", EXACT)
def test_filters_that_are_exact_have_the_evidence_and_the_gradient_of_the_textbook(x64, name):
    function = value_and_slope(EXACT[name], KEY)
    value, slope = function(NOISE)
    # Errors that last for a thousandth of a step and weights of 1e-7 are not nothing.
    np.testing.assert_allclose(value, EXPECTED, atol=2e-4)
    np.testing.assert_allclose(slope, SLOPE, atol=2e-2)
    np.testing.assert_allclose(slope, difference(function), rtol=1e-6)


PROGRAMS = EXACT | {name: partial(build, share=0.5) for name, build in SAMPLED.items()}
TRACED = {"extended_kalman", "unscented_kalman", "rao_blackwell", "guided_rao_blackwell", "auxiliary"}
"""Those of which the programs are made quickly, and others of which they have parts."""


@pytest.mark.parametrize(
    "name", [name if name in TRACED else pytest.param(name, marks=pytest.mark.system) for name in PROGRAMS]
)
def test_products_have_full_precision_and_so_have_their_derivatives(x64, products_at_default_precision, name):
    """Of the filters: how precise the products of a model are is for the model to say, here for this file."""
    assert not products_at_default_precision(value_and_slope(PROGRAMS[name], KEY), NOISE)


QUICK = {"ensemble_kalman", "bootstrap", "rao_blackwell"}


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.system) for name in SAMPLED]
)
def test_filters_that_sample_agree_with_the_textbook_within_their_error(x64, name):
    """Over 16 keys, at four standard errors of the mean: a false alarm has a probability of 6e-5 for each number.

    On top come the biases, of order 1 / N in the log evidence, and in the derivative, which ignores that another
    parameter would have resampled other particles: for N = 1000 at most 2 and 5 percent. Without resampling the log
    evidence of one key is a smooth function, whose derivative is that of finite differences.
    """
    build = SAMPLED[name]
    of_share = jax.jit(
        jax.vmap(
            lambda noise, share, key: jax.value_and_grad(lambda s: jf.log_evidence(build(s, share), key, YS))(noise),
            in_axes=(None, None, 0),
        )
    )
    values, slopes = (np.asarray(x) for x in of_share(NOISE, 0.5, KEYS))
    assert abs(values.mean() - EXPECTED) < 4 * values.std(ddof=1) / 4 + 0.02
    assert abs(slopes.mean() - SLOPE) < 4 * slopes.std(ddof=1) / 4 + 0.05 * abs(SLOPE)
    smooth = lambda noise: of_share(noise, 0.0, KEYS)
    np.testing.assert_allclose(smooth(NOISE)[1], difference(smooth), rtol=1e-4)


@pytest.mark.system
def test_adaptive_diffusion_follows_and_has_gradients(x64):
    def build(noise):
        likelihood = lambda particles, y: jax.scipy.stats.norm.logpdf(y - particles, 0.0, noise).sum(0)
        fit = jf.math.diffusion.start(jnp.ones(1))
        prior = lambda key: sample_prior(key)[:1]
        return jf.adaptive_diffusion(prior, likelihood, fit, num_particles=COUNT, mode_scale=jnp.ones(1))

    value, slope = value_and_slope(build, KEY)(NOISE)
    assert np.isfinite([value, slope]).all()
    _, estimates = jf.run(build(jnp.array(0.5)), KEY, YS, jnp.full(len(YS), DT), collect=keep_estimate)
    # The truth moves by half a unit a step, and the noise is 0.5: from the second half on it is within 3 of these.
    truth = np.arange(1, 16)[:, None] * DT
    assert np.abs(estimates - truth)[7:].max() < 1.5


def differences(evidence):
    """Central finite differences of a function of the observations."""
    steps = STEP * jnp.eye(YS.size).reshape(-1, *YS.shape)
    values = jax.jit(jax.vmap(lambda step: evidence(YS + step) - evidence(YS - step)))(steps)
    return np.asarray(values).reshape(YS.shape) / (2 * STEP)


def keep_estimate(state, info):
    del info
    return state.estimate


def test_a_hidden_markov_model_is_a_filter_too(x64):
    emission = jf.hmm.DiagonalGaussian(jnp.array([[0.0], [5.0]]), jnp.ones((2, 1)))
    model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], emission)
    total = jf.log_evidence(jf.hmm.online(model), KEY, YS)
    np.testing.assert_allclose(total, jf.hmm.log_evidence(model, model.log_likelihoods(YS)), rtol=1e-5)
    slope = jax.grad(lambda y: jf.hmm.log_evidence(model, model.log_likelihoods(y)))(YS)
    evidence = lambda y: jf.hmm.log_evidence(model, model.log_likelihoods(y))
    np.testing.assert_allclose(slope, differences(evidence), rtol=1e-6)


@pytest.mark.system
def test_a_hidden_semi_markov_model_is_a_filter_too(x64):
    emission = jf.hmm.DiagonalGaussian(jnp.array([[0.0], [5.0]]), jnp.ones((2, 1)))
    model = jf.hmm.semi_markov([0.5, 0.5], np.eye(2)[::-1], [[0.5, 0.5], [0.0, 1.0]], emission)
    total = jf.log_evidence(jf.hmm.semi_markov_online(model), KEY, YS)
    np.testing.assert_allclose(total, jf.hmm.semi_markov_log_evidence(model, model.log_likelihoods(YS)), rtol=1e-5)
    slope = jax.grad(lambda y: jf.hmm.semi_markov_log_evidence(model, model.log_likelihoods(y)))(YS)
    evidence = lambda y: jf.hmm.semi_markov_log_evidence(model, model.log_likelihoods(y))
    np.testing.assert_allclose(slope, differences(evidence), rtol=1e-6)


@pytest.mark.system
def test_smoothing_and_fitting_take_any_of_them(x64):
    beliefs, infos = jf.smoothing.filter_and_smooth(extended(jnp.array(NOISE)), KEY, YS)
    assert beliefs.mean.shape == (len(YS), 2)
    np.testing.assert_allclose(infos.log_evidence.sum(), EXPECTED, atol=2e-4)
    density = jf.fit.log_evidence(KEY, lambda theta: extended(theta["noise"]), YS)
    found = jf.fit.maximize(density, {"noise": jnp.array(NOISE)}, jf.fit.positive)
    near = [evidence_of_textbook(float(found.theta["noise"]) + step) for step in (-0.02, 0.0, 0.02)]
    assert near[1] == max(near)


def test_every_public_name_can_be_loaded():
    for name in jf.__all__:
        assert getattr(jf, name) is not None
    assert set(jf.__all__) <= set(dir(jf))


def test_every_builder_has_cases_of_bad_input():
    text = "".join(path.read_text() for path in Path(__file__).with_name("bad_input").glob("test_*.py"))
    functions = [name for name in jf.__all__ if type(getattr(jf, name)).__name__ == "function"]
    assert len(functions) > 15
    used = {"init", "keep_all", "keep_info", "map_component", "predict", "step", "update"}
    built = [name for name in functions if name not in used]
    assert not [name for name in built if f"jf.{name}(" not in text]


def test_a_name_of_the_previous_version_says_what_it_is_called_now():
    for old, new in (("extended", "extended_kalman"), ("loglikelihood", "log_evidence"), ("views", "schmidt_kalman")):
        with pytest.raises(AttributeError, match=f"renamed to jf.{new}"):
            getattr(jf, old)
