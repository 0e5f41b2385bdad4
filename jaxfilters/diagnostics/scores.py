"""Proper scores of probabilistic predictions: the expected score is best for the true distribution."""

import math

import jax.numpy as jnp
from jax.scipy.special import erf
from jaxtyping import Array, ArrayLike, Float

from jaxfilters.diagnostics.calibration import positive, sample_weights


def crps(y: Float[Array, "*shape"], mean: ArrayLike, std: ArrayLike) -> Float[Array, "*shape"]:
    r"""Continuous ranked probability score of Gaussian predictions, in the unit of `y`; smaller is better.

    $\sigma [z (2 \Phi(z) - 1) + 2 \varphi(z) - 1 / \sqrt\pi]$ with $z = (y - m) / \sigma$ (T. Gneiting and A. E.
    Raftery, "Strictly proper scoring rules, prediction, and estimation", J. Am. Stat. Assoc. 102, 2007, equation 21).

    Args:
        y: Observed values, (...).
        mean: Predicted means, broadcast with `y`.
        std: Predicted standard deviations, positive.

    Returns:
        The scores.

    Raises:
        ValueError: If a concrete `std` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> round(float(jf.diagnostics.crps(jnp.array(1.0), 0.0, 2.0)), 4)
        0.6628
    """
    positive("std", std)
    std = jnp.asarray(std, dtype=float)
    z = (y - mean) / std
    density = jnp.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    return std * (z * erf(z / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi))


def crps_ensemble(
    y: Float[Array, "*shape"], samples: Float[Array, "*shape n"], log_weights: Float[Array, " n"] | None = None
) -> Float[Array, "*shape"]:
    r"""Continuous ranked probability score of weighted samples, in the unit of `y`; smaller is better.

    $\sum_i w_i |x_i - y| - \frac12 \sum_{ij} w_i w_j |x_i - x_j|$, by sorting, in time n log n.

    Args:
        y: Observed values, (...).
        samples: Samples of each prediction along the last axis, (..., n).
        log_weights: Log weights of the samples, (n,), in common; equal weights by default.

    Returns:
        The scores.

    Raises:
        ValueError: If the shapes do not fit one another.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> float(jf.diagnostics.crps_ensemble(jnp.array(0.0), jnp.array([-1.0, 1.0])))
        0.5
    """
    w = jnp.broadcast_to(sample_weights(y, samples, log_weights), samples.shape)
    order = jnp.argsort(samples, axis=-1)
    x, w = (jnp.take_along_axis(values, order, axis=-1) for values in (samples, w))
    # A sum over pairs of gaps between neighbours: the weight below a gap times that above it. Differences, so that a
    # common offset of the samples costs no accuracy.
    below = jnp.cumsum(w, axis=-1)[..., :-1]
    spread = jnp.sum(jnp.diff(x, axis=-1) * below * (1 - below), axis=-1)
    return jnp.sum(w * jnp.abs(x - y[..., None]), axis=-1) - spread


def log_score(y: Float[Array, "*shape"], mean: ArrayLike, std: ArrayLike) -> Float[Array, "*shape"]:
    """Negative log density of Gaussian predictions, in nats; smaller is better.

    Of several dimensions at once it is the negative of `infos.log_evidence` of a filter, or of `Gaussian.logpdf`.

    Args:
        y: Observed values, (...).
        mean: Predicted means, broadcast with `y`.
        std: Predicted standard deviations, positive.

    Returns:
        The scores.

    Raises:
        ValueError: If a concrete `std` is not positive.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> round(float(jf.diagnostics.log_score(jnp.array(1.0), 0.0, 1.0)), 4)
        1.4189
    """
    positive("std", std)
    z = (y - mean) / std
    return 0.5 * z * z + jnp.log(std) + 0.5 * math.log(2 * math.pi)
