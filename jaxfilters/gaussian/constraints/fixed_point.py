"""The sites that demand themselves: the loop of expectation propagation over scalar rows, and its derivative.

Sites are Gaussian factors `exp(shift z - precision z^2 / 2)` of k values z, kept as `natural` (k, 2): precision and
shift. The values have the standard deviation 1 and the mean 0 under the belief given, which may contain sites already.
"""

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
    """Rows to be met."""
    given: Array
    """(k, 2), the sites that the belief given contains."""


class Patience(NamedTuple):
    """How the loop goes on, and when it ends."""

    damping: Array | float
    max_sweeps: Array | int
    tolerance: Array | float


class Tilted(NamedTuple):
    """A row applied to the belief without its site, seen from the belief with it: in its standard deviations."""

    proper: Array
    """Whether the belief without the site is one."""
    deviation: Array
    """Standard deviation of the belief with the site."""
    shift: Array
    """That of the site, about the mean of the belief with it."""
    left: Array
    """Precision without the site."""
    cut: moments.Moments
    """In the standard deviations that it has without the site."""


@jax.custom_jvp
def fixed_point(
    belief: Gaussian | GaussianRoot, rows: Rows, natural: Float[Array, "k 2"], patience: Patience
) -> tuple[Float[Array, "k 2"], Int[Array, ""], Float[Array, ""]]:
    """Sites that demand themselves, how many sweeps it took to find them, and what the last of these changed.

    `belief` is the one given, in the values z; the loop starts from the sites `natural` that it contains. The changes
    are those of `Patience.tolerance`: of means in standard deviations, and of log variances.
    """
    # On a root the variances of narrow rows keep their digits, however often they are changed.
    start = belief if isinstance(belief, GaussianRoot) else GaussianRoot(belief.mean, _factor(belief.covariance))

    def visit(k, carry):
        belief, natural, largest = carry
        direction = component(belief, k)
        row = jax.tree.map(itemgetter(k), rows)
        step = demanded(direction.mean, direction.deviation, natural[k], row) - natural[k]
        largest = jnp.maximum(largest, _change(direction, step))
        belief, _ = times(belief, direction, patience.damping * step)
        return belief, natural.at[k].add(patience.damping * step), largest

    def sweep(carry):
        belief, natural, count, _ = carry
        unchanged = jnp.zeros((), natural.dtype)
        belief, natural, largest = jax.lax.fori_loop(0, len(natural), visit, (belief, natural, unchanged))
        return belief, natural, count + 1, largest

    unfinished = lambda carry: (carry[3] > patience.tolerance) & (carry[2] < patience.max_sweeps)
    carry = start, natural, jnp.int32(0), jnp.full((), jnp.inf, natural.dtype)
    return jax.lax.while_loop(unfinished, sweep, carry)[1:]


def times(belief, direction, natural):
    """The belief times one factor, normalised, and the log of how much narrower it has become.

    Args:
        belief: `Gaussian` or `GaussianRoot`.
        direction: What it says of the value that the factor is of.
        natural: (2,), precision and shift of the factor.
    """
    precision, shift = natural
    mean, deviation = direction.mean, direction.deviation
    # Less than this is rounding, and would blow the belief up.
    tightened = jnp.maximum(1 + precision * deviation**2, jnp.finfo(natural.dtype).eps ** 0.5)
    moved = deviation * (shift - precision * mean) / tightened
    return reshape(belief, direction, moved, 1 / tightened), -0.5 * jnp.log(tightened)


def tilted(mean: Array, deviation: Array, left: Array, natural: Array, rows: Rows) -> Tilted:
    """The rows applied to the belief without their sites, elementwise.

    Args:
        mean: (...), of the values with their sites.
        deviation: (...).
        left: (...), share of the precision that is left without the site: `1 - precision deviation^2`.
        natural: (..., 2), the sites.
        rows: The rows, with fields of that shape.
    """
    eps = jnp.finfo(left.dtype).eps
    deviation = jnp.where(rows.active, jnp.maximum(deviation, eps**0.5), 1.0)
    shift = deviation * (natural[..., 1] - natural[..., 0] * mean)
    # Next to a narrow row nothing is left but rounding, and what there was to begin with has to do.
    clear, began = left > 32 * eps, 1 - rows.given[..., 0]
    proper = rows.active & (clear | (began > 8 * eps))
    began = jnp.where(began > 8 * eps, began, 1.0)
    left = jnp.where(clear, left, began * deviation**2)
    shift = jnp.where(clear, shift, deviation * (began * mean + rows.given[..., 1]))
    from_mean = lambda bound: jnp.sqrt(left) * ((bound - mean) / deviation + shift / left)
    return Tilted(proper, deviation, shift, left, moments.interval(from_mean(rows.lower), from_mean(rows.upper)))


def demanded(mean: Array, deviation: Array, natural: Array, rows: Rows) -> Array:
    """Natural parameters (..., 2) of the sites that would give the values the moments of the rows themselves.

    Elementwise: mean and deviation (...) of the values with their present sites `natural` (..., 2). A row that is not
    active, and one next to which nothing else is known any more, demands the site that it has.
    """
    eps = jnp.finfo(mean.dtype).eps
    known = deviation > eps**0.5
    proper, deviation, shift, left, cut = tilted(mean, deviation, 1 - natural[..., 0] * deviation**2, natural, rows)
    # Nothing is made so narrow that it could not be told from rounding afterwards.
    smallest = jnp.maximum(128 * eps, 4 * eps * left / deviation**2)
    variance = jnp.maximum(cut.variance, jnp.minimum(smallest, 1.0))
    precision = left * (1 - variance) / (variance * deviation**2)
    shift = (jnp.sqrt(left) * cut.mean - shift * (1 - variance)) / (variance * deviation)
    site = jnp.stack([precision, shift + precision * mean], axis=-1)
    return jnp.where((proper & known)[..., None], site, jax.lax.stop_gradient(natural))


def conditioned(
    belief: Gaussian | GaussianRoot, natural: Float[Array, "k 2"]
) -> tuple[Float[Array, " k"], Float[Array, "k k"], Float[Array, "k k"]]:
    """Mean and covariance of a belief of mean zero times factors of its components, and `I - covariance precision`.

    The last, with the precisions of the factors as a diagonal matrix, is what a narrow factor leaves; it has been found
    without subtraction.
    """
    prior = linalg.matmul(belief.root, belief.root.T) if isinstance(belief, GaussianRoot) else belief.covariance
    precision, shift = natural.T
    identity = jnp.eye(len(prior), dtype=prior.dtype)
    left = jnp.linalg.solve(identity + prior * precision, identity)
    P = linalg.matmul(left, prior)
    return P @ shift, P, left


@fixed_point.defjvp
def _fixed_point_jvp(primals, tangents):
    # Where what the sites demand less what they are is zero for all givens: d natural = -(d lacking / d natural)^-1
    # (d lacking / d givens) d givens. In this way a loop of unknown length has derivatives in both modes.
    (belief, rows, start, _), (d_belief, d_rows, d_start, _) = primals, tangents
    natural, sweeps, change = fixed_point(*primals)
    marginals = lambda belief, start: conditioned(belief, natural - start)[:2]
    (mean, P), (d_mean, d_P) = jax.jvp(marginals, (belief, start), (d_belief, d_start))
    slopes = _slopes_of_demand(mean, P, natural, rows)
    d_given = jnp.stack([d_mean, jnp.diagonal(d_P), d_rows.lower, d_rows.upper, *d_rows.given.T])
    d_lacking = jnp.einsum("skp,sk->kp", slopes[:6], d_given, precision="highest")
    # A row that is left alone keeps the site that it was given.
    alone = jnp.all(slopes == 0, axis=(0, 2))
    d_lacking = jnp.where(alone[:, None], d_start, d_lacking)
    step = jnp.linalg.solve(_derivative_of_lacking(mean, P, slopes), -d_lacking.ravel())
    no_tangent = np.zeros((), jax.dtypes.float0)
    return (natural, sweeps, change), (step.reshape(natural.shape), no_tangent, jnp.zeros_like(change))


def _slopes_of_demand(mean, P, natural, rows):
    """Derivatives (8, k, 2) of what a row demands by its mean, variance, bounds, given site and present site."""
    own = jnp.stack([mean, jnp.diagonal(P), rows.lower, rows.upper, *rows.given.T, *natural.T])

    def demand(own):
        mean, variance, lower, upper = own[:4]
        row = rows._replace(lower=lower, upper=upper, given=own[4:6].T)
        return demanded(mean, linalg.safe_sqrt(variance), own[6:].T, row)

    axes = jnp.eye(len(own), dtype=own.dtype)
    return jax.vmap(lambda axis: jax.jvp(demand, (own,), (jnp.broadcast_to(axis[:, None], own.shape),))[1])(axes)


def _derivative_of_lacking(mean, P, slopes):
    """Derivative (2 k, 2 k) of what the sites demand beyond themselves, by themselves.

    A row demands by its own marginal, and that hangs on the sites of all rows: with the precision of site j the mean of
    row k changes at the rate `-P_kj mean_j` and its variance at `-P_kj^2`; with the shift the mean at `P_kj`.
    """
    by_mean, by_variance, *_, by_precision, by_shift = slopes
    means, variances = jnp.stack([-P * mean, P], axis=-1), jnp.stack([-P * P, jnp.zeros_like(P)], axis=-1)
    marginals = by_mean[:, :, None, None] * means[:, None] + by_variance[:, :, None, None] * variances[:, None]
    # By roundings more than the identity: rows that contradict each other demand nothing but each other's negative.
    more = 1 + 8 * jnp.finfo(P.dtype).eps
    itself = jnp.stack([by_precision, by_shift], axis=-1) - more * jnp.eye(2, dtype=P.dtype)
    identity = jnp.eye(len(mean), dtype=P.dtype)
    return (marginals + itself[:, :, None] * identity[:, None, :, None]).reshape(2 * len(mean), -1)


def _change(direction: Direction, step):
    """Larger one of what a step means to the mean, in standard deviations, and to the log variance; 0 if rounding."""
    mean, deviation = direction.mean, jnp.where(direction.certain, 1.0, direction.deviation)
    moved = jnp.maximum(abs(step[1] - step[0] * mean) * deviation, abs(step[0]) * deviation**2)
    rounding = 2 * jnp.finfo(step.dtype).eps * (abs(mean) + 1 / deviation) / deviation
    return jnp.where(direction.certain | (moved < rounding), 0.0, moved)


def _factor(P):
    """A root of a covariance that is positive semidefinite to rounding."""
    variances, axes = jnp.linalg.eigh(P)
    return axes * jnp.sqrt(jnp.maximum(variances, 0.0))
