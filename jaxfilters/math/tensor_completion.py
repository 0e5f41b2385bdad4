"""Approximations of low multilinear rank of tensors with missing entries, by expectation-maximisation.

Alternately, missing entries are replaced by those of the approximation, and the factors are improved for the completed
tensor. The squared error over the observed entries never increases, and the limit is a stationary point of weighted
least squares with weights 1 for observed and 0 for missing entries (N. Srebro and T. Jaakkola, "Weighted low-rank
approximations", ICML 2003; for tensors X. Geng, K. Smith-Miles, Z.-H. Zhou and L. Wang, "Face image modeling by
multilinear subspace analysis with missing values", IEEE Trans. Systems, Man, and Cybernetics B 41(3), 2011).
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.math.multilinear import Factors, check_finite, check_ranks, compose, hosvd, project, sweep


class Completion(NamedTuple):
    """An approximation of low multilinear rank of the observed entries."""

    core: Float[Array, "..."]
    """The core tensor."""
    factors: Factors
    """(I_n, R_n) for each reduced mode."""
    history: Float[Array, " sweeps"]
    """Squared error over the observed entries after every sweep; after convergence the last value repeats."""
    filled: Float[Array, "..."]
    """The tensor with its missing entries replaced by the approximation."""


def complete(
    X: Float[Array, "..."],
    observed: Bool[Array, "..."],
    ranks: Mapping[int, int],
    *,
    max_sweeps: int = 2000,
    tolerance: float = 1e-9,
) -> Completion:
    """The approximation of given ranks with least squared error over the observed entries.

    Missing entries are initialised by an additive model of the means along the reduced modes. Every index of a reduced
    mode needs more observed numbers than its rank.

    Args:
        X: The tensor; missing entries may have any value, including NaN.
        observed: Whether each entry is observed, with a shape that broadcasts to that of the tensor.
        ranks: Rank of each mode to reduce.
        max_sweeps: Upper bound on the number of sweeps.
        tolerance: Relative decrease of the error below which the iteration ends; at least rounding error.

    Raises:
        ValueError: If an observed number is not finite, `observed` does not broadcast to the tensor, an index of a
            reduced mode has no observed entry, or the ranks are not those of a tensor (`check_ranks`).

    Examples:
        The missing entry of a matrix of rank one follows from the others.

        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear, tensor_completion
        >>> X = jnp.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [3.0, 6.0, jnp.nan]])
        >>> completed = tensor_completion.complete(X, jnp.isfinite(X), {0: 1})
        >>> print(multilinear.compose(completed.core, completed.factors)[2].round(2))
        [3. 6. 9.]
    """
    check_ranks(X.shape, ranks)
    try:
        observed = jnp.broadcast_to(observed, X.shape)
    except ValueError:
        raise ValueError(f"observed must broadcast to {X.shape}, the tensor; got {observed.shape}.") from None
    _check_observed(X, observed, ranks)
    if max_sweeps < 1:
        raise ValueError(f"max_sweeps must be 1 or more; got {max_sweeps}.")
    return _complete(X, observed, tuple(sorted(ranks.items())), max_sweeps, tolerance)


def _check_observed(X, observed, ranks):
    if isinstance(X, jax.core.Tracer) or isinstance(observed, jax.core.Tracer):
        return
    check_finite("X where it is observed", jnp.where(observed, X, 0))
    for mode in ranks:
        others = tuple(n for n in range(X.ndim) if n != mode)
        empty = np.flatnonzero(~np.any(np.asarray(observed), axis=others))
        if len(empty):
            raise ValueError(f"observed must have an entry for each index of mode {mode}; {empty.tolist()} have none.")


@partial(jax.jit, static_argnums=(2, 3))
def _complete(X, observed, ranks, max_sweeps, tolerance):
    X = jnp.where(observed, X, 0.0)
    least = jnp.maximum(tolerance, 4 * float(jnp.finfo(X.dtype).eps))
    error_of = lambda approximation: jnp.sum(jnp.square(jnp.where(observed, X - approximation, 0.0)))
    filled = jnp.where(observed, X, _additive_model(X, observed, [mode for mode, _ in ranks]))
    start = hosvd(filled, dict(ranks))
    approximation = compose(start.core, start.factors)
    history = jnp.full(max_sweeps + 1, error_of(approximation))

    def improve(carry):
        factors, approximation, history, count, _ = carry
        filled = jnp.where(observed, X, approximation)
        factors = sweep(filled, factors)
        approximation = compose(project(filled, factors), factors)
        error = error_of(approximation)
        decreases = history[count] - error > least * history[count]
        history = jnp.where(jnp.arange(max_sweeps + 1) > count, error, history)
        return factors, approximation, history, count + 1, decreases

    unfinished = lambda carry: carry[4] & (carry[3] < max_sweeps)
    initial = (start.factors, approximation, history, jnp.zeros((), jnp.int32), jnp.ones((), bool))
    factors, approximation, history, *_ = jax.lax.while_loop(unfinished, improve, initial)
    filled = jnp.where(observed, X, approximation)
    return Completion(project(filled, factors), factors, history, filled)


def _additive_model(X, observed, modes):
    """The mean over the reduced modes plus the mean deviation of each of their indices."""
    mean = _mean(X, observed, tuple(modes))
    estimate = mean
    for mode in modes:
        others = tuple(n for n in modes if n != mode)
        # The cells of a row are compared with the means of their columns, because missing cells would bias its own
        # mean.
        column = _mean(X, observed, (mode,))
        estimate = estimate + _mean(X - column, observed, others) if others else estimate
    return estimate


def _mean(X, observed, axes):
    """The mean of the observed entries along axes; 0 where there is none."""
    count = jnp.sum(observed, axis=axes, keepdims=True)
    return jnp.sum(jnp.where(observed, X, 0.0), axis=axes, keepdims=True) / jnp.maximum(count, 1)
