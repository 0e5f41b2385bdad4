"""Incremental principal components against closed forms and numpy, over forty seeds where chance decides."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math import incremental_pca

SIZE, NUM_COMPONENTS = 30, 5
STD = np.append([6, 4, 2.5, 1.6, 1], np.full(SIZE - NUM_COMPONENTS, 0.15))


@partial(jax.jit, static_argnums=1)
def learn(deviations, num_components=NUM_COMPONENTS, amnesic=2.0, ramp=20):
    """(t, d) deviations, one after the other."""

    def one(space, deviation):
        return incremental_pca.update(space, deviation, amnesic=amnesic, ramp=ramp), None

    return jax.lax.scan(one, incremental_pca.start(deviations.shape[1], num_components), deviations)[0]


@jax.jit
def moments_of(x):
    """(t, d) vectors, one after the other."""

    def one(moments, x):
        return incremental_pca.update_moments(moments, x), None

    return jax.lax.scan(one, incremental_pca.start_moments(x.shape[1]), x)[0]


def samples(seed, count, size=8):
    """Correlated samples about zero."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, size)) @ rng.normal(size=(size, size))


def test_in_one_dimension_the_variance_is_the_mean_square(x64):
    u = np.random.default_rng(0).normal(size=(50, 1))
    space = learn(u, 1, amnesic=0.0)
    np.testing.assert_allclose(incremental_pca.principal_components(space).variances, np.mean(u**2), rtol=1e-12)
    np.testing.assert_allclose(incremental_pca.principal_components(space).basis, np.sign(u[:1]))


def test_amnesia_weighs_late_samples_more(x64):
    u = np.random.default_rng(1).normal(size=(60, 1))
    expected = np.mean(u[:20] ** 2)
    for n, x in enumerate(u[20:, 0], start=21):
        expected = (n - 3) / n * expected + 3 / n * x**2
    np.testing.assert_allclose(incremental_pca.principal_components(learn(u, 1)).variances, expected, rtol=1e-12)


@pytest.mark.parametrize("factor", [1e-3, 7.0])
def test_variances_scale_with_the_square_of_the_data(x64, factor):
    u = samples(2, 100)
    once, scaled = learn(u), learn(factor * u)
    np.testing.assert_allclose(scaled.vectors, factor**2 * once.vectors, rtol=1e-12, atol=1e-12 * factor**2)
    np.testing.assert_allclose(scaled.residual_energy, factor**2 * once.residual_energy, rtol=1e-12)


def test_opposite_data_have_opposite_components():
    u = samples(3, 100)
    np.testing.assert_array_equal(learn(-u).vectors, -learn(u).vectors)


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf])
@pytest.mark.parametrize("place", [0, 1, 40])
def test_a_sample_that_says_nothing_changes_nothing(nothing, place):
    u = samples(4, 60)
    with_nothing = np.insert(u, place, np.full(8, nothing), axis=0)
    jax.tree.map(np.testing.assert_array_equal, learn(with_nothing), learn(u))


@pytest.mark.parametrize("amnesic", [0.0, 2.0])
def test_repeated_and_dependent_samples_begin_no_component_from_rounding(amnesic):
    u = samples(5, 2)
    space = learn(np.concatenate([np.repeat(u[:1], 5, axis=0), u, u, u]), amnesic=amnesic, ramp=0)
    assert np.all(np.isfinite(space.vectors))
    basis, variances = incremental_pca.principal_components(space)
    assert np.all(variances[:2] > 0)
    assert np.all(variances[2:] == 0)
    np.testing.assert_array_equal(basis[:, 2:], 0)
    B = np.asarray(basis)
    np.testing.assert_allclose(B @ (B.T @ u.T), u.T, atol=1e-4)
    assert incremental_pca.explained_variance_ratio(space) == pytest.approx(1, abs=1e-5)


def test_the_spectrum_of_the_specification_is_found_from_forty_seeds(x64):
    # Section 2.11: n = 1680, l = 2. The axes of the distribution are the coordinates.
    u = STD * jax.random.normal(jax.random.key(0), (40, 1680, SIZE))
    found = jax.jit(jax.vmap(lambda one: incremental_pca.principal_components(learn(one))))(u)
    aligned = np.abs(np.diagonal(found.basis[:, :NUM_COMPONENTS], axis1=1, axis2=2))
    assert np.min(aligned) >= 0.98
    ratio = np.asarray(found.variances) / STD[:NUM_COMPONENTS] ** 2
    # With l = 2 the weights grow as the square of the age: 5/9 of the samples count, and a variance of chi-squared
    # samples has a relative standard deviation of sqrt(2 / 933) = 4.6 %.
    assert np.quantile(abs(ratio - 1), 0.99) <= 0.15
    assert np.max(abs(ratio - 1)) <= 4 * 0.046
    np.testing.assert_allclose(np.median(ratio, axis=0), 1, atol=0.03)
    cosines = np.linalg.svd(np.asarray(found.basis[:, :NUM_COMPONENTS]), compute_uv=False)
    assert np.degrees(np.arccos(np.min(cosines))) < 2


def test_the_basis_is_orthonormal_sorted_and_keeps_the_signs_of_its_vectors(x64):
    space = learn(samples(6, 300), 3)
    shuffled = space._replace(vectors=space.vectors[jnp.array([2, 0, 1])])
    basis, variances = incremental_pca.principal_components(shuffled)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    assert np.all(np.diff(variances) < 0)
    np.testing.assert_allclose(variances, np.sort(np.linalg.norm(space.vectors, axis=1))[::-1])
    order = np.argsort(-np.linalg.norm(space.vectors, axis=1))
    assert np.all(np.sum(basis.T * space.vectors[order], axis=1) > 0)
    np.testing.assert_allclose(
        basis[:, 0], space.vectors[order[0]] / np.linalg.norm(space.vectors[order[0]]), atol=1e-12
    )


def test_the_contribution_is_the_share_of_the_mean_square_that_is_explained(x64):
    u = STD * np.random.default_rng(7).normal(size=(1680, SIZE))
    assert incremental_pca.explained_variance_ratio(incremental_pca.start(SIZE, NUM_COMPONENTS)) == 0
    space = learn(u, amnesic=0.0)
    explained = np.linalg.norm(space.vectors, axis=1).sum()
    # What the first components leave was left by younger, worse ones: an error that decays as the inverse of n.
    np.testing.assert_allclose(explained + space.residual_energy, np.mean(np.sum(u**2, axis=1)), rtol=0.02)
    true_share = np.sum(STD[:NUM_COMPONENTS] ** 2) / np.sum(STD**2)
    assert incremental_pca.explained_variance_ratio(space) == pytest.approx(true_share, abs=0.01)
    assert incremental_pca.explained_variance_ratio(learn(u, 2)) == pytest.approx(52 / np.sum(STD**2), abs=0.03)


def test_single_precision_finds_the_same_components():
    u = samples(8, 400)
    single = incremental_pca.principal_components(learn(u, 3))
    with jax.enable_x64(True):
        double = incremental_pca.principal_components(learn(u, 3))
    assert single.basis.dtype == jnp.float32
    np.testing.assert_allclose(single.basis, double.basis, atol=1e-4)
    np.testing.assert_allclose(single.variances, double.variances, rtol=1e-4)


def test_an_update_is_differentiable_also_before_there_is_anything(x64):
    u = jnp.asarray(samples(9, 4))

    @jax.jit
    def variance(deviations):
        return jnp.sum(incremental_pca.principal_components(learn(deviations, 3)).variances ** 2)

    gradient = jax.jit(jax.grad(variance))
    step = 1e-6 * jnp.asarray(np.random.default_rng(9).normal(size=u.shape))
    np.testing.assert_allclose(jnp.vdot(gradient(u), step), (variance(u + step) - variance(u - step)) / 2, rtol=1e-6)
    assert np.all(np.isfinite(gradient(u.at[0].set(0.0))))


def test_the_running_mean_is_the_mean(x64):
    x = samples(10, 20)
    mean = jnp.zeros(8)
    for count, one in enumerate(x, start=1):
        mean = incremental_pca.running_mean(mean, jnp.asarray(one), count)
    np.testing.assert_allclose(mean, x.mean(0), atol=1e-13)


def test_coordinates_are_carried_over_to_a_new_mean_and_basis(x64):
    rng = np.random.default_rng(11)
    full = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    full, mean, new_mean, coordinates = map(
        jnp.asarray, (full, rng.normal(size=6), rng.normal(size=6), rng.normal(size=(2, 9)))
    )
    new = incremental_pca.change_basis(coordinates, mean, full[:, :2], new_mean, full)
    np.testing.assert_allclose(new_mean[:, None] + full @ new, mean[:, None] + full[:, :2] @ coordinates, atol=1e-13)
    kept = incremental_pca.change_basis(coordinates, mean, full[:, :2], mean, full[:, :2])
    np.testing.assert_allclose(kept, coordinates, atol=1e-13)


def test_moments_are_those_of_numpy_wherever_the_data_lie(x64):
    x = samples(12, 200) + 1e3
    x = np.insert(x, [0, 50], np.nan, axis=0)
    moments = moments_of(x)
    observed = x[np.all(np.isfinite(x), axis=1)]
    np.testing.assert_allclose(moments.mean, observed.mean(0), rtol=1e-13)
    np.testing.assert_allclose(moments.scatter / 199, np.cov(observed.T), rtol=1e-10, atol=1e-10)
    basis, variances = incremental_pca.exact_principal_components(moments, 3)
    values, vectors = np.linalg.eigh(np.cov(observed.T))
    np.testing.assert_allclose(variances, values[:-4:-1], rtol=1e-10)
    np.testing.assert_allclose(np.abs(np.sum(basis * vectors[:, :-4:-1], axis=0)), 1, rtol=1e-10)


def test_incremental_and_exact_components_agree_in_the_long_run(x64):
    u = STD * np.random.default_rng(13).normal(size=(5000, SIZE))
    moments = moments_of(u)
    exact, candid = (
        incremental_pca.exact_principal_components(moments, 3),
        incremental_pca.principal_components(learn(u, 3, amnesic=0.0)),
    )
    assert np.all(np.abs(np.sum(exact.basis * candid.basis, axis=0)) > 0.999)
    np.testing.assert_allclose(candid.variances, exact.variances, rtol=0.02)


@pytest.mark.parametrize("num_components", [0, 9])
def test_numbers_of_components_that_cannot_be_are_rejected(num_components):
    with pytest.raises(ValueError, match="num_components must be from 1 to 8"):
        incremental_pca.start(8, num_components)
    with pytest.raises(ValueError, match="num_components must be from 1 to 8"):
        incremental_pca.exact_principal_components(incremental_pca.start_moments(8), num_components)
