r"""Gaussian filters of nonlinear models: extended, iterated, second-order, unscented and cubature, on manifolds too.

$$x_t = f(x_{t-1}, u_t) \boxplus q_t,\ q_t \sim N(0, Q),\qquad y_t = h(x_t, u_t) + r_t,\ r_t \sim N(0, R),$$

where $Q$ and $R$ may depend on the inputs $u_t$ and on the state.

The state of the filter is the belief itself, a `Gaussian` or `GaussianRoot`: whatever changes a belief (a constraint,
a merge of hypotheses) may change it between the steps.
"""

from collections.abc import Callable
from dataclasses import field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.emission_update import emission_update
from jaxfilters.gaussian.emissions import Emission
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
from jaxfilters.gaussian.measurement_update import (
    Measurement,
    is_difference,
    iterated_update,
    linear_update,
    subtract,
)
from jaxfilters.gaussian.noise_models import (
    Augmented,
    NonAdditiveNoise,
    StateNoise,
    bound_function,
    bound_noise,
    no_noise,
    noise_of_step,
)
from jaxfilters.gaussian.observation import Observation as Observation
from jaxfilters.gaussian.observation import as_observation as as_observation
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, as_pytree


@pytree_dataclass
class ExtendedKalman:
    """Parameters of a filter made by `extended_kalman`; its arguments describe them."""

    prior: Belief
    transition: Any
    """`(x, inputs) -> x`, or a `NonAdditiveNoise`."""
    process_noise: Array | Callable | StateNoise
    observe: Any
    """`(x, inputs) -> y`, a `NonAdditiveNoise` or an `Emission`."""
    observation_noise: Array | Callable | StateNoise | None
    manifold: Manifold
    residual: Callable
    linearize: Linearize = field(metadata={"static": True})
    arithmetic: Arithmetic = field(metadata={"static": True})
    iterations: int = field(metadata={"static": True})
    iterate_to: Literal["mean", "mode"] = field(metadata={"static": True}, default="mean")

    def linear_transition(self, belief: Belief, inputs: PyTree) -> tuple[Array, Linearization]:
        """The predicted mean, and the transition as a linear function of increments, from the mean to the predicted."""
        transition, linearize = self._transition(belief, inputs)
        if self.manifold.flat:
            ahead = linearize(transition, belief)
            return ahead.value, ahead._replace(value=jnp.zeros_like(ahead.value))
        origin = transition(belief.mean)

        def step(delta: Array, *noise: Array) -> Array:
            return self.manifold.local(origin, transition(self.manifold.retract(belief.mean, delta), *noise))

        return origin, linearize(step, increments(belief))

    def process_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """The process noise of one step: a covariance, or a root of it, as the arithmetic needs."""
        if isinstance(self.transition, NonAdditiveNoise):
            return no_noise(belief, dimension(belief))
        return noise_of_step(
            "process_noise", self.process_noise, inputs, dimension(belief), *self._about(belief), self.linearize
        )

    def observation_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """The observation noise of one step, or what `observe` receives of it."""
        return noise_of_step(
            "observation_noise", self.observation_noise, inputs, None, *self._about(belief), self.linearize
        )

    def _about(self, belief: Belief) -> tuple[Belief, Callable]:
        """The belief in coordinates, and the state at some of them."""
        if self.manifold.flat:
            return belief, lambda x: x
        return increments(belief), lambda delta: self.manifold.retract(belief.mean, delta)

    def _transition(self, belief: Belief, inputs: PyTree) -> tuple[Callable, Linearize]:
        """The transition of one step, maybe with noise as its second argument, and the strategy to linearise it."""
        if not isinstance(self.transition, NonAdditiveNoise):
            return lambda x: checks.transitioned(self.transition, x, inputs), self.linearize
        noise = noise_of_step("process_noise", self.process_noise, inputs, None, belief, lambda x: x, self.linearize)
        move = self.transition.at(inputs, noise.shape[0], belief.mean.dtype)
        return lambda x, *q: checks.moved(move(x, *q), x), Augmented(noise, self.linearize)


def extended_kalman(
    prior: Gaussian | GaussianRoot,
    transition: Callable[..., Array] | NonAdditiveNoise,
    process_noise: Array | Callable[..., Array],
    observe: Callable[..., Float[Array, " m"]] | NonAdditiveNoise | Emission,
    observation_noise: Array | Callable[..., Array] | None = None,
    *,
    linearize: Linearize = taylor,
    arithmetic: Arithmetic = arithmetics.joseph,
    manifold: Manifold = euclidean,
    residual: Callable[[Array, Array], Array] = subtract,
    iterations: int = 1,
    iterate_to: Literal["mean", "mode"] = "mean",
) -> Filter:
    r"""Extended Kalman filter: a Gaussian filter of a nonlinear model, linearised at the current mean.

    Other choices of `linearize` make it a second-order, unscented or cubature filter. An observation is an array `y`
    of shape (m,), or `Observation(y, mask, noise)`; the state is a belief like `prior`, and the info a `KalmanInfo`.
    S. Särkkä and L. Svensson, "Bayesian Filtering and Smoothing", 2nd edition, 2023, chapters 7 to 9.

    Args:
        prior: Belief before the first observation, with a mean of shape (n,): a `Gaussian` with a covariance (d, d),
            or a `GaussianRoot` for `jf.arithmetic.square_root`. On vector spaces d = n.
        transition: `x -> x` without noise, (n,) to (n,), or `(x, inputs) -> x`, where `inputs` is one step of the
            `inputs` of `jf.run`, see `jf.typing`; or `NonAdditiveNoise` of a function `(x, noise)`.
        process_noise: Covariance of the process noise, (d, d), in the tangent space of the state (for
            `jf.arithmetic.square_root` a root of it, (d, any width)); or a function `inputs -> covariance`, e.g. for
            steps of unequal length; or a function `(x, inputs) -> covariance`, whose expected value counts (with
            `taylor`, that at the mean).
        observe: `x -> y` without noise, (n,) to (m,), or `(x, inputs) -> y`; or `NonAdditiveNoise`; or an emission of
            `jf.emissions`, for counts and classes.
        observation_noise: Covariance of the observation noise, (m, m), or a root of it, (m, any width); or a function
            like `process_noise`, of the predicted state. None for an emission, and only there.
        linearize: `jf.linearize.taylor` (the extended filter), `second_order`, `second_order_covariance_only`,
            `cubature` or `unscented(...)`.
        arithmetic: `jf.arithmetic.joseph`, `square_root` or `fast`.
        manifold: Space of the states, for rotations and poses; `jf.manifold.euclidean` for vectors.
        residual: `(y, y_hat) -> y - y_hat`, (m,), for observations that wrap around, such as angles.
        iterations: Steps of every measurement update: 1 is the plain update; more are damped Gauss-Newton steps,
            halved until they lower the cost, for precise measurements that are strongly nonlinear within the prior's
            spread. Meant for `taylor`, whose cost they lower; 2 to 10 are usual.
        iterate_to: The point that more than one iteration approaches. "mean" is the mean of the posterior to the
            second order of Laplace's expansion, which needs second derivatives of `observe`. "mode" is the most
            probable state, the classical iterated extended Kalman filter. Do not use "mode" where the posterior is
            skewed, e.g. for bearings from a single moving observer: there the mode lies nearer to the observer than
            the mean, frame after frame, and the filter becomes certain of too short a range. It then loses to a single
            iteration.

    Returns:
        The filter, for `jf.run`, `jf.log_evidence`, `jf.step`, `jf.smoothing.rts` and the wrappers of filters.

    Raises:
        ValueError: If shapes do not fit one another; if `prior` is for another arithmetic; if a covariance is not
            symmetric or not positive semidefinite (unless under `jit`, where values are unknown); if
            `iterations < 1`, or `iterate_to` is another word. Shapes of the results of functions, and of
            observations, are compared when the filter is traced.
        TypeError: If an argument is of another kind, e.g. an array of integers.

    Examples:
        A range to the origin, in metres, from a point that moves at random.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([3.0, 4.0]), jnp.eye(2))
        >>> observe = lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2)
        >>> filter = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(2), observe, 0.01 * jnp.eye(1))
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), 5.0 * jnp.ones((10, 1)))
        >>> beliefs.mean.shape, infos.log_evidence.shape
        ((10, 2), (10,))
    """
    checks.arithmetic_of(prior, arithmetic)
    checks.on_manifold("prior", prior, manifold)
    is_root = isinstance(prior, GaussianRoot)
    R = _observation_noise(observe, observation_noise, is_root)
    Q = bound_noise("process_noise", process_noise, dimension(prior), is_root=is_root, function=transition)
    transition, observe = bound_function("transition", transition), bound_function("observe", observe)
    checks.function("residual", residual)
    checks.function("linearize", linearize)
    if not isinstance(iterations, int) or iterations < 1:
        raise ValueError(f"iterations must be an integer of at least 1; got {iterations!r}.")
    if iterate_to not in ("mean", "mode"):
        raise ValueError(f'iterate_to must be "mean" or "mode"; got {iterate_to!r}.')
    if isinstance(observe, Emission) and iterate_to == "mean" and iterations > 1:
        raise ValueError(f'iterate_to must be "mode" for {iterations} iterations with an emission; got "mean".')
    if isinstance(observe, Emission) and residual is not subtract:
        raise ValueError(f"residual must be left out for an emission; got {residual!r}.")
    params = ExtendedKalman(
        prior,
        transition,
        Q,
        observe,
        R,
        hashable(manifold),
        as_pytree(residual),
        linearize,
        arithmetic,
        iterations,
        iterate_to,
    )
    return Filter(params, _init, _predict, _update)


def _observation_noise(observe: Any, noise: Any, is_root: bool) -> Any:
    if isinstance(observe, Emission):
        if noise is not None:
            raise ValueError("observation_noise must be None for an emission, which has its own distribution.")
        return None
    if noise is None:
        raise ValueError(
            "observation_noise must be a covariance or a function, unless observe is an emission; got None."
        )
    return bound_noise("observation_noise", noise, None, is_root=is_root, function=observe)


def _init(model: ExtendedKalman, key: AnyKey) -> Belief:
    del key
    prior = model.prior
    if isinstance(prior, GaussianRoot) and prior.root.shape[1] != prior.root.shape[0]:
        return GaussianRoot(prior.mean, linalg.tria(prior.root))
    return prior


def _predict(model: ExtendedKalman, key: AnyKey, belief: Belief, inputs: PyTree) -> Belief:
    del key
    checks.state(belief, model.prior)
    ahead = _ahead if dimension(belief) > factor.UNROLLED else batch_last(_ahead)
    return ahead(model, belief, inputs)


def _ahead(model: ExtendedKalman, belief: Belief, inputs: PyTree) -> Belief:
    origin, step = model.linear_transition(belief, inputs)
    noise = model.process_noise_of(belief, inputs)
    ahead = model.arithmetic.predict(increments(belief), step.F, noise, step.value, step.residual_root)
    # The mean is that of the step; F times a mean of zeros would be computed.
    return retract_belief(model.manifold, origin, with_mean(ahead, step.value))


def _update(
    model: ExtendedKalman, key: AnyKey, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    del key
    checks.state(belief, model.prior)
    is_emission = isinstance(model.observe, Emission)
    y = observation if is_emission else as_observation(observation).y
    small = max(dimension(belief), *map(jnp.size, jax.tree.leaves(y))) <= factor.UNROLLED
    update = _conditioned_on_emission if is_emission else _conditioned
    return (batch_last(update) if small else update)(model, belief, observation, inputs)


def _conditioned_on_emission(
    model: ExtendedKalman, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    posterior, report = emission_update(
        model.observe, *model._about(belief), observation, inputs, model.linearize, model.arithmetic, model.iterations
    )
    return posterior if model.manifold.flat else retract_belief(model.manifold, belief.mean, posterior), report


def _conditioned(
    model: ExtendedKalman, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    measured = as_observation(observation)
    own_noise, linearize = measured.noise, model.linearize
    if isinstance(model.observe, NonAdditiveNoise):
        noise = model.observation_noise_of(belief, inputs) if own_noise is None else own_noise
        if own_noise is not None:
            checks.noise_shape("Observation.noise", own_noise, None, is_root=isinstance(belief, GaussianRoot))
        observe = model.observe.at(inputs, noise.shape[0], belief.mean.dtype)
        linearize, noise = Augmented(noise, linearize), no_noise(belief, measured.y.size)
        measured = measured._replace(noise=None)
    else:
        observe = lambda x: model.observe(x, inputs)
        noise = model.observation_noise_of(belief, inputs) if own_noise is None else own_noise
    return condition(
        belief,
        measured,
        observe,
        noise,
        linearize=linearize,
        arithmetic=model.arithmetic,
        residual=model.residual,
        manifold=model.manifold,
        iterations=model.iterations,
        iterate_to=model.iterate_to,
    )


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
    iterate_to: Literal["mean", "mode"] = "mean",
) -> tuple[Gaussian | GaussianRoot, KalmanInfo]:
    r"""Belief after an observation that is linearised at any point, and the diagnostics of the update.

    With $H = \partial h / \partial x$ at $\bar x$ and the predicted mean $\tilde x$, the innovation is
    $(y \ominus h(\bar x)) - H (\tilde x - \bar x)$; it, not the prediction, depends on where h is linearised
    (N. Shimada et al., "Shape and pose estimation of an articulated object", 1997, equation 19, where
    $\bar x = \tilde x$).

    Args:
        belief: The predicted belief.
        measured: The observation.
        observe: `x -> y`, without noise.
        noise: Covariance of the observation noise, (m, m), or a root of it, (m, any width), unless `measured` has its
            own.
        at: Point at which h is linearised, (n,); `None` is the predicted mean. Several hypotheses about one prediction
            differ in nothing else.
        linearize: As for `extended_kalman`, like all that follow.
        arithmetic: Arithmetic of the update.
        residual: `(y, y_hat) -> y - y_hat`.
        manifold: Space of the states.
        iterations: Steps of the update.
        iterate_to: The point that they approach.

    Returns:
        The belief, and a `KalmanInfo`.

    Raises:
        ValueError: If shapes do not fit one another.
        TypeError: If an argument is of another kind.
    """
    y, mask, own_noise = as_observation(measured)
    name, noise = ("observation_noise", noise) if own_noise is None else ("Observation.noise", own_noise)
    is_root = isinstance(belief, GaussianRoot)
    if at is not None:
        checks.shaped("at", at, belief.mean.shape, ", that of the mean")
    point = (lambda x: x) if manifold.flat else (lambda delta: manifold.retract(belief.mean, delta))
    start = belief.mean if manifold.flat else jnp.zeros(dimension(belief), belief.mean.dtype)
    measurement = Measurement(
        belief,
        start,
        y,
        mask,
        noise,
        lambda coordinates, *r: checks.predicted(observe(point(coordinates), *r), y, name, noise, is_root=is_root),
        residual if is_difference(residual) else checks.residual_of(residual),
        linearize,
        arithmetic,
    )
    offset = None if at is None else manifold.local(belief.mean, at)
    if iterations == 1:
        posterior, report, _ = linear_update(measurement, offset)
    else:
        posterior, report = iterated_update(measurement, offset, iterations, iterate_to == "mean")
    if manifold.flat:
        return posterior, report
    # What the arithmetic sees is an increment, which is finite about any mean.
    log_evidence = jnp.where(jnp.all(jnp.isfinite(belief.mean)), report.log_evidence, -jnp.inf)
    return retract_belief(manifold, belief.mean, posterior), replace(report, log_evidence=log_evidence)
