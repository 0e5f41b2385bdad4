"""Whether innovations are white: of a filter whose model is right they are uncorrelated in time."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.special import gammaincc, ndtri
from jaxtyping import Array, ArrayLike, Float

from jaxfilters.diagnostics.consistency import between
from jaxfilters.gaussian import checks


class Whiteness(NamedTuple):
    """A test of no correlation in time, for each component."""

    statistic: Float[Array, " m"]
    """Chi-square where innovations are white, with a degree of freedom for each lag that has pairs of frames."""
    p_value: Float[Array, " m"]
    """Probability of a statistic at least as large."""


def autocorrelation(innovations: Float[Array, "t m"], max_lag: int) -> Float[Array, "k m"]:
    r"""Sample autocorrelation of each component at the lags 0 to `max_lag`, without removal of the mean.

    A consistent filter's innovations have the mean zero, so that an offset is a correlation at all lags. Divide
    innovations of unequal variance by their standard deviations before. Components that are not finite count as absent:
    at the lag k, the result is $1 - k / t$ times the mean product of the pairs that are there, divided by the mean
    square. Without gaps this is the sum of products divided by the sum of squares.

    Args:
        innovations: Time first, (t, m).
        max_lag: Largest lag, at least 0 and below t.

    Returns:
        (max_lag + 1, m): the first row is one. NaN at a lag without pairs, e.g. 1 if every second frame is absent.

    Raises:
        ValueError: If `innovations` are not (t, m), or `max_lag` is out of range.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> jf.diagnostics.autocorrelation(jnp.array([[1.0], [-1.0], [1.0], [-1.0]]), 1).tolist()
        [[1.0], [-0.75]]
    """
    ratios, pairs = _lagged(innovations, max_lag)
    length = innovations.shape[0]
    # Without gaps both products are the same number, and the scale is exactly one.
    full = (length - jnp.arange(max_lag + 1.0, dtype=ratios.dtype))[:, None] * pairs[0]
    scale = full / (length * jnp.where(pairs > 0, pairs, 1.0))
    return jnp.where(pairs > 0, ratios * scale, jnp.nan)


def _lagged(innovations: Float[Array, "t m"], max_lag: int) -> tuple[Float[Array, "k m"], Float[Array, "k m"]]:
    """Sums of products of each component at the lags 0 to `max_lag` over the sum of squares, and numbers of pairs."""
    checks.floating("innovations", innovations)
    if innovations.ndim != 2:
        raise ValueError(f"innovations must have the shape (t, m); got {innovations.shape}.")
    length = innovations.shape[0]
    if isinstance(max_lag, bool) or not isinstance(max_lag, int) or not 0 <= max_lag < length:
        raise ValueError(f"max_lag must be an integer from 0 to {length - 1}; got {max_lag!r}.")
    finite = jnp.isfinite(innovations)
    known = jnp.where(finite, innovations, 0.0)
    lags = range(max_lag + 1)
    products = jnp.stack([jnp.sum(known[lag:] * known[: length - lag], axis=0) for lag in lags])
    pairs = jnp.stack([jnp.sum(finite[lag:] & finite[: length - lag], axis=0) for lag in lags])
    return products / products[0], pairs.astype(known.dtype)


def autocorrelation_band(num_steps: int, *, probability: ArrayLike = 0.95) -> Float[Array, ""]:
    """Half the width of the band about zero in which an autocorrelation of white innovations lies.

    Args:
        num_steps: Number t of innovations, at least 1; with gaps, the number of pairs at the lag.
        probability: Probability inside, in (0, 1).

    Returns:
        The limit, `z / sqrt(t)`.

    Raises:
        ValueError: If a number is out of range.

    Examples:
        >>> import jaxfilters as jf
        >>> round(float(jf.diagnostics.autocorrelation_band(100)), 3)
        0.196
    """
    between("probability", probability, 0.0, 1.0)
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1; got {num_steps}.")
    return ndtri(0.5 + 0.5 * jnp.asarray(probability, dtype=float)) / math.sqrt(num_steps)


def whiteness(innovations: Float[Array, "t m"], max_lag: int) -> Whiteness:
    r"""Test that no lag from 1 to `max_lag` has a correlation.

    G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65, 1978. Innovations
    that are not finite count as absent. Of n that are there, with the sum $s_k$ of the products of the $n_k$ pairs at
    the lag k, the statistic is $n (n + 2) \sum_k (s_k / s_0)^2 / n_k$: of white Gaussian noise, each term has the mean
    one, with gaps as without them. Lags without pairs are left out.

    Args:
        innovations: Time first, (t, m).
        max_lag: Largest lag, at least 1 and below t.

    Returns:
        Statistic and p-value of each component; a p-value of NaN where no lag has pairs.

    Raises:
        ValueError: As for `autocorrelation`, or if `max_lag` is 0.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> noise = jax.random.normal(jax.random.key(0), (500, 1))
        >>> bool(jf.diagnostics.whiteness(noise, 10).p_value[0] > 0.01)
        True
    """
    ratios, pairs = _lagged(innovations, max_lag)
    if max_lag == 0:
        raise ValueError("max_lag must be at least 1; got 0.")
    number, pairs = pairs[0], pairs[1:]
    terms = jnp.where(pairs > 0, ratios[1:] ** 2 / jnp.where(pairs > 0, pairs, 1.0), 0.0)
    statistic = number * (number + 2) * jnp.sum(terms, axis=0)
    freedom = jnp.sum(pairs > 0, axis=0)
    p_value = gammaincc(0.5 * jnp.maximum(freedom, 1), 0.5 * statistic)
    return Whiteness(statistic, jnp.where(freedom > 0, p_value, jnp.nan))
