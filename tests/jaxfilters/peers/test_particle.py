"""What other libraries test of their particle filters, with their models and tolerances.

cuthbert (tests/cuthbert/smc, tests/cuthbertlib/resampling), blackjax (tests/smc/test_resampling.py), smcx
(tests/test_guided.py, tests/test_auxiliary_guided_composition.py) and particles, whose tests are the figures of the
book of N. Chopin and O. Papaspiliopoulos (book/filtering). The tests are written anew.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import jaxfilters as jf

KEY = jax.random.key(0)
TO_ANY_NUMBER = ("systematic", "stratified", "multinomial", "residual", "ssp")


def linear_model(seed, n=3, m=2, length=20):
    """A random linear Gaussian model like that of cuthbert's `generate_lgssm`, and readings."""
    rng = np.random.default_rng(seed)
    root = lambda size: np.linalg.cholesky(np.eye(size) + 0.1 * (lambda A: A @ A.T)(rng.normal(size=(size, size))))
    F, H = 0.9 * np.linalg.qr(rng.normal(size=(n, n)))[0], rng.normal(size=(m, n))
    Q, R = root(n) @ root(n).T, root(m) @ root(m).T
    Q, R = (Q + Q.T) / 2, (R + R.T) / 2
    Q, R = Q @ Q.T, R @ R.T
    x, ys = rng.normal(size=n), []
    for _ in range(length):
        x = F @ x + np.linalg.cholesky(Q) @ rng.normal(size=n)
        ys.append(H @ x + np.linalg.cholesky(R) @ rng.normal(size=m))
    arrays = (jnp.asarray(array, jnp.float32) for array in (F, Q, H, R, np.array(ys)))
    return (jf.Gaussian(jnp.zeros(n), jnp.eye(n)), *arrays)


def bootstrap_of(prior, F, Q, H, R, num_particles):
    root = jnp.linalg.cholesky(Q)
    return jf.bootstrap(
        jf.priors.gaussian_prior(prior),
        lambda noise, x: F @ x + root @ noise,
        lambda x, y: jf.Gaussian(H @ x, R).logpdf(y),
        num_particles=num_particles,
        noise=jf.StandardNormal(len(F)),
        ess_threshold=0.7,
    )


def keep_moments(state, info):
    cloud = (state.particles, state.log_weights)
    return jf.weights.mean(*cloud), jf.weights.covariance(*cloud), info.log_evidence, info.effective_sample_size


@pytest.mark.optimised
@pytest.mark.system
def test_cuthbert_a_million_particles_are_the_kalman_filter():
    """At five standard errors, for 260 numbers: wrong with a probability of 2e-4 if the errors are Gaussian.

    One observation lies so far from its prediction that 1 % of the particles carry the weight, then and a step later.
    """
    prior, F, Q, H, R, ys = linear_model(0)
    _, (*found, effective) = jf.run(bootstrap_of(prior, F, Q, H, R, 1_000_000), KEY, ys, collect=keep_moments)
    _, (beliefs, infos) = jf.run(jf.kalman(prior, F, Q, H, R), KEY, ys)
    share = 1 / np.sqrt(np.minimum(effective, np.append(effective[:1], effective[:-1])))
    P = np.asarray(beliefs.covariance)
    v = np.diagonal(P, axis1=1, axis2=2)
    standard_errors = np.sqrt(v), np.sqrt(v[:, :, None] * v[:, None, :] + P**2), np.ones(len(ys))
    for a, b, std in zip(found, (beliefs.mean, P, infos.log_evidence), standard_errors, strict=True):
        error = np.abs(np.asarray(a) - b) / std
        assert np.all(error.reshape(len(ys), -1).max(axis=1) < 5 * share)


def test_cuthbert_particles_may_be_tuples():
    def move(key, state):
        position, velocity = state
        return position + 0.1 * velocity, velocity + jax.random.normal(key, (2,))

    pf = jf.bootstrap(lambda key: (jnp.zeros(2), jnp.ones(2)), move, lambda x, y: jnp.zeros(()), num_particles=100)
    _, (states, _) = jf.run(pf, KEY, jnp.zeros(5))
    assert [leaf.shape for leaf in states.particles] == [(5, 2, 100)] * 2


@pytest.mark.system
@pytest.mark.parametrize("name", [*TO_ANY_NUMBER, "killing"])
def test_cuthbert_shares_of_ancestors_are_the_weights(name):
    scheme = getattr(jf.resampling, name)
    tolerance = 1 / np.sqrt(1000)
    for n, m in [(5, 5), (10, 10), (5, 10), (10, 5)]:
        log_weights = jax.random.uniform(jax.random.key(42), (n,))
        if name == "killing" and n != m:
            continue
        draw = (lambda key: scheme(key, log_weights)) if n == m else lambda key: scheme(key, log_weights, m)  # noqa: B023
        ancestors = jax.vmap(draw)(jax.random.split(KEY, 1000))
        shares = np.bincount(np.asarray(ancestors).ravel(), minlength=n) / ancestors.size
        np.testing.assert_allclose(shares, jax.nn.softmax(log_weights), rtol=tolerance, atol=tolerance)


@pytest.mark.optimised
@pytest.mark.system
@pytest.mark.parametrize("method", ["trajectories", "backward_sampling"])
def test_cuthbert_smoothed_means_are_those_of_the_kalman_smoother(method):
    prior, F, Q, H, R, ys = linear_model(1)
    pf = bootstrap_of(prior, F, Q, H, R, 5000)
    state, history = jf.run(pf, KEY, ys, collect=jf.smoothing.keep_history)
    if method == "trajectories":
        paths = jax.vmap(jf.weights.mean, (0, None))(jf.smoothing.trajectories(history), state.log_weights)
    else:
        log_transition = lambda x_next, x: jf.Gaussian(F @ x, Q).logpdf(x_next)
        paths = jf.smoothing.backward_sampling(KEY, history, log_transition, num_paths=200).mean(axis=-1)
    smoothed, _ = jf.smoothing.filter_and_smooth(jf.kalman(prior, F, Q, H, R), KEY, ys)
    assert np.mean((paths - smoothed.mean) ** 2) <= 0.1


def test_cuthbert_effective_sample_size():
    assert np.isclose(jf.weights.effective_sample_size(jnp.ones(10)), 10.0, rtol=1e-6)
    one = jnp.full(10, -jnp.inf).at[2].set(0.0)
    assert np.isclose(jf.weights.effective_sample_size(one), 1.0, rtol=1e-8)
    log_weights = jax.random.normal(KEY, (100,))
    expected = 1 / jnp.sum(jax.nn.softmax(log_weights) ** 2)
    assert np.isclose(jf.weights.effective_sample_size(log_weights), expected, rtol=1e-6)


@pytest.mark.system
@pytest.mark.parametrize("num_samples", [100, 2000])
@pytest.mark.parametrize("name", TO_ANY_NUMBER)
def test_blackjax_resampled_moments_are_the_weighted_ones(name, num_samples):
    rng = np.random.default_rng(42)
    w, values = rng.random(10_000), np.cos(rng.normal(size=10_000))
    draw = jax.jit(jax.vmap(lambda key: getattr(jf.resampling, name)(key, jnp.log(jnp.asarray(w)), num_samples)))
    drawn = values[np.asarray(draw(jax.random.split(jax.random.key(42), 100)))]
    mean = np.average(values, weights=w)
    np.testing.assert_allclose(drawn.mean(), mean, atol=1e-2, rtol=1e-2)
    std = np.sqrt(np.average((values - mean) ** 2, weights=w))
    np.testing.assert_allclose(drawn.std(axis=1).mean(), std, atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize("name", TO_ANY_NUMBER)
def test_blackjax_weightless_ends_are_never_drawn(name):
    # A float32 softmax whose cumulative sum ends below 1, and weights of zero at both ends and in between.
    draw = jax.jit(lambda w: jax.vmap(lambda key: getattr(jf.resampling, name)(key, w))(jax.random.split(KEY, 500)))
    for logits in ([0.0, -1.0, -2.0, -3.0, -4.0, -jnp.inf], [-jnp.inf, 0.0, -jnp.inf, 0.0, -jnp.inf, -jnp.inf]):
        log_weights = jnp.array(logits)
        assert np.isfinite(log_weights[draw(log_weights)]).all()


A, Q, R = 0.9, 0.25, 1.0
"""The model of smcx's tests: an autoregression, and the variances of its noise and of a reading."""
MEAN_OF = {"prior": lambda x, y: A * x, "optimal": lambda x, y: (A * x / Q + y / R) / (1 / Q + 1 / R)}
MEAN_OF["misspecified"] = lambda x, y: A * x + 0.25 * (y - A * x)
VARIANCE_OF = {"prior": Q, "optimal": 1 / (1 / Q + 1 / R), "misspecified": 0.6}


def autoregression(length):
    rng = np.random.default_rng(0)
    x, ys = rng.normal(), []
    for _ in range(length):
        ys.append(x + rng.normal())
        x = A * x + np.sqrt(Q) * rng.normal()
    return jnp.asarray(ys, jnp.float32)[:, None]


def smcx_filter(name, num_particles, **options):
    mean_of, std = MEAN_OF[name], VARIANCE_OF[name] ** 0.5
    # smcx begins with an update of N(0, 1), to which this prior moves.
    prior = jf.Gaussian(jnp.zeros(1), (1 - Q) / A**2 * jnp.eye(1))
    build = jf.auxiliary if "log_first_stage" in options else jf.guided
    filter = build(
        jf.priors.gaussian_prior(prior),
        lambda noise, x: A * x + Q**0.5 * noise,
        lambda x, y: norm.logpdf(y, x, R**0.5).sum(),
        log_transition=lambda x_next, x: norm.logpdf(x_next, A * x, Q**0.5).sum(),
        proposal=(
            lambda noise, x, y: mean_of(x, y) + std * noise,
            lambda x_next, x, y: norm.logpdf(x_next, mean_of(x, y), std).sum(),
        ),
        num_particles=num_particles,
        noise=jf.StandardNormal(1),
        **options,
    )
    return filter, jf.kalman(prior, A * jnp.eye(1), Q * jnp.eye(1), jnp.eye(1), R * jnp.eye(1))


def check_target(filter, exact, ys):
    """Evidence and two moments of the last frame over 12 seeds: within 5 standard errors plus 2e-5."""
    belief, infos = jf.run(exact, KEY, ys, collect=jf.keep_info)

    def estimates(key):
        state, found = jf.run(filter, key, ys, collect=jf.keep_info)
        ratio = jnp.exp(found.log_evidence.sum() - infos.log_evidence.sum())
        moments = [jf.weights.mean(state.particles[0] ** power, state.log_weights) for power in (1, 2)]
        return jnp.stack([ratio, *moments])

    rows = np.asarray(jax.jit(jax.vmap(estimates))(jax.random.split(KEY, 12)), float)
    mean, variance = float(belief.mean[0]), float(belief.covariance[0, 0])
    error = rows.std(axis=0, ddof=1) / np.sqrt(12)
    assert (abs(rows.mean(axis=0) - [1.0, mean, variance + mean**2]) < 5 * error + 2e-5).all()


@pytest.mark.system
@pytest.mark.parametrize("name", MEAN_OF)
def test_smcx_any_proposal_has_the_exact_target(name):
    check_target(*smcx_filter(name, 1500), autoregression(60))


def test_smcx_auxiliary_and_optimal_proposal_compose():
    first_stage = lambda x, y: norm.logpdf(y, A * x, (Q + R) ** 0.5).sum()
    check_target(*smcx_filter("optimal", 512, log_first_stage=first_stage, ess_threshold=1.1), autoregression(30))


@pytest.mark.system
def test_particles_book_guided_is_better_than_bootstrap_and_auxiliary_than_guided():
    """Figure 10.2: log-likelihoods for rho 0.9, deviations 1 and 0.2, T = 100, N = 1000."""
    rng = np.random.default_rng(1)
    x, ys = rng.normal(), []
    for _ in range(100):
        x = 0.9 * x + rng.normal()
        ys.append(x + 0.2 * rng.normal())
    ys = jnp.asarray(ys, jnp.float32)[:, None]
    one = jnp.eye(1)
    prior = jf.Gaussian(jnp.zeros(1), one / (1 - 0.81))
    exact = jf.log_evidence(jf.kalman(prior, 0.9 * one, one, one, 0.04 * one), KEY, ys)
    optimal = jf.proposals.linearized(lambda x: 0.9 * x, one, lambda x: x, 0.04 * one)
    model = (
        jf.priors.gaussian_prior(prior),
        lambda noise, x: 0.9 * x + noise,
        lambda x, y: norm.logpdf(y, x, 0.2).sum(),
    )
    options = {"num_particles": 1000, "noise": jf.StandardNormal(1)}
    guide = {"proposal": optimal, "log_transition": lambda x_next, x: norm.logpdf(x_next, 0.9 * x, 1.0).sum()}
    filters = {
        "bootstrap": jf.bootstrap(*model, **options),
        "guided": jf.guided(*model, **guide, **options),
        "auxiliary": jf.auxiliary(*model, log_first_stage=optimal.log_predictive, **guide, **options),
    }
    error = {}
    for name, filter in filters.items():
        run = jax.jit(jax.vmap(lambda key, filter=filter: jf.log_evidence(filter, key, ys)))
        error[name] = float(np.mean((run(jax.random.split(KEY, 50)) - exact) ** 2))
    # Ratios of mean squares over 50 runs, at three standard deviations of their logarithm: a factor of 1.8.
    assert error["guided"] < error["bootstrap"] / 1.8
    assert error["auxiliary"] < error["guided"]
