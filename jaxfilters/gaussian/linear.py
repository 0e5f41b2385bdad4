"""The Kalman filter of a linear Gaussian model, given by its matrices."""

from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation
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

    def linear_transition(self, belief: Belief, control: PyTree) -> tuple[Array, Linearization]:
        """The predicted mean, and F about it."""
        _refuse(control)
        ahead = factor.apply(self.F, belief.mean)
        nothing = jnp.zeros((ahead.size, 0), ahead.dtype)
        linear = Linearization(jnp.zeros_like(ahead), self.F, nothing)
        return (ahead if self.b is None else ahead + self.b), linear

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

    Raises:
        ValueError: If shapes do not fit one another, the prior does not fit the arithmetic, or a covariance is not
            symmetric and positive semidefinite (tested where its values are known); when it runs, if an observation
            has another shape than `(m,)`, or a control is given.
    """
    _check_prior(prior, arithmetic)
    dtype = prior.mean.dtype
    F, Q, H, R = (_floating(matrix, dtype) for matrix in (F, Q, H, R))
    b, d = (None if offset is None else _floating(offset, dtype) for offset in (b, d))
    n, m = prior.mean.shape[0], jnp.shape(H)[0] if jnp.ndim(H) else 0
    _check_shape("F", F, (n, n), f"the prior has {n} components")
    _check_shape("H", H, (m, n), f"the prior has {n} components")
    if b is not None:
        _check_shape("b", b, (n,), f"the prior has {n} components")
    if d is not None:
        _check_shape("d", d, (m,), f"H has {m} rows")
    for name, noise, size in (("Q", Q, n), ("R", R, m)):
        if isinstance(prior, GaussianRoot):
            _check_root(name, noise, size)
        else:
            _check_covariance(name, noise, size)
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
    predict = _predicted if dimension(belief) > factor.UNROLLED else batch_last(_predicted)
    return predict(model, belief)


def _predicted(model: Kalman, belief: Belief) -> Belief:
    return model.arithmetic.predict(belief, model.F, model.Q, 0.0 if model.b is None else model.b)


def _update(model: Kalman, key: AnyKey, belief: Belief, observation: PyTree) -> tuple[Belief, KalmanInfo]:
    del key
    observation = observation if isinstance(observation, Observation) else Observation(observation)
    m, n = model.H.shape
    _check_shape("observation", observation.y, (m,), f"H has {m} rows")
    if observation.mask is not None:
        _check_shape("observation.mask", observation.mask, (m,), f"H has {m} rows")
    if observation.noise is not None and jnp.shape(observation.noise)[:1] != (m,):
        raise ValueError(f"observation.noise must have {m} rows, as H has; got shape {jnp.shape(observation.noise)}.")
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


def _floating(matrix: ArrayLike, dtype: np.dtype) -> Array:
    matrix = jnp.asarray(matrix)
    return matrix if jnp.issubdtype(matrix.dtype, jnp.floating) else matrix.astype(dtype)


def _check_prior(prior: Belief, arithmetic: Arithmetic) -> None:
    if not isinstance(prior, arithmetic.Belief):
        raise ValueError(
            f"prior must be a {arithmetic.Belief.__name__} for {arithmetic.__name__}; got a {type(prior).__name__}."
        )
    if jnp.ndim(prior.mean) != 1:
        raise ValueError(f"prior must have a mean of shape (n,); got {jnp.shape(prior.mean)}.")
    if isinstance(prior, Gaussian):
        _check_covariance("prior.covariance", prior.covariance, prior.mean.shape[0])
    else:
        _check_root("prior.root", prior.root, prior.mean.shape[0])


def _check_shape(name: str, value: ArrayLike, shape: tuple[int, ...], reason: str) -> None:
    if jnp.shape(value) != shape:
        raise ValueError(f"{name} must have shape {shape}, as {reason}; got {jnp.shape(value)}.")


def _check_root(name: str, root: Array, size: int) -> None:
    if jnp.ndim(root) != 2 or jnp.shape(root)[0] != size:
        raise ValueError(f"{name} must be a root of a covariance, ({size}, any width); got shape {jnp.shape(root)}.")


def _check_covariance(name: str, covariance: Array, size: int) -> None:
    if jnp.shape(covariance) != (size, size):
        raise ValueError(f"{name} must be a covariance, ({size}, {size}); got shape {jnp.shape(covariance)}.")
    if isinstance(covariance, jax.core.Tracer):
        return
    values = np.asarray(covariance, np.float64)
    rounding = 1e3 * size * float(jnp.finfo(jnp.asarray(covariance).dtype).eps) * np.max(abs(values), initial=0.0)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} must be finite; got {covariance}.")
    if np.max(abs(values - values.T), initial=0.0) > rounding:
        raise ValueError(
            f"{name} must be symmetric; it differs by {np.max(abs(values - values.T)):.3g} from its transpose."
        )
    lowest = np.min(np.linalg.eigvalsh(values), initial=0.0)
    if lowest < -rounding:
        raise ValueError(f"{name} must be positive semidefinite; its least eigenvalue is {lowest:.3g}.")
