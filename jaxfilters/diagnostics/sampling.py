"""How many independent samples a weighted or a correlated sample is worth."""

from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtri
from jaxtyping import Array, Float

from jaxfilters.gaussian import checks
from jaxfilters.weights import effective_sample_size as effective_sample_size


def mcmc_effective_sample_size(chains: Float[Array, "c n"], *, rank_normalised: bool = True) -> Float[Array, ""]:
    """Number of independent draws that estimate a mean as well as the draws of Markov chains do.

    Chains are split in halves, replaced by normal scores of their ranks, and their correlations summed by Geyer's
    initial monotone sequence ("bulk" effective sample size: A. Vehtari et al., "Rank-normalization, folding, and
    localization: an improved R-hat", Bayesian Analysis 16, 2021, section 4). One quantity; use `jax.vmap` for several.

    Args:
        chains: Draws of one quantity, a chain a row, (c, n) with n at least 4.
        rank_normalised: Whether draws are replaced by normal scores, which heavy tails do not disturb.

    Returns:
        The number; at most c n log10(c n). NaN where a draw is NaN.

    Raises:
        ValueError: If `chains` is not (c, n) with n at least 4.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> draws = jax.random.normal(jax.random.key(0), (4, 500))
        >>> bool(1600 < jf.diagnostics.mcmc_effective_sample_size(draws) < 2400)
        True
    """
    return _draws(_split(chains), rank_normalised)


@partial(jax.jit, static_argnames="rank_normalised")
def _draws(halves: Float[Array, "c n"], rank_normalised: bool) -> Float[Array, ""]:
    x = _normal_scores(halves) if rank_normalised else halves
    count, length = x.shape
    deviations = x - jnp.mean(x, axis=1, keepdims=True)
    transformed = jnp.fft.rfft(deviations, n=2 * length, axis=1)
    covariance = jnp.fft.irfft(jnp.abs(transformed) ** 2, axis=1)[:, :length].astype(x.dtype) / length
    within = jnp.mean(covariance[:, 0]) * length / (length - 1)
    total = within * (length - 1) / length + jnp.var(jnp.mean(x, axis=1), ddof=1)
    rho = (1 - (within - jnp.mean(covariance, axis=0)) / total).at[0].set(1.0)
    # Sums of neighbours, positive and falling for a reversible chain; after the first that is not, noise.
    pairs = rho[: 2 * max((length - 3) // 2, 1)].reshape(-1, 2).sum(axis=1)
    positive = jnp.cumprod(pairs > 0)
    falling = jax.lax.cummin(jnp.where(positive, pairs, jnp.inf))
    # The first even correlation after the last pair improves antithetic chains.
    last = jnp.sum(positive)
    following = jnp.maximum(rho[jnp.minimum(2 * last, length - 1)], 0.0)
    time = -1 + 2 * jnp.sum(jnp.where(positive, falling, 0.0)) + following
    draws = count * length
    found = draws / jnp.maximum(time, 1 / jnp.log10(draws))
    return jnp.where(jnp.any(jnp.isnan(halves)), jnp.nan, jnp.where(total > 0, found, draws))


def r_hat(chains: Float[Array, "c n"]) -> Float[Array, ""]:
    """Potential scale reduction of Markov chains, near one where they have mixed: split, rank-normalised and folded.

    A. Vehtari et al., Bayesian Analysis 16, 2021, section 3; above 1.01 chains should not be used.

    Args:
        chains: Draws of one quantity, a chain a row, (c, n) with n at least 4.

    Returns:
        The larger one of the values for the draws and for their distances from the median.

    Raises:
        ValueError: If `chains` is not (c, n) with n at least 4.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> draws = jax.random.normal(jax.random.key(0), (4, 500))
        >>> bool(jf.diagnostics.r_hat(draws) < 1.01)
        True
    """
    return _mixed(_split(chains))


@jax.jit
def _mixed(halves: Float[Array, "c n"]) -> Float[Array, ""]:
    folded = jnp.abs(halves - jnp.median(halves))
    return jnp.maximum(_scale_reduction(_normal_scores(halves)), _scale_reduction(_normal_scores(folded)))


def _scale_reduction(x: Float[Array, "c n"]) -> Float[Array, ""]:
    length = x.shape[1]
    within = jnp.mean(jnp.var(x, axis=1, ddof=1))
    between = length * jnp.var(jnp.mean(x, axis=1), ddof=1)
    return jnp.sqrt((between / within + length - 1) / length)


def _split(chains: Array) -> Array:
    checks.floating("chains", chains)
    if chains.ndim != 2 or chains.shape[1] < 4:
        raise ValueError(f"chains must have the shape (c, n), n at least 4; got {chains.shape}.")
    half = chains.shape[1] // 2
    return jnp.concatenate([chains[:, :half], chains[:, -half:]])


def _normal_scores(x: Array) -> Array:
    """Normal quantiles of the ranks, ties in the middle (G. Blom, 1958)."""
    flat = x.reshape(-1)
    ordered = jnp.sort(flat)
    ranks = 0.5 * (jnp.searchsorted(ordered, flat, side="left") + jnp.searchsorted(ordered, flat, side="right") + 1)
    return ndtri((ranks - 3 / 8) / (flat.size + 1 / 4)).reshape(x.shape).astype(x.dtype)
