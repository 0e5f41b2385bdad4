"""A Gaussian belief cut by all inequalities together, by expectation propagation, with sites that persist.

Each row is stood for by a Gaussian factor of `normal^T x`, its site, chosen so that the belief keeps its moments when
this one site is replaced by the row itself (T. Minka, "Expectation propagation for approximate Bayesian inference",
2001; J. Cunningham, P. Hennig, S. Lacoste-Julien, "Gaussian probabilities and expectation propagation", 2011). The
result does not depend on the order of the rows.

A site that is handed on with the belief that contains it is *replaced* the next time, so that an inequality about
something that does not change is counted once, however often it is applied.

Rows are iterated in units in which each has a standard deviation of one, counted from the mean. The belief is changed
by one rank at a time and never inverted; at the end it is made from the one given, in one step a row, so that rounding
does not pile up.
"""

from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters import linalg
from jaxfilters.gaussian import GaussianRoot
from jaxfilters.truncation import moments
from jaxfilters.truncation.constraints import LinearConstraints
from jaxfilters.truncation.directions import Belief, Direction, along, compiled, image, reshape, resolution
from jaxfilters.truncation.info import TruncationInfo, distances_along
from jaxfilters.truncation.sites import Sites, destandardized, no_sites, standardized

_TOLERANCE = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}


class _Rows(NamedTuple):
    """Inequalities about values that are N(0, 1) under the belief given; k each."""

    lower: Array
    upper: Array
    active: Array
    """False where the value is certain."""
    floor: Array
    """Standard deviation below which a value is no longer known from rounding."""


@compiled
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
    given = no_sites(constraints) if sites is None else sites
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    distances = jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)
    active = ~directions.certain
    unit = jnp.where(active, directions.deviation, 1.0)
    normals = jnp.where(active[:, None], constraints.normals / unit[:, None], 0.0)
    rows = _Rows(*_within_reach(-distances[:, 0], distances[:, 1]), active, jnp.full_like(unit, resolution(belief)))
    start = standardized(given, directions.mean, unit)
    centred = replace(belief, mean=jnp.zeros_like(belief.mean))

    tolerance = _TOLERANCE[belief.mean.dtype] if tolerance is None else tolerance
    iterate = partial(_iterate, damping=damping, max_sweeps=max_sweeps, tolerance=tolerance)
    natural, (sweeps, change) = _fixed_point(image(centred, normals), rows, _natural(start), iterate)

    truncated, log_integral = _multiplied(centred, normals, natural - _natural(start))
    marginals = jax.vmap(along, (None, 0))(truncated, normals)
    log_scale = _log_scale(marginals.mean, marginals.deviation, natural, rows, start.log_scale)
    infeasible = jnp.where(active, _outside(marginals, rows), jnp.any(distances < 0, axis=-1))
    log_mass = log_integral + jnp.sum(log_scale - start.log_scale)
    log_mass = jnp.where(jnp.any(infeasible & ~active), -jnp.inf, log_mass)
    info = TruncationInfo(distances, log_mass, infeasible, sweeps.astype(jnp.int32), change <= tolerance)
    result = destandardized(Sites(*natural.T, log_scale), directions.mean, unit)
    return replace(truncated, mean=belief.mean + truncated.mean), result, info


def _fixed_point(belief, rows, start, iterate):
    """Natural parameters (k, 2) of the sites, where the belief in the values (k,) contains `start`; diagnostics."""

    def lacking(natural):
        precision, shift = (natural - start).T
        identity = jnp.eye(len(start), dtype=start.dtype)
        P = jnp.linalg.solve(identity + prior * precision, prior)
        return _demanded(P @ shift, linalg.safe_sqrt(jnp.diagonal(P)), natural, rows) - natural

    def solve_linear(linear, y):
        unit_vectors = jnp.eye(y.size, dtype=y.dtype).reshape(y.size, *y.shape)
        columns = jax.vmap(linear)(unit_vectors).reshape(y.size, y.size).T
        return jnp.linalg.solve(columns, y.ravel()).reshape(y.shape)

    prior = linalg.matmul(belief.root, belief.root.T) if isinstance(belief, GaussianRoot) else belief.covariance
    solve = lambda _, start: iterate(belief, rows, start)
    return jax.lax.custom_root(lacking, start, solve, solve_linear, has_aux=True)


def _iterate(belief, rows, natural, *, damping, max_sweeps, tolerance):
    """Natural parameters after enough sweeps; how many it took, and the largest change in the last one."""
    identity = jnp.eye(len(natural), dtype=natural.dtype)

    def visit(k, carry):
        belief, natural, largest = carry
        direction = along(belief, identity[k])
        row = jax.tree.map(itemgetter(k), rows)
        step = _demanded(direction.mean, direction.deviation, natural[k], row) - natural[k]
        largest = jnp.maximum(largest, _change(direction, step))
        belief, _ = _times(belief, direction, damping * step)
        return belief, natural.at[k].add(damping * step), largest

    def sweep(carry):
        belief, natural, count, _ = carry
        unchanged = jnp.zeros((), natural.dtype)
        belief, natural, largest = jax.lax.fori_loop(0, len(natural), visit, (belief, natural, unchanged))
        return belief, natural, count + 1, largest

    unfinished = lambda carry: (carry[3] > tolerance) & (carry[2] < max_sweeps)
    start = belief, natural, jnp.int32(0), jnp.full((), jnp.inf, natural.dtype)
    _, natural, count, largest = jax.lax.while_loop(unfinished, sweep, start)
    return natural, jnp.stack([count.astype(largest.dtype), largest])


def _change(direction: Direction, step):
    """Larger one of what a step means to the mean, in standard deviations, and to the log variance; 0 if rounding."""
    mean, deviation = direction.mean, jnp.where(direction.certain, 1.0, direction.deviation)
    moved = jnp.maximum(abs(step[1] - step[0] * mean) * deviation, abs(step[0]) * deviation**2)
    rounding = 2 * jnp.finfo(step.dtype).eps * (abs(mean) + 1 / deviation) / deviation
    return jnp.where(direction.certain | (moved < rounding), 0.0, moved)


def _multiplied(belief, normals, natural):
    """The belief times one factor a row, normalised, and the log of what it was normalised by."""

    def step(belief, row):
        normal, factor = row
        return _times(belief, along(belief, normal), factor)

    # What adds information goes first: then no belief in between is less certain than the last one, or improper.
    order = jnp.argsort(-natural[:, 0])
    belief, log_integrals = jax.lax.scan(step, belief, (normals[order], natural[order]))
    return belief, jnp.sum(log_integrals)


def _times(belief, direction: Direction, natural):
    """The belief times `exp(shift z - precision z^2 / 2)`, normalised, and the log of what it was normalised by."""
    precision, shift = natural
    mean, deviation = direction.mean, direction.deviation
    tightened = jnp.maximum(1 + precision * deviation**2, jnp.finfo(natural.dtype).eps)
    moved = deviation * (shift - precision * mean) / tightened
    exponent = mean * (2 * shift - precision * mean) + (deviation * shift) ** 2
    log_integral = 0.5 * (exponent / tightened - jnp.log(tightened))
    return reshape(belief, direction, moved, 1 / tightened), log_integral


class _Tilted(NamedTuple):
    """A row applied to the belief without its site, in standard deviations of the belief with it."""

    usable: Array
    """Whether the belief without the site is proper, and known from rounding."""
    deviation: Array
    """Standard deviation of the belief with the site; 1 where not usable."""
    shift: Array
    """That of the site."""
    left: Array
    """Precision without the site."""
    cut: moments.Moments
    """In the standard deviations that it has without the site."""


def _tilted(mean, deviation, natural, rows: _Rows) -> _Tilted:
    precision, shift = natural[..., 0], natural[..., 1]
    resolved = rows.active & (deviation > rows.floor)
    deviation = jnp.where(resolved, deviation, 1.0)
    shift = deviation * (shift - precision * mean)
    left = 1 - precision * deviation**2
    usable = resolved & (left > 8 * jnp.finfo(left.dtype).eps)
    left = jnp.where(usable, left, 1.0)
    from_mean = lambda bound: jnp.sqrt(left) * ((bound - mean) / deviation + shift / left)
    return _Tilted(usable, deviation, shift, left, moments.interval(from_mean(rows.lower), from_mean(rows.upper)))


def _demanded(mean, deviation, natural, rows: _Rows):
    """Natural parameters of the site that gives the belief along the direction the moments of the row itself."""
    usable, deviation, shift, left, cut = _tilted(mean, deviation, natural, rows)
    variance = jnp.maximum(cut.variance, jnp.finfo(left.dtype).eps)
    precision = left * (1 - variance) / (variance * deviation**2)
    shift = (jnp.sqrt(left) * cut.mean - shift * (1 - variance)) / (variance * deviation)
    demanded = jnp.stack([precision, shift + precision * mean], axis=-1)
    return jnp.where(usable[..., None], demanded, jax.lax.stop_gradient(natural))


def _log_scale(mean, deviation, natural, rows: _Rows, otherwise):
    """Log of what the site has to be multiplied by to have the integral of the row itself."""
    usable, _, shift, left, cut = _tilted(mean, deviation, natural, rows)
    at_mean = mean * (natural[..., 1] - 0.5 * natural[..., 0] * mean)
    return jnp.where(usable, cut.log_mass + 0.5 * (shift * shift / left - jnp.log(left)) - at_mean, otherwise)


def _outside(direction: Direction, rows: _Rows):
    """Rows that the mean violates, which it cannot where sites that demand themselves have been found."""
    violation = jnp.maximum(rows.lower - direction.mean, direction.mean - rows.upper)
    return violation > 0.1 * direction.deviation + rows.floor


def _within_reach(*bounds):
    # Further out nothing is resolved, and squares of squares must not overflow.
    limit = 1 / float(jnp.finfo(bounds[0].dtype).eps)
    return [jnp.clip(bound, -limit, limit) for bound in bounds]


def _natural(sites: Sites):
    return jnp.stack([sites.precision, sites.shift], axis=-1)
