"""Optimal resampling against its definition, over all values of the one random number that it draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

pytestmark = pytest.mark.system

COUNT, PLACES, DRAWS = 40, 16, 4000
KEYS = jax.random.split(jax.random.key(0), DRAWS)
RNG = np.random.default_rng(0)
CASES = {
    "uneven": RNG.exponential(size=COUNT) ** 3,
    "geometric": 0.5 ** np.arange(COUNT),
    "two scales": np.r_[np.full(3, 1e3), np.full(COUNT - 3, 1e-3)],
    "equal": np.ones(COUNT),
    "zeros": np.r_[np.zeros(15), RNG.uniform(size=COUNT - 15)],
}


@jax.jit
def resampled(log_weights):
    return jax.vmap(lambda key: jf.resampling.optimal(key, log_weights, PLACES))(KEYS)


def chances(weights):
    """Probabilities min(1, c w) that sum to the number of places, by bisection in float64."""
    low, high = 0.0, 1e12 / weights.max()
    for _ in range(200):
        c = 0.5 * (low + high)
        low, high = (c, high) if np.minimum(1, c * weights).sum() < PLACES else (low, c)
    return np.minimum(1, high * weights)


@pytest.mark.parametrize("name", CASES)
def test_survivors_are_different_and_their_weights_unbiased(name):
    weights = CASES[name] / CASES[name].sum()
    expected = chances(weights)
    indices, log_weights = map(np.asarray, resampled(jnp.log(jnp.asarray(weights, jnp.float32))))
    alive = log_weights > -np.inf
    found = np.zeros((DRAWS, COUNT))
    rows = np.broadcast_to(np.arange(DRAWS)[:, None], indices.shape)
    copies = np.zeros((DRAWS, COUNT), int)
    np.add.at(copies, (rows[alive], indices[alive]), 1)
    np.add.at(found, (rows[alive], indices[alive]), np.exp(log_weights[alive]))
    assert copies.max() == 1
    assert (copies.sum(1) == PLACES).all()
    assert (np.diff(indices) >= 0).all()
    np.testing.assert_allclose(found.sum(1), 1, rtol=2e-5)
    # Each survivor has the weight w / p: what is certain keeps its own, the others share one.
    np.testing.assert_allclose(
        np.where(copies, found, 0), np.where(copies, weights / np.maximum(expected, 1e-30), 0), rtol=1e-3
    )
    # A frequency has at most the standard error 0.5 / sqrt(4000); 200 comparisons at five: 1e-4 of a false alarm.
    assert np.abs(copies.mean(0) - expected).max() < 5 * 0.5 / np.sqrt(DRAWS)


def test_few_particles_stay_as_they_are():
    log_weights = jnp.full(COUNT, -jnp.inf).at[jnp.array([2, 5, 30])].set(jnp.log(jnp.array([1e-30, 0.3, 0.7])))
    indices, kept = resampled(log_weights)
    assert (indices[:, :3] == jnp.array([2, 5, 30])).all()
    np.testing.assert_array_equal(kept[:, :3], np.broadcast_to(log_weights[jnp.array([2, 5, 30])], (DRAWS, 3)))
    assert (kept[:, 3:] == -jnp.inf).all()


def test_no_weight_and_nan_leave_nothing():
    for value in (-jnp.inf, jnp.nan):
        assert (jax.jit(resampled)(jnp.full(COUNT, value))[1] == -jnp.inf).all()


def test_the_weights_keep_their_derivative():
    log_weights = jnp.log(jnp.asarray(CASES["uneven"], jnp.float32))
    slope = jax.jacobian(lambda w: jf.resampling.optimal(KEYS[0], w, PLACES).log_weights)(log_weights)
    kept = jf.resampling.optimal(KEYS[0], log_weights, PLACES).indices
    np.testing.assert_array_equal(slope, jax.nn.one_hot(kept, COUNT))


def test_the_threshold_is_found_for_any_weights():
    """A search that compares rounded sums goes on for ever for one set of weights in some hundred."""
    log_weights = jnp.asarray(np.random.default_rng(1).normal(0, 5, (DRAWS, COUNT)), jnp.float32)
    found = jax.jit(jax.vmap(lambda key, w: jf.resampling.optimal(key, w, PLACES)))(KEYS, log_weights)
    assert (jnp.sum(found.log_weights > -jnp.inf, axis=1) == PLACES).all()
