import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla import prefix
from jaxfilters.particle import resampling

SCHEMES = {
    "systematic": jax.jit(resampling.systematic),
    "stratified": jax.jit(resampling.stratified),
    "multinomial": jax.jit(resampling.multinomial),
    "residual": jax.jit(resampling.residual),
}
# How far a count may lie from n w_i.
SPREAD = {"systematic": (-1, 1), "stratified": (-2, 2), "multinomial": (-np.inf, np.inf), "residual": (-1, np.inf)}
# 32 numbers a row, 1024 two levels of rows.
SIZES = [1, 33, 1025]


@pytest.fixture(params=SCHEMES, ids=str)
def scheme(request):
    return SCHEMES[request.param]


def uneven(n, seed=0, scale=3.0, dtype=jnp.float32):
    rng = np.random.default_rng(seed)
    log_weights = scale * rng.normal(size=n)
    log_weights[rng.random(n) < 0.3] = -np.inf
    log_weights[n // 2] = scale
    return jnp.asarray(log_weights, dtype)


def normalised(log_weights):
    w = np.exp(np.asarray(log_weights, np.float64) - float(log_weights.max()))
    return w / w.sum()


@pytest.mark.system
@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("name", SCHEMES)
def test_ancestors_are_sorted_weighted_indices_with_the_counts_of_their_scheme(name, n):
    log_weights = uneven(n)
    ancestors = np.asarray(SCHEMES[name](jax.random.key(n), log_weights))
    assert ancestors.shape == (n,)
    assert ancestors.dtype == np.int32
    assert (np.diff(ancestors) >= 0).all()
    assert np.isfinite(np.asarray(log_weights)[ancestors]).all()
    deviation = np.bincount(ancestors, minlength=n) - n * normalised(log_weights)
    low, high = SPREAD[name]
    assert (deviation > low - 1e-3).all()
    assert (deviation < high + 1e-3).all()


@pytest.mark.system
def test_counts_are_unbiased(scheme):
    n, runs = 40, 3000
    log_weights = uneven(n, seed=2, scale=1.5)
    ancestors = jax.jit(jax.vmap(scheme, (0, None)))(jax.random.split(jax.random.key(7), runs), log_weights)
    counts = np.apply_along_axis(np.bincount, 1, np.asarray(ancestors), minlength=n)
    expected = n * normalised(log_weights)
    # Where every run gives the same count it must be the expected one; elsewhere a z-test of the mean.
    error = np.sqrt(np.maximum(counts.var(axis=0, ddof=1), 1e-10) / runs)
    assert (abs(counts.mean(axis=0) - expected) < 4 * error).all()


def test_draws_that_should_be_independent_have_the_multinomial_variance():
    n, runs = 40, 4000
    log_weights = uneven(n, seed=2, scale=1.5)
    ancestors = jax.vmap(SCHEMES["multinomial"], (0, None))(jax.random.split(jax.random.key(9), runs), log_weights)
    counts = np.apply_along_axis(np.bincount, 1, np.asarray(ancestors), minlength=n)
    w = normalised(log_weights)
    covariance = n * (np.diag(w) - np.outer(w, w))
    # Each entry of a sample covariance has variance near (c_ii c_jj + c_ij^2) / runs, more for rare particles.
    sigma = np.sqrt((np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2) / runs) + 4 / runs
    assert (abs(np.cov(counts.T) - covariance) < 5 * sigma).all()


@pytest.mark.system
@pytest.mark.parametrize("n", [1, 1000])
def test_even_dead_and_undefined_ensembles(scheme, n):
    for log_weights in (jnp.full(n, -math.log(n)), jnp.full(n, -30.0)):
        ancestors = scheme(jax.random.key(0), log_weights)
        if scheme is not SCHEMES["multinomial"]:
            np.testing.assert_array_equal(ancestors, np.arange(n))
    for nothing in (-jnp.inf, jnp.nan):
        dead = scheme(jax.random.key(0), jnp.full(n, nothing))
        np.testing.assert_array_equal(dead, scheme(jax.random.key(0), jnp.zeros(n)))


@pytest.mark.system
@pytest.mark.parametrize("most", [3, 13])
def test_whole_expected_counts_are_met_exactly_by_certain_copies(most):
    expected = np.tile([most, 1] + [0] * (most - 1), 9)
    log_weights = jnp.log(jnp.asarray(expected / expected.sum(), jnp.float32))
    ancestors = SCHEMES["residual"](jax.random.key(1), log_weights)
    np.testing.assert_array_equal(np.bincount(ancestors, minlength=expected.size), expected)


@pytest.mark.parametrize("heir", [0, 31, 32, 500, 999])
def test_one_particle_with_all_the_weight_is_the_only_ancestor(scheme, heir):
    log_weights = jnp.where(jnp.arange(1000) == heir, -5.0, -jnp.inf)
    for seed in range(3):
        np.testing.assert_array_equal(scheme(jax.random.key(seed), log_weights), heir)


@pytest.mark.system
def test_weightless_particles_are_never_drawn_at_any_offset(scheme):
    # Sums of these weights round differently in every order, and half of the particles lie between equal sums.
    log_weights = jnp.where(jnp.arange(3000) % 64 >= 30, -jnp.inf, uneven(3000, seed=5, scale=1.0))
    ancestors = jax.vmap(scheme, (0, None))(jax.random.split(jax.random.key(3), 300), log_weights)
    assert np.isfinite(np.asarray(log_weights)[np.asarray(ancestors)]).all()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_million_ancestors_are_those_of_exact_arithmetic(x64, dtype):
    n = 1_000_000
    key = jax.random.key(11)
    log_weights = jax.random.normal(jax.random.key(4), (n,), dtype)
    ancestors = np.asarray(jax.jit(resampling.systematic)(key, log_weights))
    cumulative = np.cumsum(normalised(log_weights))
    grid = (np.arange(n) + float(jax.random.uniform(key, (), dtype))) / n
    expected = np.searchsorted(cumulative, grid * cumulative[-1], side="right")
    assert np.mean(ancestors != expected) <= (1e-3 if dtype == jnp.float32 else 1e-8)


@pytest.mark.system
def test_running_totals_are_exact_and_never_decrease():
    rng = np.random.default_rng(1)
    w = (rng.random((500, 32)) ** 8 * (rng.random((500, 32)) < 0.7)).astype(np.float32)
    w[-1, 5:] = 0
    whole, fraction = prefix.positions(jnp.asarray(w), 12_000)
    position = np.asarray(whole, np.float64) + np.asarray(fraction, np.float64)
    exact = np.cumsum(w.astype(np.float64)).reshape(w.shape)
    np.testing.assert_allclose(position[:-1], 12_000 * exact[:-1] / exact[-1, -1], atol=1e-3)
    # From the last weighted entry on the fraction says nothing.
    assert (np.diff(position.ravel()[: 499 * 32]) >= 0).all()
    assert (np.diff(position.ravel()[: 499 * 32])[w.ravel()[1 : 499 * 32] == 0] == 0).all()
    assert (np.asarray(whole)[-1, 5:] == 12_000).all()
    counts = rng.integers(0, 9, (70, 32))
    np.testing.assert_array_equal(prefix.running_count(jnp.asarray(counts)).ravel(), np.cumsum(counts))


@pytest.mark.system
def test_schemes_map_compile_and_pass_no_derivative(scheme):
    log_weights = jnp.stack([uneven(100, seed) for seed in range(3)], axis=-1)
    keys = jax.random.split(jax.random.key(1), 3)
    mapped = jax.jit(jax.vmap(scheme, (0, -1), -1))(keys, log_weights)
    for i in range(3):
        np.testing.assert_array_equal(mapped[:, i], scheme(keys[i], log_weights[:, i]))
    picked = lambda lw: jnp.sum(jnp.arange(100.0)[scheme(keys[0], lw)] * lw)
    assert np.isfinite(jax.grad(picked)(jnp.zeros(100))).all()


def test_too_many_particles_for_exact_sums_are_refused():
    abstract = jax.ShapeDtypeStruct((2**23 + 1,), jnp.float32)
    with pytest.raises(ValueError, match=r"at most 2\*\*23 particles.*float32.*wider"):
        jax.eval_shape(lambda lw: resampling.systematic(jax.random.key(0), lw), abstract)
