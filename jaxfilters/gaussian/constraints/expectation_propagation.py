"""A Gaussian belief truncated by all inequalities together, by expectation propagation, with sites that persist.

Each row is approximated by a Gaussian factor of `normal^T x`, its site, chosen so that the belief keeps its mean and
variance along the normal when this one site is replaced by the row itself (T. Minka, "Expectation propagation for
approximate Bayesian inference", UAI 2001; J. Cunningham, P. Hennig, S. Lacoste-Julien, "Gaussian probabilities and
expectation propagation", arXiv:1111.6832, 2011). The result does not depend on the order of the rows.

A site that is passed to the next truncation, with the belief that contains it, is *replaced* there. An inequality on a
quantity that is constant in time therefore counts once, however often it is applied.

Rows are iterated in units in which each has a standard deviation of one, counted from an origin within its bounds, so
that intervals of 1e-4 prior standard deviations are accurate in single precision:
`docs/derivations/narrow_constraints.md`. The belief itself is never inverted: one change of rank one for each row
makes the result from the given belief.
"""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.gaussian.constraints.directions import Belief, Direction, along, compiled, image
from jaxfilters.gaussian.constraints.fixed_point import (
    Rows,
    Settings,
    fixed_point,
    marginal,
    times,
    truncated,
)
from jaxfilters.gaussian.constraints.info import TruncationInfo, distances_along
from jaxfilters.gaussian.constraints.linear import LinearConstraints, check_width
from jaxfilters.gaussian.constraints.sites import Sites, destandardized, initial_sites, standardized
from jaxfilters.math import linalg

_TOLERANCE = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}


def truncate(
    belief: Belief,
    constraints: LinearConstraints,
    sites: Sites | None = None,
    *,
    damping: Float[Array, ""] | float = 0.7,
    max_sweeps: Int[Array, ""] | int = 60,
    tolerance: Float[Array, ""] | float | None = None,
) -> tuple[Belief, Sites, TruncationInfo]:
    """Moments of a belief truncated to all rows, its sites, and diagnostics.

    A single row is exact. With float32 covariances, rows that are neither parallel to an axis nor wider than 3e-3 prior
    standard deviations lose accuracy when they are applied repeatedly; a `GaussianRoot` keeps it. Derivatives are those
    of the fixed point, by the implicit function theorem.

    Args:
        belief: The belief to truncate, a `Gaussian` or `GaussianRoot` of n components. It contains `sites` already.
        constraints: k rows on n components. A row whose value is certain has no effect, and is reported where it is
            violated.
        sites: The sites that an earlier truncation by the same rows returned, to be replaced; `None` for a belief to
            which no row has been applied.
        damping: Share of each change that is applied, in (0, 1].
        max_sweeps: Largest number of sweeps over the rows, at least 1.
        tolerance: The iteration stops when no mean, in standard deviations, and no log variance changes by more in a
            sweep; by default 1e-8 in float64 and 1e-5 in float32.

    Returns:
        The belief, its sites, and diagnostics. `log_mass` is the log of the expectation, under the given belief, of
        the rows divided by the given sites: without given sites, of the probability that all rows hold.

    Raises:
        TypeError: `belief` is not Gaussian.
        ValueError: The normals do not have one column for each component of the belief, or an option is out of range.
    """
    check_width(belief, constraints)
    _check_settings(damping, max_sweeps, tolerance)
    sites = initial_sites(constraints) if sites is None else sites
    tolerance = _TOLERANCE[belief.mean.dtype] if tolerance is None else tolerance
    return _truncate(belief, constraints, sites, Settings(damping, max_sweeps, tolerance))


@compiled
def _truncate(belief, constraints, given, settings):
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    distances = jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)
    uncertain = ~directions.certain
    unit = jnp.where(uncertain, directions.deviation, 1.0)
    normals = jnp.where(uncertain[:, None], constraints.normals / unit[:, None], 0.0)
    origin = _origin(directions, constraints)
    start = standardized(given, origin, unit)
    active = uncertain & ~_settled(directions, start)
    rows = Rows(*(_scaled(bound, origin, unit) for bound in (constraints.lower, constraints.upper)), active)
    centred = replace(belief, mean=jnp.zeros_like(belief.mean))
    offset = (directions.mean - origin) / unit
    values = replace(image(centred, normals), mean=offset)

    natural, mean, P, _, sweeps, change = fixed_point(values, rows, _natural(start), settings)
    shifted, log_volume = _multiplied(centred, normals, offset, natural - _natural(start))
    deviation = linalg.safe_sqrt(jnp.diagonal(P))
    log_scale, log_change = _log_scale(mean, deviation, offset, natural, start, rows)
    infeasible = jnp.where(uncertain, active & _outside(mean, deviation, rows), jnp.any(distances < 0, axis=-1))
    log_mass = jnp.where(jnp.any(infeasible), -jnp.inf, log_volume + jnp.sum(log_change))
    info = TruncationInfo(distances, log_mass, infeasible, sweeps, change <= settings.tolerance)
    new = destandardized(Sites(*natural.T, log_scale, origin), origin, unit)
    sites = jax.tree.map(lambda new, old: jnp.where(active, new, old), new, given)
    return replace(shifted, mean=belief.mean + shifted.mean), sites, info


def _origin(directions: Direction, constraints: LinearConstraints):
    """A point within each row near the mean: the middle of a narrow row, and in a wide one less than a deviation in."""
    # The result does not depend on the origin: there is nothing to differentiate.
    mean, deviation, lower, upper = jax.lax.stop_gradient(
        (directions.mean, directions.deviation, constraints.lower, constraints.upper)
    )
    beyond = jnp.maximum(jnp.maximum(lower - mean, mean - upper), 0.0)
    depth = deviation**2 / jnp.where(directions.certain, 1.0, deviation + beyond)
    margin = jnp.minimum(depth, 0.5 * (upper - lower))
    return jnp.clip(mean, lower + margin, upper - margin)


def _settled(directions: Direction, given: Sites):
    """Rows whose sites are kept, because all other information about their values is below the rounding errors.

    The share of the precision that does not come from the site is a difference of two numbers of size one; a share
    below the rounding error of the variance cannot change the site in a way that could be computed.
    """
    return (given.precision > 0.5) & (1 - given.precision < 4 * directions.noise)


def _multiplied(belief, normals, offset, natural):
    """The belief times one factor a row, normalised, and the log of the ratio of the volumes."""

    def step(belief, row):
        normal, offset, factor = row
        direction = along(belief, normal)
        return times(belief, direction._replace(mean=direction.mean + offset), factor)

    # Factors that add information go first, so that no belief in between is wider than the given one, or improper.
    order = jnp.argsort(-natural[:, 0])
    belief, log_volumes = jax.lax.scan(step, belief, (normals[order], offset[order], natural[order]))
    return belief, jnp.sum(log_volumes)


def _log_scale(mean, deviation, offset, natural, start: Sites, rows: Rows):
    """Log scales of the sites, with which they have the integrals of the rows, and their part of the log mass.

    Section 3 of the derivation: the large terms of the exponent and of the log scales cancel analytically.
    """
    deviation = jnp.where(rows.active & (deviation > 0), deviation, 1.0)
    own = truncated(marginal(mean, deviation, natural, rows)).log_mass - 0.5 * math.log(2 * math.pi)
    force, before = natural[:, 1] - natural[:, 0] * mean, start.shift - start.precision * mean
    log_scale = own - mean * (force + 0.5 * natural[:, 0] * mean)
    change = own - 0.5 * mean * (force + start.shift) + 0.5 * offset * (force - before) - start.log_scale
    return log_scale, jnp.where(rows.active, change, 0.0)


def _outside(mean, deviation, rows: Rows):
    """Rows that the mean violates, which is impossible at a fixed point."""
    violation = jnp.maximum(rows.lower - mean, mean - rows.upper)
    # A tenth of a deviation, and the rounding error of the belief.
    return violation > 0.1 * deviation + (len(mean) * jnp.finfo(mean.dtype).eps) ** 0.5


def _scaled(bound, origin, unit):
    # Bounds further away have no effect, and the fourth power of a bound must not overflow.
    limit = 1 / float(jnp.finfo(bound.dtype).eps)
    finite = jnp.isfinite(bound)
    return jnp.clip(jnp.where(finite, (jnp.where(finite, bound, origin) - origin) / unit, bound), -limit, limit)


def _natural(sites: Sites):
    return jnp.stack([sites.precision, sites.shift], axis=-1)


def _check_settings(damping, max_sweeps, tolerance):
    for name, value, valid, expected in (
        ("damping", damping, lambda x: 0 < x <= 1, "a number in (0, 1]"),
        ("max_sweeps", max_sweeps, lambda x: x >= 1, "at least 1"),
        ("tolerance", tolerance, lambda x: x is None or x >= 0, "a number of at least 0"),
    ):
        if not isinstance(value, jax.core.Tracer) and not valid(value):
            raise ValueError(f"{name}: expected {expected}; got {value!r}.")
