r"""Whether importance weights have a variance: the tail index k of a generalised Pareto distribution.

A. Vehtari, D. Simpson, A. Gelman, Y. Yao and J. Gabry, "Pareto smoothed importance sampling", Journal of Machine
Learning Research 25, 2024. Weights with k above about 0.7 are not to be trusted, whatever their effective sample size.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import weights


class ParetoSmoothed(NamedTuple):
    """Weights whose largest are replaced by the expected ones, and the tail index."""

    log_weights: Float[Array, " n"]
    """Log weights that sum to one."""
    k: Float[Array, ""]


def pareto_k(log_weights: Float[Array, " n"]) -> Float[Array, ""]:
    """Tail index of importance weights: below 0.5 their variance is finite, above 0.7 they are not to be trusted.

    Args:
        log_weights: Log weights, (n,), normalised or not; at least 25 are needed for a tail of five.

    Returns:
        The index; infinity where fewer than five weights are in the tail or the tail is constant.

    Raises:
        ValueError: If `log_weights` is not a vector.
        TypeError: If they are not floating-point numbers.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> bool(jf.diagnostics.pareto_k(jax.random.normal(jax.random.key(0), (1000,))) < 0.7)
        True
    """
    return pareto_smoothed(log_weights).k


def pareto_smoothed(log_weights: Float[Array, " n"]) -> ParetoSmoothed:
    """Pareto-smoothed importance weights.

    The largest min(n / 5, 3 sqrt(n)) weights are replaced by the expected order statistics of the generalised Pareto
    distribution that is fitted to them (J. Zhang and M. A. Stephens, "A new and efficient estimation method for the
    generalized Pareto distribution", Technometrics 51, 2009, with a weak prior on k), at most the largest of them.

    Args:
        log_weights: Log weights, (n,), normalised or not.

    Returns:
        The smoothed log weights, and the tail index.

    Raises:
        ValueError: If `log_weights` is not a vector.
        TypeError: If they are not floating-point numbers.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> log_weights, k = jf.diagnostics.pareto_smoothed(3.0 * jax.random.normal(jax.random.key(0), (1000,)))
        >>> round(float(jax.numpy.exp(log_weights).sum()), 3)
        1.0
    """
    return _smoothed(log_weights)


@jax.jit
def _smoothed(log_weights: Float[Array, " n"]) -> ParetoSmoothed:
    normalised, _ = weights.normalize(log_weights)
    n = normalised.size
    size = math.ceil(min(0.2 * n, 3 * math.sqrt(n)))
    if size < 5:
        return ParetoSmoothed(normalised, jnp.full((), jnp.inf, normalised.dtype))
    peak = jnp.max(normalised)
    shifted = normalised - peak
    order = jnp.argsort(shifted)
    cutoff = jnp.maximum(shifted[order[n - size - 1]], jnp.log(jnp.finfo(shifted.dtype).tiny))
    tail = shifted[order[n - size :]]
    excess = jnp.exp(tail) - jnp.exp(cutoff)
    k, scale = _fit(jnp.where(excess[-1] > 0, jnp.maximum(excess, 0.0), jnp.arange(1.0, size + 1)))
    usable = excess[-1] > 0
    levels = (jnp.arange(size) + 0.5) / size
    smoothed = jnp.log(_quantile(levels, k, scale) + jnp.exp(cutoff))
    replaced = jnp.where(usable & jnp.isfinite(k), jnp.minimum(smoothed, 0.0), tail)
    found, _ = weights.normalize(shifted.at[order[n - size :]].set(replaced.astype(shifted.dtype)))
    return ParetoSmoothed(found, jnp.where(usable, k, jnp.inf))


def _fit(excess: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Shape and scale of a generalised Pareto distribution from its sorted sample."""
    n = excess.size
    points = 30 + math.isqrt(n)
    quartile = excess[int(n / 4 + 0.5) - 1]
    largest = excess[-1]
    b = 1 - jnp.sqrt(points / (jnp.arange(1, points + 1) - 0.5))
    b = b / (3 * jnp.where(quartile > 0, quartile, largest)) + 1 / largest
    inner = jnp.log1p(-b[:, None] * excess)
    k = jnp.mean(inner, axis=1)
    log_likelihood = n * (jnp.log(-b / k) - k - 1)
    weight = jax.nn.softmax(log_likelihood)
    b = jnp.sum(b * weight)
    k = jnp.mean(jnp.log1p(-b * excess))
    scale = -k / b
    return (n * k + 5) / (n + 10), scale


def _quantile(level: Array, k: Array, scale: Array) -> Array:
    """Quantiles of a generalised Pareto distribution, that of the exponential one for k = 0."""
    small = jnp.abs(k) < 1e-6
    shape = jnp.where(small, 1.0, k)
    return scale * jnp.where(small, -jnp.log1p(-level), jnp.expm1(-shape * jnp.log1p(-level)) / shape)
