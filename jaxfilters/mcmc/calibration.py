"""Simulation-based calibration: whether a sampler draws from the posterior of a model."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters.mcmc import checks
from jaxfilters.particle.checks import check_callables
from jaxfilters.typing import AnyKey, SamplePrior


class Calibration(NamedTuple):
    """Ranks of true parameters among draws from their posteriors, and a test that they are uniform."""

    ranks: PyTree
    """Numbers of draws below the truth, leaves `(num_runs, ...)`, integers from 0 to the number of draws."""
    p_values: PyTree
    """Chi-square tests of uniform ranks, leaves `(...)`: the probability of a histogram at least as uneven, if the
    sampler is right."""


def calibrate(
    key: AnyKey,
    sample_prior: SamplePrior,
    simulate: Callable[[AnyKey, PyTree], PyTree],
    sample_posterior: Callable[[AnyKey, PyTree], PyTree],
    *,
    num_runs: int,
    num_bins: int,
) -> Calibration:
    """Simulation-based calibration: rank true parameters among posterior draws, over many simulated data sets.

    If the sampler is right, the rank of the truth among independent draws is uniform for every parameter (S. Talts, M.
    Betancourt, D. Simpson, A. Vehtari and A. Gelman, "Validating Bayesian inference algorithms with simulation-based
    calibration", 2018, theorem 1). Draws of a chain must be thinned until they hardly depend on each other. All runs
    are one compiled `vmap`.

    Args:
        key: Random key.
        sample_prior: `key -> theta`.
        simulate: `(key, theta) -> observations`.
        sample_posterior: `(key, observations) -> draws`, a tree like theta whose leaves have the draws as their first
            axis, (num_draws, ...).
        num_runs: Number of data sets.
        num_bins: Number of bins of the test; num_draws + 1 must be a multiple of it.

    Returns:
        The ranks, and the p-value of each parameter.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If a count is not an integer of at least 1 (2 for `num_bins`), the draws do not fit theta, or their
            number does not fit `num_bins`.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> def sample_posterior(key, y):  # of a standard normal mean, given one observation with unit noise
        ...     return 0.5 * y + jnp.sqrt(0.5) * jax.random.normal(key, (19,))
        >>> found = jf.mcmc.calibrate(
        ...     jax.random.key(0), jax.random.normal, lambda key, theta: theta + jax.random.normal(key),
        ...     sample_posterior, num_runs=200, num_bins=10)
        >>> found.ranks.shape, bool(found.p_values > 1e-3)
        ((200,), True)
    """
    check_callables(sample_prior=sample_prior, simulate=simulate, sample_posterior=sample_posterior)
    checks.check_count("num_runs", num_runs)
    checks.check_count("num_bins", num_bins, 2)

    def one(key: AnyKey) -> tuple[PyTree, PyTree]:
        prior_key, data_key, sampler_key, tie_key = jax.random.split(key, 4)
        theta = jax.tree.map(jnp.asarray, sample_prior(prior_key))
        draws = sample_posterior(sampler_key, simulate(data_key, theta))
        _check_draws(draws, theta, num_bins)
        ranks = jax.tree.map(lambda truth, leaf: _rank(tie_key, truth, leaf), theta, draws)
        return ranks, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[:1]), draws)

    ranks, draws = jax.jit(jax.vmap(one))(jax.random.split(key, num_runs))
    p_values = jax.tree.map(lambda leaf, of: _p_value(leaf, of.shape[1] + 1, num_bins), ranks, draws)
    return Calibration(ranks, p_values)


def _rank(key: AnyKey, truth: Array, draws: Array) -> Int[Array, "..."]:
    """Number of draws below the truth; the place of the truth among equal ones is uniform."""
    equal = jnp.sum(draws == truth, axis=0)
    among = jnp.floor(jax.random.uniform(key, jnp.shape(truth)) * (equal + 1)).astype(jnp.int32)
    # A NaN is not below anything: it would count as above, silently.
    return jnp.where(jnp.any(jnp.isnan(draws), axis=0), -1, jnp.sum(draws < truth, axis=0) + among)


def _p_value(ranks: Int[Array, "runs ..."], num_ranks: int, num_bins: int) -> Float[Array, "..."]:
    """Upper tail of the chi-square distribution; 0 where a draw was NaN."""
    bins = ranks * num_bins // num_ranks
    counts = jnp.sum(bins[..., None] == jnp.arange(num_bins), axis=0)
    expected = ranks.shape[0] / num_bins
    statistic = jnp.sum(jnp.square(counts - expected), axis=-1) / expected
    tail = jax.scipy.special.gammaincc((num_bins - 1) / 2, statistic / 2)
    return jnp.where(jnp.any(ranks < 0, axis=0), 0.0, tail)


def _check_draws(draws: PyTree, theta: PyTree, num_bins: int) -> None:
    structures: tuple[Any, Any] = jax.tree.structure(theta), jax.tree.structure(draws)
    if structures[0] != structures[1]:
        raise ValueError(f"sample_posterior must return a tree like theta, {structures[0]}; got {structures[1]}.")
    for (path, leaf), truth in zip(jax.tree_util.tree_leaves_with_path(draws), jax.tree.leaves(theta), strict=True):
        name = f"sample_posterior{jax.tree_util.keystr(path)}"
        if jnp.shape(leaf)[1:] != jnp.shape(truth) or jnp.ndim(leaf) == 0:
            raise ValueError(
                f"{name} must return the shape (num_draws, *{jnp.shape(truth)}), that of theta; got {jnp.shape(leaf)}."
            )
        if (leaf.shape[0] + 1) % num_bins:
            raise ValueError(
                f"{name} must return a number of draws to which adding 1 gives a multiple of num_bins = {num_bins}; "
                f"got {leaf.shape[0]}."
            )
