"""Diagnostics of truncations, and the distances to constraints in standard deviations."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints.directions import Direction, along
from jaxfilters.gaussian.constraints.linear import LinearConstraints, check_width


@pytree_dataclass
class CutInfo:
    """Diagnostics of a truncation by one inequality."""

    distances: Float[Array, "..."]
    """(2,), distances of the mean from the lower and from the upper bound, in standard deviations; negative outside."""
    log_mass: Float[Array, "..."]
    """Log of the probability that the inequality holds under the given belief; `-inf` where infeasible."""
    infeasible: Bool[Array, "..."]
    """Whether the value was certain and outside of the bounds; the belief was then left as it was."""


@pytree_dataclass
class TruncationInfo:
    """Diagnostics of a truncation by k constraints."""

    distances: Float[Array, "..."]
    """(k, 2), `constraint_distances` of the belief before truncation."""
    log_mass: Float[Array, "..."]
    """Log of the probability that all constraints hold, as the method estimates it; `-inf` where one is infeasible."""
    infeasible: Bool[Array, "..."]
    """(k,), rows that a certain value violates, or that the mean still violates after expectation propagation because
    they contradict other rows."""
    sweeps: Int[Array, "..."]
    """Number of sweeps over the rows."""
    converged: Bool[Array, "..."]
    """Whether the last sweep changed the belief by no more than the tolerance."""


def constraint_distances(belief: Gaussian | GaussianRoot, constraints: LinearConstraints) -> Float[Array, "k 2"]:
    """Distances of the mean from the lower and the upper bound of each row, in standard deviations; negative outside.

    `(normal^T mean - lower) / s` and `(upper - normal^T mean) / s` (N. Shimada et al., "Shape and pose estimation of an
    articulated object", 1997, equation 24), where s is the standard deviation of `normal^T x`. The distance from an
    infinite bound is infinite. Where the value is certain, distances are infinite, negative where a bound is violated.

    Args:
        belief: A `Gaussian` or `GaussianRoot` of n components.
        constraints: k rows on n components.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: The normals do not have one column for each component of the belief.

    Examples:
        A mean of 3 with a standard deviation of 2, which must not be negative.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0]], lower=0.0, upper=jnp.inf)
        >>> jf.constraints.constraint_distances(jf.Gaussian(jnp.array([3.0]), 4.0 * jnp.eye(1)), rows).tolist()
        [[1.5, inf]]
    """
    check_width(belief, constraints)
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    return jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)


def distances_along(
    direction: Direction, lower: Float[Array, ""] | float, upper: Float[Array, ""] | float
) -> Float[Array, " 2"]:
    """Distances (2,) of one row, from the marginal of the belief along its normal."""
    slack = jnp.stack([direction.mean - lower, upper - direction.mean])
    scaled = jnp.isfinite(slack) & ~direction.certain
    endless = jnp.where(slack >= -direction.rounding, jnp.inf, -jnp.inf)
    distances = jnp.where(scaled, slack, 0.0) / jnp.where(direction.certain, 1.0, direction.deviation)
    return jnp.where(scaled, distances, endless)
