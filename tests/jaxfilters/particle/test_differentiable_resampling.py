"""Soft and transport resampling against plain numpy; the default score against the exact Kalman gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters.filter import keep_info, log_evidence, run
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.differentiable_resampling import soft, transport, transport_plan
from jaxfilters.particle.weighting import resample

KEY = jax.random.key(5)
RNG = np.random.default_rng(7)
YS = RNG.normal(size=10)
THETA = np.array([0.8, -0.5, -1.0])


def sample_prior(key):
    return jax.random.normal(key)


def move(theta, noise, x, inputs):
    del inputs
    return theta[0] * x + jnp.exp(theta[1]) * noise[0]


def log_likelihood(theta, x, y):
    return norm.logpdf(y, x, jnp.exp(theta[2]))


def particle_filter(theta, **options):
    transition, likelihood = (jax.tree_util.Partial(f, theta) for f in (move, log_likelihood))
    return bootstrap(sample_prior, transition, likelihood, noise=StandardNormal(1), **options)


def exact_log_evidence(theta):
    m, P, total = 0.0, 1.0, 0.0
    for y in YS:
        m, P = theta[0] * m, theta[0] ** 2 * P + jnp.exp(2 * theta[1])
        S = P + jnp.exp(2 * theta[2])
        total += norm.logpdf(y, m, jnp.sqrt(S))
        m, P = m + P / S * (y - m), P - P**2 / S
    return total


@jax.jit
def many_gradients(keys, theta):
    def of_theta(theta, key):
        return log_evidence(particle_filter(theta, num_particles=1000), key, jnp.asarray(YS, jnp.float32))

    return jax.vmap(jax.grad(of_theta), in_axes=(None, 0))(theta, keys)


@pytest.mark.system
def test_the_default_is_the_score_of_every_parameter():
    # 400 independent estimates; their bias, O(1/N), is below four standard errors of the mean.
    found = many_gradients(jax.random.split(KEY, 400), jnp.asarray(THETA, jnp.float32))
    found = np.asarray(found, dtype=np.float64)
    exact = np.asarray(jax.grad(exact_log_evidence)(jnp.asarray(THETA)))
    z = (found.mean(axis=0) - exact) / (found.std(axis=0, ddof=1) / np.sqrt(len(found)))
    assert abs(z).max() < 4


@pytest.mark.system
def test_soft_resampling_leaves_the_evidence_unbiased():
    # The evidence itself is unbiased, its logarithm is not: a z-test at 4 sigma.
    pf = particle_filter(jnp.asarray(THETA, jnp.float32), num_particles=100, scheme=soft(0.5), ess_threshold=0.8)
    keys = jax.random.split(KEY, 2000)
    found = jax.vmap(log_evidence, in_axes=(None, 0, None))(pf, keys, jnp.asarray(YS, jnp.float32))
    ratio = np.exp(np.asarray(found, np.float64) - float(exact_log_evidence(jnp.asarray(THETA))))
    z = (ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))
    assert abs(z) < 4


@pytest.mark.system
def test_soft_weights_are_corrected_and_differentiated(x64):
    log_weights = jnp.log(jnp.asarray(RNG.dirichlet(np.ones(6)))).at[2].set(-jnp.inf)
    log_weights = weights.normalize(log_weights)[0]
    particles = {"x": jnp.arange(6.0)}
    found = soft(0.7).resample(KEY, particles, log_weights)
    w = np.exp(log_weights)
    expected = w / (0.7 * w + 0.3 / 6) / 6
    chosen = np.asarray(found.ancestors)
    np.testing.assert_allclose(np.exp(found.log_weights), expected[chosen], rtol=1e-10)
    np.testing.assert_array_equal(found.particles["x"], chosen)
    # d log(w / (a w + b)) / d log w = 1 - a w / (a w + b), and nothing for what has no weight.
    slope = jax.grad(lambda lw: jnp.sum(jnp.exp(soft(0.7).resample(KEY, particles, lw).log_weights)))(log_weights)
    each = expected * (1 - 0.7 * w / (0.7 * w + 0.3 / 6))
    np.testing.assert_allclose(slope, np.bincount(chosen, minlength=6) * each, rtol=1e-10)


def plain_sinkhorn(x, w, regularization):
    """Scalings of the kernel, until nothing changes."""
    n = len(w)
    scaled = (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1).max() * len(x))
    kernel = np.exp(-0.5 * ((scaled[:, :, None] - scaled[:, None]) ** 2).sum(axis=0) / regularization)
    u, v = np.ones(n), np.ones(n)
    for _ in range(5000):
        v = n * w / (kernel.T @ u)
        u = 1 / (kernel @ v)
    return u[:, None] * kernel * v


CLOUD = RNG.normal(size=(2, 15))
SHARES = RNG.dirichlet(np.full(15, 0.5))
SHARES[4] = 0
SHARES /= SHARES.sum()


@pytest.mark.system
@pytest.mark.parametrize("regularization", [0.5, 0.1])
def test_the_plan_is_that_of_sinkhorn(x64, regularization):
    found = transport_plan(jnp.asarray(CLOUD), jnp.log(jnp.asarray(SHARES)), regularization)
    np.testing.assert_allclose(found, plain_sinkhorn(CLOUD, SHARES, regularization), atol=1e-6)
    np.testing.assert_allclose(found.sum(axis=0), 15 * SHARES, atol=1e-5)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-6)


@pytest.mark.system
def test_transport_keeps_the_mean_and_its_derivative_is_that_of_the_plan(x64):
    direction = jnp.asarray(RNG.normal(size=(2, 15)))
    scheme = transport(0.2)

    @jax.jit
    @jax.value_and_grad
    def moved(shift):
        particles = {"x": jnp.asarray(CLOUD) + shift[0] * direction**2}
        log_weights = weights.normalize(jnp.log(jnp.asarray(SHARES)) + shift[1] * direction[0])[0]
        found = scheme.resample(KEY, particles, log_weights)
        return jnp.sum(direction * found.particles["x"])

    shift, steps = jnp.zeros(2), 1e-4 * np.eye(2)
    differences = [(moved(shift + step)[0] - moved(shift - step)[0]) / 2e-4 for step in steps]
    np.testing.assert_allclose(moved(shift)[1], differences, rtol=1e-4)
    found = scheme.resample(KEY, {"x": jnp.asarray(CLOUD)}, jnp.log(jnp.asarray(SHARES)))
    np.testing.assert_allclose(found.particles["x"].mean(axis=1), CLOUD @ SHARES, atol=1e-6)
    np.testing.assert_allclose(np.exp(found.log_weights), 1 / 15, rtol=1e-12)
    assert found.ancestors.dtype == jnp.int32


def test_a_filter_with_transport_is_smooth(x64):
    # The same key on both sides of a difference: with plain resampling it would jump.
    @jax.jit
    @jax.value_and_grad
    def of_theta(theta):
        pf = particle_filter(theta, num_particles=20, scheme=transport(0.3), ess_threshold=1.0)
        return log_evidence(pf, KEY, jnp.asarray(YS))

    theta, steps = jnp.asarray(THETA), 1e-4 * np.eye(3)
    differences = [(of_theta(theta + step)[0] - of_theta(theta - step)[0]) / 2e-4 for step in steps]
    np.testing.assert_allclose(of_theta(theta)[1], differences, rtol=1e-3)


@pytest.mark.parametrize("scheme", [soft(0.5), transport()], ids=["soft", "transport"])
def test_resampling_happens_when_it_should_and_equal_particles_stay(scheme):
    particles = {"x": jnp.full((2, 8), 3.0)}
    log_weights = jnp.log(jnp.asarray(RNG.dirichlet(np.full(8, 0.2)), jnp.float32))
    redraw = jax.jit(lambda lw, threshold: resample(KEY, particles, lw, scheme, threshold))
    moved, found, ancestors = redraw(log_weights, 0.9)
    np.testing.assert_allclose(moved["x"], 3.0, rtol=1e-6)
    assert np.isfinite(found).all()
    assert ancestors.shape == (8,)
    _, kept, ancestors = redraw(log_weights, 0.0)
    np.testing.assert_allclose(kept, log_weights, atol=1e-5)
    np.testing.assert_array_equal(ancestors, np.arange(8))


def test_what_cannot_be_is_rejected():
    with pytest.raises(ValueError, match=r"share must be between 0 and 1; got 1"):
        soft(1.0)
    with pytest.raises(ValueError, match="regularization must be positive; got 0"):
        transport(0.0)
    with pytest.raises(ValueError, match=r"particles\['n'\] must be floating-point.*int32"):
        transport().resample(KEY, {"n": jnp.arange(3)}, weights.uniform(3))


def test_resampling_is_reported():
    pf = particle_filter(jnp.asarray(THETA, jnp.float32), num_particles=20, scheme=soft(0.5), ess_threshold=1.0)
    _, infos = run(pf, KEY, jnp.asarray(YS, jnp.float32), collect=keep_info)
    assert infos.resampled[1:].all()
