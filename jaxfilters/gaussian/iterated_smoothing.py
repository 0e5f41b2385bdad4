r"""Iterated smoothers of nonlinear models: each pass linearises the model about the smoothed states of the last one.

With first derivatives this is the iterated extended Kalman smoother: the Gauss-Newton method for the most probable
trajectory (B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM Journal on Optimization 4(3),
1994). With sigma points it is the iterated posterior linearisation smoother, whose linearisation errors are those over
the posterior (A. F. Garcia-Fernandez, L. Svensson and S. Särkkä, "Iterated posterior linearization smoother", IEEE
Transactions on Automatic Control 62(4), 2017). Of each step the length of the least cost is taken, from a whole one by
halves to none (S. Särkkä and L. Svensson, "Levenberg-Marquardt and line-search extended Kalman smoothers", ICASSP
2020), for sigma points with covariances and linearisation errors held during the step (J. Lindqvist, S. Särkkä,
A. F. Garcia-Fernandez, M. Raitoharju and L. Svensson, "Posterior linearisation smoothing with robust iterations",
2021). Where a noise is singular, what is exact comes first, as in the iterated update (`measurement_update`).
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters.filter import Filter, run
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.affine import (
    AffineModel,
    Smoother,
    affine_model,
    linear_observation,
    read_components,
    sequential,
)
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.linearize import lower_root
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.gaussian.measurement_update import exact_rows, least, misfit
from jaxfilters.gaussian.posterior_linearization import widened
from jaxfilters.gaussian.smoothing import reverse_transition, rts
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, Mask

_HALVINGS = 10


class IterationInfo(NamedTuple):
    """The course of an iterated smoother."""

    cost: Float[Array, " i"]
    """Cost of the trajectory before each iteration, in nats: minus the log density of states and observations, but for
    a constant; of sigma points, with the covariances of that iteration. What is exact has none."""
    reached: Float[Array, " i"]
    """The same cost after the iteration; never larger, but where something exact was violated before."""
    step: Float[Array, " i"]
    """Length of the step, 1 for a whole one, 0 where no step lowered the cost or the violation of what is exact."""
    log_evidence: Float[Array, ""]
    """Of the model linearised about the last trajectory."""


def iterated(
    filter: Filter,
    key: AnyKey,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Mask | None = None,
    iterations: int = 10,
    start: Belief | None = None,
    smoother: Smoother = sequential,
) -> tuple[Belief, IterationInfo]:
    """Smoothed beliefs by iterated linearisation about the smoothed states; no iteration raises the cost.

    Transitions and observations without noise are exact: iterations first reduce what violates them, at any cost.

    A filter linearised by `taylor` finds the most probable trajectory; one linearised by `cubature` or `unscented`
    finds means and covariances whose linearisation errors are least over the posterior.

    Args:
        filter: Filter made by `extended_kalman`, `unscented_kalman` or `cubature_kalman`, of vectors.
        key: Random key; the filter ignores it.
        observations: Observations, time first, as for `jf.run`.
        inputs: Known inputs, time first, or `None`.
        mask: False for frames without an observation, (t,).
        iterations: Number of passes, at least 1; 5 to 20 are usual.
        start: Beliefs of all frames to linearise about first, time first; `None` is what filter and smoother find.
        smoother: `jf.smoothing.sequential`, or `jf.smoothing.parallel` for logarithmic depth (F. Yaghoobi,
            A. Corenflos, S. Hassan and S. Särkkä, "Parallel iterated extended and sigma-point Kalman smoothers",
            ICASSP 2021); both find the same. The latter is NaN where the noise of a transition and of its observation
            leave something exact, H Q H^T + R being singular.

    Returns:
        The smoothed beliefs, time first, and the course of the iteration.

    Raises:
        ValueError: If `filter` is another kind of filter or its states are no vectors; if lengths differ, `iterations`
            is less than 1, or `start` has other shapes than the beliefs of the filter.
        TypeError: If `filter` is no filter, or `smoother` no function.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([3.0, 4.0]), jnp.eye(2))
        >>> distance = lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2)
        >>> filter = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(2), distance, 0.01 * jnp.eye(1))
        >>> smoothed, info = jf.smoothing.iterated(filter, jax.random.key(0), 5.0 * jnp.ones((10, 1)), iterations=5)
        >>> smoothed.mean.shape, bool((info.reached <= info.cost).all())
        ((10, 2), True)
    """
    _check_filter(filter)
    checks.count("iterations", iterations)
    checks.function("smoother", smoother)
    _, (beliefs, infos) = run(filter, key, observations, inputs, mask=mask)
    if start is None:
        start = rts(filter, beliefs, inputs)
    elif checks.beliefs("start", start, filter.params.prior) != len(beliefs.mean):
        raise ValueError(f"start must have the {len(beliefs.mean)} frames of observations; got {len(start.mean)}.")
    found = _Filtered(beliefs, linalg.safe_norm(infos.innovation_root))
    return _iterated(filter.params, start, observations, inputs, mask, found, iterations, smoother)


def _check_filter(filter: Filter) -> None:
    checks.is_filter("filter", filter)
    if not isinstance(filter.params, ExtendedKalman) or not filter.params.manifold.flat:
        raise ValueError(
            "filter must be made by extended_kalman, unscented_kalman or cubature_kalman, and have vectors for states; "
            f"its parameters are {type(filter.params).__name__}."
        )


class _Filtered(NamedTuple):
    """What the filter found, as the unit of what violates exact transitions and observations."""

    beliefs: Belief
    innovations: Float[Array, "t m"]
    """Standard deviations, 0 for components that do not count."""


@partial(jax.jit, static_argnames=("iterations", "smoother"))
def _iterated(
    model: ExtendedKalman,
    start: Belief,
    observations: PyTree,
    inputs: PyTree,
    mask: Mask | None,
    filtered: _Filtered,
    iterations: int,
    smoother: Smoother,
) -> tuple[Belief, IterationInfo]:
    first = _joined(_before_first(model, start, inputs), start)
    about_start = affine_model(model, first, observations, inputs, mask)
    predicted = _predicted(model, filtered.beliefs, about_start)
    scales = _std(predicted), filtered.innovations
    exact_at_first = _is_exact(_noise_roots(model, about_start)[1], filtered.innovations)

    def improve(carry: tuple[Belief, Array], index: Array) -> tuple[tuple[Belief, Array], tuple]:
        trajectory, exact = carry
        rest = jax.vmap(widened)(jax.tree.map(lambda leaf: leaf[1:], trajectory), predicted, exact)
        over = jax.tree.map(lambda many, wide: jnp.concatenate([many[:1], wide]), trajectory, rest)
        affine = affine_model(model, over, observations, inputs, mask)
        target, log_evidence = smoother(model.prior, affine, model.arithmetic)
        step = target.mean - trajectory.mean
        roots = _noise_roots(model, affine)
        cost = _cost(model, over, affine.read, roots, (observations, inputs), scales)
        lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=step.dtype), 0.0)
        costs, violations = jax.lax.map(lambda length: cost(trajectory.mean + length * step), lengths)
        best = least(lengths, costs, violations)
        # The last pass gives the covariances and the evidence about the trajectory, and takes no step.
        length = jnp.where(index < iterations, lengths[best], 0.0)
        stay = jnp.where(jnp.isnan(target.mean), jnp.nan, trajectory.mean)
        moved = jnp.where(length > 0, trajectory.mean + length * step, stay)
        course = costs[-1], costs[best], length, log_evidence
        # Covariances are those about the trajectory, also where no step lowers the cost.
        return (replace(target, mean=moved), _is_exact(roots[1], filtered.innovations)), course

    (final, _), (*course, log_evidence) = jax.lax.scan(improve, (first, exact_at_first), jnp.arange(iterations + 1))
    cost, reached, step = (each[:-1] for each in course)
    info = IterationInfo(cost, reached, step, log_evidence[-1])
    return jax.tree.map(lambda leaf: leaf[1:], final), info


def _joined(first: Belief, rest: Belief) -> Belief:
    """Beliefs of all frames after one; roots as lower roots."""
    if isinstance(first, GaussianRoot):
        assert isinstance(rest, GaussianRoot)
        first = GaussianRoot(first.mean, linalg.tria(first.root))
        rest = GaussianRoot(rest.mean, jax.vmap(linalg.tria)(rest.root))
    return jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), first, rest)


def _before_first(model: Any, start: Belief, inputs: PyTree) -> Belief:
    """Belief about the state before the first observation, from that of the first frame."""
    first, inputs = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (start, inputs))
    prior = model.prior
    if isinstance(prior, GaussianRoot):
        prior = GaussianRoot(prior.mean, linalg.tria(prior.root))
    origin, gain, rest = reverse_transition(model, prior, inputs)
    return replace(prior, mean=prior.mean + rest.mean + factor.apply(gain, first.mean - origin))


def _predicted(model: ExtendedKalman, filtered: Belief, affine: AffineModel) -> Belief:
    """The belief about every state given the observations before it; its mean is that of an affine model."""
    earlier = jax.tree.map(lambda leaf: leaf[:-1], _joined(model.prior, filtered))
    return jax.vmap(model.arithmetic.predict)(earlier, affine.F, affine.Q, affine.b, affine.added_Q)


def _std(beliefs: Belief) -> Array:
    """Standard deviations, 1 where they are zero."""
    if isinstance(beliefs, GaussianRoot):
        std = linalg.safe_norm(beliefs.root)
    else:
        std = linalg.safe_sqrt(jnp.diagonal(beliefs.covariance, axis1=1, axis2=2))
    return jnp.where(std > 0, std, 1.0)


def _noise_roots(model: ExtendedKalman, affine: AffineModel) -> tuple[Array, Array]:
    """Roots of the noises of all transitions and observations, with the linearisation errors."""
    noise_root = jax.vmap(model.arithmetic.noise_root)
    return noise_root(affine.Q, None, affine.added_Q), noise_root(affine.R, affine.read, affine.added_R)


def _is_exact(root_R: Array, innovations: Array) -> Array:
    """In which frames something of the observation is exact."""
    return jnp.any(jax.vmap(exact_rows)(root_R, innovations), axis=1)


def _cost(
    model: ExtendedKalman, trajectory: Belief, read: Array, roots: tuple, given: tuple[PyTree, PyTree], scales: tuple
):
    """Minus the log density of a trajectory of means, with the covariances and errors of a linearisation.

    Beside it, the squared violation of what is exact.
    """
    root_P = lower_root(model.prior)
    scales = scales[0], jnp.where(read, scales[1], 0.0)

    def one(before: Belief, here: Belief, given: tuple[PyTree, PyTree], read: Array, roots: tuple, scales: tuple):
        observation, inputs = given
        ahead, step = model.linear_transition(before, inputs)
        surprise = misfit(roots[0], scales[0], here.mean - ahead - step.value)
        y, _, own_noise = read_components(observation)
        linear = linear_observation(model, here, jnp.where(read, y, 0.0), own_noise, inputs)
        residual = jnp.where(read, linear.y - factor.apply(linear.H, here.mean) - linear.d, 0.0)
        return jax.tree.map(jnp.add, surprise, misfit(roots[1], scales[1], residual))

    def cost(means: Array) -> tuple[Array, Array]:
        at = replace(trajectory, mean=means)
        before, here = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], at) for cut in (slice(-1), slice(1, None)))
        squares, violations = jax.vmap(one)(before, here, given, read, roots, scales)
        start = linalg.solve_triangular(root_P, means[0] - model.prior.mean)
        return 0.5 * (jnp.sum(start**2) + jnp.sum(squares)), jnp.sum(violations)

    return cost
