"""A Gaussian belief cut by all inequalities together, by expectation propagation, with sites that persist.

Each row is stood for by a Gaussian factor of `normal^T x`, its site, chosen so that the belief keeps its moments when
this one site is replaced by the row itself (T. Minka, "Expectation propagation for approximate Bayesian inference",
2001; J. Cunningham, P. Hennig, S. Lacoste-Julien, "Gaussian probabilities and expectation propagation", 2011). The
result does not depend on the order of the rows.

A site that is handed on with the belief that contains it is *replaced* the next time, so that an inequality about
something that does not change is counted once, however often it is applied.

Rows are iterated in units in which each has a standard deviation of one, counted from the mean. The belief itself is
never inverted: it is made from the one given, in one step of one rank for each row.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.gaussian.constraints.directions import Belief, along, compiled, image
from jaxfilters.gaussian.constraints.fixed_point import Patience, Rows, conditioned, fixed_point, tilted, times
from jaxfilters.gaussian.constraints.info import TruncationInfo, distances_along
from jaxfilters.gaussian.constraints.linear import LinearConstraints
from jaxfilters.gaussian.constraints.sites import Sites, destandardized, no_sites, standardized
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
    """Moments of the belief within all rows, the sites that made it so, and diagnostics.

    One row alone is met exactly. Derivatives are those of the fixed point, by the implicit function theorem.

    Args:
        belief: What is cut. It contains `sites` already.
        constraints: The rows. One whose value is certain is left alone, and reported where it is violated.
        sites: What an earlier truncation made of the same rows, to be replaced and not applied again; `None` for a
            belief that no row has been applied to.
        damping: Share of each change that is made, in (0, 1].
        max_sweeps: The rows are gone through at most this often.
        tolerance: Largest change in a sweep that is small enough, of means in standard deviations and of log
            variances; by default 1e-8 in float64 and 1e-5 in float32.

    Returns:
        The belief, its sites, and diagnostics. `log_mass` is the log of the mean, under the given belief, of the rows
        over the given sites: without given sites, of the share of the belief within all rows.
    """
    sites = no_sites(constraints) if sites is None else sites
    tolerance = _TOLERANCE[belief.mean.dtype] if tolerance is None else tolerance
    return _truncate(belief, constraints, sites, Patience(damping, max_sweeps, tolerance))


@compiled
def _truncate(belief, constraints, given, patience):
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    distances = jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)
    active = ~directions.certain
    unit = jnp.where(active, directions.deviation, 1.0)
    normals = jnp.where(active[:, None], constraints.normals / unit[:, None], 0.0)
    start = standardized(given, directions.mean, unit)
    rows = Rows(*_within_reach(-distances[:, 0], distances[:, 1]), active, _natural(start))
    centred = replace(belief, mean=jnp.zeros_like(belief.mean))
    values = image(centred, normals)

    natural, sweeps, change = fixed_point(values, rows, rows.given, patience)
    truncated, log_volume = _multiplied(centred, normals, natural - rows.given)
    # Of values that have become nearly certain the belief itself has lost the variance to rounding, not so the mean.
    mean = jnp.matmul(normals, truncated.mean, precision="highest")
    deviation, left = _deviation(values, natural, rows)
    log_scale, log_change = _log_scale(mean, deviation, left, natural, start, rows)
    outside = _outside(mean, deviation, rows)
    infeasible = jnp.where(active, outside, jnp.any(distances < 0, axis=-1))
    log_mass = jnp.where(jnp.any(infeasible), -jnp.inf, log_volume + jnp.sum(log_change))
    info = TruncationInfo(distances, log_mass, infeasible, sweeps, change <= patience.tolerance)
    result = destandardized(Sites(*natural.T, log_scale), directions.mean, unit)
    return replace(truncated, mean=belief.mean + truncated.mean), result, info


def _multiplied(belief, normals, natural):
    """The belief times one factor a row, normalised, and the log of how much narrower it has become."""

    def step(belief, row):
        normal, factor = row
        return times(belief, along(belief, normal), factor)

    # What adds information goes first: then no belief in between is less certain than the last one, or improper.
    order = jnp.argsort(-natural[:, 0])
    belief, log_volumes = jax.lax.scan(step, belief, (normals[order], natural[order]))
    return belief, jnp.sum(log_volumes)


def _deviation(values, natural, rows: Rows):
    """Standard deviations of the values with their sites, and the shares of their precisions without them."""
    _, P, remaining = conditioned(values, natural - rows.given)
    variance, precision = jnp.diagonal(P), natural[:, 0]
    left = jnp.diagonal(remaining) - variance * rows.given[:, 0]
    narrow = left < 0.5
    return linalg.safe_sqrt(jnp.where(narrow, (1 - left) / jnp.where(narrow, precision, 1.0), variance)), left


def _log_scale(mean, deviation, left, natural, start: Sites, rows: Rows):
    """Log scales of the sites, with which they have the integrals of the rows, and what they add to the log mass.

    The integral of the belief given, times the new sites over the old, is exp(half of the sum of the changed shifts
    times the new means), but for how narrow it has become. Its exponent and those of the scales are large and cancel;
    here they have been cancelled beforehand.
    """
    row = tilted(mean, deviation, left, natural, rows)
    force = natural[:, 1] - natural[:, 0] * mean
    own = row.cut.log_mass + 0.5 * (row.shift**2 / row.left - jnp.log(row.left))
    log_scale = own - mean * (force + 0.5 * natural[:, 0] * mean)
    change = own - 0.5 * mean * (force + start.shift) - start.log_scale
    return jnp.where(row.proper, log_scale, start.log_scale), jnp.where(row.proper, change, 0.0)


def _outside(mean, deviation, rows: Rows):
    """Rows that the mean violates, which it cannot where sites that demand themselves have been found."""
    violation = jnp.maximum(rows.lower - mean, mean - rows.upper)
    # A tenth of a deviation, and what a belief may be off by rounding.
    return violation > 0.1 * deviation + (len(mean) * jnp.finfo(mean.dtype).eps) ** 0.5


def _within_reach(*bounds):
    # Further out nothing is resolved, and squares of squares must not overflow.
    limit = 1 / float(jnp.finfo(bounds[0].dtype).eps)
    return [jnp.clip(bound, -limit, limit) for bound in bounds]


def _natural(sites: Sites):
    return jnp.stack([sites.precision, sites.shift], axis=-1)
