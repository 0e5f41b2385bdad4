"""Fixed point of expectation propagation over scalar inequalities, and its derivative.

Sites are Gaussian factors `exp(shift z - precision z^2 / 2)` of k values z, kept as `natural` (k, 2): precision and
shift. Each value is counted from an origin within or near its bounds, in standard deviations of the given belief,
which may contain sites already. `docs/derivations/narrow_constraints.md` derives the equations.
"""

from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints import moments
from jaxfilters.gaussian.constraints.directions import Direction, component, reshape
from jaxfilters.math import linalg


class Rows(NamedTuple):
    """Inequalities `lower <= z <= upper` of k values."""

    lower: Array
    upper: Array
    active: Array
    """Rows whose sites are updated."""


class Settings(NamedTuple):
    """Damping and stopping rule of the iteration."""

    damping: Array | float
    max_sweeps: Array | int
    tolerance: Array | float


class Approximation(NamedTuple):
    """The sites found, the belief with them, and how they were found."""

    natural: Float[Array, "k 2"]
    """Precisions and shifts of the sites."""
    mean: Float[Array, " k"]
    covariance: Float[Array, "k k"]
    remaining: Float[Array, "k k"]
    """`I - covariance diag(change of the precisions)`: the derivative of the mean by that of the given belief."""
    sweeps: Int[Array, ""]
    """How often the rows were gone through."""
    change: Float[Array, ""]
    """The larger one of the changes of a mean, in standard deviations, and of a log variance, in the last sweep."""


class Marginal(NamedTuple):
    """A marginal of the belief, divided by its site, in the standard deviations of the marginal from its mean.

    The quotient (the cavity distribution) is proportional to `exp(-slope v - curvature v^2 / 2)`; it is truncated to
    `lower <= v <= upper`.
    """

    slope: Array
    curvature: Array
    """Share of the precision that does not come from the site, in (0, 1]. For a narrow row it is below the rounding
    error, on which the result does not depend."""
    lower: Array
    upper: Array


@jax.custom_jvp
def fixed_point(
    belief: Gaussian | GaussianRoot, rows: Rows, given: Float[Array, "k 2"], settings: Settings
) -> Approximation:
    """Sites at which the belief has the moments of every row.

    Args:
        belief: The given belief in the values z.
        rows: The inequalities.
        given: Sites that the belief contains already. The iteration starts from them.
        settings: The iteration stops when the change in a sweep is at most `settings.tolerance`.
    """
    # The variances of narrow rows keep their relative accuracy in a root, however often they are changed.
    start = belief if isinstance(belief, GaussianRoot) else GaussianRoot(belief.mean, _factor(belief.covariance))

    def visit(k, carry):
        belief, natural, largest = carry
        direction = component(belief, k)
        row = jax.tree.map(itemgetter(k), rows)
        change = site_change(direction.mean, direction.deviation, natural[k], row)
        largest = jnp.maximum(largest, _size(direction, change))
        belief = _times_component(belief, direction, k, settings.damping * change)
        return belief, natural.at[k].add(settings.damping * change), largest

    def sweep(carry):
        belief, natural, count, _ = carry
        unchanged = jnp.zeros((), natural.dtype)
        belief, natural, largest = jax.lax.fori_loop(0, len(natural), visit, (belief, natural, unchanged))
        return belief, natural, count + 1, largest

    unfinished = lambda carry: (carry[3] > settings.tolerance) & (carry[2] < settings.max_sweeps)
    carry = start, given, jnp.int32(0), jnp.full((), jnp.inf, given.dtype)
    _, natural, sweeps, change = jax.lax.while_loop(unfinished, sweep, carry)
    # Once more from the start: the mean and the sites have been rounded in different ways in the loop.
    found, remaining = _conditioned(start, natural - given)
    return Approximation(natural, found.mean, linalg.matmul(found.root, found.root.T), remaining, sweeps, change)


def _conditioned(belief: GaussianRoot, natural):
    """The belief times factors of its components, and the derivative of its mean by that of the given belief."""
    # Factors that add information go first, so that no belief in between is wider than the given one, or improper.
    order = jnp.argsort(-natural[:, 0])

    def step(i, carry):
        belief, remaining = carry
        k = order[i]
        direction = component(belief, k)
        tightened = _tightened(direction.deviation**2, natural[k, 0])
        row = remaining[k] / tightened
        # Without subtraction where the derivative is small.
        others = remaining - (natural[k, 0] * direction.deviation * direction.gain)[:, None] * row
        return _times_component(belief, direction, k, natural[k]), others.at[k].set(row)

    return jax.lax.fori_loop(0, len(natural), step, (belief, jnp.eye(len(natural), dtype=natural.dtype)))


def _times_component(belief: GaussianRoot, direction: Direction, k, natural):
    """The belief times a factor of component k, whose new mean keeps its relative accuracy however small it is."""
    changed, _ = times(belief, direction, natural)
    variance = direction.deviation**2
    mean = (direction.mean + variance * natural[1]) / _tightened(variance, natural[0])
    return replace(changed, mean=changed.mean.at[k].set(mean))


def times(belief, direction, natural):
    """The belief times one factor, normalised, and the log of the ratio of its standard deviations along the factor.

    Args:
        belief: `Gaussian` or `GaussianRoot`.
        direction: The marginal of the value that the factor depends on.
        natural: (2,), precision and shift of the factor.
    """
    precision, shift = natural
    mean, deviation = direction.mean, direction.deviation
    tightened = _tightened(deviation**2, precision)
    moved = deviation * (shift - precision * mean) / tightened
    return reshape(belief, direction, moved, 1 / tightened), -0.5 * jnp.log(tightened)


def _tightened(variance, precision):
    """The ratio by which a factor divides a variance."""
    # A smaller number is a rounding error, and the belief would become very wide.
    return jnp.maximum(1 + precision * variance, jnp.finfo(variance.dtype).eps ** 0.5)


def marginal(mean: Array, deviation: Array, natural: Array, rows: Rows) -> Marginal:
    """Marginals of the belief divided by their sites, elementwise.

    Args:
        mean: (...), of the values with their sites.
        deviation: (...), positive.
        natural: (..., 2), the sites.
        rows: The rows, with fields of that shape.
    """
    slope = deviation * (natural[..., 1] - natural[..., 0] * mean)
    curvature = 1 - natural[..., 0] * deviation**2
    return Marginal(slope, curvature, (rows.lower - mean) / deviation, (rows.upper - mean) / deviation)


def truncated(cavity: Marginal) -> moments.Moments:
    """Moments of the truncated quotient; its log mass is relative to the density at v = 0."""
    positive = jnp.maximum(cavity.curvature, jnp.finfo(cavity.curvature.dtype).eps ** 1.5)
    return moments.exponential_quadratic(cavity.slope, positive, cavity.lower, cavity.upper)


def site_change(mean: Array, deviation: Array, natural: Array, rows: Rows) -> Array:
    """Changes (..., 2) of the sites that give the values the moments of the truncated marginals, elementwise.

    Args:
        mean: (...), of the values with their present sites.
        deviation: (...).
        natural: (..., 2), the present sites.
        rows: The rows. One that is not active does not change, and neither does one whose value is certain.
    """
    changeable = rows.active & _resolved(deviation)
    deviation = jnp.where(changeable, deviation, 1.0)
    precision, shift = _local_change(marginal(mean, deviation, natural, rows), deviation)
    precision = precision / deviation**2
    change = jnp.stack([precision, shift / deviation + precision * mean], axis=-1)
    return jnp.where(changeable[..., None], change, 0.0)


@fixed_point.defjvp
def _fixed_point_jvp(primals, tangents):
    # Implicit differentiation: the derivative of the changes by the sites, times the tangent of the sites, cancels the
    # derivative by everything else. This differentiates a loop of unknown length in both modes.
    (belief, rows, given, _), (d_belief, d_rows, d_given, _) = primals, tangents
    found = fixed_point(*primals)
    natural, mean, P = found[:3]
    # Tangents of mean and covariance at constant sites.
    d_mean, d_P = _tangents_of_belief(belief, d_belief, natural - given, -d_given, found)
    variance = jnp.diagonal(P)
    changeable = rows.active & _resolved(linalg.safe_sqrt(variance))
    deviation = jnp.where(changeable, linalg.safe_sqrt(variance), 1.0)
    cavity = marginal(mean, deviation, natural, rows)
    # From here on sites are in the standard deviations of their marginals, from the means: all numbers are near one.
    slopes = jnp.where(changeable, _slopes(cavity, deviation), 0.0)
    by_lower, by_upper = slopes[2:]
    by_mean, by_log_variance = _by_marginal(cavity, slopes)
    d_step = by_mean * d_mean / deviation + by_log_variance * jnp.diagonal(d_P) / deviation**2
    d_step += by_lower * d_rows.lower / deviation + by_upper * d_rows.upper / deviation
    # A row that is left alone keeps the site that it was given.
    d_own = _localized(d_given, mean, deviation)
    d_step = jnp.where(changeable, d_step, d_own)
    matrix = _derivative_of_change(P / (deviation[:, None] * deviation), slopes, by_mean, by_log_variance, changeable)
    precision, shift = jnp.linalg.solve(matrix, -d_step.ravel()).reshape(d_step.shape)
    d_precision = precision / deviation**2
    d_natural = jnp.stack([d_precision, shift / deviation + d_precision * mean], axis=-1)
    d_mean += jnp.matmul(P, d_natural[:, 1] - d_precision * mean, precision="highest")
    d_P -= linalg.matmul(P * d_precision, P)
    d_remaining = -d_P * (natural - given)[:, 0] - P * (d_precision - d_given[:, 0])
    no_tangent = np.zeros((), jax.dtypes.float0)
    return found, Approximation(d_natural, d_mean, d_P, d_remaining, no_tangent, jnp.zeros_like(found.change))


def _tangents_of_belief(belief, d_belief, factors, d_factors, found):
    """Tangents of mean and covariance of the belief times factors, from those of the belief and of the factors."""
    if isinstance(belief, GaussianRoot):
        half = linalg.matmul(d_belief.root, belief.root.T)
        d_prior = half + half.T
    else:
        d_prior = d_belief.covariance
    mean, P, remaining = found.mean, found.covariance, found.remaining
    force = factors[:, 1] - factors[:, 0] * mean
    full = lambda a, b: jnp.matmul(a, b, precision="highest")
    d_mean = full(remaining, d_belief.mean + full(d_prior, force)) + full(P, d_factors[:, 1] - d_factors[:, 0] * mean)
    return d_mean, full(full(remaining, d_prior), remaining.T) - full(P * d_factors[:, 0], P)


def _local_change(cavity: Marginal, deviation: Array):
    """Changes of precision and shift, in the standard deviations of the marginals and from their means."""
    row = truncated(cavity)
    # The smallest deviation that is resolved, so that a row that allows a single point has a finite precision.
    smallest = _smallest(deviation) ** 2 / deviation**2
    variance = jnp.maximum(row.variance, jnp.minimum(smallest, 1.0))
    return jnp.stack([1 / variance - 1, row.mean / variance])


def _slopes(cavity: Marginal, deviation):
    """Derivatives (4, 2, k) of the changes by the four fields of the marginals."""
    change = lambda *fields: _local_change(Marginal(*fields), deviation)
    axes = jnp.eye(4, dtype=deviation.dtype)
    broadcast = lambda axis: tuple(jnp.broadcast_to(axis[:, None], (4, *deviation.shape)))
    return jax.vmap(lambda axis: jax.jvp(change, tuple(cavity), broadcast(axis))[1])(axes)


def _by_marginal(cavity: Marginal, slopes):
    """Derivatives (2, k) of the changes by the means, in standard deviations, and by the log variances."""
    by_slope, by_curvature, by_lower, by_upper = slopes
    share = 1 - cavity.curvature
    by_mean = -share * by_slope - by_lower - by_upper
    by_bounds = cavity.lower * by_lower + cavity.upper * by_upper
    return by_mean, 0.5 * (cavity.slope * by_slope - by_bounds) - share * by_curvature


def _derivative_of_change(correlation, slopes, by_mean, by_log_variance, changeable):
    """Derivative (2 k, 2 k) of the changes by the sites, precisions first.

    A change depends on its own site, and on the sites of all rows through its marginal: with the precision of site j
    the log variance of row k changes at the rate -correlation_kj^2, with the shift its mean at the rate correlation_kj.
    """
    own = jnp.stack([-slopes[1], slopes[0]], axis=1)
    through = jnp.stack(
        [-by_log_variance[..., None] * correlation**2, by_mean[..., None] * correlation],
        axis=1,
    )
    k = len(correlation)
    identity = jnp.eye(k, dtype=correlation.dtype)
    alone = jnp.where(changeable, 0.0, -jnp.eye(2, dtype=correlation.dtype)[..., None])
    # Where rows contradict each other, the sites are not determined, and the matrix is regularised.
    regular = 8 * jnp.finfo(correlation.dtype).eps * jnp.eye(2, dtype=correlation.dtype)
    blocks = through + (own + alone - regular[..., None])[..., None] * identity
    return blocks.transpose(0, 2, 1, 3).reshape(2 * k, 2 * k)


def _localized(d_natural, mean, deviation):
    """Tangents (2, k) of sites, in the standard deviations of the marginals and from their means."""
    d_precision, d_shift = d_natural.T
    return jnp.stack([d_precision * deviation**2, deviation * (d_shift - d_precision * mean)])


def _smallest(x):
    """The smallest standard deviation to which a row of zero width reduces a value, relative to the given belief."""
    return float(jnp.finfo(x.dtype).eps) ** 0.75


def _resolved(deviation):
    return deviation > _smallest(deviation)


def _size(direction: Direction, change):
    """The larger one of the changes of the mean, in standard deviations, and of the log variance; 0 if rounding."""
    mean, deviation = direction.mean, jnp.where(direction.certain, 1.0, direction.deviation)
    moved = jnp.maximum(abs(change[1] - change[0] * mean) * deviation, abs(change[0]) * deviation**2)
    rounding = 4 * jnp.finfo(change.dtype).eps * (1 + abs(mean) / deviation)
    return jnp.where(direction.certain | (moved < rounding), 0.0, moved)


def _factor(P):
    """A root of a covariance that is positive semidefinite to rounding."""
    variances, axes = jnp.linalg.eigh(P)
    return axes * jnp.sqrt(jnp.maximum(variances, 0.0))
