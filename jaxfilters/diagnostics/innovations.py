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
    """Chi-square with `max_lag` degrees of freedom where innovations are white."""
    p_value: Float[Array, " m"]
    """Probability of a statistic at least as large."""


def autocorrelation(innovations: Float[Array, "t m"], max_lag: int) -> Float[Array, "k m"]:
    """Sample autocorrelation of each component at the lags 0 to `max_lag`, without removal of the mean.

    A consistent filter's innovations have the mean zero, so that an offset is a correlation at all lags. Divide
    innovations of unequal variance by their standard deviations before. Components that are not finite count as absent.

    Args:
        innovations: Time first, (t, m).
        max_lag: Largest lag, at least 0 and below t.

    Returns:
        (max_lag + 1, m): the first row is one.

    Raises:
        ValueError: If `innovations` are not (t, m), or `max_lag` is out of range.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> jf.diagnostics.autocorrelation(jnp.array([[1.0], [-1.0], [1.0], [-1.0]]), 1).tolist()
        [[1.0], [-0.75]]
    """
    checks.floating("innovations", innovations)
    if innovations.ndim != 2:
        raise ValueError(f"innovations must have the shape (t, m); got {innovations.shape}.")
    length = innovations.shape[0]
    if isinstance(max_lag, bool) or not isinstance(max_lag, int) or not 0 <= max_lag < length:
        raise ValueError(f"max_lag must be an integer from 0 to {length - 1}; got {max_lag!r}.")
    known = jnp.where(jnp.isfinite(innovations), innovations, 0.0)
    products = [jnp.sum(known[lag:] * known[: length - lag], axis=0) for lag in range(max_lag + 1)]
    return jnp.stack(products) / products[0]


def autocorrelation_band(num_steps: int, *, probability: ArrayLike = 0.95) -> Float[Array, ""]:
    """Half the width of the band about zero in which an autocorrelation of white innovations lies.

    Args:
        num_steps: Number t of innovations, at least 1.
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
    """Test that no lag from 1 to `max_lag` has a correlation.

    G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65, 1978.

    Args:
        innovations: Time first, (t, m).
        max_lag: Largest lag, at least 1 and below t.

    Returns:
        Statistic and p-value of each component.

    Raises:
        ValueError: As for `autocorrelation`, or if `max_lag` is 0.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> noise = jax.random.normal(jax.random.key(0), (500, 1))
        >>> bool(jf.diagnostics.whiteness(noise, 10).p_value[0] > 0.01)
        True
    """
    correlations = autocorrelation(innovations, max_lag)[1:]
    if max_lag == 0:
        raise ValueError("max_lag must be at least 1; got 0.")
    length = innovations.shape[0]
    remaining = (length - jnp.arange(1, max_lag + 1))[:, None]
    statistic = length * (length + 2) * jnp.sum(correlations**2 / remaining, axis=0)
    return Whiteness(statistic, gammaincc(0.5 * max_lag, 0.5 * statistic))
