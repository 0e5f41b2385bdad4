"""Diagnostics of a Kalman update, and the components of an observation that it uses."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.materialize import materialized
from jaxfilters.gaussian.arithmetic import factor


@pytree_dataclass
class KalmanInfo:
    """Diagnostics of one update. Nothing in it, nor in the belief beside it, is NaN unless the belief before was."""

    innovation: Float[Array, "..."]
    """`y - y_hat`, (m,); 0 for components left out: masked, invalid, or certain beforehand."""
    innovation_root: Float[Array, "..."]
    """Lower root L of the covariance `L L^T` of the innovation, (m, m); zeros for components left out."""
    log_evidence: Float[Array, "..."]
    """Marginal log-likelihood of the observation, log p(y_t | y_1:t-1), in nats, over the components used. `-inf` where
    a prediction or a noise is not finite, or the innovation covariance is not positive semidefinite."""
    nis: Float[Array, "..."]
    """Normalised innovation squared: chi-squared with `rank` degrees of freedom."""
    rank: Int[Array, "..."]
    """Number of components used: the rank of the innovation covariance over those that were read."""
    deficiency: Int[Array, "..."]
    """Number of components that were read but are left out, because they were certain beforehand or follow from the
    components before them, to rounding: there the innovation covariance loses rank."""
    num_invalid: Int[Array, "..."]
    """Number of components, not masked, that are left out because they, their prediction or noise are not finite."""


class Rows(NamedTuple):
    """Which rows of a measurement count, and what they say."""

    deviation: Float[Array, " m"]
    """`y - y_hat`, 0 in rows that do not count."""
    observed: Bool[Array, " m"]
    """Neither masked nor invalid."""
    num_invalid: Int[Array, ""]
    impossible: Bool[Array, ""]
    """Whether a prediction or a noise, not the reading itself, is what is invalid."""


def rows(
    mean: Float[Array, " n"],
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    noise: Float[Array, "m _"],
    y_hat: Float[Array, " m"] | None,
    mask: Bool[Array, " m"] | None,
) -> Rows:
    """What of `y = y_hat + H (x - mean) + noise` can be used; `y_hat` is `H mean` unless given.

    `noise` is finite in rows that are not masked, or says that they are invalid; a mean that is not finite makes all of
    them so.
    """
    read = jnp.isfinite(y) if mask is None else jnp.isfinite(y) & mask
    y_hat = factor.apply(H, mean) if y_hat is None else y_hat
    # Products show NaN and infinity, in a fraction of the time that testing all elements takes.
    ones = jnp.where(jnp.isfinite(mean), jnp.ones_like(mean), jnp.nan)
    shown = factor.apply(H, ones) + factor.apply(noise, jnp.ones(noise.shape[1], noise.dtype)) + y_hat
    is_read = materialized(read & jnp.isfinite(shown))
    return used_rows(jnp.where(is_read, y - y_hat, 0.0), read, is_read, mask)


def used_rows(
    deviation: Float[Array, " m"],
    read: Bool[Array, " m"],
    usable: Bool[Array, " m"],
    mask: Bool[Array, " m"] | None,
) -> Rows:
    """The rows of a measurement, of which `read` are finite and not masked, and `usable` can be used."""
    invalid = ~usable if mask is None else mask & ~usable
    return Rows(deviation, usable, jnp.sum(invalid, dtype=jnp.int32), jnp.any(read & ~usable))


def observed(mask: Bool[Array, " m"] | None, rows: Float[Array, "m *k"] | None) -> Any:
    """The rows, zero where masked; all of them without a mask, none of none."""
    if mask is None or rows is None:
        return rows
    return jnp.where(mask.reshape(mask.shape + (1,) * (rows.ndim - 1)), rows, 0.0)


class Evidence(NamedTuple):
    """What the whitened innovation says."""

    log_density: Float[Array, ""]
    nis: Float[Array, ""]


def evidence(diagonal: Float[Array, " m"], counts: Bool[Array, " m"], whitened: Float[Array, " m"]) -> Evidence:
    """Log density and squared length of an innovation over the components that count.

    `diagonal` is that of the innovation's root, 1 for the other components; their part of `whitened` is 0.
    """
    # One sum, which is one loop: separate ones would be compiled for the scale, the rank and the length.
    terms = 0.5 * whitened * whitened + jnp.where(counts, jnp.log(diagonal) + 0.5 * math.log(2 * math.pi), 0.0)
    return Evidence(-jnp.sum(terms), jnp.sum(whitened * whitened))


def report(usable: Rows, root: Float[Array, "m m"], found: Evidence) -> KalmanInfo:
    """Diagnostics of an update, given the lower root of the innovation covariance, zero where nothing counts."""
    counts = factor.diagonal(root) > 0
    rank = jnp.sum(counts, dtype=jnp.int32)
    return KalmanInfo(
        innovation=observed(counts, usable.deviation),
        innovation_root=root,
        log_evidence=jnp.where(usable.impossible, -jnp.inf, found.log_density),
        nis=found.nis,
        rank=rank,
        deficiency=jnp.sum(usable.observed, dtype=jnp.int32) - rank,
        num_invalid=usable.num_invalid,
    )
