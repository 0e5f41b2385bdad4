"""Online smoothing of sums over time against the joint Gaussian of all states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import jaxfilters as jf

RATE, PROCESS_STD, NOISE_STD, LENGTH = 0.9, 0.5, 0.4, 20
LOG_BOUND = float(norm.logpdf(0.0, 0.0, PROCESS_STD))
YS = jnp.asarray(np.cumsum(np.random.default_rng(0).normal(0, 0.4, LENGTH)), jnp.float32)


def build(num_particles, log_bound=LOG_BOUND, rate=RATE):
    pf = jf.bootstrap(
        jax.random.normal,
        lambda noise, x: rate * x + PROCESS_STD * noise[0],
        lambda x, y: norm.logpdf(y, x, NOISE_STD),
        num_particles=num_particles,
        noise=jf.StandardNormal(1),
    )
    functional = lambda x, x_next: {"squares": x**2, "products": x * x_next}
    start = lambda x: {"squares": 0.0, "products": 0.0}
    density = lambda x_next, x: norm.logpdf(x_next, rate * x, PROCESS_STD)
    return jf.smoothing.paris(pf, start, functional, density, log_bound, max_candidates=4)


def expected():
    """Sums of E[x_t^2] for t < T and of E[x_t x_t+1] given all observations."""
    carry = np.tril(RATE ** np.subtract.outer(np.arange(LENGTH + 1), np.arange(LENGTH + 1)).astype(float))
    stds = np.diag([1.0, *[PROCESS_STD] * LENGTH]) ** 2
    P = carry @ stds @ carry.T
    H = np.eye(LENGTH + 1)[1:]
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + NOISE_STD**2 * np.eye(LENGTH))
    mean, C = gain @ np.asarray(YS, float), P - gain @ H @ P
    second = C + np.outer(mean, mean)
    return {"squares": np.trace(second) - second[-1, -1], "products": np.trace(second, offset=1)}


@pytest.mark.system
@pytest.mark.optimised
def test_the_estimates_are_those_of_the_joint_gaussian():
    """Means of 64 runs, at four standard errors: a false alarm has a probability of 6e-5 for each number.

    The bias of 200 particles, of order 1 / N, may be half of a percent besides.
    """
    run = lambda key: jf.run(build(200), key, YS, collect=jf.keep_info)[0]
    last = jax.jit(lambda keys: jax.lax.map(run, keys))(jax.random.split(jax.random.key(0), 64))
    assert last.is_bounded.all()
    found = jax.vmap(lambda state: state.estimate)(last)
    for name, value in expected().items():
        values = np.asarray(found[name], float)
        assert abs(values.mean() - value) < 4 * values.std(ddof=1) / 8 + 0.005 * value, name


@pytest.mark.system
def test_a_bound_that_is_too_low_is_no_estimate_and_gradients_are_finite():
    last, _ = jf.run(build(50, LOG_BOUND - 0.5), jax.random.key(0), YS, collect=jf.keep_info)
    assert not last.is_bounded
    assert np.isnan(last.estimate["squares"])

    def products(rate):
        return jf.run(build(50, rate=rate), jax.random.key(0), YS[:5], collect=jf.keep_info)[0].estimate["products"]

    assert np.isfinite(jax.grad(products)(0.9))
