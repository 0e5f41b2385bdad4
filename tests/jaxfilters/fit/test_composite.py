"""Certainty of estimates from images with correlated residuals: against the spread of estimates over many images."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

SIZE, COUNT = 40, 1000
KERNEL = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
"""Noise is white noise smoothed by it along both axes, so that its correlation ends at the lag four."""


def template():
    """Derivatives of an image of a blob along three parameters: place and brightness."""
    across = np.linspace(-1, 1, SIZE)
    u, v = np.meshgrid(across, across, indexing="ij")
    blob = np.exp(-(u**2 + v**2) / 0.18)
    return jnp.asarray(np.stack([u * blob, v * blob, blob], -1), jnp.float32)


def noise_of(key):
    white = jax.random.normal(key, (SIZE + 4, SIZE + 4))
    return jax.scipy.signal.convolve2d(white, jnp.asarray(np.outer(KERNEL, KERNEL) / np.sum(KERNEL**2)), "valid")


def covariance_of_noise():
    """Along one axis; that of an image is its Kronecker square."""
    band = np.correlate(KERNEL, KERNEL, "full") / np.sum(KERNEL**2)
    return sum(band[4 + lag] * np.eye(SIZE, k=lag) for lag in range(-4, 5))


def mode_and_certainty(key, A, lags):
    y = noise_of(key)
    flat = A.reshape(-1, 3)
    mode = jnp.linalg.solve(flat.T @ flat, flat.T @ y.ravel())
    return mode, jf.fit.godambe(lambda x: -0.5 * (y - A @ x) ** 2, mode, lags=lags)


@pytest.mark.system
def test_estimates_spread_over_images_as_godambe_says_and_not_as_laplace():
    """The standard deviation over 1000 images has an error of 2.2 percent: four of them, and the bias of the weights.

    Weights that fall linearly to zero at the lag nine leave out 15 to 20 percent of the correlation along each axis;
    the expected matrix with these weights is computed in NumPy, too.
    """
    A, lags = template(), 8
    keys = jax.random.split(jax.random.key(0), COUNT)
    modes, found = jax.jit(jax.vmap(lambda key: mode_and_certainty(key, A, lags)))(keys)
    spread, claimed = np.std(modes, axis=0), np.sqrt(np.mean(np.diagonal(found.covariance, axis1=1, axis2=2), axis=0))
    flat, C = np.asarray(A, float).reshape(-1, 3), covariance_of_noise()
    inverse = np.linalg.inv(flat.T @ flat)

    def sandwich(C):
        return np.sqrt(np.diag(inverse @ flat.T @ np.kron(C, C) @ flat @ inverse))

    np.testing.assert_allclose(spread, sandwich(C), rtol=0.09)
    distance = np.abs(np.subtract.outer(np.arange(SIZE), np.arange(SIZE)))
    weighted = sandwich(C * np.maximum(1 - distance / (lags + 1), 0))
    np.testing.assert_allclose(claimed, weighted, rtol=0.09)
    assert np.all(claimed > 0.72 * spread)
    laplace = np.sqrt(np.diagonal(found.laplace[0]))
    assert np.all(spread > 2.5 * laplace)
    # The magnitude is that of the mean ratio of variances.
    np.testing.assert_allclose(np.mean(1 / found.magnitude), np.mean(claimed**2 / laplace**2), rtol=0.05)


def along(values, axis, matrix):
    return np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)


@pytest.mark.system
def test_certainty_from_a_sequence_of_images_whose_residuals_are_correlated_in_time_too():
    """A blob that moves through 16 images, with noise of a longer correlation in time than across the image.

    The standard deviation over 500 sequences has an error of 3.2 percent, of which four; the expected matrix with the
    weights of the lags is computed axis by axis in NumPy.
    """
    grid, lengths, lags = (16, 10, 10), (3, 2, 2), (4, 2, 2)
    t, u, v = np.meshgrid(*(np.linspace(-1, 1, size) for size in grid), indexing="ij")
    blob = np.exp(-((u - 0.3 * t) ** 2 + v**2) / 0.6)
    A = np.stack([v * blob, blob], -1)
    flat = A.reshape(-1, 2)
    inverse = np.linalg.inv(flat.T @ flat)

    # Means of neighbours, so that the correlation falls linearly to zero at their number.
    y = np.random.default_rng(4).normal(size=(500, *(n + k - 1 for n, k in zip(grid, lengths, strict=True))))
    for axis, (n, k) in enumerate(zip(grid, lengths, strict=True), start=1):
        y = along(y, axis, sum(np.eye(n, n + k - 1, shift) for shift in range(k)) / np.sqrt(k))
    modes = y.reshape(500, -1) @ flat @ inverse
    basis = jnp.asarray(A, jnp.float32)

    def variances(pair):
        y, mode = pair
        found = jf.fit.godambe(lambda x: -0.5 * (y - basis @ x) ** 2, mode, lags=lags)
        return jnp.diagonal(found.covariance)

    pairs = jnp.asarray(y, jnp.float32), jnp.asarray(modes, jnp.float32)
    claimed = np.sqrt(np.mean(jax.lax.map(variances, pairs, batch_size=50), axis=0))

    def sandwich(lags):
        K = A
        for axis, (n, k, lag) in enumerate(zip(grid, lengths, lags, strict=True)):
            distance = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
            weights = np.maximum(1 - distance / (lag + 1), 0)
            K = along(K, axis, weights * np.maximum(1 - distance / k, 0))
        return np.sqrt(np.diag(inverse @ flat.T @ K.reshape(-1, 2) @ inverse))

    whole = sandwich((np.inf, np.inf, np.inf))
    np.testing.assert_allclose(np.std(modes, axis=0), whole, rtol=0.13)
    np.testing.assert_allclose(claimed, sandwich(lags), rtol=0.13)
    assert np.all(whole > 2 * np.sqrt(np.diag(inverse)))
    # The tolerance tells it from the matrix of images that are independent in time.
    assert np.all(claimed > 1.2 * sandwich((0, *lags[1:])))


def test_windows_are_the_sum_over_pairs_with_weights():
    """Brute force over all pairs of 42 pixels, in float64."""
    rng = np.random.default_rng(1)
    scores, lags = rng.normal(size=(6, 7, 2)), (1, 2)
    white = scores @ np.linalg.inv(np.linalg.cholesky(np.einsum("ijk,ijl->kl", scores, scores))).T
    expected, L = np.zeros((2, 2)), np.zeros((2, 2))
    for i, j, k, m in np.ndindex(6, 7, 6, 7):
        weight = max(1 - abs(i - k) / 2, 0) * max(1 - abs(j - m) / 3, 0)
        expected += weight * np.outer(scores[i, j], scores[k, m])
        L += weight * np.outer(white[i, j], white[i, j]) @ np.outer(white[k, m], white[k, m])
    # The determinant does not depend on which root of I - L divides the result.
    found = jf.fit.score_covariance(jnp.asarray(scores, jnp.float32), lags)
    np.testing.assert_allclose(
        np.linalg.det(found), np.linalg.det(expected) / np.linalg.det(np.eye(2) - 0.5 * (L + L.T)), rtol=1e-4
    )


@pytest.mark.system
def test_independent_terms_have_the_magnitude_one():
    """A mean of 2000 numbers: the magnitude is the inverse of their variance, whose error is 3.2 percent; four."""
    y = jax.random.normal(jax.random.key(2), (2000,))
    found = jf.fit.godambe(lambda x: -0.5 * (y - x[0]) ** 2, y.mean()[None], lags=0)
    assert abs(float(found.magnitude) - 1) < 0.13
    np.testing.assert_allclose(found.laplace, [[1 / 2000]], rtol=1e-5)


def test_lags_are_those_of_the_noise():
    """The correlation of the kernel ends at the lag four: the next is within the band, or the fourth already is."""
    found = jf.fit.correlation_lags(noise_of(jax.random.key(0)))
    assert set(found) <= {6, 8, 10, 12}


def test_a_point_that_is_no_maximum_has_no_certainty():
    y = jnp.arange(20.0)
    found = jf.fit.godambe(lambda x: 0.5 * (y - x[0]) ** 2, jnp.ones(1), lags=1)
    assert np.isnan(found.covariance).all()
    assert np.isnan(found.laplace).all()
    assert np.isnan(found.magnitude)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jf.fit.score_covariance(jnp.zeros(5), 1), r"scores must have the axes of a grid and then \(d,\)"),
        (lambda: jf.fit.score_covariance(jnp.zeros((9, 9, 1)), (1, 2, 3)), "lags must be at least 0, one number or 2"),
        (lambda: jf.fit.score_covariance(jnp.zeros((9, 9, 1)), -1), "lags must be at least 0"),
        (lambda: jf.fit.score_covariance(jnp.zeros((9, 9, 1)), 5), "windows of at most a quarter of the 81 terms"),
        (lambda: jf.fit.correlation_lags(np.ones((30, 4)) * np.arange(4)), "along axis 0, of 30, they keep it"),
        (lambda: jax.jit(jf.fit.correlation_lags)(jnp.ones(3)), "residuals must be concrete"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
