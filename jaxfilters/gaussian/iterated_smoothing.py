r"""Iterated smoothers of nonlinear models: each pass linearises the model about the smoothed states of the last one.

With first derivatives this is the iterated extended Kalman smoother: the Gauss-Newton method for the most probable
trajectory (B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM Journal on Optimization 4(3),
1994). With sigma points it is the iterated posterior linearisation smoother, whose linearisation errors are those over
the posterior (A. F. Garcia-Fernandez, L. Svensson and S. Särkkä, "Iterated posterior linearization smoother", IEEE
Transactions on Automatic Control 62(4), 2017). Of each step the length of the least cost is taken, from a whole one by
halves to none (S. Särkkä and L. Svensson, "Levenberg-Marquardt and line-search extended Kalman smoothers", ICASSP
2020), for sigma points with covariances and linearisation errors held during the step (J. Lindqvist, S. Särkkä,
A. F. Garcia-Fernandez, M. Raitoharju and L. Svensson, "Posterior linearisation smoothing with robust iterations",
2021).
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
from jaxfilters.gaussian.smoothing import reverse_transition, rts
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, Mask

_HALVINGS = 10


class IterationInfo(NamedTuple):
    """The course of an iterated smoother."""

    cost: Float[Array, " i"]
    """Cost of the trajectory before each iteration, in nats: minus the log density of states and observations, but for
    a constant; of sigma points, with the covariances of that iteration."""
    reached: Float[Array, " i"]
    """The same cost after the iteration; never larger."""
    step: Float[Array, " i"]
    """Length of the step, 1 for a whole one, 0 where no step lowered the cost."""
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
            ICASSP 2021); both find the same.

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
    checks.is_filter("filter", filter)
    if not isinstance(filter.params, ExtendedKalman) or not filter.params.manifold.flat:
        raise ValueError(
            "filter must be made by extended_kalman, unscented_kalman or cubature_kalman, and have vectors for states; "
            f"its parameters are {type(filter.params).__name__}."
        )
    checks.count("iterations", iterations)
    checks.function("smoother", smoother)
    _, (beliefs, _) = run(filter, key, observations, inputs, mask=mask)
    if start is None:
        start = rts(filter, beliefs, inputs)
    elif checks.beliefs("start", start, filter.params.prior) != len(beliefs.mean):
        raise ValueError(f"start must have the {len(beliefs.mean)} frames of observations; got {len(start.mean)}.")
    return _iterated(filter.params, start, observations, inputs, mask, iterations, smoother)


@partial(jax.jit, static_argnames=("iterations", "smoother"))
def _iterated(
    model: ExtendedKalman,
    start: Belief,
    observations: PyTree,
    inputs: PyTree,
    mask: Mask | None,
    iterations: int,
    smoother: Smoother,
) -> tuple[Belief, IterationInfo]:
    def improve(trajectory: Belief, index: Array) -> tuple[Belief, tuple]:
        affine = affine_model(model, trajectory, observations, inputs, mask)
        target, log_evidence = smoother(model.prior, affine, model.arithmetic)
        step = target.mean - trajectory.mean
        cost = _cost(model, trajectory, affine, observations, inputs)
        lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=step.dtype), 0.0)
        costs = jax.lax.map(lambda length: cost(trajectory.mean + length * step), lengths)
        best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
        # The last pass gives the covariances and the evidence about the trajectory, and takes no step.
        length = jnp.where(index < iterations, lengths[best], 0.0)
        moved = jnp.where(length > 0, trajectory.mean + length * step, trajectory.mean)
        # Covariances are those about the trajectory, also where no step lowers the cost.
        return replace(target, mean=moved), (costs[-1], costs[best], length, log_evidence)

    first = _with_first(model, start, inputs)
    final, (*course, log_evidence) = jax.lax.scan(improve, first, jnp.arange(iterations + 1))
    cost, reached, step = (each[:-1] for each in course)
    info = IterationInfo(cost, reached, step, log_evidence[-1])
    return jax.tree.map(lambda leaf: leaf[1:], final), info


def _with_first(model: Any, start: Belief, inputs: PyTree) -> Belief:
    """The beliefs with that of the state before the first observation."""
    first, inputs = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (start, inputs))
    prior = model.prior
    if isinstance(prior, GaussianRoot):
        prior = GaussianRoot(prior.mean, linalg.tria(prior.root))
        assert isinstance(start, GaussianRoot)
        start = GaussianRoot(start.mean, jax.vmap(linalg.tria)(start.root))
    origin, gain, rest = reverse_transition(model, prior, inputs)
    before = replace(prior, mean=prior.mean + rest.mean + factor.apply(gain, first.mean - origin))
    return jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), before, start)


def _cost(model: ExtendedKalman, trajectory: Belief, affine: AffineModel, observations: PyTree, inputs: PyTree):
    """Minus the log density of a trajectory of means, with the covariances and errors of a linearisation."""
    noise_root = jax.vmap(model.arithmetic.noise_root)
    root_P = lower_root(model.prior)
    root_Q, root_R = noise_root(affine.Q, None, affine.added_Q), noise_root(affine.R, affine.read, affine.added_R)

    def one(before: Belief, here: Belief, observation: PyTree, inputs: PyTree, read: Array, roots: tuple) -> Array:
        ahead, step = model.linear_transition(before, inputs)
        surprise = linalg.solve_triangular(roots[0], here.mean - ahead - step.value)
        y, _, own_noise = read_components(observation)
        linear = linear_observation(model, here, jnp.where(read, y, 0.0), own_noise, inputs)
        residual = jnp.where(read, linear.y - factor.apply(linear.H, here.mean) - linear.d, 0.0)
        return jnp.sum(surprise**2) + jnp.sum(linalg.solve_triangular(roots[1], residual) ** 2)

    def cost(means: Array) -> Array:
        at = replace(trajectory, mean=means)
        before, here = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], at) for cut in (slice(-1), slice(1, None)))
        each = jax.vmap(one)(before, here, observations, inputs, affine.read, (root_Q, root_R))
        start = linalg.solve_triangular(root_P, means[0] - model.prior.mean)
        return 0.5 * (jnp.sum(start**2) + jnp.sum(each))

    return cost
