"""Least squares with shared variables against the dense solver and SciPy (oracle 11 of the one-camera tracker)."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
import scipy.optimize

from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt
from jaxfilters.optimize.shared_least_squares import Split, solve_shared

NUM_FRAMES, NUM_POINTS = 6, 7


def residuals(shared, frame, observed):
    """A flat shape, scaled, turned and moved in each frame: points (K, 2) against those seen."""
    c, s = jnp.cos(frame["angle"]), jnp.sin(frame["angle"])
    turned = jnp.array([[c, -s], [s, c]])
    return (frame["size"] * shared @ turned.T + frame["place"] - observed).ravel()


def prior(shared):
    return 0.1 * (shared - jnp.asarray(SHAPE, shared.dtype)).ravel()


SHAPE = np.random.default_rng(5).normal(0, 1, (NUM_POINTS, 2))


def problem(seed=0, num_frames=NUM_FRAMES):
    """Points with noise, and a start near the truth."""
    rng = np.random.default_rng(seed)
    frames = {
        "angle": rng.uniform(-1, 1, num_frames),
        "size": rng.uniform(0.7, 1.4, num_frames),
        "place": rng.normal(0, 1, (num_frames, 2)),
    }
    true = jax.tree.map(jnp.asarray, Split(SHAPE + 0.2 * rng.normal(size=SHAPE.shape), frames))
    data = jax.vmap(residuals, (None, 0, 0))(true.shared, true.frames, jnp.zeros((num_frames, *SHAPE.shape)))
    data = data.reshape(num_frames, *SHAPE.shape) + 0.05 * rng.normal(size=(num_frames, *SHAPE.shape))
    start = jax.tree.map(lambda leaf: leaf + 0.2 * rng.normal(size=leaf.shape), true)
    return start, data


def all_residuals(split, data):
    of_frames = jax.vmap(residuals, (None, 0, 0))(split.shared, split.frames, data)
    return jnp.concatenate([of_frames.ravel(), prior(split.shared)])


@jax.jit
def solved(start, data, lower, upper):
    return solve_shared(residuals, start, data, prior=prior, lower=lower, upper=upper, steps=200, atol=1e-10)


@jax.jit
def dense(start, data, lower, upper):
    return optimistix.least_squares(
        all_residuals,
        BoxLevenbergMarquardt(rtol=1e-13, atol=1e-10),
        start,
        data,
        {"lower": lower, "upper": upper},
        max_steps=400,
        throw=False,
    ).value


def infinite(start):
    none = lambda side: jax.tree.map(lambda leaf: jnp.full_like(leaf, side), start)
    return none(-jnp.inf), none(jnp.inf)


def narrow(start):
    beside = lambda side: jax.tree.map(lambda leaf: leaf + side, start)
    return beside(-0.1), beside(0.15)


@pytest.mark.system
@pytest.mark.parametrize("box", [infinite, narrow])
@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_the_dense_one(x64, seed, box):
    start, data = problem(seed)
    low, high = box(start)
    found = solved(start, data, low, high)
    expected = dense(start, data, low, high)
    for a, b in zip(jax.tree.leaves(found.value), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    assert found.projected_gradient < 1e-6
    assert bool(found.finite)


def test_bounds_hold_and_are_met(x64):
    start, data = problem(1)
    low, high = narrow(start)
    found = solved(start, data, low, high).value
    met = 0
    for value, a, b in zip(*map(jax.tree.leaves, (found, low, high)), strict=True):
        assert np.all(value >= a)
        assert np.all(value <= b)
        met += int(np.sum((value == a) | (value == b)))
    assert met > 3


def test_scipy_finds_nothing_better(x64):
    start, data = problem(2)
    low, high = narrow(start)
    found = solved(start, data, low, high)
    flat, unravel = jax.flatten_util.ravel_pytree(start)
    bounds = [np.asarray(jax.flatten_util.ravel_pytree(side)[0]) for side in (low, high)]
    of_flat = jax.jit(lambda x: all_residuals(unravel(x), data))
    peer = scipy.optimize.least_squares(of_flat, np.asarray(flat), bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert float(found.energy) <= peer.cost * (1 + 1e-6)


@pytest.mark.system
def test_it_runs_in_single_precision_and_under_vmap():
    starts, data = zip(*(problem(seed) for seed in range(3)), strict=True)
    stack = lambda *leaves: jnp.stack([jnp.asarray(leaf, jnp.float32) for leaf in leaves])
    start, observed = jax.tree.map(stack, *starts), jnp.stack(data).astype(jnp.float32)
    found = jax.vmap(lambda start, observed: solve_shared(residuals, start, observed, prior=prior, steps=30))(
        start, observed
    )
    assert found.energy.shape == (3,)
    one = solve_shared(residuals, jax.tree.map(lambda leaf: leaf[1], start), observed[1], prior=prior, steps=30)
    np.testing.assert_allclose(found.energy[1], one.energy, rtol=1e-4)


@pytest.mark.system
def test_what_is_not_finite_is_said_and_the_start_stays():
    start, data = problem()
    found = solve_shared(residuals, start, data.at[2, 0, 0].set(jnp.nan), steps=5)
    assert not bool(found.finite)
    for a, b in zip(jax.tree.leaves(found.value), jax.tree.leaves(start), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_contradicting_bounds_are_refused():
    start, data = problem()
    low, high = infinite(start)
    with pytest.raises(ValueError, match="lower must be at most upper"):
        solve_shared(residuals, start, data, lower=high, upper=low)
