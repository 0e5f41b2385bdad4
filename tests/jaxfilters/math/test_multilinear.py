"""Tensor algebra against numpy's einsum, and the oracles of the monocular head tracker's specification, section 8."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math import multilinear
from jaxfilters.math.multilinear import compose, fold, hooi, hosvd, mode_product, numerical_ranks, project, unfold

SHAPE, RANKS = (30, 22, 10), {1: 10, 2: 5}


@pytest.fixture
def X(x64):
    return jnp.asarray(np.random.default_rng(0).normal(size=SHAPE))


def relative_error(X, core, factors):
    return np.linalg.norm(X - compose(core, factors)) / np.linalg.norm(X)


def low_rank(seed, shape, ranks):
    """A tensor of exact multilinear rank."""
    draw = np.random.default_rng(seed)
    core = draw.normal(size=[ranks.get(n, size) for n, size in enumerate(shape)])
    return compose(jnp.asarray(core), {n: jnp.asarray(draw.normal(size=(shape[n], r))) for n, r in ranks.items()})


@pytest.mark.parametrize("mode", range(3))
def test_unfolding_lists_the_fibres_and_folding_takes_it_back(X, mode):
    unfolded = unfold(X, mode)
    np.testing.assert_array_equal(unfolded[3, :7], np.moveaxis(np.asarray(X), mode, 0)[3].ravel()[:7])
    np.testing.assert_array_equal(fold(unfolded, mode, SHAPE), X)


@pytest.mark.parametrize("mode", range(3))
def test_a_mode_product_is_a_product_of_the_unfolding(X, mode):
    C = jnp.asarray(np.random.default_rng(1).normal(size=(4, SHAPE[mode])))
    product = mode_product(X, C, mode)
    np.testing.assert_allclose(unfold(product, mode), np.asarray(C) @ np.asarray(unfold(X, mode)), atol=1e-12)
    subscripts = ("abc,ja->jbc", "abc,jb->ajc", "abc,jc->abj")[mode]
    np.testing.assert_allclose(product, np.einsum(subscripts, np.asarray(X), np.asarray(C)), atol=1e-12)


def test_products_over_different_modes_commute(X):
    draw = np.random.default_rng(2)
    A, B = jnp.asarray(draw.normal(size=(4, 30))), jnp.asarray(draw.normal(size=(3, 10)))
    one, other = mode_product(mode_product(X, A, 0), B, 2), mode_product(mode_product(X, B, 2), A, 0)
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_the_full_decomposition_is_exact_and_its_core_all_orthogonal(X):
    core, factors = hosvd(X)
    np.testing.assert_allclose(compose(core, factors), X, atol=1e-12)
    for mode, U in factors.items():
        np.testing.assert_allclose(U.T @ U, np.eye(U.shape[1]), atol=1e-12)
        assert np.all(np.sum(U, axis=0) >= 0)
        gram = unfold(core, mode) @ unfold(core, mode).T
        norms = np.sqrt(np.diagonal(gram))
        np.testing.assert_allclose(gram, np.diag(norms**2), atol=1e-9)
        assert np.all(np.diff(norms) < 1e-9)
        np.testing.assert_allclose(norms, np.linalg.svd(unfold(X, mode), compute_uv=False), rtol=1e-10)


def test_a_mode_that_is_longer_than_all_others_together_is_exact_too(x64):
    X = jnp.asarray(np.random.default_rng(3).normal(size=(12, 2, 3)))
    core, factors = hosvd(X)
    assert core.shape == (6, 2, 3)
    np.testing.assert_allclose(compose(core, factors), X, atol=1e-12)


def test_truncation_loses_at_most_the_discarded_energies(X):
    core, factors = hosvd(X, RANKS)
    discarded = sum(np.sum(np.linalg.svd(unfold(X, n), compute_uv=False)[r:] ** 2) for n, r in RANKS.items())
    error2 = np.sum(np.square(X - compose(core, factors)))
    assert 0 < error2 <= discarded
    np.testing.assert_allclose(error2, np.sum(X**2) - np.sum(core**2), rtol=1e-9)


def test_alternating_least_squares_improves_on_truncation(X):
    core, factors, history = hooi(X, RANKS)
    truncated = hosvd(X, RANKS)
    assert np.all(np.diff(history) > -1e-9 * history[-1])
    np.testing.assert_allclose(history[0], np.sum(truncated.core**2), rtol=1e-12)
    np.testing.assert_allclose(history[-1], np.sum(core**2), rtol=1e-12)
    np.testing.assert_allclose(np.sum(np.square(X - compose(core, factors))), np.sum(X**2) - history[-1], rtol=1e-9)
    # The specification's figures for such a tensor.
    assert relative_error(X, *truncated) == pytest.approx(0.825, abs=0.003)
    assert relative_error(X, core, factors) == pytest.approx(0.806, abs=0.003)
    for mode, U in factors.items():
        np.testing.assert_allclose(U.T @ U, np.eye(RANKS[mode]), atol=1e-12)
        assert np.all(np.sum(U, axis=0) >= 0)


def test_converged_factors_are_those_of_one_more_sweep(X):
    core, factors, history = hooi(X, RANKS, max_sweeps=3000, tolerance=0.0)
    again = multilinear.sweep(X, factors)
    np.testing.assert_allclose(np.sum(project(X, again) ** 2), np.sum(core**2), rtol=1e-13)
    assert history[-1] == history[-2]


@pytest.mark.parametrize("decompose", [hosvd, hooi])
def test_exactly_low_rank_tensors_are_recovered(x64, decompose):
    ranks = {1: 4, 2: 3}
    X = low_rank(4, SHAPE, ranks)
    core, factors, *_ = decompose(X, ranks)
    assert relative_error(X, core, factors) < 1e-10


def test_the_core_through_the_data_is_the_core_through_the_feature_mode(X):
    full = hosvd(X)
    partly = project(X, {mode: full.factors[mode] for mode in (1, 2)})
    np.testing.assert_allclose(partly, mode_product(full.core, full.factors[0], 0), atol=1e-11)


def test_with_one_reduced_mode_it_is_the_best_matrix_approximation(X):
    core = hooi(X, {0: 7}).core
    values = np.linalg.svd(unfold(X, 0), compute_uv=False)
    np.testing.assert_allclose(np.sum(core**2), np.sum(values[:7] ** 2), rtol=1e-12)


def test_it_compiles_and_single_precision_ends(X):
    compiled = jax.jit(partial(hooi, ranks=RANKS))(X)
    np.testing.assert_allclose(compiled.core, hooi(X, RANKS).core, atol=1e-9)
    single = hooi(X.astype(jnp.float32), RANKS)
    assert single.core.dtype == jnp.float32
    np.testing.assert_allclose(single.history[-1], compiled.history[-1], rtol=1e-4)


def test_ranks_of_exact_and_of_noisy_data(x64):
    X = low_rank(5, (12, 9, 8), {0: 4, 1: 3, 2: 2})
    assert numerical_ranks(X).tolist() == [4, 3, 2]
    noise = 1e-4 * np.random.default_rng(6).normal(size=X.shape)
    assert numerical_ranks(X + noise).tolist() == [12, 9, 8]
    largest = min(np.linalg.svd(unfold(X, mode), compute_uv=False)[0] for mode in range(3))
    assert numerical_ranks(X + noise, 1e-4 * (12**0.5 + 108**0.5) / largest).tolist() == [4, 3, 2]


def test_a_long_mode_needs_no_square_of_its_length():
    """All of its singular vectors would be 4 TB."""
    X = np.random.default_rng(7).normal(size=(3, 2, 1_000_000)).astype(np.float32)
    assert numerical_ranks(jnp.asarray(X)).tolist() == [3, 2, 6]


@pytest.mark.parametrize(
    ("ranks", "message"),
    [
        ({}, "ranks must reduce one mode or more"),
        ({1: 0}, "ranks must be 1 to 22 for mode 1 of a tensor .*; got 0"),
        ({1: 23}, "ranks must be 1 to 22 for mode 1 .*; got 23"),
        ({0: 2, 1: 7, 2: 3}, "ranks must be 1 to 6 for mode 1 .*; got 7"),
        ({3: 1}, "mode must be 0 to 2"),
    ],
)
@pytest.mark.parametrize("decompose", [hosvd, hooi])
def test_impossible_ranks_are_refused(X, decompose, ranks, message):
    with pytest.raises(ValueError, match=message):
        decompose(X, ranks)


def test_other_wrong_input_is_refused(X):
    with pytest.raises(ValueError, match="X must be finite; 1 of 6600"):
        hooi(X.at[2, 3, 4].set(np.nan), RANKS)
    with pytest.raises(ValueError, match="X must be finite"):
        hosvd(X.at[2, 3, 4].set(np.inf))
    with pytest.raises(ValueError, match="X must be finite"):
        numerical_ranks(X.at[2, 3, 4].set(np.inf))
    with pytest.raises(ValueError, match="max_sweeps must be 1 or more"):
        hooi(X, RANKS, max_sweeps=0)
    with pytest.raises(ValueError, match="tolerance must be in"):
        numerical_ranks(X, 1.0)
    with pytest.raises(ValueError, match="mode must be 0 to 2"):
        unfold(X, 3)
    with pytest.raises(ValueError, match=r"Y must be \(22, 300\) to fold"):
        fold(unfold(X, 0), 1, SHAPE)
    with pytest.raises(ValueError, match="C must have 22 columns"):
        mode_product(X, jnp.eye(3), 1)
