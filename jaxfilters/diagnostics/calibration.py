"""Whether predictive distributions are calibrated: their quantiles of what happened are uniform."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters import weights
from jaxfilters.gaussian import checks

_SERIES = 100
"""Terms of Kolmogorov's distribution; below its argument of 0.2, where they would be too few, it is zero."""


class Uniformity(NamedTuple):
    """A test that numbers are uniform on (0, 1)."""

    statistic: Float[Array, ""]
    """Largest distance of the empirical distribution function from the diagonal."""
    p_value: Float[Array, ""]
    """Probability of a distance at least as large."""


def pit(y: Float[Array, "*shape"], mean: ArrayLike, std: ArrayLike) -> Float[Array, "*shape"]:
    """Probability integral transform of Gaussian predictions: the predicted probability of less than what was observed.

    A. P. Dawid, "Statistical theory: the prequential approach", J. R. Statist. Soc. A 147, 1984. Those of calibrated
    predictions are uniform; of successive ones of a filter they are independent, too.

    Args:
        y: Observed values, (...).
        mean: Predicted means, broadcast with `y`.
        std: Predicted standard deviations, positive.

    Returns:
        Numbers in [0, 1].

    Raises:
        ValueError: If a concrete `std` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> [round(float(p), 3) for p in jf.diagnostics.pit(jnp.array([0.0, 2.0]), 0.0, 1.0)]
        [0.5, 0.977]
    """
    positive("std", std)
    return jax.scipy.special.ndtr((y - mean) / std)


def pit_ensemble(
    y: Float[Array, "*shape"], samples: Float[Array, "*shape n"], log_weights: Float[Array, " n"] | None = None
) -> Float[Array, "*shape"]:
    """Probability integral transform of weighted samples: the weight below, and half of that at what was observed.

    Args:
        y: Observed values, (...).
        samples: Samples of each prediction along the last axis, (..., n).
        log_weights: Log weights of the samples, (n,), in common; equal weights by default.

    Returns:
        Numbers in [0, 1].

    Raises:
        ValueError: If the shapes do not fit one another.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> float(jf.diagnostics.pit_ensemble(jnp.array(1.5), jnp.array([0.0, 1.0, 2.0, 3.0])))
        0.5
    """
    w = sample_weights(y, samples, log_weights)
    below = (samples < y[..., None]) + 0.5 * (samples == y[..., None])
    return jnp.sum(w * below, axis=-1)


def sample_weights(y: Array, samples: Array, log_weights: Array | None) -> Float[Array, " n"]:
    """Weights of samples (..., n) of predictions of `y`, (...), that sum to one.

    Raises:
        ValueError: If the shapes do not fit one another.
    """
    checks.floating("samples", samples)
    if samples.ndim == 0 or samples.shape[:-1] != y.shape:
        raise ValueError(f"samples must have the shape of y and then (n,), {y.shape} + (n,); got {samples.shape}.")
    count = samples.shape[-1]
    if log_weights is None:
        return jnp.full(count, 1 / count, samples.dtype)
    checks.shaped("log_weights", log_weights, (count,), ", one for each sample")
    return weights.linear(log_weights)


def uniformity(values: Float[Array, " n"]) -> Uniformity:
    """Test that numbers are independent and uniform on (0, 1), such as transforms `pit`, by Kolmogorov and Smirnov.

    The p-value is Kolmogorov's limit with the correction of M. A. Stephens (J. R. Statist. Soc. B 32, 1970), which is
    within 0.002 where it is below 0.1, and within 0.03 above, for 5 numbers and more.

    Args:
        values: Numbers, (n,).

    Returns:
        Statistic and p-value; a small one says that predictions are not calibrated.

    Raises:
        ValueError: If `values` is not a vector, or empty.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> test = jf.diagnostics.uniformity(jnp.linspace(0.05, 0.95, 10))
        >>> round(float(test.statistic), 3), round(float(test.p_value), 3)
        (0.05, 1.0)
    """
    checks.floating("values", values)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"values must have the shape (n,), n at least 1; got {values.shape}.")
    n = values.size
    ordered = jnp.sort(values)
    above, below = (jnp.arange(first, n + first) / n for first in (1, 0))
    statistic = jnp.max(jnp.maximum(above - ordered, ordered - below))
    argument = statistic * (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n))
    k = jnp.arange(1, _SERIES + 1)
    total = 2 * jnp.sum((-1.0) ** (k - 1) * jnp.exp(-2 * jnp.square(k * jnp.maximum(argument, 0.2))))
    return Uniformity(statistic, jnp.where(argument < 0.2, 1.0, jnp.clip(total, 0.0, 1.0)))


def sigma_coverage(
    truth: Float[Array, "*shape"], mean: ArrayLike, std: ArrayLike, *, sigmas: Sequence[float] = (1.0, 2.0, 3.0)
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Share of errors within 1, 2 and 3 standard deviations, and what it is for Gaussian errors.

    Args:
        truth: True values, (...).
        mean: Estimates, broadcast with `truth`.
        std: Standard deviations of the estimates, positive.
        sigmas: Numbers of standard deviations, positive.

    Returns:
        The shares, and the expected ones: 0.683, 0.954 and 0.997.

    Raises:
        ValueError: If a concrete `std` or one of `sigmas` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> within, expected = jf.diagnostics.sigma_coverage(jnp.array([0.5, -1.5, 0.1, 2.5]), 0.0, 1.0)
        >>> within.tolist(), [round(float(p), 3) for p in expected]
        ([0.5, 0.75, 1.0], [0.683, 0.954, 0.997])
    """
    positive("std", std)
    positive("sigmas", np.asarray(sigmas))
    limits = jnp.asarray(sigmas, dtype=float)
    size = (jnp.abs(truth - mean) / std).reshape(-1, 1)
    known = ~jnp.isnan(size)
    within = jnp.sum(known & (size <= limits), axis=0) / jnp.sum(known)
    return within, jax.scipy.special.erf(limits / math.sqrt(2))


def positive(name: str, value: Any) -> None:
    """Raise a `ValueError` unless all concrete values are positive."""
    known = checks.concrete(value)
    if known is not None and not np.all(known > 0):
        raise ValueError(f"{name} must be positive; got {known.min()}.")
