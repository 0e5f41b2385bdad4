r"""Gaussian filters for observations whose noise is correlated in time: the lasting part is a part of the state.

$$y_t = h(x_t) + G b_t + r_t,\qquad r_t \sim N(0, R),$$

with a Gauss-Markov process b, `GaussMarkov`. The belief is about x and b together (A. E. Bryson and D. E. Johansen,
"Linear filtering for time-varying systems using measurements containing colored noise", IEEE Transactions on Automatic
Control 10(1), 1965). Where R is zero, `measurement_differencing` gives the same without the additional state.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman, as_observation
from jaxfilters.gaussian.gauss_markov import GaussMarkov, as_matrix, check_process, rooted
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.gaussian.linearize import Linearization
from jaxfilters.gaussian.manifold import Belief, Manifold, dimension, euclidean, increments, retract_belief, with_mean
from jaxfilters.gaussian.measurement_update import is_difference
from jaxfilters.gaussian.noise_models import Augmented, NonAdditiveNoise, no_noise
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, only_inputs


@pytree_dataclass
class CorrelatedNoise:
    """Parameters of a filter made by `correlated_noise`; a `GaussianModel`. The arguments of the builder describe them.

    The first components of the state are those of `inner`, the last ones are the lasting errors b.
    """

    inner: Any
    """The parameters of the filter without lasting errors."""
    noise: GaussMarkov
    loading: Any
    """(m, k), a function of the inputs, or None for the identity."""
    dt: Any
    """A number, or a function of the inputs."""

    @property
    def prior(self) -> Belief:
        """Independent: that of the filter without errors, and the stationary one of the errors."""
        x, b = self.inner.prior, self.noise.prior()
        mean = jnp.concatenate([x.mean, b.mean.astype(x.mean.dtype)])
        if isinstance(x, GaussianRoot):
            return GaussianRoot(mean, block_diag(linalg.tria(x.root), rooted(self.noise.covariance)))
        return Gaussian(mean, block_diag(x.covariance, b.covariance))

    @property
    def manifold(self) -> Manifold:
        """That of the filter without errors, beside vectors."""
        inner = self.inner.manifold
        if inner.flat:
            return euclidean
        joint = _Beside(inner, self.inner.prior.mean.shape[0], dimension(self.inner.prior))
        return Manifold(joint.retract, joint.local)

    @property
    def arithmetic(self) -> Arithmetic:
        """That of the filter without errors."""
        return self.inner.arithmetic

    @property
    def observation_noise(self) -> Any:
        """The white part, R."""
        return self.inner.observation_noise

    def linear_transition(self, belief: Belief, inputs: PyTree) -> tuple[Array, Linearization]:
        """The predicted mean, and the transition as a linear function of increments."""
        origin, step = self.inner.linear_transition(self.own(belief), self.inputs_of_inner(inputs))
        decay = self.noise.decay_matrix(self.dt_of(inputs))
        ahead = jnp.concatenate([origin, factor.apply(decay, self.errors(belief.mean))])
        k = self.noise.size
        value = jnp.pad(step.value, (0, k))
        return ahead, Linearization(value, block_diag(step.F, decay), jnp.pad(step.residual_root, ((0, k), (0, 0))))

    def process_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """Process noise of the filter without errors, beside that of the errors."""
        own = self.inner.process_noise_of(self.own(belief), self.inputs_of_inner(inputs))
        added = self.noise.added(self.dt_of(inputs))
        return block_diag(own, rooted(added) if isinstance(belief, GaussianRoot) else as_matrix(added))

    def observation_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """The white part of one step."""
        return self.inner.observation_noise_of(self.own(belief), self.inputs_of_inner(inputs))

    def own(self, belief: Belief) -> Belief:
        """Belief about the state without errors."""
        n, d = self.inner.prior.mean.shape[0], dimension(self.inner.prior)
        if isinstance(belief, GaussianRoot):
            return GaussianRoot(belief.mean[:n], belief.root[:d])
        return Gaussian(belief.mean[:n], belief.covariance[:d, :d])

    def errors(self, mean: Float[Array, " size"]) -> Float[Array, " k"]:
        """The lasting errors of a state."""
        return mean[self.inner.prior.mean.shape[0] :]

    def loading_of(self, inputs: PyTree, rows: int, dtype: Any) -> Float[Array, "m k"]:
        """How the errors enter the observation of one step."""
        if self.loading is None:
            G = jnp.asarray(factor.identity(self.noise.size, dtype))
        else:
            G = self.loading(inputs) if callable(self.loading) else self.loading
        why = f", a row for each of the {rows} of the observation and a column for each error"
        checks.shaped("loading (the identity where it is None)", G, (rows, self.noise.size), why)
        return G

    def inputs_of_inner(self, inputs: PyTree) -> PyTree:
        """The inputs that the filter without errors takes: none where the errors alone have a use for them."""
        is_ours = callable(self.dt) or callable(self.loading)
        constant = isinstance(self.inner, Kalman) and not any(map(callable, self.inner.given()))
        return None if is_ours and constant else inputs

    def dt_of(self, inputs: PyTree) -> Array:
        """Length of one step."""
        found = self.dt(inputs) if callable(self.dt) else self.dt
        if jnp.shape(found) != ():
            raise ValueError(f"dt must be one number for each step; got the shape {jnp.shape(found)}.")
        return jnp.asarray(found, self.noise.covariance.dtype)


@pytree_dataclass
class _Beside:
    """A manifold of points of `size` numbers, beside vectors."""

    manifold: Manifold
    size: int = field(metadata={"static": True})
    dimension: int = field(metadata={"static": True})

    def retract(self, x: Array, delta: Array) -> Array:
        moved = self.manifold.retract(x[: self.size], delta[: self.dimension])
        return jnp.concatenate([moved, x[self.size :] + delta[self.dimension :]])

    def local(self, x: Array, other: Array) -> Array:
        delta = self.manifold.local(x[: self.size], other[: self.size])
        return jnp.concatenate([delta, other[self.size :] - x[self.size :]])


def correlated_noise(
    inner: Filter,
    noise: GaussMarkov,
    *,
    dt: ArrayLike | Callable = 1.0,
    loading: Float[Array, "m k"] | Callable | None = None,
) -> Filter:
    r"""Gaussian filter `inner` for observations with errors that last: $y_t = h(x_t) + G b_t + r_t$.

    A filter that takes lasting errors for white noise becomes certain of the wrong value; one that inflates its white
    noise is too uncertain of what changes faster than the errors do. Here the errors b are a Gauss-Markov process and
    part of the state. The state of the filter is a belief like that of `inner` with k more components at the end;
    `belief.marginal(range(n))` is that about x. Rows of an observation that are missing tell nothing, and their errors
    only decay. The function h alone is linearised, over the belief about x: h is evaluated as often as in `inner`.

    With an infinite time constant the errors are constant biases, e.g. of a calibration. Where only the repetition of a
    view would tell of them, `jf.schmidt_kalman` around this filter keeps their covariance as it is.

    Args:
        inner: Filter made by `kalman`, `extended_kalman`, `unscented_kalman` or `cubature_kalman`, of any arithmetic
            and manifold, with one iteration. Its observation noise R is the white part; it may be zero.
        noise: The process of the errors, with k components, whose time constants have the unit of `dt`.
        dt: Length of a step, or a function `inputs -> length`.
        loading: Matrix G, (m, k), or a function `inputs -> G`; `None` is the identity, one error for each row. A matrix
            with fewer columns than rows describes errors that several rows share.

    Returns:
        The filter, whose info is a `KalmanInfo`; smoothers and wrappers take it as they take `inner`.

    Raises:
        ValueError: If `inner` is another kind of filter, a time constant is not positive, a covariance is not possible,
            or shapes do not fit one another.
        TypeError: If an argument is of another kind.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), 100.0 * jnp.eye(1))
        >>> inner = jf.kalman(prior, jnp.eye(1), 0.01 * jnp.eye(1), jnp.ones((2, 1)), 0.1 * jnp.eye(2))
        >>> filter = jf.correlated_noise(inner, jf.GaussMarkov(jnp.array(50.0), jnp.array([1.0, 1.0])))
        >>> ys = jnp.broadcast_to(jnp.array([0.5, -0.5]), (30, 2))
        >>> white, _ = jf.run(inner, jax.random.key(0), ys)
        >>> lasting, _ = jf.run(filter, jax.random.key(0), ys)
        >>> [round(float(belief.covariance[0, 0]) ** 0.5, 2) for belief in (white, lasting)]
        [0.13, 0.67]
    """
    checks.is_filter("inner", inner)
    check_inner(inner.params)
    check_process("noise", noise)
    check_dt(dt)
    dt = only_inputs("dt", dt) if callable(dt) else dt
    if callable(loading):
        loading = only_inputs("loading", loading)
    elif loading is not None:
        checks.floating("loading", loading)
        if loading.ndim != 2 or loading.shape[1] != noise.size:
            raise ValueError(f"loading must be a matrix with {noise.size} columns; got the shape {loading.shape}.")
    return Filter(CorrelatedNoise(inner.params, noise, loading, dt), _init, _predict, _update)


def check_inner(model: Any) -> None:
    """Raise an error unless a model is one whose observation noise can have a lasting part."""
    if not isinstance(model, Kalman | ExtendedKalman):
        raise ValueError(
            "inner must be made by kalman, extended_kalman, unscented_kalman or cubature_kalman; "
            f"its parameters are {type(model).__name__}."
        )
    if model.observation_noise is None:
        raise ValueError("inner must have Gaussian observation noise; it has an emission.")
    if isinstance(model, ExtendedKalman) and model.iterations > 1:
        raise ValueError(f"inner must have one iteration; got iterations={model.iterations}.")


def check_dt(dt: Any) -> None:
    """Raise an error unless a length of a step is a function, or one number of at least zero."""
    if callable(dt):
        return
    if jnp.shape(dt) != ():
        raise ValueError(f"dt must be one number, or a function of the inputs; got the shape {jnp.shape(dt)}.")
    known = checks.concrete(dt)
    if known is not None and not 0 <= known < float("inf"):
        raise ValueError(f"dt must be zero or positive and finite; got {dt}.")


def _init(model: CorrelatedNoise, key: AnyKey) -> Belief:
    del key
    return model.prior


def _predict(model: CorrelatedNoise, key: AnyKey, belief: Belief, inputs: PyTree) -> Belief:
    del key
    checks.state(belief, model.prior)
    if isinstance(belief, GaussianRoot):
        origin, step = model.linear_transition(belief, inputs)
        Q = model.process_noise_of(belief, inputs)
        ahead = model.arithmetic.predict(increments(belief), step.F, Q, step.value, step.residual_root)
        return retract_belief(model.manifold, origin, with_mean(ahead, step.value))
    # Rounding leaves P not quite symmetric. What an update contracts as a whole may grow in the blocks that are treated
    # apart below, until P is indefinite: only a P that is symmetric may be taken apart.
    belief = Gaussian(belief.mean, 0.5 * (belief.covariance + belief.covariance.T))
    dt, own, inner_inputs = model.dt_of(inputs), model.own(belief), model.inputs_of_inner(inputs)
    origin, step = model.inner.linear_transition(own, inner_inputs)
    Q = model.inner.process_noise_of(own, inner_inputs)
    x = model.arithmetic.predict(increments(own), step.F, Q, step.value, step.residual_root).covariance
    P, d, decay = belief.covariance, dimension(own), model.noise.decay(dt)
    # Independent time constants are factors of rows and columns: no product of matrices for the largest block.
    if decay.ndim == 1:
        cross = linalg.matmul(step.F, P[:d, d:]) * decay
        errors = P[d:, d:] * decay * decay[:, None]
    else:
        cross = factor.outer(linalg.matmul(step.F, P[:d, d:]), decay)
        errors = factor.turned(decay, P[d:, d:])
    errors = errors + as_matrix(model.noise.added(dt))
    covariance = jnp.block([[x, cross], [cross.T, errors]])
    b = factor.apply(decay, model.errors(belief.mean)) if decay.ndim == 2 else decay * model.errors(belief.mean)
    value = jnp.pad(step.value, (0, model.noise.size))
    ahead = Gaussian(value, covariance)
    return retract_belief(model.manifold, jnp.concatenate([origin, b]), ahead)


def _update(
    model: CorrelatedNoise, key: AnyKey, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    del key
    checks.state(belief, model.prior)
    y, mask, own_noise = as_observation(observation)
    own, inner = model.own(belief), model.inner
    linear, y, R = observed_linearly(inner, own, y, own_noise, model.inputs_of_inner(inputs))
    G = model.loading_of(inputs, y.shape[0], belief.mean.dtype)
    y_hat = linear.value + factor.apply(G, model.errors(belief.mean))
    flat = inner.manifold.flat
    start = belief.mean if flat else jnp.zeros(dimension(belief), belief.mean.dtype)
    posterior, info = inner.arithmetic.update(
        with_mean(belief, start), y, jnp.hstack([linear.F, G]), R, y_hat, mask, linear.residual_root
    )
    return posterior if flat else retract_belief(model.manifold, belief.mean, posterior), info


def observed_linearly(
    inner: Kalman | ExtendedKalman, own: Belief, y: Float[Array, " m"], own_noise: Array | None, inputs: PyTree
) -> tuple[Linearization, Float[Array, " m"], Array]:
    """The prediction of an observation as a linear function of coordinates, the observation, and its white noise.

    The coordinates are those of the state, or on a manifold increments from its mean. Where residuals are no
    differences, the prediction and the observation are both residuals from the one at the mean.
    """
    m, is_root = y.shape[0], isinstance(own, GaussianRoot)
    R = inner.observation_noise_of(own, inputs) if own_noise is None else own_noise
    if isinstance(inner, Kalman):
        step = inner.matrices(inputs)
        checks.shaped("the observation y", y, step.H.shape[:1], f", as H has {step.H.shape[0]} rows")
        checks.noise_shape("the observation noise", R, m, is_root=is_root)
        y_hat = factor.apply(step.H, own.mean)
        return Linearization(y_hat if step.d is None else y_hat + step.d, step.H, jnp.zeros((m, 0), y_hat.dtype)), y, R
    observe, linearize = lambda x: inner.observe(x, inputs), inner.linearize
    if isinstance(inner.observe, NonAdditiveNoise):
        checks.noise_shape("the observation noise", R, None, is_root=is_root)
        observe, linearize = inner.observe.at(inputs, R.shape[0], own.mean.dtype), Augmented(R, linearize)
        R = no_noise(own, m)
    coordinates, point = inner._about(own)
    predict = lambda at, *r: checks.predicted(observe(point(at), *r), y, "observation_noise", R, is_root=is_root)
    if is_difference(inner.residual):
        return linearize(predict, coordinates), y, R
    residual = checks.residual_of(inner.residual)
    reference = predict(coordinates.mean)
    linear = linearize(lambda at, *r: residual(predict(at, *r), reference), coordinates)
    read = jnp.isfinite(y)
    return linear, jnp.where(read, residual(jnp.where(read, y, 0.0), reference), jnp.nan), R
