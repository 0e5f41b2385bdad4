"""A Gaussian belief truncated by inequalities one at a time: one half-space, one interval, or a list of them in order.

Each truncation has the exact mean and covariance of the truncated belief. After several truncations in a row the
result depends on their order, because each intermediate belief is approximated by a Gaussian; the result of
`expectation_propagation` does not.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints import moments
from jaxfilters.gaussian.constraints.directions import Belief, Direction, along, compiled, reshape
from jaxfilters.gaussian.constraints.info import CutInfo, TruncationInfo, constraint_distances, distances_along
from jaxfilters.gaussian.constraints.linear import LinearConstraints, check_width


def halfspace(
    belief: Belief,
    normal: Float[Array, " n"],
    upper: Float[Array, ""] | float,
    *,
    skip: Float[Array, ""] | float = jnp.inf,
) -> tuple[Belief, CutInfo]:
    """Moments of a belief truncated to `normal^T x <= upper`, and diagnostics.

    Let s be the standard deviation of `normal^T x` and c the distance of the bound from its mean, divided by s. With
    the moments of a standard normal variable below c, the mean changes by `mean P normal / s` and the covariance by
    `(variance - 1) P normal normal^T P / s^2` (a closed form of N. Shimada et al., "Shape and pose estimation of an
    articulated object", 1997, equations 21 to 29).

    Args:
        belief: The belief to truncate, a `Gaussian` or `GaussianRoot` of n components.
        normal: (n,).
        upper: The bound; may be `inf`.
        skip: The belief is returned as it is where c exceeds this number.

    Returns:
        The truncated belief, and its `CutInfo`.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: `normal` does not have one number for each component of the belief.

    Examples:
        The lower half of a standard normal variable has the mean -sqrt(2 / pi).

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> from jaxfilters.gaussian.constraints import cut
        >>> belief = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
        >>> truncated, info = cut.halfspace(belief, jnp.array([1.0, 0.0]), 0.0)
        >>> round(float(truncated.mean[0]), 3)
        -0.798
    """
    _check_normal(belief, normal)
    direction = along(belief, normal)
    distances = distances_along(direction, -jnp.inf, upper)
    # An infinite bound has no effect.
    c = jnp.where(distances[1] > skip, jnp.inf, distances[1])
    return _apply(belief, direction, distances, moments.one_sided(c))


def interval(
    belief: Belief, normal: Float[Array, " n"], lower: Float[Array, ""] | float, upper: Float[Array, ""] | float
) -> tuple[Belief, CutInfo]:
    """Moments of a belief truncated to `lower <= normal^T x <= upper`, and diagnostics.

    Args:
        belief: The belief to truncate, a `Gaussian` or `GaussianRoot` of n components.
        normal: (n,).
        lower: Lower bound; may be `-inf`.
        upper: Upper bound, at least `lower`; may be `inf`.

    Returns:
        The truncated belief, and its `CutInfo`.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: `normal` does not have one number for each component of the belief, or `lower` exceeds `upper`
            where both are known.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> from jaxfilters.gaussian.constraints import cut
        >>> belief = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> truncated, info = cut.interval(belief, jnp.ones(1), -1.0, 1.0)
        >>> round(float(truncated.covariance[0, 0]), 3)
        0.291
    """
    _check_normal(belief, normal)
    if not isinstance(lower, jax.core.Tracer) and not isinstance(upper, jax.core.Tracer) and not lower <= upper:
        raise ValueError(f"lower, upper: expected lower <= upper; got {lower} and {upper}.")
    direction = along(belief, normal)
    distances = distances_along(direction, lower, upper)
    return _apply(belief, direction, distances, moments.interval(-distances[0], distances[1]))


@compiled
def sequential_halfspaces(
    belief: Belief, constraints: LinearConstraints, *, skip: Float[Array, ""] | float = jnp.inf
) -> tuple[Belief, TruncationInfo]:
    """Belief truncated by one half-space after the other: for each row by the upper bound, then by the lower.

    The method of N. Shimada et al., "Shape and pose estimation of an articulated object", 1997, sections 4 and 5.

    Args:
        belief: The belief to truncate, a `Gaussian` or `GaussianRoot` of n components.
        constraints: k rows on n components.
        skip: Bounds that are further from the mean than this number of standard deviations are not applied.

    Returns:
        The truncated belief, and its `TruncationInfo`.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: The normals do not have one column for each component of the belief.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> from jaxfilters.gaussian.constraints import cut
        >>> belief = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
        >>> rows = jf.constraints.linear_constraints(jnp.eye(2), -jnp.inf, jnp.zeros(2))
        >>> truncated, info = cut.sequential_halfspaces(belief, rows)
        >>> [round(float(number), 3) for number in truncated.mean]
        [-0.798, -0.798]
    """
    check_width(belief, constraints)

    def cut(belief, row):
        normal, lower, upper = row
        belief, above = halfspace(belief, normal, upper, skip=skip)
        belief, below = halfspace(belief, -normal, -lower, skip=skip)
        return belief, (above.log_mass + below.log_mass, above.infeasible | below.infeasible)

    return _in_order(cut, belief, constraints)


@compiled
def sequential_intervals(belief: Belief, constraints: LinearConstraints) -> tuple[Belief, TruncationInfo]:
    """Belief truncated by one interval after the other, in the order of the rows.

    Args:
        belief: The belief to truncate, a `Gaussian` or `GaussianRoot` of n components.
        constraints: k rows on n components.

    Returns:
        The truncated belief, and its `TruncationInfo`.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: The normals do not have one column for each component of the belief.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> from jaxfilters.gaussian.constraints import cut
        >>> belief = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
        >>> rows = jf.constraints.linear_constraints(jnp.eye(2), -jnp.ones(2), jnp.ones(2))
        >>> truncated, info = cut.sequential_intervals(belief, rows)
        >>> [round(float(number), 3) for number in jnp.diagonal(truncated.covariance)]
        [0.291, 0.291]
    """
    check_width(belief, constraints)

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


def _check_normal(belief, normal):
    if not isinstance(belief, Gaussian | GaussianRoot):
        raise TypeError(f"belief: expected a Gaussian or a GaussianRoot; got {type(belief).__name__}.")
    if jnp.shape(normal) != jnp.shape(belief.mean):
        raise ValueError(f"normal: expected shape {jnp.shape(belief.mean)}; got {jnp.shape(normal)}.")
