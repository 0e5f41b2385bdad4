"""Approximations of low rank of tensors of which some entries are missing, by expectation-maximisation.

Missing entries are replaced by what the approximation says of them, and the factors improved for the completed tensor,
in turn. The squared error over the observed entries never grows, and where it stops falling the approximation is one of
weighted least squares with weights 1 for the observed entries and 0 for the others (N. Srebro and T. Jaakkola,
"Weighted low-rank approximations", 2003; for tensors X. Geng et al., "Face image modeling by multilinear subspace
analysis with missing values", 2011).
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
    """An approximation of low rank of what was observed."""

    core: Float[Array, "..."]
    factors: Factors
    """(I_n, R_n) for each reduced mode."""
    history: Float[Array, " sweeps"]
    """Squared error over the observed entries after every sweep; the last value repeats after convergence."""
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
    """The approximation of given ranks of least squared error over the observed entries.

    Missing entries begin as the sum of the means of the observed entries along each reduced mode, less what these
    share. How well they are found depends on the ranks: every index of a reduced mode needs more observed numbers than
    its rank.

    Args:
        X: The tensor; missing entries may hold anything, NaN too.
        observed: Which entries count, of a shape that broadcasts to the tensor's: (1, S, A) for cells of two modes.
        ranks: Rank of each mode to reduce.
        max_sweeps: Most sweeps.
        tolerance: Relative fall of the observed error at which a sweep is the last; no less than rounding.

    Raises:
        ValueError: if an observed number is not finite, `observed` does not broadcast to the tensor, an index of a
            reduced mode has no observed entry, or the ranks are not those of a tensor (`check_ranks`).
    """
    check_ranks(X.shape, ranks)
    try:
        seen = jnp.broadcast_to(observed, X.shape)
    except ValueError:
        raise ValueError(f"observed must broadcast to {X.shape}, the tensor; got {observed.shape}.") from None
    _check_observed(X, seen, ranks)
    if max_sweeps < 1:
        raise ValueError(f"max_sweeps must be 1 or more; got {max_sweeps}.")
    return _complete(X, seen, tuple(sorted(ranks.items())), max_sweeps, tolerance)


def _check_observed(X, seen, ranks):
    if isinstance(X, jax.core.Tracer) or isinstance(seen, jax.core.Tracer):
        return
    check_finite("X where it is observed", jnp.where(seen, X, 0))
    for mode in ranks:
        others = tuple(n for n in range(X.ndim) if n != mode)
        empty = np.flatnonzero(~np.any(np.asarray(seen), axis=others))
        if len(empty):
            raise ValueError(f"observed must have an entry for each index of mode {mode}; {empty.tolist()} have none.")


@partial(jax.jit, static_argnums=(2, 3))
def _complete(X, seen, ranks, max_sweeps, tolerance):
    X = jnp.where(seen, X, 0.0)
    least = jnp.maximum(tolerance, 4 * float(jnp.finfo(X.dtype).eps))
    error_of = lambda approximation: jnp.sum(jnp.square(jnp.where(seen, X - approximation, 0.0)))
    filled = jnp.where(seen, X, _first_guess(X, seen, [mode for mode, _ in ranks]))
    start = hosvd(filled, dict(ranks))
    approximation = compose(start.core, start.factors)
    history = jnp.full(max_sweeps + 1, error_of(approximation))

    def improve(carry):
        factors, approximation, history, count, _ = carry
        filled = jnp.where(seen, X, approximation)
        factors = sweep(filled, factors)
        approximation = compose(project(filled, factors), factors)
        error = error_of(approximation)
        falls = history[count] - error > least * history[count]
        history = jnp.where(jnp.arange(max_sweeps + 1) > count, error, history)
        return factors, approximation, history, count + 1, falls

    underway = lambda carry: carry[4] & (carry[3] < max_sweeps)
    begun = (start.factors, approximation, history, jnp.zeros((), jnp.int32), jnp.ones((), bool))
    factors, approximation, history, *_ = jax.lax.while_loop(underway, improve, begun)
    filled = jnp.where(seen, X, approximation)
    return Completion(project(filled, factors), factors, history, filled)


def _first_guess(X, seen, modes):
    """Of every entry: the mean of all along the reduced modes, and how far each index lies from it on average."""
    mean = _mean(X, seen, tuple(modes))
    guess = mean
    for mode in modes:
        others = tuple(n for n in modes if n != mode)
        # What is missing elsewhere would shift the mean of a row: its cells are compared with their columns' means.
        column = _mean(X, seen, (mode,))
        guess = guess + _mean(X - column, seen, others) if others else guess
    return guess


def _mean(X, seen, axes):
    """Mean of the observed entries along axes, 0 where there is none."""
    count = jnp.sum(seen, axis=axes, keepdims=True)
    return jnp.sum(jnp.where(seen, X, 0.0), axis=axes, keepdims=True) / jnp.maximum(count, 1)
