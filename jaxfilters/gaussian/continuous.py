r"""Continuous-discrete extended Kalman filter: a stochastic differential equation, observed at points in time.

$$dx = f(x, u)\,dt + L(x)\,dw,\qquad y_k = h(x(t_k)) + r_k,\ r_k \sim N(0, R).$$

Between observations the mean and the covariance follow $\dot m = f(m)$, $\dot P = J P + P J^T + L L^T$ with the
Jacobian J of f at m (A. H. Jazwinski, "Stochastic Processes and Filtering Theory", 1970, section 9.3). The solution is
$P(t) = \Phi P \Phi^T + \Sigma$ with $\dot\Phi = J \Phi$, which is integrated together with the mean. $\Sigma$ is the
integral of $\Phi(t, s) L L^T \Phi(t, s)^T$ by Simpson's rule on each interval: a sum of squares, which no error of
the integration can make indefinite.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman, extended_kalman
from jaxfilters.gaussian.linearize import Linearization
from jaxfilters.gaussian.manifold import Belief, Manifold, with_mean
from jaxfilters.gaussian.measurement_update import subtract
from jaxfilters.motion.discretization import product, step_length
from jaxfilters.motion.flow import Integrate, rk4
from jaxfilters.typing import AnyKey, as_pytree, only_inputs, taking_inputs

_WEIGHTS = (1 / 6, 4 / 6, 1 / 6)
"""Of Simpson's rule at the begin, the middle and the end of an interval."""


@pytree_dataclass
class ContinuousExtendedKalman:
    """Parameters of a filter made by `continuous_extended_kalman`; a `GaussianModel`."""

    discrete: Filter
    """An extended Kalman filter with the same prior and observations, which updates."""
    drift: Callable
    diffusion: Array | Callable
    duration: Callable
    integrate: Integrate = field(metadata={"static": True})
    num_intervals: int = field(metadata={"static": True})

    @property
    def _model(self) -> ExtendedKalman:
        return self.discrete.params

    @property
    def prior(self) -> Belief:
        """Belief before the first observation."""
        return self._model.prior

    @property
    def manifold(self) -> Manifold:
        """Vectors."""
        return self._model.manifold

    @property
    def arithmetic(self) -> Arithmetic:
        """Whether beliefs are written as covariances or as roots of them."""
        return self._model.arithmetic

    def observation_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """Covariance of the observation noise, or a root of it."""
        return self._model.observation_noise_of(belief, inputs)

    def process_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """None beside that of `linear_transition`, which depends on where the belief is."""
        return self._model.process_noise_of(belief, inputs)

    def linear_transition(self, belief: Belief, inputs: PyTree) -> tuple[Array, Linearization]:
        """Where the mean goes, the Jacobian of the flow there, and a root of the noise that has come on top."""
        x = belief.mean
        h = step_length(self.duration(inputs), x.dtype) / self.num_intervals
        rate = lambda x: _checked_drift(self.drift(x, inputs), x)

        def field(y: tuple[Array, Array]) -> tuple[Array, Array]:
            return rate(y[0]), jax.vmap(lambda v: jax.jvp(rate, y[:1], (v,))[1], in_axes=-1, out_axes=-1)(y[1])

        def interval(x: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            eye = jnp.eye(x.size, dtype=x.dtype)
            middle, first = self.integrate(field, (x, eye), 0.5 * h)
            end, second = self.integrate(field, (middle, eye), 0.5 * h)
            flow = product(second, first)
            parts = [product(to_end, self._noise(at)) for to_end, at in ((flow, x), (second, middle), (eye, end))]
            weighted = [weight**0.5 * part for weight, part in zip(_WEIGHTS, parts, strict=True)]
            return end, (flow, jnp.concatenate(weighted, axis=1))

        def compose(to_end: Array, piece: tuple[Array, Array]) -> tuple[Array, Array]:
            flow, noise = piece
            return product(to_end, flow), product(to_end, noise)

        ahead, pieces = jax.lax.scan(interval, x, length=self.num_intervals)
        flow, roots = jax.lax.scan(compose, jnp.eye(x.size, dtype=x.dtype), pieces, reverse=True)
        # A root of zero has an infinite derivative, and a step of no length no noise.
        scale = jnp.where(h == 0, 0.0, jnp.sqrt(jnp.where(h == 0, 1.0, h)))
        root = scale * jnp.moveaxis(roots, 0, 1).reshape(x.size, -1)
        return ahead, Linearization(jnp.zeros_like(ahead), flow, root)

    def _noise(self, x: Array) -> Array:
        if not callable(self.diffusion):
            return self.diffusion.astype(x.dtype)
        L = self.diffusion(x)
        checks.noise_shape("the result of diffusion", L, x.size, is_root=True)
        return L


def same(inputs: PyTree) -> PyTree:
    """The inputs themselves."""
    return inputs


def continuous_extended_kalman(
    prior: Gaussian | GaussianRoot,
    drift: Callable[..., Float[Array, " n"]],
    diffusion: Array | Callable[[Float[Array, " n"]], Float[Array, "n k"]],
    observe: Callable[..., Float[Array, " m"]],
    observation_noise: Array | Callable[..., Array],
    *,
    duration: Callable[[PyTree], Array] = same,
    integrate: Integrate | None = None,
    num_intervals: int = 4,
    arithmetic: Arithmetic = arithmetics.joseph,
    residual: Callable[[Array, Array], Array] = subtract,
    iterations: int = 1,
    iterate_to: Literal["mean", "mode"] = "mean",
) -> Filter:
    r"""Continuous-discrete extended Kalman filter of `dx = drift dt + diffusion dw`, observed at points in time.

    The moments are integrated inside the filter's scan. Pass the lengths of the steps as the inputs of `jf.run`; a step
    of zero length changes nothing. `smoothing.rts` and the wrappers of Gaussian filters take it.
    A. H. Jazwinski, "Stochastic Processes and Filtering Theory", 1970, section 9.3.

    Args:
        prior: Belief before the first step, with a mean of shape (n,), a `Gaussian` or, for
            `jf.arithmetic.square_root`, a `GaussianRoot`.
        drift: `(x, inputs) -> dx/dt` or `x -> dx/dt`, (n,) to (n,), per unit of time.
        diffusion: Root L of the spectral density of the noise, (n, k): `L @ L.T` is the covariance that it adds per
            unit of time; or a function `x -> L`.
        observe: `x -> y` or `(x, inputs) -> y` without noise; (n,) to (m,).
        observation_noise: As for `extended_kalman`.
        duration: `inputs -> length of the step`, where inputs hold more than the length.
        integrate: `jf.motion.rk4(num_steps)`, one step by default, or `jf.motion.adaptive(...)`, which needs diffrax;
            what integrates over half an interval.
        num_intervals: Intervals of equal length into which a step is divided. Each has a point of the noise's integral
            at its ends and its middle; the error falls with the fourth power of the number.
        arithmetic: `jf.arithmetic.joseph`, `square_root` or `fast`.
        residual: `(y, y_hat) -> y - y_hat`, for observations that wrap around.
        iterations: Steps of every measurement update, as for `extended_kalman`.
        iterate_to: "mean" or "mode", as for `extended_kalman`.

    Returns:
        The filter; a negative length of a step that is known only when it runs makes its beliefs NaN.

    Raises:
        ValueError: If `num_intervals` is no integer of at least 1, `diffusion` has another number of rows than the
            state, a concrete step is negative, or as for `extended_kalman`.
        TypeError: If an argument is of another kind.

    Examples:
        A pendulum whose angle is read now and then.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> drift = lambda x: jnp.stack([x[1], -9.8 * jnp.sin(x[0])])
        >>> prior, R = jf.Gaussian(jnp.array([1.0, 0.0]), 0.1 * jnp.eye(2)), 0.01 * jnp.eye(1)
        >>> L = jnp.array([[0.0], [0.1]])
        >>> filter = jf.continuous_extended_kalman(prior, drift, L, lambda x: x[:1], R)
        >>> last, infos = jf.run(filter, jax.random.key(0), jnp.ones((3, 1)), jnp.array([0.1, 0.4, 0.2]))
        >>> last.mean.shape
        (2,)
    """
    if isinstance(num_intervals, bool) or not isinstance(num_intervals, int) or num_intervals < 1:
        raise ValueError(f"num_intervals must be an integer of at least 1; got {num_intervals!r}.")
    checks.arithmetic_of(prior, arithmetic)
    n = prior.mean.size
    integrate = rk4() if integrate is None else integrate
    checks.function("integrate", integrate)
    if not callable(diffusion):
        checks.noise("diffusion", diffusion, n, is_root=True)
    none = jnp.zeros((n, n), prior.mean.dtype)
    discrete = extended_kalman(
        prior,
        _stay,
        none,
        observe,
        observation_noise,
        arithmetic=arithmetic,
        residual=residual,
        iterations=iterations,
        iterate_to=iterate_to,
    )
    params = ContinuousExtendedKalman(
        discrete,
        taking_inputs("drift", drift, "x"),
        as_pytree(diffusion) if callable(diffusion) else diffusion,
        only_inputs("duration", duration),
        integrate,
        num_intervals,
    )
    return Filter(params, _init, _predict, _update)


def _stay(x):
    return x


def _checked_drift(rate, x):
    checks.shaped("the result of drift", rate, x.shape, ", that of the state")
    return rate


def _init(model: ContinuousExtendedKalman, key: AnyKey) -> Belief:
    return model.discrete.init(model.discrete.params, key)


def _predict(model: ContinuousExtendedKalman, key: AnyKey, belief: Belief, inputs: PyTree) -> Belief:
    del key
    checks.state(belief, model.prior)
    ahead, flow = model.linear_transition(belief, inputs)
    moved = model.arithmetic.predict(belief, flow.F, model.process_noise_of(belief, inputs), 0.0, flow.residual_root)
    return with_mean(moved, ahead)


def _update(
    model: ContinuousExtendedKalman, key: AnyKey, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    return model.discrete.update(model.discrete.params, key, belief, observation, inputs)
