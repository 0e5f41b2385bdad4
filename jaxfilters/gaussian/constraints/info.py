"""What truncation reports, and the distances to constraints in standard deviations."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints.directions import Direction, along
from jaxfilters.gaussian.constraints.linear import LinearConstraints


@pytree_dataclass
class CutInfo:
    """Diagnostics of one cut."""

    distances: Float[Array, "..."]
    """(2,), from the mean inwards from the lower and from the upper bound, in standard deviations; negative outside."""
    log_mass: Float[Array, "..."]
    """Log of the share of the belief that lay within the bounds; `-inf` where infeasible."""
    infeasible: Bool[Array, "..."]
    """Whether the value was certain, and outside; the belief was then left as it was."""


@pytree_dataclass
class TruncationInfo:
    """Diagnostics of a truncation by k constraints."""

    distances: Float[Array, "..."]
    """(k, 2), `constraint_distances` of the belief before truncation."""
    log_mass: Float[Array, "..."]
    """Log of the share of the belief that satisfies all constraints, as the method estimates it; `-inf` where one of
    them is infeasible."""
    infeasible: Bool[Array, "..."]
    """(k,), rows that contradict what is certain, or that expectation propagation could not meet together with the
    others."""
    sweeps: Int[Array, "..."]
    """How often the rows were gone through."""
    converged: Bool[Array, "..."]
    """Whether the last sweep changed less than was tolerated."""


def constraint_distances(belief: Gaussian | GaussianRoot, constraints: LinearConstraints) -> Float[Array, "k 2"]:
    """How far the mean is inside the lower and the upper bound of each row, in standard deviations; negative outside.

    `(normal^T mean - lower) / s` and `(upper - normal^T mean) / s` (N. Shimada et al., "Shape and pose estimation of an
    articulated object", 1997, equation 24). A bound that is not there is infinitely far; where the value is certain,
    any bound is, inside or outside.
    """
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    return jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)


def distances_along(
    direction: Direction, lower: Float[Array, ""] | float, upper: Float[Array, ""] | float
) -> Float[Array, " 2"]:
    """The distances of one row, from the belief along its normal."""
    slack = jnp.stack([direction.mean - lower, upper - direction.mean])
    scaled = jnp.isfinite(slack) & ~direction.certain
    endless = jnp.where(slack >= -direction.rounding, jnp.inf, -jnp.inf)
    distances = jnp.where(scaled, slack, 0.0) / jnp.where(direction.certain, 1.0, direction.deviation)
    return jnp.where(scaled, distances, endless)
