"""Gaussian factors that stand for inequalities, carried from one truncation to the next."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.constraints.linear import LinearConstraints


@pytree_dataclass
class Sites:
    """Factors `exp(log_scale + shift d - precision d^2 / 2)` of `d = normal^T x - origin`, one for each of k rows.

    Measured from an origin within the bounds, the shift of a narrow row is of the order of one. Measured from zero, it
    would be the product of a large precision and a position, and its digits would be lost in single precision.
    """

    precision: Float[Array, "..."]
    """(k,), at least 0, in the inverse squared unit of `normal^T x`."""
    shift: Float[Array, "..."]
    """(k,), the derivative of the log factor at the origin."""
    log_scale: Float[Array, "..."]
    """(k,), the log factor at the origin. Only the reported `log_mass` depends on it."""
    origin: Float[Array, "..."]
    """(k,), in the unit of `normal^T x`."""

    def select(self, rows: Bool[Array, " k"]) -> "Sites":
        """Sites of the selected rows, and factors of one for the others.

        The next truncation takes the result where only the selected rows concern quantities that are constant in time.

        Args:
            rows: (k,), True for the rows whose sites are kept.
        """
        return jax.tree.map(lambda leaf: jnp.where(rows, leaf, 0.0), self)


def initial_sites(constraints: LinearConstraints) -> Sites:
    """Factors of one: the sites of a belief to which no row has been applied yet.

    Args:
        constraints: The k rows; only their number and type matter.

    Returns:
        Sites whose fields are all zeros, (k,).

    Examples:
        >>> import jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0, 0.0], [0.0, 1.0]], lower=0.0, upper=1.0)
        >>> jf.constraints.initial_sites(rows).precision.tolist()
        [0.0, 0.0]
    """
    zeros = jnp.zeros_like(constraints.lower)
    return Sites(zeros, zeros, zeros, zeros)


def standardized(sites: Sites, origin: Float[Array, " k"], unit: Float[Array, " k"]) -> Sites:
    """The same factors as functions of `(z - origin) / unit`, where `z = normal^T x`."""
    moved = origin - sites.origin
    shift = sites.shift - sites.precision * moved
    log_scale = sites.log_scale + moved * (sites.shift - 0.5 * sites.precision * moved)
    return Sites(sites.precision * unit * unit, shift * unit, log_scale, jnp.zeros_like(origin))


def destandardized(sites: Sites, origin: Float[Array, " k"], unit: Float[Array, " k"]) -> Sites:
    """Factors of `(z - origin) / unit` as functions of `z - origin`."""
    return Sites(sites.precision / (unit * unit), sites.shift / unit, sites.log_scale, origin)
