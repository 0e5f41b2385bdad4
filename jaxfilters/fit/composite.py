r"""How certain an estimate is that maximises a likelihood whose terms are not independent, such as that of an image.

A likelihood that multiplies the terms of all pixels counts the same error many times where residuals of neighbours are
correlated. Its curvature J at the mode is then no measure of certainty. With the scores $s_p$ of the terms and
$K = \operatorname{Var}(\sum_p s_p)$, the estimate has the covariance $J^{-1} K J^{-1}$ (V. P. Godambe, "An optimum
property of regular maximum likelihood estimation", Annals of Mathematical Statistics 31, 1960; C. Varin, N. Reid and
D. Firth, "An overview of composite likelihood methods", Statistica Sinica 21, 2011).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.math import linalg

_SHARE = 4
"""One over the largest share of a grid in one window, and over the least share of the information outside of it."""

_UNCORRELATED = 0.2
"""Autocorrelation below which residuals count as nearly independent."""


class Godambe(NamedTuple):
    """The certainty of an estimate."""

    covariance: Float[Array, "d d"]
    """Of the estimate, J^-1 K J^-1."""
    laplace: Float[Array, "d d"]
    """J^-1: what the covariance would be if all terms were independent. NaN where the estimate is no maximum."""
    score_covariance: Float[Array, "d d"]
    """K."""
    magnitude: Float[Array, ""]
    """eta = d / tr(J^-1 K): the power to which the likelihood has about the right curvature (F. Pauli, W. Racugno and
    L. Ventura, "Bayesian composite marginal likelihoods", Statistica Sinica 21, 2011). Particles weighted by it carry
    weights that mean something; 1 for independent terms."""


def godambe(
    log_likelihoods: Callable[[Array], Float[Array, "..."]], x: Float[Array, " d"], *, lags: int | Sequence[int]
) -> Godambe:
    """Certainty of the maximum of a sum of log-likelihoods on a grid, whose neighbours are correlated.

    Args:
        log_likelihoods: `x -> terms`, one for each pixel, row or block: an array over the axes of the grid, e.g. (h, w)
            or (t, h, w). Terms of pixels that are left out are constants.
        x: Coordinates of the maximum, (d,).
        lags: Distance along each axis of the grid beyond which terms are independent, as of `score_covariance`.

    Returns:
        The covariance, that of Laplace's method, and the magnitude of the likelihood. Where the negative Hessian is not
        positive definite, all but the score covariance are NaN.

    Raises:
        ValueError: If `x` is no vector, or as for `score_covariance`.
        TypeError: If `x` is no array of floating-point numbers.

    Examples:
        The mean of a series with errors that last: 400 readings are worth far fewer.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> white = jax.random.normal(jax.random.key(0), (409,))
        >>> y = jnp.convolve(white, jnp.ones(10), "valid") / 10**0.5
        >>> found = jf.fit.godambe(lambda x: -0.5 * (y - x[0]) ** 2, y.mean()[None], lags=20)
        >>> bool(found.magnitude < 0.25), round(float(found.laplace[0, 0]), 4)
        (True, 0.0025)
    """
    checks.floating("x", x)
    if x.ndim != 1:
        raise ValueError(f"x must have the shape (d,); got {x.shape}.")
    # One column of scores a direction: an image has many more pixels than the state has components.
    scores = jax.jacfwd(log_likelihoods)(x)
    J = -jax.hessian(lambda x: jnp.sum(log_likelihoods(x)))(x)
    K = score_covariance(scores, lags)
    root = jnp.linalg.cholesky(0.5 * (J + J.T))
    half = linalg.solve_triangular(root, jnp.eye(x.size, dtype=x.dtype))
    inverse = factor.inner(half, half)
    inverse = jnp.where(jnp.all(jnp.isfinite(root)), inverse, jnp.nan)
    adjusted = factor.turned(inverse, K)
    return Godambe(adjusted, inverse, K, x.size / jnp.trace(linalg.matmul(inverse, K)))


def score_covariance(scores: Float[Array, "*grid d"], lags: int | Sequence[int]) -> Float[Array, "d d"]:
    r"""Covariance of the sum of correlated scores on a grid, at the maximum, where their sum is zero.

    The sum over pairs of pixels with weights that fall linearly with their distance along each axis (W. K. Newey and
    K. D. West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
    Econometrica 55, 1987), which is that of the sums over all windows of lags + 1 pixels. As the scores add to zero,
    such sums are too small where a window holds a good part of what the estimate rests on: about by the factor I - L,
    with $L = \sum_{pq} w_{pq} I_p I_q$ and the shares $I_p$ of the pixels in the sum of squares of scores, whitened.
    The result is divided by it. With more than three quarters in one window it cannot be known, and is NaN. The weights
    leave it too small: see `correlation_lags`.

    Args:
        scores: Derivatives of the log-likelihoods of the pixels, over the axes of the grid and then (d,).
        lags: Largest distance along each axis at which scores are correlated, one number or one for each axis; 0 for
            independent scores. About twice the correlation length: `correlation_lags` of the residuals.

    Returns:
        (d, d), positive semidefinite.

    Raises:
        ValueError: If `scores` has fewer than two axes, `lags` is negative or has another length than the grid, or a
            window holds more than a quarter of the grid.

    Examples:
        The sum of 100 independent scores of variance one has a variance near 100; 0.99 is the correction I - L.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> scores = jnp.array([1.0, -1.0] * 50)[:, None]
        >>> K = jax.jit(lambda scores: jf.fit.score_covariance(scores, lags=0))(scores)
        >>> round(float(0.99 * K[0, 0]), 2)
        100.0
    """
    checks.floating("scores", scores)
    if scores.ndim < 2:
        raise ValueError(f"scores must have the axes of a grid and then (d,); got the shape {scores.shape}.")
    grid = scores.shape[:-1]
    each = (lags,) * len(grid) if isinstance(lags, int) else tuple(lags)
    widths = [int(lag) + 1 for lag in each]
    if len(widths) != len(grid) or min(widths) < 1:
        raise ValueError(f"lags must be at least 0, one number or {len(grid)}, one for each axis; got {lags}.")
    pixels, window = math.prod(grid), math.prod(widths)
    if _SHARE * window > pixels:
        raise ValueError(
            f"lags must give windows of at most a quarter of the {pixels} terms; got {lags}, windows of {window}."
        )
    sums = _window_sums(scores, widths)
    d = scores.shape[-1]
    K = factor.inner(sums, sums) / window
    flat = scores.reshape(-1, d)
    root = linalg.cholesky(factor.inner(flat, flat))
    white = linalg.solve_triangular(root, flat.T).T
    shares = _window_sums(jnp.reshape(white[:, :, None] * white[:, None, :], (*grid, d * d)), widths).reshape(-1, d, d)
    L = jnp.einsum("wij,wjk->ik", shares, shares, precision="highest") / window
    left = jnp.linalg.cholesky(factor.identity(d, scores.dtype) - 0.5 * (L + L.T))
    known = jnp.all(jnp.isfinite(left)) & (jnp.min(jnp.diagonal(left)) ** 2 > 1 / _SHARE)
    half = linalg.solve_triangular(root, linalg.solve_triangular(root, K).T)
    half = linalg.solve_triangular(left, linalg.solve_triangular(left, half).T)
    return jnp.where(known, factor.turned(root, half), jnp.nan)


def _window_sums(values: Float[Array, "*grid k"], widths: Sequence[int]) -> Float[Array, "w k"]:
    """Sums over all windows that overlap the grid."""
    padding = [(width - 1, width - 1) for width in widths] + [(0, 0)]
    ones = (1,) * values.ndim
    sums = jax.lax.reduce_window(values, 0.0, jax.lax.add, (*widths, 1), ones, padding)
    return sums.reshape(-1, values.shape[-1])


def correlation_lags(residuals: ArrayLike, *, most: int = 64) -> tuple[int, ...]:
    """Lags for `score_covariance` from the correlation of residuals along each axis of their grid.

    Along an axis it is twice the first lag at which the autocorrelation is below 0.2, or 2 / sqrt(number of residuals)
    where that is larger: weights that fall linearly count half of the correlation at half of the largest lag. A smaller
    limit would be lost in the sampling error that the correlation itself makes large.

    With these weights and twice the lag at which the correlation ends, the variance of the estimate is too small: by 15
    percent for moving averages of 5 or 10 terms, and, as the factors of the axes multiply, by about 30 percent for an
    image averaged over 3 x 3 pixels. Larger lags reduce this and make the estimate of the variance noisier.

    Args:
        residuals: Residuals on the grid at the estimate, concrete; NaN where there is none.
        most: Largest lag that is looked at along an axis.

    Returns:
        One integer for each axis.

    Raises:
        ValueError: If residuals are correlated along a whole axis, or fewer than two are finite.
        TypeError: If they are traced.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> jf.fit.correlation_lags(jax.random.normal(jax.random.key(0), (50, 60)))
        (2, 2)
    """
    values = checks.concrete(residuals)
    if values is None:
        raise TypeError("residuals must be concrete: lags are sizes of windows, which are known when JAX traces.")
    values = np.asarray(values, float)
    read = np.isfinite(values)
    if read.sum() < 2:
        raise ValueError(f"residuals must have at least two finite numbers; got {read.sum()}.")
    e = np.where(read, values - values[read].mean(), 0.0)
    limit = max(2 / math.sqrt(read.sum()), _UNCORRELATED)
    lags = []
    for axis, size in enumerate(values.shape):
        found = next(
            (lag for lag in range(1, min(most, size - 1) + 1) if _correlation(e, read, axis, lag) < limit), None
        )
        if found is None:
            raise ValueError(
                f"residuals must lose their correlation along each axis; along axis {axis}, of {size}, they keep it."
            )
        lags.append(2 * found)
    return tuple(lags)


def _correlation(e: np.ndarray, read: np.ndarray, axis: int, lag: int) -> float:
    size = e.shape[axis]
    first, second = (np.take(e, range(*cut), axis) for cut in ((0, size - lag), (lag, size)))
    both = np.take(read, range(size - lag), axis) & np.take(read, range(lag, size), axis)
    variance = np.sum(e * e) / np.sum(read)
    return float(np.sum(first * second) / max(np.sum(both), 1) / variance) if variance > 0 else 0.0
