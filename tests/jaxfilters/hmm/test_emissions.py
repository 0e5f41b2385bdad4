"""Densities against scipy, and M-steps against the maximum of the expected log-likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxfilters import hmm

RNG = np.random.default_rng(0)
MEAN = jnp.asarray(RNG.normal(size=(2, 3)), dtype=float)
ROOT = RNG.normal(size=(2, 3, 3)) + 2 * np.eye(3)
COVARIANCE = jnp.asarray(ROOT @ ROOT.transpose(0, 2, 1), dtype=float)
VARIANCE = jnp.asarray(RNG.uniform(0.5, 2, size=(2, 3)), dtype=float)


def weighted(num_frames=40, num_sequences=3):
    """Vectors (t, 3, n), and shares of two states (t, 2, n)."""
    rng = np.random.default_rng(1)
    y = rng.normal(size=(num_frames, 3, num_sequences)) @ np.eye(num_sequences) * np.array([1, 2, 0.1])[:, None]
    share = rng.dirichlet([0.5, 0.5], (num_frames, num_sequences)).transpose(0, 2, 1)
    return jnp.asarray(y, dtype=float), jnp.asarray(share, dtype=float)


def test_densities_are_those_of_scipy():
    y = np.array([0.3, -1.0, 2.0], np.float32)
    diagonal = hmm.DiagonalGaussian(MEAN, VARIANCE).log_likelihood(jnp.asarray(y))
    full = hmm.FullGaussian(MEAN, COVARIANCE).log_likelihood(jnp.asarray(y))
    for i in range(2):
        expected = stats.multivariate_normal(MEAN[i], np.diag(VARIANCE[i])).logpdf(y)
        np.testing.assert_allclose(diagonal[i], expected, rtol=1e-5)
        np.testing.assert_allclose(full[i], stats.multivariate_normal(MEAN[i], COVARIANCE[i]).logpdf(y), rtol=1e-5)


def test_a_code_that_does_not_exist_is_impossible_and_has_no_derivative():
    codes = hmm.Codes(jnp.log(jnp.array([[0.25, 0.75], [1.0, 0.0]])))
    np.testing.assert_allclose(np.exp(codes.log_likelihood(jnp.array(1))), [0.75, 0.0], rtol=1e-6)
    for unknown in (-1, 2):
        assert np.all(codes.log_likelihood(jnp.array(unknown)) == -np.inf)
        model = hmm.from_probabilities([0.5, 0.5], np.full((2, 2), 0.5), codes)
        total = lambda model, y: hmm.log_evidence(model, model.log_likelihoods(y))
        gradient = jax.jit(jax.grad(total))(model, jnp.array([0, unknown, 1]))
        with pytest.raises(ValueError, match=f"codes from 0 to 1.*got {unknown} in frame 1"):
            model.log_likelihoods(jnp.array([0, unknown, 1]))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_frequencies_of_codes_with_pseudo_counts():
    y, share = jnp.array([[0, 1], [2, 0]]), jnp.array([[[1.0, 0.5], [0.0, 0.5]], [[0.25, 0.0], [0.75, 0.0]]])
    start = hmm.Codes(jnp.log(jnp.full((2, 3), 1 / 3)), pseudo_count=0.1)
    counts = np.array([[1.0, 0.5, 0.25], [0.0, 0.5, 0.75]]) + 0.1
    found = start.m_step(y, share)
    np.testing.assert_allclose(np.exp(found.log_probability), counts / counts.sum(1, keepdims=True), rtol=1e-5)
    np.testing.assert_allclose(found.log_prior(), 0.1 * np.log(counts / counts.sum(1, keepdims=True)).sum(), rtol=1e-5)


def test_moments_of_gaussians_are_weighted_means_and_covariances(x64):
    y, share = weighted()
    flat, weights = (
        np.moveaxis(np.asarray(y), 1, -1).reshape(-1, 3),
        np.moveaxis(np.asarray(share), 1, 0).reshape(2, -1),
    )
    diagonal = hmm.DiagonalGaussian(MEAN, VARIANCE, 1e-9).m_step(y, share)
    full = hmm.FullGaussian(MEAN, COVARIANCE, 1e-9).m_step(y, share)
    for i in range(2):
        mean, covariance = np.average(flat, axis=0, weights=weights[i]), np.cov(flat.T, aweights=weights[i], bias=True)
        np.testing.assert_allclose(diagonal.mean[i], mean, atol=1e-12)
        np.testing.assert_allclose(full.mean[i], mean, atol=1e-12)
        np.testing.assert_allclose(diagonal.variance[i], np.diag(covariance), rtol=1e-10)
        np.testing.assert_allclose(full.covariance[i], covariance, atol=1e-12)


def test_variances_have_a_floor_and_states_without_frames_keep_theirs():
    y, share = weighted()
    share = share.at[:, 1].set(0.0)
    diagonal = hmm.DiagonalGaussian(MEAN, VARIANCE, 0.5).m_step(y, share)
    full = hmm.FullGaussian(MEAN, COVARIANCE, 0.5).m_step(y, share)
    np.testing.assert_allclose(diagonal.variance[0, 2], 0.5)
    np.testing.assert_allclose(np.linalg.eigvalsh(full.covariance[0])[0], 0.5, rtol=1e-5)
    for found, start in ((diagonal.variance, VARIANCE), (full.covariance, COVARIANCE), (full.mean, MEAN)):
        np.testing.assert_array_equal(found[1], start[1])
    assert np.all(np.isfinite(full.covariance))


@pytest.mark.parametrize(
    "emission", [hmm.DiagonalGaussian(MEAN, VARIANCE), hmm.FullGaussian(MEAN, COVARIANCE)], ids=["diagonal", "full"]
)
def test_draws_have_the_moments_of_their_state(emission):
    keys = jax.random.split(jax.random.key(2), 20_000)
    y = np.asarray(jax.vmap(emission.sample, (0, None))(keys, jnp.array(1)))
    covariance = COVARIANCE[1] if isinstance(emission, hmm.FullGaussian) else np.diag(VARIANCE[1])
    spread = np.sqrt(np.diag(covariance))
    # 4 standard deviations of the mean, and of the largest element of a covariance.
    np.testing.assert_allclose(y.mean(0), MEAN[1], atol=4 * spread.max() / np.sqrt(20_000))
    np.testing.assert_allclose(np.cov(y.T), covariance, atol=4 * np.sqrt(2 / 20_000) * spread.max() ** 2)


def test_independent_parts_multiply_and_are_trained_apart():
    codes, gaussian = hmm.Codes(jnp.log(jnp.full((2, 4), 0.25))), hmm.DiagonalGaussian(MEAN, VARIANCE)
    both = hmm.Independent((codes, gaussian))
    y, share = weighted()
    symbols = jnp.asarray(np.random.default_rng(3).integers(0, 4, (40, 3)))
    found = both.m_step((symbols, y), share)
    jax.tree.map(np.testing.assert_array_equal, found.parts[0], codes.m_step(symbols, share))
    jax.tree.map(np.testing.assert_array_equal, found.parts[1], gaussian.m_step(y, share))
    one = (jnp.array(1), y[0, :, 0])
    expected = codes.log_likelihood(one[0]) + gaussian.log_likelihood(one[1])
    np.testing.assert_allclose(both.log_likelihood(one), expected, rtol=1e-6)
    assert both.log_prior() == 0
    drawn = both.sample(jax.random.key(4), jnp.array(0))
    assert drawn[0] in range(4)
    assert drawn[1].shape == (3,)
    with pytest.raises(ValueError, match="tuple of 2"):
        both.log_likelihood((one[0],))
