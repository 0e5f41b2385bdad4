r"""Gaussian filters of nonlinear models: extended, iterated, second-order, unscented and cubature, on manifolds too.

$$x_t = f(x_{t-1}, u_t) \boxplus q_t,\ q_t \sim N(0, Q),\qquad y_t = h(x_t) + r_t,\ r_t \sim N(0, R).$$

The state of the filter is the belief itself, a `Gaussian` or `GaussianRoot`: whatever changes a belief (a constraint,
a merge of hypotheses) may change it between the steps.
"""

from collections.abc import Callable
from dataclasses import field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor, info
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.linearize import Linearization, Linearize, taylor
from jaxfilters.gaussian.manifold import (
    Belief,
    Manifold,
    dimension,
    euclidean,
    hashable,
    increments,
    retract_belief,
    with_mean,
)
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, as_pytree

_HALVINGS = 6


class Observation(NamedTuple):
    """An observation with what is known about it; the filter takes a plain array too."""

    y: Float[Array, " m"]
    """NaN where nothing was read: such components are left out, and counted in `info.num_invalid` unless masked."""
    mask: Bool[Array, " m"] | None = None
    """False for components that were not seen, whatever `y` holds there."""
    noise: Array | None = None
    """In place of the filter's observation noise."""


@pytree_dataclass
class ExtendedKalman:
    """Parameters of an extended filter."""

    prior: Belief
    transition: Callable
    process_noise: Array | Callable
    observe: Callable
    observation_noise: Array
    manifold: Manifold
    residual: Callable
    linearize: Linearize = field(metadata={"static": True})
    arithmetic: Arithmetic = field(metadata={"static": True})
    iterations: int = field(metadata={"static": True})

    def linear_transition(self, belief: Belief, control: PyTree) -> tuple[Array, Linearization]:
        """Where the mean goes, and the transition as a linear function of increments, from the mean to there."""
        return linear_transition(self, belief, control)

    def process_noise_of(self, control: PyTree) -> Array:
        """The process noise of one step, as the arithmetic wants it."""
        return noise_of_step(self, control)


def subtract(y: Float[Array, " m"], y_hat: Float[Array, " m"]) -> Float[Array, " m"]:
    """The difference of two observations that are vectors."""
    return y - y_hat


def extended_kalman(
    prior: Gaussian | GaussianRoot,
    transition: Callable[[Array, PyTree], Array],
    process_noise: Array | Callable[[PyTree], Array],
    observe: Callable[[Array], Float[Array, " m"]],
    observation_noise: Float[Array, "m _"],
    *,
    linearize: Linearize = taylor,
    arithmetic: Arithmetic = arithmetics.joseph,
    manifold: Manifold = euclidean,
    residual: Callable[[Array, Array], Array] = subtract,
    iterations: int = 1,
) -> Filter:
    """Gaussian filter of a nonlinear model: an extended Kalman filter unless `linearize` says otherwise.

    Observations are arrays `y` or `Measured(y, mask, noise)`. The info is a `KalmanInfo`.

    Args:
        prior: Belief before the first observation: a `Gaussian`, or a `GaussianRoot` for `kalman.square_root`.
        transition: `(x, control) -> x`, without noise.
        process_noise: Covariance of the noise in the tangent space of the state (a root of it for
            `kalman.square_root`), or `control -> covariance`, for steps of different length.
        observe: `x -> y`, without noise.
        observation_noise: Covariance (or root) of the noise of y.
        linearize: `taylor` (extended filter), `second_order`, `second_order_bias`, `cubature` or `unscented(...)` of
            `jaxfilters.linearize`.
        arithmetic: `kalman.joseph`, `kalman.square_root` or `kalman.fast`.
        manifold: What the state lives on; `euclidean` for vectors.
        residual: `(y, y_hat) -> y - y_hat`, for observations that wrap around.
        iterations: How often the observation is made linear: 1 is the plain update; more are Gauss-Newton steps to
            the most probable state, each as long as lowers its cost (for `taylor` and `second_order`).

    Raises:
        ValueError: If prior, noises and arithmetic do not fit one another, or `iterations < 1`.
    """
    _check(prior, process_noise, observation_noise, arithmetic, iterations)
    params = ExtendedKalman(
        prior,
        as_pytree(transition),
        as_pytree(process_noise) if callable(process_noise) else process_noise,
        as_pytree(observe),
        observation_noise,
        hashable(manifold),
        as_pytree(residual),
        linearize,
        arithmetic,
        iterations,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: ExtendedKalman, key: AnyKey) -> Belief:
    del key
    prior = model.prior
    if isinstance(prior, GaussianRoot) and prior.root.shape[1] != prior.root.shape[0]:
        return GaussianRoot(prior.mean, linalg.tria(prior.root))
    return prior


def _predict(model: ExtendedKalman, key: AnyKey, belief: Belief, control: PyTree) -> Belief:
    del key
    ahead = _ahead if dimension(belief) > factor.UNROLLED else batch_last(_ahead)
    return ahead(model, belief, control)


def _ahead(model: ExtendedKalman, belief: Belief, control: PyTree) -> Belief:
    origin, step = linear_transition(model, belief, control)
    noise = noise_of_step(model, control)
    ahead = model.arithmetic.predict(increments(belief), step.F, noise, step.value, step.lost_root)
    # The mean is that of the step; F times a mean of zeros would be computed.
    return retract_belief(model.manifold, origin, with_mean(ahead, step.value))


def _update(model: ExtendedKalman, key: AnyKey, belief: Belief, observation: PyTree) -> tuple[Belief, KalmanInfo]:
    del key
    y = observation.y if isinstance(observation, Observation) else observation
    small = max(dimension(belief), jnp.size(y)) <= factor.UNROLLED
    given = batch_last(_given) if small else _given
    return given(model, belief, observation)


def _given(model: ExtendedKalman, belief: Belief, observation: PyTree) -> tuple[Belief, KalmanInfo]:
    return condition(
        belief,
        observation,
        model.observe,
        model.observation_noise,
        linearize=model.linearize,
        arithmetic=model.arithmetic,
        residual=model.residual,
        manifold=model.manifold,
        iterations=model.iterations,
    )


def linear_transition(model: ExtendedKalman, belief: Belief, control: PyTree) -> tuple[Array, Linearization]:
    """Where the mean goes, and the transition as a linear function of increments, from the mean to there."""
    if model.manifold.flat:
        ahead = model.linearize(lambda x: model.transition(x, control), belief)
        return ahead.value, ahead._replace(value=jnp.zeros_like(ahead.value))
    origin = model.transition(belief.mean, control)

    def step(delta: Array) -> Array:
        return model.manifold.local(origin, model.transition(model.manifold.retract(belief.mean, delta), control))

    return origin, model.linearize(step, increments(belief))


def noise_of_step(model: ExtendedKalman, control: PyTree) -> Array:
    """The process noise of one step, as the arithmetic wants it."""
    return model.process_noise(control) if callable(model.process_noise) else model.process_noise


def condition(
    belief: Gaussian | GaussianRoot,
    measured: Float[Array, " m"] | Observation,
    observe: Callable[[Array], Float[Array, " m"]],
    noise: Float[Array, "m _"],
    *,
    at: Array | None = None,
    linearize: Linearize = taylor,
    arithmetic: Arithmetic = arithmetics.joseph,
    residual: Callable[[Array, Array], Array] = subtract,
    manifold: Manifold = euclidean,
    iterations: int = 1,
) -> tuple[Gaussian | GaussianRoot, KalmanInfo]:
    r"""Belief after an observation, made linear at any point, and the diagnostics of the update.

    With $H = \partial h / \partial x$ at $\bar x$ and the predicted mean $\tilde x$, the innovation is
    $(y \ominus h(\bar x)) - H (\tilde x - \bar x)$; it, not the prediction, depends on where h is made linear
    (N. Shimada et al., "Shape and pose estimation of an articulated object", eq. 19, for $\bar x = \tilde x$).

    Args:
        belief: The predicted belief.
        measured: The observation.
        observe: `x -> y`, without noise.
        noise: As the arithmetic wants it, unless the observation has its own.
        at: The point where h is made linear, the predicted mean by default. Several hypotheses about one prediction
            differ in nothing else.
        linearize: As in `extended`; so are the other arguments.
        arithmetic: Covariances or roots.
        residual: `(y, y_hat) -> y - y_hat`.
        manifold: What the state lives on.
        iterations: How often h is made linear.
    """
    y, mask, own_noise = measured if isinstance(measured, Observation) else Observation(measured)
    noise = noise if own_noise is None else own_noise
    point = (lambda x: x) if manifold.flat else (lambda delta: manifold.retract(belief.mean, delta))
    start = belief.mean if manifold.flat else jnp.zeros(dimension(belief), belief.mean.dtype)
    sight = _Sight(belief, start, y, mask, noise, lambda at: observe(point(at)), residual, linearize, arithmetic)
    offset = None if at is None else manifold.local(belief.mean, at)
    posterior, report = _look(sight, offset)[:2] if iterations == 1 else _iterate(sight, offset, iterations)
    if manifold.flat:
        return posterior, report
    # What the arithmetic sees is an increment, which is finite about any mean.
    log_evidence = jnp.where(jnp.all(jnp.isfinite(belief.mean)), report.log_evidence, -jnp.inf)
    return retract_belief(manifold, belief.mean, posterior), replace(report, log_evidence=log_evidence)


class _Sight(NamedTuple):
    """An observation, and how the state would be seen at coordinates about the mean."""

    belief: Belief
    start: Array
    """Coordinates of the mean: its numbers where the manifold is flat, else zeros."""
    y: Array
    mask: Array | None
    noise: Array
    predict: Callable
    residual: Callable
    linearize: Linearize
    arithmetic: Arithmetic


def _look(sight, offset):
    """Belief in the coordinates, made linear at an increment (`None`: none); diagnostics; the linear observation."""
    at = sight.start if offset is None else sight.start + offset
    about = with_mean(sight.belief, at)
    # Where the residual is a difference, that from a reference would only cost time.
    if getattr(sight.residual, "func", sight.residual) is subtract:
        seen = sight.linearize(sight.predict, about)
        y, y_hat = sight.y, seen.value
    else:
        reference = sight.predict(at)
        seen = sight.linearize(lambda x: sight.residual(sight.predict(x), reference), about)
        read, y = _difference(sight, reference)
        # A residual that is not finite is the model's fault, unless nothing was read.
        y_hat = jnp.where(jnp.isfinite(y), seen.value, jnp.nan)
        y = jnp.where(read, jnp.where(jnp.isfinite(y), y, 0.0), jnp.nan)
    if offset is not None:
        y_hat = y_hat - factor.apply(seen.F, offset)
    prior = with_mean(sight.belief, sight.start)
    posterior, report = sight.arithmetic.update(prior, y, seen.F, sight.noise, y_hat, sight.mask, seen.lost_root)
    return posterior, report, seen


def _difference(sight, y_hat):
    """Which components were read, and the residual, 0 for the others."""
    read = jnp.isfinite(sight.y) if sight.mask is None else jnp.isfinite(sight.y) & sight.mask
    return read, jnp.where(read, sight.residual(jnp.where(read, sight.y, 0.0), y_hat), 0.0)


def _iterate(sight, first, iterations):
    """Gauss-Newton on the posterior's density (Bell and Cathey 1993), every step as long as lowers the cost.

    An iterate is an increment P g: with g beside it, the cost of leaving the prior is g^T P g / 2, without an inverse
    of P.
    """

    def refine(offset, dual):
        posterior, report, seen = _look(sight, offset)
        step, dual_step = posterior.mean - sight.start - offset, _dual(report, seen) - dual
        misfit = _misfit(sight, report, seen)

        def cost(length):
            reached = offset + length * step
            return 0.5 * jnp.sum((dual + length * dual_step) * reached) + misfit(reached)

        lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=step.dtype), 0.0)
        costs = jax.vmap(cost)(lengths)
        length = lengths[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))]
        return offset + length * step, dual + length * dual_step, posterior, report

    offset = dual = jnp.zeros(sight.start.shape, sight.start.dtype)
    if first is not None:
        # No increment P g leads there: what the prior says of it is not known, and the first step is a whole one.
        posterior, report, seen = _look(sight, first)
        offset, dual, iterations = posterior.mean - sight.start, _dual(report, seen), iterations - 1
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(refine, offset, dual)[2:])
    refined = jax.lax.fori_loop(0, iterations, lambda _, found: refine(*found[:2]), (offset, dual, *nothing))
    offset, _, posterior, report = refined
    return with_mean(posterior, sight.start + offset), report


def _dual(report, seen):
    whitened = linalg.solve_triangular(report.innovation_root, report.innovation)
    weights = linalg.solve_triangular(report.innovation_root, whitened, transpose=True)
    return factor.apply(info.observed(_counts(report), seen.F).T, weights)


def _misfit(sight, report, seen):
    counts = _counts(report)
    root = sight.arithmetic.noise_root(sight.noise, counts, seen.lost_root)

    def misfit(delta):
        missed = info.observed(counts, _difference(sight, sight.predict(sight.start + delta))[1])
        return 0.5 * jnp.sum(linalg.solve_triangular(root, missed) ** 2)

    return misfit


def _counts(report):
    return factor.diagonal(report.innovation_root) > 0


def _check(prior, process_noise, observation_noise, arithmetic, iterations):
    if not isinstance(prior, arithmetic.Belief):
        raise ValueError(
            f"prior must be a {arithmetic.Belief.__name__} for {arithmetic.__name__}; got a {type(prior).__name__}."
        )
    square = not isinstance(prior, GaussianRoot)
    shape = jnp.shape(prior.covariance if square else prior.root)
    if jnp.ndim(prior.mean) != 1 or len(shape) != 2 or (square and shape[0] != shape[1]):
        raise ValueError(f"prior must be one belief; its mean has shape {jnp.shape(prior.mean)}, the rest {shape}.")
    _check_noise("observation_noise", observation_noise, None, square)
    if not callable(process_noise):
        _check_noise("process_noise", process_noise, shape[0], square)
    if not isinstance(iterations, int) or iterations < 1:
        raise ValueError(f"iterations must be an integer of at least 1; got {iterations!r}.")


def _check_noise(name, noise, size, square):
    shape = jnp.shape(noise)
    if len(shape) != 2 or (square and shape[0] != shape[1]) or (size is not None and shape[0] != size):
        rows = "m" if size is None else size
        form = f"a covariance, ({rows}, {rows})" if square else f"a root, ({rows}, any width)"
        raise ValueError(f"{name} must be {form}; got shape {shape}.")
