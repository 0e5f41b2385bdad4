"""The Kalman filter of a linear Gaussian model, given by its matrices."""

from dataclasses import field

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float, Num, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, as_observation
from jaxfilters.gaussian.linearize import Linearization
from jaxfilters.gaussian.manifold import Belief, Manifold, dimension, euclidean
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey


@pytree_dataclass
class Kalman:
    """Parameters of a Kalman filter; a `GaussianModel`."""

    prior: Belief
    F: Float[Array, "..."]
    """(n, n)."""
    Q: Float[Array, "..."]
    """(n, n), or (n, any) where the arithmetic takes roots."""
    H: Float[Array, "..."]
    """(m, n)."""
    R: Float[Array, "..."]
    """(m, m), or (m, any) where the arithmetic takes roots."""
    b: Float[Array, "..."] | None
    """(n,)."""
    d: Float[Array, "..."] | None
    """(m,)."""
    arithmetic: Arithmetic = field(metadata={"static": True})

    @property
    def manifold(self) -> Manifold:
        """Vectors."""
        return euclidean

    @property
    def observation_noise(self) -> Array:
        """R."""
        return self.R

    @property
    def process_noise(self) -> Array:
        """Q."""
        return self.Q

    def transition(self, x: Float[Array, " n"], control: PyTree) -> Float[Array, " n"]:
        """F x + b."""
        _refuse(control)
        return factor.apply(self.F, x) if self.b is None else factor.apply(self.F, x) + self.b

    def linear_transition(self, belief: Belief, control: PyTree) -> tuple[Array, Linearization]:
        """The predicted mean, and F about it."""
        ahead = self.transition(belief.mean, control)
        return ahead, Linearization(jnp.zeros_like(ahead), self.F, jnp.zeros((ahead.size, 0), ahead.dtype))

    def process_noise_of(self, control: PyTree) -> Array:
        """Q."""
        _refuse(control)
        return self.Q


def kalman(
    prior: Gaussian | GaussianRoot,
    F: Num[ArrayLike, "..."],
    Q: Num[ArrayLike, "..."],
    H: Num[ArrayLike, "..."],
    R: Num[ArrayLike, "..."],
    *,
    b: Num[ArrayLike, "..."] | None = None,
    d: Num[ArrayLike, "..."] | None = None,
    arithmetic: Arithmetic = arithmetics.joseph,
) -> Filter:
    """Kalman filter of `x' = F x + b + q`, `y = H x + d + r` with `q ~ N(0, Q)` and `r ~ N(0, R)`.

    Observations are arrays `y` with m components, NaN where nothing was read, or `Observation(y, mask, noise)`. The
    state is the belief, and the info a `KalmanInfo` (R. Kalman, "A new approach to linear filtering and prediction
    problems", J. Basic Eng. 82(1), 1960). `smoothing.rts` smooths what it found. For matrices that change with time,
    use `extended_kalman`, whose transition takes a control.

    Args:
        prior: Belief before the first observation, which is predicted once before it is updated: a `Gaussian`, or a
            `GaussianRoot` for `arithmetic.square_root`.
        F: Transition matrix, (n, n).
        Q: Covariance of the process noise, (n, n); a root of it, (n, any width), for `arithmetic.square_root`.
        H: Observation matrix, (m, n).
        R: Covariance of the observation noise, (m, m); a root of it, (m, any width), for `arithmetic.square_root`.
        b: Known change of the state in every step, (n,); none by default.
        d: Known offset of the observation, (m,); none by default.
        arithmetic: `jaxfilters.arithmetic.joseph`, `square_root` or `fast`.

    Returns:
        The filter.

    Raises:
        ValueError: If shapes do not fit one another, the prior does not fit the arithmetic, or a covariance is not
            symmetric and positive semidefinite (tested where its values are known); when it runs, if an observation
            has another shape than `(m,)`, or a control is given.
        TypeError: If the prior is no belief.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
        >>> F, H = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[1.0, 0.0]])
        >>> filter = jf.kalman(prior, F, 0.01 * jnp.eye(2), H, 0.1 * jnp.eye(1))
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((20, 1)))
        >>> beliefs.mean.shape, infos.log_evidence.shape
        ((20, 2), (20,))
    """
    checks.arithmetic_of(prior, arithmetic)
    dtype = prior.mean.dtype
    F, Q, H, R = (_floating(matrix, dtype) for matrix in (F, Q, H, R))
    b, d = (None if offset is None else _floating(offset, dtype) for offset in (b, d))
    n, m = prior.mean.shape[0], H.shape[0] if H.ndim else 0
    for name, value, shape in (("F", F, (n, n)), ("H", H, (m, n)), ("b", b, (n,)), ("d", d, (m,))):
        if value is not None:
            checks.shaped(name, value, shape, f", as the prior has {n} components and H {m} rows")
    is_root = isinstance(prior, GaussianRoot)
    checks.noise("Q", Q, n, is_root=is_root)
    checks.noise("R", R, m, is_root=is_root)
    return Filter(Kalman(prior, F, Q, H, R, b, d, arithmetic), _init, _predict, _update)


def _init(model: Kalman, key: AnyKey) -> Belief:
    del key
    prior = model.prior
    if isinstance(prior, GaussianRoot) and prior.root.shape[1] != prior.root.shape[0]:
        return GaussianRoot(prior.mean, linalg.tria(prior.root))
    return prior


def _predict(model: Kalman, key: AnyKey, belief: Belief, control: PyTree) -> Belief:
    del key
    _refuse(control)
    checks.state(belief, model.prior)
    predict = _predicted if dimension(belief) > factor.UNROLLED else batch_last(_predicted)
    return predict(model, belief)


def _predicted(model: Kalman, belief: Belief) -> Belief:
    return model.arithmetic.predict(belief, model.F, model.Q, 0.0 if model.b is None else model.b)


def _update(model: Kalman, key: AnyKey, belief: Belief, observation: PyTree) -> tuple[Belief, KalmanInfo]:
    del key
    checks.state(belief, model.prior)
    observation = as_observation(observation)
    m, n = model.H.shape
    checks.shaped("the observation y", observation.y, (m,), f", as H has {m} rows")
    if observation.noise is not None:
        checks.noise_shape("Observation.noise", observation.noise, m, is_root=isinstance(belief, GaussianRoot))
    update = _updated if max(m, n) > factor.UNROLLED else batch_last(_updated)
    return update(model, belief, observation)


def _updated(model: Kalman, belief: Belief, observation: Observation) -> tuple[Belief, KalmanInfo]:
    y, mask, noise = observation
    y_hat = None if model.d is None else factor.apply(model.H, belief.mean) + model.d
    return model.arithmetic.update(belief, y, model.H, model.R if noise is None else noise, y_hat, mask)


def _refuse(control: PyTree) -> None:
    if jax.tree.leaves(control):
        raise ValueError(
            "control must be None for a filter made by kalman, whose model has no input; extended_kalman has one."
        )


def _floating(matrix: ArrayLike, dtype: DTypeLike) -> Array:
    matrix = jnp.asarray(matrix)
    return matrix if jnp.issubdtype(matrix.dtype, jnp.floating) else matrix.astype(dtype)
