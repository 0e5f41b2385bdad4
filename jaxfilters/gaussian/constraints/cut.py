"""A Gaussian belief cut by inequalities one at a time: one half-space, one interval, or a list of them in order.

Each cut matches the mean and the covariance of the belief that is left, exactly. After several cuts in a row the
result depends on their order, because the belief in between is taken to be Gaussian again; `expectation_propagation`
does not have that fault.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.gaussian.constraints import moments
from jaxfilters.gaussian.constraints.directions import Belief, Direction, along, compiled, reshape
from jaxfilters.gaussian.constraints.info import CutInfo, TruncationInfo, constraint_distances, distances_along
from jaxfilters.gaussian.constraints.linear import LinearConstraints


def halfspace(
    belief: Belief,
    normal: Float[Array, " n"],
    upper: Float[Array, ""] | float,
    *,
    skip: Float[Array, ""] | float = jnp.inf,
) -> tuple[Belief, CutInfo]:
    """Moments of the belief in `normal^T x <= upper`, and diagnostics.

    With the bound c standard deviations s away, and the moments of a standard normal variable below c, the mean moves
    by `mean P normal / s` and the covariance by `(variance - 1) P normal normal^T P / s^2` (the closed form of
    N. Shimada et al., "Shape and pose estimation of an articulated object", 1997, equations 21 to 29). Nothing is
    done where c exceeds `skip`.
    """
    direction = along(belief, normal)
    distances = distances_along(direction, -jnp.inf, upper)
    # Without a bound a cut does nothing.
    c = jnp.where(distances[1] > skip, jnp.inf, distances[1])
    return _apply(belief, direction, distances, moments.one_sided(c))


def interval(
    belief: Belief, normal: Float[Array, " n"], lower: Float[Array, ""] | float, upper: Float[Array, ""] | float
) -> tuple[Belief, CutInfo]:
    """Moments of the belief in `lower <= normal^T x <= upper`, and diagnostics. Bounds may be infinite."""
    direction = along(belief, normal)
    distances = distances_along(direction, lower, upper)
    return _apply(belief, direction, distances, moments.interval(-distances[0], distances[1]))


@compiled
def sequential_halfspaces(
    belief: Belief, constraints: LinearConstraints, *, skip: Float[Array, ""] | float = jnp.inf
) -> tuple[Belief, TruncationInfo]:
    """The belief cut by one half-space after the other: of each row the upper bound, then the lower.

    As in N. Shimada et al., "Shape and pose estimation of an articulated object", 1997, sections 4 and 5: with both
    bounds of a row apart, and those further than `skip` standard deviations left out.
    """

    def cut(belief, row):
        normal, lower, upper = row
        belief, above = halfspace(belief, normal, upper, skip=skip)
        belief, below = halfspace(belief, -normal, -lower, skip=skip)
        return belief, (above.log_mass + below.log_mass, above.infeasible | below.infeasible)

    return _in_order(cut, belief, constraints)


@compiled
def sequential_intervals(belief: Belief, constraints: LinearConstraints) -> tuple[Belief, TruncationInfo]:
    """The belief cut by one interval after the other, in the order of the rows."""

    def cut(belief, row):
        belief, info = interval(belief, *row)
        return belief, (info.log_mass, info.infeasible)

    return _in_order(cut, belief, constraints)


def _in_order(cut, belief, constraints):
    rows = constraints.normals, constraints.lower, constraints.upper
    truncated, (log_masses, infeasible) = jax.lax.scan(cut, belief, rows)
    distances = constraint_distances(belief, constraints)
    info = TruncationInfo(distances, jnp.sum(log_masses), infeasible, jnp.int32(1), jnp.bool_(True))
    return truncated, info


def _apply(belief: Belief, direction: Direction, distances: Array, cut: moments.Moments) -> tuple[Belief, CutInfo]:
    certain = direction.certain
    infeasible = certain & jnp.any(distances < 0)
    shift = jnp.where(certain, 0.0, cut.mean)
    ratio = jnp.where(certain, 1.0, cut.variance)
    log_mass = jnp.where(certain, jnp.where(infeasible, -jnp.inf, 0.0), cut.log_mass)
    return reshape(belief, direction, shift, ratio), CutInfo(distances, log_mass, infeasible)
