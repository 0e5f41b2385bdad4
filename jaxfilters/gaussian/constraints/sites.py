"""The factors that stand for inequalities from one truncation to the next."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.constraints.linear import LinearConstraints


@pytree_dataclass
class Sites:
    """Factors `exp(log_scale + shift z - precision z^2 / 2)` of `z = normal^T x`, one for each of k rows."""

    precision: Float[Array, "..."]
    """(k,), at least 0."""
    shift: Float[Array, "..."]
    """(k,)."""
    log_scale: Float[Array, "..."]
    """(k,). Only the reported `log_mass` depends on it."""

    def only(self, rows: Bool[Array, " k"]) -> "Sites":
        """The sites of the chosen rows; factors of one for the others.

        To be given to the next truncation where only the chosen rows are about something that has not changed.
        """
        return jax.tree.map(lambda leaf: jnp.where(rows, leaf, 0.0), self)


def no_sites(constraints: LinearConstraints) -> Sites:
    """Factors of one: the sites of a belief that no row has been applied to."""
    ones = jnp.zeros_like(constraints.lower)
    return Sites(ones, ones, ones)


def standardized(sites: Sites, mean: Float[Array, " k"], unit: Float[Array, " k"]) -> Sites:
    """The same factors as functions of `(z - mean) / unit`."""
    shift = sites.shift - sites.precision * mean
    log_scale = sites.log_scale + mean * (sites.shift - 0.5 * sites.precision * mean)
    return Sites(sites.precision * unit * unit, shift * unit, log_scale)


def destandardized(sites: Sites, mean: Float[Array, " k"], unit: Float[Array, " k"]) -> Sites:
    """Factors of `(z - mean) / unit` as functions of z."""
    precision = sites.precision / (unit * unit)
    shift = sites.shift / unit
    log_scale = sites.log_scale - mean * (shift + 0.5 * precision * mean)
    return Sites(precision, shift + precision * mean, log_scale)
