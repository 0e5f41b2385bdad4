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
    "ssp": jax.jit(resampling.ssp),
    "killing": jax.jit(resampling.killing),
}
IN_PLACE = {"killing"}
"""Schemes whose indices are not sorted, because ancestors stay where they are."""
# How far a count may lie from n w_i.
SPREAD = {"systematic": (-1, 1), "stratified": (-2, 2), "multinomial": (-np.inf, np.inf), "residual": (-1, np.inf)}
SPREAD |= {"ssp": (-1, 1), "killing": (-np.inf, np.inf)}
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


def check_counts(ancestors, expected):
    """A z-test at 4 sigma of the mean counts of many runs: 40 of them fail by chance once in 400."""
    counts = np.apply_along_axis(np.bincount, 1, np.asarray(ancestors), minlength=expected.size)
    # No integer of that mean has a smaller variance; a rare particle may have none in the sample.
    part = expected % 1
    variance = np.maximum(counts.var(axis=0, ddof=1), np.maximum(part * (1 - part), 1e-10))
    assert (abs(counts.mean(axis=0) - expected) < 4 * np.sqrt(variance / len(counts))).all()


@pytest.mark.system
@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("name", SCHEMES)
def test_ancestors_are_sorted_weighted_indices_with_the_counts_of_their_scheme(name, n):
    log_weights = uneven(n)
    ancestors = np.asarray(SCHEMES[name](jax.random.key(n), log_weights))
    assert ancestors.shape == (n,)
    assert ancestors.dtype == np.int32
    assert name in IN_PLACE or (np.diff(ancestors) >= 0).all()
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
    check_counts(ancestors, n * normalised(log_weights))


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
@pytest.mark.parametrize("num_samples", [7, 100])
@pytest.mark.parametrize("name", sorted(set(SCHEMES) - IN_PLACE))
def test_another_number_of_particles_has_unbiased_counts(name, num_samples):
    log_weights = uneven(40, seed=2, scale=1.5)
    draw = jax.jit(jax.vmap(lambda key: getattr(resampling, name)(key, log_weights, num_samples)))
    ancestors = np.asarray(draw(jax.random.split(jax.random.key(4), 2000)))
    assert ancestors.shape == (2000, num_samples)
    check_counts(ancestors, num_samples * normalised(log_weights))
    low, high = SPREAD[name]
    counts = np.apply_along_axis(np.bincount, 1, ancestors, minlength=40) - num_samples * normalised(log_weights)
    assert (counts > low - 1e-3).all()
    assert (counts < high + 1e-3).all()


def test_ssp_copies_are_negatively_correlated():
    # Those of systematic resampling are not: alternating weights are copied together (Gerber et al. 2019, section 2).
    w = np.tile([0.4, 0.6], 10) / 10
    log_weights = jnp.log(jnp.asarray(w, jnp.float32))
    keys = jax.random.split(jax.random.key(5), 3000)
    spread = {}
    for name in ("ssp", "systematic"):
        ancestors = np.asarray(jax.vmap(SCHEMES[name], (0, None))(keys, log_weights))
        spread[name] = (ancestors % 2).sum(axis=1).var()
    # The number of copies of one half of the particles: below the 20 * 0.24 = 2.4 * 2 of independent copies.
    assert spread["ssp"] < 2.4 * 1.1
    assert spread["systematic"] > 5 * 2.4


def test_killing_leaves_survivors_in_their_places():
    log_weights = uneven(1000, scale=0.1)
    ancestors = np.asarray(SCHEMES["killing"](jax.random.key(0), log_weights))
    alive = np.asarray(log_weights) > -np.inf
    kept = ancestors == np.arange(1000)
    chance = np.exp(np.asarray(log_weights) - float(log_weights.max()))
    assert not kept[~alive].any()
    # A sum of independent draws with these chances, at 4 standard deviations, and a replacement in place now and then.
    assert abs(kept.sum() - chance.sum()) < 4 * np.sqrt((chance * (1 - chance)).sum()) + 4


@pytest.mark.parametrize("num_steps", [1, 6])
def test_metropolis_has_the_distribution_of_its_chain_within_the_published_bound(num_steps):
    w = np.array([0.05, 0.3, 0.1, 0.2, 0.35])
    kernel = np.minimum(1, w / w[:, None]) / 5
    np.fill_diagonal(kernel, 0)
    np.fill_diagonal(kernel, 1 - kernel.sum(axis=1))
    exact = np.linalg.matrix_power(kernel, num_steps)
    runs = 20_000
    scheme = jax.jit(jax.vmap(resampling.metropolis(num_steps), (0, None)))
    ancestors = np.asarray(scheme(jax.random.split(jax.random.key(3), runs), jnp.log(jnp.asarray(w, jnp.float32))))
    found = np.stack([np.bincount(ancestors[:, i], minlength=5) for i in range(5)]) / runs
    # 25 frequencies at 4 sigma: fails by chance once in 600.
    assert (abs(found - exact) <= 4 * np.sqrt(exact * (1 - exact) / runs)).all()
    bound = (1 - 1 / (5 * w.max())) ** num_steps
    assert (0.5 * abs(exact - w).sum(axis=1) <= bound).all()
    assert resampling.metropolis_steps(5 * w.max(), bound * 1.001) == num_steps


@pytest.mark.system
@pytest.mark.parametrize("n", [1, 1000])
def test_even_dead_and_undefined_ensembles(scheme, n):
    for log_weights in (jnp.full(n, -math.log(n)), jnp.full(n, -30.0)):
        ancestors = scheme(jax.random.key(0), log_weights)
        if scheme is not SCHEMES["multinomial"]:
            np.testing.assert_array_equal(ancestors, np.arange(n))
    for nothing in (-jnp.inf, jnp.nan):
        dead = jax.jit(scheme)(jax.random.key(0), jnp.full(n, nothing))
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
