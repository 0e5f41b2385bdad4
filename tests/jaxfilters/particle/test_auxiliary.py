"""Guided and auxiliary filters against closed forms, integration on a grid, and a bootstrap filter of 1e6 particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import jaxfilters as jf

KEY = jax.random.key(0)
NORMAL = jf.StandardNormal(1)
Q, R = 0.3, 0.05
"""Variances of a step and of a reading of the wave."""


def wave(x, inputs):
    return 0.7 * x + jnp.sin(2 * x) + (0.0 if inputs is None else inputs)


def observe(x):
    return x + 0.2 * x**2


def sample_prior(key):
    return jax.random.normal(key, (1,))


def move(noise, x, inputs):
    return wave(x, inputs) + Q**0.5 * noise


def log_transition(x_next, x, inputs):
    return norm.logpdf(x_next, wave(x, inputs), Q**0.5).sum()


def log_likelihood(x, y):
    return norm.logpdf(y, observe(x), R**0.5).sum()


def rough_first_stage(x, y, inputs):
    return norm.logpdf(y, observe(wave(x, inputs)), 1.5).sum()


ROUGH = (
    lambda z, x, y, inputs: 0.5 * wave(x, inputs) + 0.5 * y + z,
    lambda x_next, x, y, inputs: norm.logpdf(x_next, 0.5 * wave(x, inputs) + 0.5 * y, 1.0).sum(),
)
MODEL = (sample_prior, move, log_likelihood)
WITH = {"num_particles": 100, "noise": NORMAL}
ADDITIVE = (jf.Gaussian(jnp.zeros(1), jnp.eye(1)), wave, Q * jnp.eye(1), observe, R * jnp.eye(1))
LAPLACE = jf.proposals.laplace(wave, Q * jnp.eye(1), log_likelihood)
FILTERS = {
    "pair": jf.guided(*MODEL, log_transition=log_transition, proposal=ROUGH, **WITH),
    "first stage": jf.auxiliary(*MODEL, log_first_stage=rough_first_stage, ess_threshold=1.0, **WITH),
    "both": jf.auxiliary(
        *MODEL, log_first_stage=rough_first_stage, log_transition=log_transition, proposal=jf.Proposal(*ROUGH), **WITH
    ),
    "laplace": jf.auxiliary(
        *MODEL, log_first_stage=LAPLACE.log_predictive, log_transition=log_transition, proposal=LAPLACE, **WITH
    ),
    "taylor": jf.locally_optimal(*ADDITIVE, num_particles=100, ess_threshold=1.0, prior_share=0.1),
    "unscented": jf.locally_optimal(
        *ADDITIVE, num_particles=100, linearize=jf.linearize.unscented(), iterations=3, prior_share=0.1
    ),
    "soft": jf.guided(
        *MODEL,
        log_transition=log_transition,
        proposal=ROUGH,
        scheme=jf.differentiable_resampling.soft(0.7),
        **WITH,
    ),
}


def readings(length=12):
    rng = np.random.default_rng(3)
    x, ys = rng.normal(), []
    for _ in range(length):
        x = 0.7 * x + np.sin(2 * x) + np.sqrt(Q) * rng.normal()
        ys.append(x + 0.2 * x**2 + np.sqrt(R) * rng.normal())
    return np.array(ys)[:, None]


YS = readings()
MISSING = np.arange(len(YS)) % 4 == 2


def log_evidence_on_a_grid(ys, missing):
    """The forward recursion of the wave on 3000 points, whose spacing is a fiftieth of the noise of a step."""
    grid = np.linspace(-15.0, 15.0, 3000)
    spacing = grid[1] - grid[0]
    density = np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi)
    ahead = 0.7 * grid + np.sin(2 * grid)
    kernel = np.exp(-0.5 * (grid[:, None] - ahead) ** 2 / Q) / np.sqrt(2 * np.pi * Q)
    total = 0.0
    for y, skipped in zip(ys[:, 0], missing, strict=True):
        density = kernel @ density * spacing
        if not skipped:
            error = y - grid - 0.2 * grid**2
            density = density * np.exp(-0.5 * error**2 / R) / np.sqrt(2 * np.pi * R)
            evidence = density.sum() * spacing
            total, density = total + np.log(evidence), density / evidence
    return total


@pytest.fixture(scope="module")
def exact():
    return log_evidence_on_a_grid(YS, MISSING)


@pytest.mark.system
@pytest.mark.parametrize("name", FILTERS)
def test_evidence_is_unbiased_whatever_proposal_and_first_stage_are(name, exact):
    # z-test at 4 sigma over 2000 runs: fails by chance once in 16000. One frame in four has no observation.
    keys = jax.random.split(jax.random.key(1), 2000)
    ys = jnp.where(MISSING[:, None], jnp.nan, jnp.asarray(YS, jnp.float32))
    run = jax.vmap(lambda key: jf.log_evidence(FILTERS[name], key, ys, mask=jnp.asarray(~MISSING)))
    ratio = np.exp(np.asarray(jax.jit(run)(keys), np.float64) - exact)
    assert abs((ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))) < 4
    # Skewed estimates would hide a bias: that of the rough first stage alone has a relative deviation of 1.5.
    assert ratio.std() < 2


def linear(num_particles, **options):
    """One step of a walk, of which the reading is linear."""
    prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
    variances = (Q * jnp.eye(1), lambda x: x, R * jnp.eye(1))
    return jf.locally_optimal(prior, lambda x, inputs: x, *variances, num_particles=num_particles, **options)


def relative_variance(P, S, y):
    """Of N(y; x, S) with x ~ N(0, P), divided by the squared mean."""
    square = norm.pdf(y, 0.0, np.sqrt(P + S / 2)) / (2 * np.sqrt(np.pi * S))
    return float(square / norm.pdf(y, 0.0, np.sqrt(P + S)) ** 2 - 1)


@pytest.mark.system
def test_the_variance_of_the_evidence_is_that_of_theory():
    """One step: n times the variance is that of one weight, N(y; x', R), or N(y; x, Q + R) with the optimal proposal.

    A sample variance of 4000 has a relative standard error of sqrt((kurtosis - 1) / 4000), at most 5 percent here.
    """
    y, count = 0.5, 50
    bootstrap = jf.bootstrap(
        sample_prior,
        lambda noise, x, inputs: x + Q**0.5 * noise,
        lambda x, y: norm.logpdf(y, x, R**0.5).sum(),
        num_particles=count,
        noise=NORMAL,
    )
    keys = jax.random.split(jax.random.key(2), 4000)
    expected = {"bootstrap": relative_variance(1 + Q, R, y), "optimal": relative_variance(1.0, Q + R, y)}
    found = {}
    for name, filter in (("bootstrap", bootstrap), ("optimal", linear(count, ess_threshold=0.0))):
        run = jax.jit(jax.vmap(lambda key, filter=filter: jf.log_evidence(filter, key, jnp.full((1, 1), y))))
        evidence = np.exp(np.asarray(run(keys), float))
        found[name] = count * evidence.var() / evidence.mean() ** 2
    assert expected["optimal"] < 0.3 * expected["bootstrap"]
    for name, value in expected.items():
        assert abs(found[name] / value - 1) < 0.2


def test_a_fully_adapted_filter_has_equal_weights():
    _, infos = jf.run(linear(64, ess_threshold=1.0), KEY, 3 * jnp.asarray(YS, jnp.float32), collect=jf.keep_info)
    # Each weight is a ratio of densities with logarithms of order ten in float32.
    np.testing.assert_allclose(infos.effective_sample_size, 64.0, rtol=1e-5)
    assert infos.resampled.sum() > 6


def test_no_first_stage_excludes_a_particle():
    def sometimes_zero(x, y, inputs):
        return jnp.where(x[0] > 1, -jnp.inf, jnp.where(x[0] < -1, jnp.nan, 0.0))

    pf = jf.auxiliary(*MODEL, log_first_stage=sometimes_zero, ess_threshold=0.0, **WITH)
    _, infos = jf.run(pf, KEY, jnp.asarray(YS, jnp.float32), collect=jf.keep_info)
    plain = jf.guided(*MODEL, log_transition=log_transition, proposal=(lambda z, x, y, u: move(z, x, u), same), **WITH)
    _, expected = jf.run(replaced(plain), KEY, jnp.asarray(YS, jnp.float32), collect=jf.keep_info)
    # Without resampling the first stage has no effect at all.
    np.testing.assert_allclose(infos.log_evidence, expected.log_evidence, rtol=1e-4, atol=1e-4)


def same(x_next, x, y, inputs):
    return log_transition(x_next, x, inputs)


def replaced(filter):
    return jax.tree.map(lambda leaf: 0.0 if leaf == 0.5 else leaf, filter)


def test_states_may_be_pytrees_and_inputs_reach_the_proposal():
    step = lambda x, inputs: x["at"] + inputs["by"]
    proposal = (
        lambda z, x, y, inputs: {"at": step(x, inputs) + 0.5 * z},
        lambda new, x, y, inputs: norm.logpdf(new["at"], step(x, inputs), 0.5).sum(),
    )
    pf = jf.guided(
        lambda key: {"at": jnp.zeros(2)},
        lambda z, x, inputs: {"at": step(x, inputs) + 0.5 * z},
        lambda x, y: norm.logpdf(y, x["at"], 0.1).sum(),
        log_transition=lambda new, x, inputs: norm.logpdf(new["at"], step(x, inputs), 0.5).sum(),
        proposal=proposal,
        num_particles=500,
        noise=jf.StandardNormal(2),
    )
    inputs = {"by": jnp.ones((8, 1))}
    ys = jnp.arange(1.0, 9.0)[:, None] * jnp.ones(2)
    state, _ = jf.run(pf, KEY, ys, inputs)
    mean = jf.weights.mean(state.particles, state.log_weights)["at"]
    np.testing.assert_allclose(mean, 8.0, atol=0.1)


@pytest.mark.system
def test_gradients_are_those_of_finite_differences(x64):
    """Without resampling the estimate is a smooth function of the parameters."""

    @jax.jit
    def value(log_noise):
        variances = (jnp.exp(log_noise) * jnp.eye(1), observe, R * jnp.eye(1))
        prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        pf = jf.locally_optimal(prior, wave, *variances, num_particles=20, ess_threshold=0.0)
        return jf.log_evidence(pf, KEY, jnp.asarray(YS[:3]))

    at, h = jnp.log(Q), 1e-5
    slope = (value(at + h) - value(at - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(value)(at), slope, rtol=1e-6)


@pytest.mark.system
def test_iterated_twisting_of_a_linear_model_leaves_little_variance(x64):
    """The model of P. Guarniero et al. 2017, section 4.1, in two dimensions."""
    F = 0.4 ** (1.0 + abs(np.arange(2)[:, None] - np.arange(2)))
    prior, eye = jf.Gaussian(jnp.zeros(2), jnp.eye(2)), jnp.eye(2)
    ys = jnp.asarray(1.5 * np.random.default_rng(0).normal(size=(30, 2)))
    expected = jf.log_evidence(jf.kalman(prior, jnp.asarray(F), eye, eye, eye), KEY, ys)
    reading = lambda x, y: jf.Gaussian(x, eye).logpdf(y)
    find = lambda key: jf.iterated_auxiliary(
        key, prior, lambda x: F @ x, eye, reading, ys, num_particles=50, iterations=1
    )
    found = jax.jit(jax.vmap(find))(jax.random.split(KEY, 10))
    # The first run is that of a bootstrap filter; in the last one percent of the particles is not twisted.
    errors = np.asarray(found.estimates - expected)
    assert abs(errors[:, -1]).max() < 0.3
    assert errors[:, -1].std() < 0.1 * errors[:, 0].std()
    # Trajectories are draws from the smoothing distribution.
    smoothed = jf.smoothing.filter_and_smooth(jf.kalman(prior, jnp.asarray(F), eye, eye, eye), KEY, ys)[0]
    means = jax.vmap(jf.smoothing.trajectories)(found.history).mean(axis=(0, -1))
    # 500 particles, of which early ones share ancestors; deviations are below 0.8.
    assert abs(means - smoothed.mean).max() < 0.4


@pytest.mark.system
def test_products_of_twisted_filters_have_full_precision(products_at_default_precision):
    prior, Q, ys = jf.Gaussian(jnp.zeros(2), jnp.eye(2)), jnp.eye(2), jnp.zeros((3, 2))
    reading = lambda x, y: -jnp.sum((y - x) ** 2)
    find = lambda key: jf.iterated_auxiliary(key, prior, lambda x: x, Q, reading, ys, num_particles=20, iterations=1)
    assert not products_at_default_precision(find, KEY)


@pytest.mark.system
def test_iterated_twisting_is_unbiased_and_better_than_bootstrap(exact):
    ys = jnp.asarray(YS, jnp.float32)
    inputs = jnp.asarray(~MISSING, jnp.float32)
    reading = lambda x, y, is_read: is_read * log_likelihood(x, y)
    prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
    find = lambda key: jf.iterated_auxiliary(
        key, prior, lambda x: wave(x, None), Q * jnp.eye(1), reading, ys, inputs, num_particles=200, iterations=3
    )
    estimates = jax.jit(jax.vmap(lambda key: find(key).estimates))(jax.random.split(jax.random.key(1), 400))
    ratios = np.exp(np.asarray(estimates, np.float64) - exact)
    # z-tests at 4 sigma of the first run and the last: one of them fails by chance once in 8000.
    for of_run in (ratios[:, 0], ratios[:, -1]):
        assert abs((of_run.mean() - 1) / (of_run.std(ddof=1) / 20)) < 4
    assert ratios[:, -1].std() < 0.7 * ratios[:, 0].std()


MU, PHI, SIGMA = -1.0, 0.9, 1.0


@pytest.mark.optimised
@pytest.mark.system
def test_stochastic_volatility_agrees_with_a_million_particles():
    """The model of S. Kim, N. Shephard and S. Chib 1998; 200 runs of 100 particles against one of 1e6, at 4 sigma."""
    mean = lambda x, inputs: MU + PHI * (x - MU)
    likelihood = lambda x, y: norm.logpdf(y, 0.0, jnp.exp(x[0] / 2))
    prior = jf.Gaussian(jnp.full(1, MU), SIGMA**2 / (1 - PHI**2) * jnp.eye(1))
    step = lambda noise, x, inputs: mean(x, inputs) + SIGMA * noise
    model = (jf.priors.gaussian_prior(prior), step, likelihood)
    laplace = jf.proposals.laplace(mean, SIGMA**2 * jnp.eye(1), likelihood)
    adapted = jf.auxiliary(
        *model,
        log_first_stage=laplace.log_predictive,
        log_transition=lambda new, x, inputs: norm.logpdf(new, mean(x, inputs), SIGMA).sum(),
        proposal=laplace,
        **WITH,
    )
    ys = jnp.asarray(np.random.default_rng(0).normal(size=12) * np.tile([0.1, 3.0, 0.7], 4), jnp.float32)
    million = jf.bootstrap(*model, num_particles=1_000_000, noise=NORMAL)
    reference = float(jf.log_evidence(million, KEY, ys))
    keys = jax.random.split(jax.random.key(1), 200)
    evidences = {}
    for name, filter in (("adapted", adapted), ("bootstrap", jf.bootstrap(*model, **WITH))):
        run = jax.jit(jax.vmap(lambda key, filter=filter: jf.log_evidence(filter, key, ys)))
        evidences[name] = np.exp(np.asarray(run(keys), float) - reference)
    # The reference's own error is that of the bootstrap filter of 100 particles over a hundred.
    error = np.hypot(evidences["adapted"].std() / np.sqrt(200), evidences["bootstrap"].std() / 100)
    assert abs(evidences["adapted"].mean() - 1) < 4 * error
    assert evidences["adapted"].std() < 0.95 * evidences["bootstrap"].std()


def test_missing_components_of_a_reading_say_nothing():
    R2 = jnp.array([[0.3, 0.1], [0.1, 0.2]])
    both = jf.proposals.linearized(wave, Q * jnp.eye(1), lambda x: jnp.concatenate([x, 2 * x]), R2)
    one = jf.proposals.linearized(wave, Q * jnp.eye(1), lambda x: x, R2[:1, :1])
    x = jnp.full(1, 0.3)
    found, expected = both.posterior(x, jnp.array([1.0, jnp.nan]), None), one.posterior(x, jnp.ones(1), None)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


@pytest.mark.system
def test_noise_in_few_directions_is_proposed_in_these():
    """A position and a velocity that one acceleration drives: Q has rank 1."""
    B = jnp.array([0.5, 1.0])
    model = (lambda x, inputs: jnp.array([x[0] + x[1], x[1]]), jnp.outer(B, B), lambda x: x[:1], 0.1 * jnp.eye(1))
    pf = jf.locally_optimal(jf.Gaussian(jnp.zeros(2), jnp.eye(2)), *model, num_particles=50, ess_threshold=1.0)
    ys = jnp.arange(1.0, 11.0)[:, None]
    _, infos = jf.run(pf, KEY, ys, collect=jf.keep_info)
    np.testing.assert_allclose(infos.effective_sample_size, 50.0, rtol=1e-4)
    exact = jf.kalman(
        jf.Gaussian(jnp.zeros(2), jnp.eye(2)), jnp.array([[1.0, 1.0], [0.0, 1.0]]), model[1], jnp.eye(2)[:1], model[3]
    )
    ratio = jax.vmap(lambda key: jf.log_evidence(pf, key, ys))(jax.random.split(KEY, 300)) - jf.log_evidence(
        exact, KEY, ys
    )
    ratio = np.exp(np.asarray(ratio, float))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(300)


@pytest.mark.system
def test_many_positions_with_velocities_may_be_driven_by_one_acceleration_each():
    """Five copies: Q is (10, 10) of rank 5."""
    eye = jnp.eye(5)
    F, Q = (
        jnp.kron(eye, jnp.array([[1.0, 1.0], [0.0, 1.0]])),
        jnp.kron(eye, jnp.outer(jnp.array([0.5, 1.0]), jnp.array([0.5, 1.0]))),
    )
    prior, ys = jf.Gaussian(jnp.zeros(10), 0.05 * jnp.eye(10)), jnp.ones((4, 5))
    model = (Q, lambda x: x[::2], 0.1 * eye)
    pf = jf.locally_optimal(prior, lambda x: F @ x, *model, num_particles=100, ess_threshold=1.0)
    _, infos = jf.run(pf, KEY, ys, collect=jf.keep_info)
    np.testing.assert_allclose(infos.effective_sample_size, 100.0, rtol=1e-4)
    assert jnp.all(infos.num_invalid == 0)
    exact = jf.log_evidence(jf.kalman(prior, F, Q, jnp.eye(10)[::2], model[2]), KEY, ys)
    estimates = jax.vmap(lambda key: jf.log_evidence(pf, key, ys))(jax.random.split(KEY, 300))
    # The estimate is unbiased: within four standard errors.
    ratio = np.exp(np.asarray(estimates - exact, float))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(300)
    assert ratio.std() < 2
