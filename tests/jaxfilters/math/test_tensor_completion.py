"""Missing cells of a tensor against weighted alternating least squares, written out in numpy."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math.multilinear import compose, hooi
from jaxfilters.math.tensor_completion import complete

SHAPE, RANKS = (6, 8, 7), {1: 3, 2: 2}


@pytest.fixture
def X(x64):
    """Rank (., 3, 2) and noise."""
    draw = np.random.default_rng(0)
    exact = compose(
        jnp.asarray(draw.normal(size=(6, 3, 2))),
        {n: jnp.asarray(draw.normal(size=(SHAPE[n], RANKS[n]))) for n in RANKS},
    )
    return exact, exact + 0.1 * draw.normal(size=SHAPE)


@pytest.fixture
def observed():
    """48 of 56 cells."""
    visible = np.ones(SHAPE[1:], bool)
    visible[[0, 1, 2, 3, 4, 5, 6, 7], [3, 0, 6, 2, 3, 5, 1, 4]] = False
    return jnp.asarray(visible)


def weighted_least_squares(X, visible, core, people, actions, sweeps):
    """Observed squared error after solving for the core, for each person's and each action's row in turn."""
    X, core, people, actions = (np.array(a) for a in (X, core, people, actions))
    cells = np.argwhere(visible)
    for _ in range(sweeps):
        for i in range(len(people)):
            basis = [np.einsum("fjk,k->fj", core, actions[a]) for s, a in cells if s == i]
            target = [X[:, i, a] for s, a in cells if s == i]
            people[i] = np.linalg.lstsq(np.concatenate(basis), np.concatenate(target))[0]
        for a in range(len(actions)):
            basis = [np.einsum("fjk,j->fk", core, people[s]) for s, b in cells if b == a]
            target = [X[:, s, a] for s, b in cells if b == a]
            actions[a] = np.linalg.lstsq(np.concatenate(basis), np.concatenate(target))[0]
        design = np.stack([np.kron(people[s], actions[a]) for s, a in cells])
        core = np.linalg.lstsq(design, np.stack([X[:, s, a] for s, a in cells]))[0].T.reshape(core.shape)
    left = X - np.einsum("fjk,sj,ak->fsa", core, people, actions)
    return np.sum(left[:, visible] ** 2)


def test_with_nothing_missing_it_is_the_best_approximation(X):
    _, noisy = X
    whole = complete(noisy, jnp.ones((1, 1, 1), bool), RANKS, tolerance=1e-12)
    best = hooi(noisy, RANKS)
    np.testing.assert_array_equal(whole.filled, noisy)
    np.testing.assert_allclose(compose(whole.core, whole.factors), compose(best.core, best.factors), atol=1e-5)
    np.testing.assert_allclose(whole.history[-1], np.sum(noisy**2) - best.history[-1], rtol=1e-9)


def test_the_observed_error_falls_to_that_of_weighted_least_squares(X, observed):
    _, noisy = X
    # A missing cell holds no number.
    done = complete(jnp.where(observed, noisy, jnp.nan), observed[None], RANKS, tolerance=1e-13, max_sweeps=5000)
    assert np.all(np.diff(done.history) <= 1e-12 * done.history[0])
    begun = hooi(jnp.where(observed, noisy, 0.0), RANKS)
    brute = weighted_least_squares(noisy, np.asarray(observed), begun.core, *begun.factors.values(), sweeps=100)
    np.testing.assert_allclose(done.history[-1], brute, rtol=1e-6)
    left = np.where(observed, noisy - compose(done.core, done.factors), 0.0)
    np.testing.assert_allclose(np.sum(left**2), done.history[-1], rtol=1e-6)
    np.testing.assert_array_equal(np.where(observed, done.filled - noisy, 0), 0)


def test_missing_cells_of_exact_data_are_found(X, observed):
    exact, _ = X
    done = complete(jnp.where(observed, exact, jnp.nan), observed[None], RANKS, tolerance=1e-14, max_sweeps=20000)
    np.testing.assert_allclose(done.filled, exact, atol=1e-3 * np.std(exact))


def test_wrong_input_is_refused(X, observed):
    _, noisy = X
    with pytest.raises(ValueError, match=r"observed must broadcast to \(6, 8, 7\)"):
        complete(noisy, observed.T[None], RANKS)
    with pytest.raises(ValueError, match="X where it is observed must be finite"):
        complete(noisy.at[0, 5, 0].set(jnp.nan), observed[None], RANKS)
    with pytest.raises(ValueError, match=r"entry for each index of mode 1; \[4\] have none"):
        complete(noisy, observed.at[4].set(False)[None], RANKS)
    with pytest.raises(ValueError, match="ranks must be 1 to 7 for mode 2"):
        complete(noisy, observed[None], {2: 8})
    with pytest.raises(ValueError, match="max_sweeps"):
        complete(noisy, observed[None], RANKS, max_sweeps=0)
