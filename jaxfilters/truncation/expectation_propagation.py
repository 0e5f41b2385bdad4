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
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
    given: Array
    """(k, 2), natural parameters of the sites that the belief contains."""
    rounding: Array
    """Variance that may be rounding."""
    floor: Array
    """Standard deviation below which a row is left alone; rows that contradict each other would go on for ever."""


class _Patience(NamedTuple):
    damping: Array | float
    max_sweeps: Array | int
    tolerance: Array | float


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
    return _truncate(belief, constraints, sites, _Patience(damping, max_sweeps, tolerance))


@compiled
def _truncate(belief, constraints, given, patience):
    directions = jax.vmap(along, (None, 0))(belief, constraints.normals)
    distances = jax.vmap(distances_along)(directions, constraints.lower, constraints.upper)
    active = ~directions.certain
    unit = jnp.where(active, directions.deviation, 1.0)
    normals = jnp.where(active[:, None], constraints.normals / unit[:, None], 0.0)
    start = standardized(given, directions.mean, unit)
    rounding = jnp.full_like(unit, resolution(belief) ** 2)
    floor = jnp.sqrt(jnp.maximum(rounding, jnp.finfo(unit.dtype).eps))
    rows = _Rows(*_within_reach(-distances[:, 0], distances[:, 1]), active, _natural(start), rounding, floor)
    centred = replace(belief, mean=jnp.zeros_like(belief.mean))

    natural, sweeps, change = _fixed_point(image(centred, normals), rows, _natural(start), patience)
    truncated, log_spread = _multiplied(centred, normals, natural - _natural(start))
    marginals = jax.vmap(along, (None, 0))(truncated, normals)
    log_scale, log_change = _log_scale(marginals, natural, start, rows)
    infeasible = jnp.where(active, _outside(marginals, rows), jnp.any(distances < 0, axis=-1))
    log_mass = jnp.where(jnp.any(infeasible), -jnp.inf, log_spread + jnp.sum(log_change))
    info = TruncationInfo(distances, log_mass, infeasible, sweeps, change <= patience.tolerance)
    result = destandardized(Sites(*natural.T, log_scale), directions.mean, unit)
    return replace(truncated, mean=belief.mean + truncated.mean), result, info


@jax.custom_jvp
def _fixed_point(belief, rows, natural, patience):
    """Natural parameters (k, 2) of the sites that demand themselves, sweeps taken, and the change in the last one.

    From the belief in the values (k,), which contains `natural` to begin with.
    """
    identity = jnp.eye(len(natural), dtype=natural.dtype)

    def visit(k, carry):
        belief, natural, largest = carry
        direction = along(belief, identity[k])
        row = jax.tree.map(itemgetter(k), rows)
        step = _demanded(direction.mean, direction.deviation, natural[k], row) - natural[k]
        largest = jnp.maximum(largest, _change(direction, step))
        belief, _ = _times(belief, direction, patience.damping * step)
        return belief, natural.at[k].add(patience.damping * step), largest

    def sweep(carry):
        belief, natural, count, _ = carry
        unchanged = jnp.zeros((), natural.dtype)
        belief, natural, largest = jax.lax.fori_loop(0, len(natural), visit, (belief, natural, unchanged))
        return belief, natural, count + 1, largest

    unfinished = lambda carry: (carry[3] > patience.tolerance) & (carry[2] < patience.max_sweeps)
    start = belief, natural, jnp.int32(0), jnp.full((), jnp.inf, natural.dtype)
    return jax.lax.while_loop(unfinished, sweep, start)[1:]


@_fixed_point.defjvp
def _fixed_point_jvp(primals, tangents):
    # Where what the sites demand less what they are is zero for all givens: d natural = -(d lacking / d natural)^-1
    # (d lacking / d givens) d givens. In this way a loop of unknown length has derivatives in both modes.
    (belief, rows, start, _), (d_belief, d_rows, d_start, _) = primals, tangents
    natural, sweeps, change = _fixed_point(*primals)
    conditioned = lambda belief, start: _conditioned(belief, natural - start)
    (mean, P), (d_mean, d_P) = jax.jvp(conditioned, (belief, start), (d_belief, d_start))
    slopes = _slopes_of_demand(mean, P, natural, rows)
    usable = _tilted(mean, linalg.safe_sqrt(jnp.diagonal(P)), natural, rows).usable
    d_given = jnp.stack([d_mean, jnp.diagonal(d_P), d_rows.lower, d_rows.upper, *d_rows.given.T])
    d_lacking = jnp.einsum("skp,sk->kp", slopes[:6], d_given, precision="highest")
    # A row that is left alone keeps the site that it was given.
    d_lacking = jnp.where(usable[:, None], d_lacking, d_start)
    step = jnp.linalg.solve(_derivative_of_lacking(mean, P, slopes), -d_lacking.ravel())
    no_tangent = np.zeros((), jax.dtypes.float0)
    return (natural, sweeps, change), (step.reshape(natural.shape), no_tangent, jnp.zeros_like(change))


def _slopes_of_demand(mean, P, natural, rows):
    """Derivatives (8, k, 2) of what a row demands by its mean, variance, bounds, given site and present site."""
    own = jnp.stack([mean, jnp.diagonal(P), rows.lower, rows.upper, *rows.given.T, *natural.T])

    def demanded(own):
        mean, variance, lower, upper = own[:4]
        row = rows._replace(lower=lower, upper=upper, given=own[4:6].T)
        return _demanded(mean, linalg.safe_sqrt(variance), own[6:].T, row)

    axes = jnp.eye(len(own), dtype=own.dtype)
    return jax.vmap(lambda axis: jax.jvp(demanded, (own,), (jnp.broadcast_to(axis[:, None], own.shape),))[1])(axes)


def _derivative_of_lacking(mean, P, slopes):
    """Derivative (2 k, 2 k) of what the sites demand beyond themselves, by themselves.

    A row demands by its own marginal, and that hangs on the sites of all rows: with the precision of site j the mean of
    row k changes at the rate `-P_kj mean_j` and its variance at `-P_kj^2`; with the shift the mean at `P_kj`.
    """
    by_mean, by_variance, *_, by_precision, by_shift = slopes
    means, variances = jnp.stack([-P * mean, P], axis=-1), jnp.stack([-P * P, jnp.zeros_like(P)], axis=-1)
    marginals = by_mean[:, :, None, None] * means[:, None] + by_variance[:, :, None, None] * variances[:, None]
    itself = jnp.stack([by_precision, by_shift], axis=-1) - jnp.eye(2, dtype=P.dtype)
    identity = jnp.eye(len(mean), dtype=P.dtype)
    return (marginals + itself[:, :, None] * identity[:, None, :, None]).reshape(2 * len(mean), -1)


def _conditioned(belief, natural):
    """Mean and covariance of a belief of mean zero, times factors with these natural parameters, one a component."""
    prior = linalg.matmul(belief.root, belief.root.T) if isinstance(belief, GaussianRoot) else belief.covariance
    precision, shift = natural.T
    P = jnp.linalg.solve(jnp.eye(len(prior), dtype=prior.dtype) + prior * precision, prior)
    return P @ shift, P


def _change(direction: Direction, step):
    """Larger one of what a step means to the mean, in standard deviations, and to the log variance; 0 if rounding."""
    mean, deviation = direction.mean, jnp.where(direction.certain, 1.0, direction.deviation)
    moved = jnp.maximum(abs(step[1] - step[0] * mean) * deviation, abs(step[0]) * deviation**2)
    rounding = 2 * jnp.finfo(step.dtype).eps * (abs(mean) + 1 / deviation) / deviation
    return jnp.where(direction.certain | (moved < rounding), 0.0, moved)


def _multiplied(belief, normals, natural):
    """The belief times one factor a row, normalised, and the log of how much narrower its volume has become."""

    def step(belief, row):
        normal, factor = row
        return _times(belief, along(belief, normal), factor)

    # What adds information goes first: then no belief in between is less certain than the last one, or improper.
    order = jnp.argsort(-natural[:, 0])
    belief, log_spread = jax.lax.scan(step, belief, (normals[order], natural[order]))
    return belief, jnp.sum(log_spread)


def _times(belief, direction: Direction, natural):
    """The belief times `exp(shift z - precision z^2 / 2)`, normalised, and the log of the ratio of the deviations."""
    precision, shift = natural
    mean, deviation = direction.mean, direction.deviation
    # Less than this is rounding, and would blow the belief up.
    tightened = jnp.maximum(1 + precision * deviation**2, jnp.finfo(natural.dtype).eps ** 0.5)
    moved = deviation * (shift - precision * mean) / tightened
    return reshape(belief, direction, moved, 1 / tightened), -0.5 * jnp.log(tightened)


class _Tilted(NamedTuple):
    """A row applied to the belief without its site, in standard deviations of the belief with it."""

    proper: Array
    """Whether the belief without the site is one."""
    usable: Array
    """Whether it is also known from rounding."""
    deviation: Array
    """Standard deviation of the belief with the site."""
    shift: Array
    """That of the site, about the mean of the belief with it."""
    left: Array
    """Precision without the site."""
    cut: moments.Moments
    """In the standard deviations that it has without the site."""


def _tilted(mean, deviation, natural, rows: _Rows) -> _Tilted:
    precision, shift = natural[..., 0], natural[..., 1]
    eps = jnp.finfo(precision.dtype).eps
    known = rows.active & (deviation > rows.floor)
    deviation = jnp.where(rows.active, jnp.maximum(deviation, rows.floor), 1.0)
    shift = deviation * (shift - precision * mean)
    left = 1 - precision * deviation**2
    # Next to a narrow row nothing is left but rounding, and what there was to begin with has to do.
    clear = left > jnp.maximum(8 * eps, rows.rounding / deviation**2)
    began = 1 - rows.given[..., 0]
    proper = rows.active & (clear | (began > 8 * eps))
    began = jnp.where(began > 8 * eps, began, 1.0)
    left = jnp.where(clear, left, began * deviation**2)
    shift = jnp.where(clear, shift, deviation * (began * mean + rows.given[..., 1]))
    from_mean = lambda bound: jnp.sqrt(left) * ((bound - mean) / deviation + shift / left)
    cut = moments.interval(from_mean(rows.lower), from_mean(rows.upper))
    return _Tilted(proper, proper & known, deviation, shift, left, cut)


def _demanded(mean, deviation, natural, rows: _Rows):
    """Natural parameters of the site that gives the belief along the direction the moments of the row itself."""
    _, usable, deviation, shift, left, cut = _tilted(mean, deviation, natural, rows)
    # Nothing is made as narrow as rounding.
    smallest = jnp.maximum(32 * jnp.finfo(left.dtype).eps, 4 * left * (rows.floor / deviation) ** 2)
    variance = jnp.maximum(cut.variance, jnp.minimum(smallest, 1.0))
    precision = left * (1 - variance) / (variance * deviation**2)
    shift = (jnp.sqrt(left) * cut.mean - shift * (1 - variance)) / (variance * deviation)
    demanded = jnp.stack([precision, shift + precision * mean], axis=-1)
    return jnp.where(usable[..., None], demanded, jax.lax.stop_gradient(natural))


def _log_scale(marginals: Direction, natural, start: Sites, rows: _Rows):
    """Log scales of the sites, with which they have the integrals of the rows, and what they add to the log mass.

    The integral of the belief given, times the new sites over the old, is exp(half of the sum of the changed shifts
    times the new means), but for how narrow it has become. Its exponent and that of the scales are large and cancel;
    here they have been cancelled beforehand.
    """
    mean = marginals.mean
    tilted = _tilted(mean, marginals.deviation, natural, rows)
    force = natural[:, 1] - natural[:, 0] * mean
    own = tilted.cut.log_mass + 0.5 * (tilted.shift**2 / tilted.left - jnp.log(tilted.left))
    log_scale = own - mean * (force + 0.5 * natural[:, 0] * mean)
    change = own - 0.5 * mean * (force + start.shift) - start.log_scale
    return jnp.where(tilted.proper, log_scale, start.log_scale), jnp.where(tilted.proper, change, 0.0)


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
