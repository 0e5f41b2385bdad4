r"""One measurement update: linearised at a point, or iterated.

The iterated update lowers the negative logarithm of the posterior density,
$J(x) = \tfrac12 |x - m|^2_{P^{-1}} + \tfrac12 |y - h(x)|^2_{R^{-1}}$, by Gauss-Newton steps (B. M. Bell and
F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE Transactions on Automatic Control
38(2), 1993). Its minimum is the mode. The mean of a skewed posterior lies elsewhere: to the next order of Laplace's
expansion it minimises $J(x) + \tfrac12 \log |S(x)|$, with $S = H P H^T + R$ of the observation linearised at x
(L. Tierney and J. B. Kadane, "Accurate approximations for posterior moments and marginal densities", Journal of the
American Statistical Association 81, 1986; `docs/derivations/iterated_update.md`).

Where R is singular, some combinations of the components are exact: they are constraints, which no cost can weigh. As in
R. Fletcher and S. Leyffer, "Nonlinear programming without a penalty function", Mathematical Programming 91, 2002, a
step is then taken if it reduces their violation, or else the cost.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor, info
from jaxfilters.gaussian.linearize import Linearization, Linearize, lower_root
from jaxfilters.gaussian.manifold import Belief, with_mean
from jaxfilters.math import linalg

_HALVINGS = 6


class Measurement(NamedTuple):
    """An observation, and its prediction as a function of coordinates about the mean of the belief."""

    belief: Belief
    start: Float[Array, " n"]
    """Coordinates of the mean: its numbers where the manifold is flat, else zeros."""
    y: Float[Array, " m"]
    mask: Array | None
    noise: Float[Array, "m _"]
    predict: Callable[..., Array]
    """`coordinates -> y`, without noise; `(coordinates, noise) -> y` where the noise is not additive."""
    residual: Callable[[Array, Array], Array]
    linearize: Linearize
    arithmetic: Arithmetic
    noise_at: Callable[[Array], Array] | None = None
    """`coordinates -> noise` where it is evaluated anew in each iteration."""
    log_probability: Callable[[Array], Array] | None = None
    """`coordinates -> log p(y | x)` where it is not that of Gaussian noise."""


def subtract(y: Float[Array, " m"], y_hat: Float[Array, " m"]) -> Float[Array, " m"]:
    """The difference of two observations that are vectors."""
    return y - y_hat


def is_difference(residual: Callable) -> bool:
    """Whether a residual is `subtract`."""
    return getattr(residual, "func", residual) is subtract


def linear_update(
    measurement: Measurement, offset: Float[Array, " n"] | None = None
) -> tuple[Belief, KalmanInfo, Linearization]:
    """Belief in the coordinates after an update linearised at an increment from the mean (`None`: at the mean).

    Returns:
        The belief, the diagnostics, and the linear function that stands for the observation.
    """
    linear, reference = _linear_at(measurement, offset)
    if reference is None:
        y, y_hat = measurement.y, linear.value
    else:
        read, y = _difference(measurement, reference)
        # A residual that is not finite is the model's fault, unless nothing was read.
        y_hat = jnp.where(jnp.isfinite(y), linear.value, jnp.nan)
        y = jnp.where(read, jnp.where(jnp.isfinite(y), y, 0.0), jnp.nan)
    if offset is not None:
        y_hat = y_hat - factor.apply(linear.F, offset)
    prior = with_mean(measurement.belief, measurement.start)
    posterior, report = measurement.arithmetic.update(
        prior, y, linear.F, measurement.noise, y_hat, measurement.mask, linear.residual_root
    )
    return posterior, report, linear


def iterated_update(
    measurement: Measurement, first: Float[Array, " n"] | None, iterations: int, to_mean: bool
) -> tuple[Belief, KalmanInfo]:
    """Belief in the coordinates after damped Gauss-Newton steps, and the diagnostics of an update linearised there.

    Every step is halved until it lowers the cost, with the residual as it is, not linearised; or, where the noise is
    singular, until it reduces the violation of what is exact. An increment from the mean is P g, and g is carried
    beside it: the prior's part of the cost is g^T P g / 2, without an inverse of P.

    Args:
        measurement: The observation.
        first: Increment at which the first step is linearised; `None` is the mean.
        iterations: How many steps there are.
        to_mean: Whether log|S| / 2 is part of the cost. Its gradient u moves the minimum by -C u, where C is the
            covariance of the posterior.
    """
    prior_root = lower_root(measurement.belief)
    given = measurement
    times_P = lambda v: factor.apply(prior_root, factor.apply(prior_root.T, v))

    def refine(index, offset, dual):
        measurement = _noise_at(given, offset)
        posterior, report, linear = linear_update(measurement, offset)
        end, end_dual = posterior.mean - measurement.start, dual_of(report, linear.F, report.innovation)
        if measurement.log_probability is not None:
            log_evidence = laplace_log_evidence(measurement, report, linear, offset, dual)
            report = replace(report, log_evidence=log_evidence)
        if to_mean:
            # The first step is that of the plain update: its result is never better than where the iteration ends.
            u = jnp.where(index > 0, _log_determinant_slope(measurement, report, linear, prior_root, offset), 0.0)
            # C u = P u - P F^T S^-1 F P u.
            shift_dual = dual_of(report, linear.F, factor.apply(_counted(report, linear.F), times_P(u))) - u
            end, end_dual = end + times_P(shift_dual), end_dual + shift_dual
        step, dual_step = end - offset, end_dual - dual
        likelihood_cost = _likelihood_cost(measurement, report, linear, prior_root if to_mean else None)

        def cost(length):
            at = offset + length * step
            likelihood, violation = likelihood_cost(at)
            return 0.5 * jnp.sum((dual + length * dual_step) * at) + likelihood, violation

        lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=step.dtype), 0.0)
        length = lengths[least(lengths, *jax.lax.map(cost, lengths))]
        # The last round only linearises the observation at the final point.
        length = jnp.where(index < iterations, length, 0.0)
        return offset + length * step, dual + length * dual_step, posterior, report

    offset = dual = jnp.zeros(measurement.start.shape, measurement.start.dtype)
    done = 0
    if first is not None:
        # The prior's part of the cost is not known at a point that is no P g: the first step is a whole one.
        posterior, report, linear = linear_update(measurement, first)
        offset, dual, done = posterior.mean - measurement.start, dual_of(report, linear.F, report.innovation), 1
    results = jax.eval_shape(partial(refine, done), offset, dual)[2:]
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), results)
    found = jax.lax.fori_loop(done, iterations + 1, lambda i, at: refine(i, *at[:2]), (offset, dual, *empty))
    offset, _, posterior, report = found
    return with_mean(posterior, measurement.start + offset), report


def laplace_log_evidence(
    measurement: Measurement,
    report: KalmanInfo,
    linear: Linearization,
    offset: Float[Array, " n"],
    dual: Float[Array, " n"],
) -> Float[Array, ""]:
    r"""Log evidence of an observation whose noise is not Gaussian, from the Gaussian update that stands for it.

    $\log p(y \mid \hat x) + \log N(\hat x; m, P) - \log N(\hat x; \hat x, \hat P)$ with
    $|\hat P| / |P| = |R| / |S|$, and $\hat x - m = P g$.

    Args:
        measurement: The observation, with its `log_probability`.
        report: Diagnostics of the update.
        linear: The linear function of that update.
        offset: The increment $\hat x - m$.
        dual: The vector g.
    """
    counts = factor.diagonal(report.innovation_root) > 0
    root = measurement.arithmetic.noise_root(measurement.noise, counts, linear.residual_root)
    diagonals = (jnp.where(counts, jnp.abs(factor.diagonal(part)), 1.0) for part in (root, report.innovation_root))
    log_noise, log_innovation = (jnp.sum(jnp.log(diagonal)) for diagonal in diagonals)
    assert measurement.log_probability is not None
    at_mean = measurement.log_probability(measurement.start + offset)
    value = at_mean - 0.5 * jnp.sum(dual * offset) + log_noise - log_innovation
    return jnp.where(report.log_evidence == -jnp.inf, -jnp.inf, value)


def _noise_at(measurement, offset):
    if measurement.noise_at is None:
        return measurement
    return measurement._replace(noise=measurement.noise_at(measurement.start + offset))


def _linear_at(measurement, offset):
    """The linear function at an increment; where residuals are no differences, of the residual from a reference."""
    at = measurement.start if offset is None else measurement.start + offset
    about = with_mean(measurement.belief, at)
    # Where the residual is a difference, that from a reference would only cost time.
    if is_difference(measurement.residual):
        return measurement.linearize(measurement.predict, about), None
    reference = measurement.predict(at)
    from_reference = lambda x, *noise: measurement.residual(measurement.predict(x, *noise), reference)
    return measurement.linearize(from_reference, about), reference


def _difference(measurement, y_hat):
    """Which components were read, and the residual, 0 for the others."""
    y, mask = measurement.y, measurement.mask
    read = jnp.isfinite(y) if mask is None else jnp.isfinite(y) & mask
    return read, jnp.where(read, measurement.residual(jnp.where(read, y, 0.0), y_hat), 0.0)


def dual_of(report: KalmanInfo, F: Float[Array, "m n"], innovation: Float[Array, " m"]) -> Float[Array, " n"]:
    """`F^T S^-1 innovation`, over the components that count."""
    whitened = linalg.solve_triangular(report.innovation_root, innovation)
    weights = linalg.solve_triangular(report.innovation_root, whitened, transpose=True)
    return factor.apply(_counted(report, F).T, weights)


def _likelihood_cost(measurement, report, linear, prior_root):
    """Negative log likelihood at an increment, but for a constant; with log|S| / 2 where a root of P is given.

    Beside it, the squared violation of what is exact.
    """
    if measurement.log_probability is not None:
        return lambda offset: (-measurement.log_probability(measurement.start + offset), jnp.zeros_like(offset[0]))
    counts = factor.diagonal(report.innovation_root) > 0
    noise_root = measurement.arithmetic.noise_root(measurement.noise, counts, linear.residual_root)
    scales = linalg.safe_norm(report.innovation_root)

    def cost(offset):
        residual = info.observed(counts, _difference(measurement, measurement.predict(measurement.start + offset))[1])
        square, violation = misfit(noise_root, scales, residual)
        if prior_root is None:
            return 0.5 * square, violation
        F = _counted(report, _linear_at(measurement, offset)[0].F)
        diagonal = factor.diagonal(linalg.tria(jnp.hstack([linalg.matmul(F, prior_root), noise_root])))
        return 0.5 * square + jnp.sum(jnp.log(jnp.where(counts, jnp.abs(diagonal), 1.0))), violation

    return cost


def exact_rows(noise_root: Float[Array, "m m"], scales: Float[Array, " m"]) -> Bool[Array, " m"]:
    """Which components have no noise, given those before them, to rounding.

    Args:
        noise_root: Lower root of the covariance of the noise.
        scales: Standard deviations of the components before they are read; 0 for those that do not count.
    """
    tolerance = 4 * len(scales) * float(jnp.finfo(scales.dtype).eps)
    return (factor.diagonal(noise_root) <= tolerance * scales) & (scales > 0)


def misfit(
    noise_root: Float[Array, "m m"], scales: Float[Array, " m"], residual: Float[Array, " m"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Squared length of a residual whitened by its noise; and of what no noise explains, in units of `scales`.

    The residual is 0 in components that do not count. The other arguments are those of `exact_rows`.
    """
    exact = exact_rows(noise_root, scales)
    root = jnp.where(exact, 0.0, noise_root)
    whitened = linalg.solve_triangular(root, residual)
    unexplained = (residual - factor.apply(root, whitened)) / jnp.where(exact, scales, 1.0)
    return jnp.sum(whitened**2), jnp.sum(jnp.where(exact, unexplained, 0.0) ** 2)


def least(lengths: Float[Array, " k"], costs: Float[Array, " k"], violations: Float[Array, " k"]) -> Int[Array, ""]:
    """Index of the length of least cost, unless one reduces the violation of what is exact: see `feasible`."""
    merits = costs + 0.5 * violations
    return feasible(lengths, violations, jnp.argmin(jnp.where(jnp.isnan(merits), jnp.inf, merits)))


def feasible(lengths: Float[Array, " k"], violations: Float[Array, " k"], otherwise: Int[Array, ""]) -> Int[Array, ""]:
    """Index of the first length of a step that reduces a squared violation; `otherwise` where there is none.

    The violation is that of constraints, in standard deviations before they are known; the last length is 0. One below
    the rounding error of its root is no reason for a step. To compare costs instead, `otherwise` should add half of
    the squared violation: a step along a constraint may then leave it a little, but not far.
    """
    now = violations[-1]
    reduces = (violations <= (1 - lengths / 4) ** 2 * now) & (lengths > 0) & (now > jnp.finfo(now.dtype).eps)
    return jnp.where(jnp.any(reduces), jnp.argmax(reduces), otherwise)


def _log_determinant_slope(measurement, report, linear, prior_root, offset):
    """Gradient of log|S| / 2 at an increment, S = F P F^T + R: with W = S^-1 F P, that of the sum of W_ij F_ij."""
    FP = factor.outer(linalg.matmul(_counted(report, linear.F), prior_root), prior_root)
    root = report.innovation_root
    W = linalg.solve_triangular(root, linalg.solve_triangular(root, FP), transpose=True)
    slope = jax.jacfwd(lambda at: jnp.sum(W * _counted(report, _linear_at(measurement, at)[0].F)))(offset)
    return jnp.where(jnp.all(jnp.isfinite(slope)), slope, 0.0)


def _counted(report, F):
    """The rows of F that count, zero for the others."""
    return info.observed(factor.diagonal(report.innovation_root) > 0, F)
