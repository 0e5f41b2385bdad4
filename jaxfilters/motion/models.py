r"""Models of motion whose space dimensions are independent and move by one law.

The state is $x = (p, \dot p, \ddot p, \dots)$: first the d coordinates of the position, then the d coordinates of its
first derivative, and so on. With $F_1$ and $Q_1$ of one coordinate, $F = F_1 \otimes I_d$ and
$Q = Q_1 \otimes \operatorname{diag}(q_1, \dots, q_d)$. To order by coordinate, $(p_1, \dot p_1, \dots, p_2, \dots)$,
take `x.reshape(-1, d).T.ravel()`.
"""

import math
from collections.abc import Callable
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.motion.discretization import Step, product, step_length
from jaxfilters.motion.laws import Decay, DrivenByDecay, Matern, Wiener, matern_unit

_LARGEST_ORDER = 20
"""Of an integrated Wiener process: the factorials of twice the order are still exact in double precision."""


@pytree_dataclass
class Motion:
    """A model of motion, d coordinates that move by one law; made by the functions of `jf.motion`.

    Its leaves are its parameters, so that it is an argument of `jit` and `grad`.
    """

    law: Callable[[Array], Step]
    """`dt -> F_1, Q_1` of one coordinate with unit intensity, (..., k, k)."""
    intensity: Float[Array, "..."]
    """Factor of Q of each coordinate, () or (d,)."""
    stationary: Float[Array, "..."] | None
    """Covariance (k, k) of one coordinate in the stationary state with unit intensity, None where there is none."""
    num_derivatives: int = field(metadata={"static": True})
    """Derivatives in the state beside the position; k is one more."""
    dims: int = field(metadata={"static": True})
    """Number d of space dimensions."""

    @property
    def size(self) -> int:
        """Length n of the state, d (1 + `num_derivatives`)."""
        return self.dims * (1 + self.num_derivatives)

    @property
    def position(self) -> Float[Array, "d n"]:
        """The matrix H that takes the position from the state."""
        return jnp.eye(self.dims, self.size)

    def discretize(self, dt: ArrayLike) -> Step:
        """F and Q of steps of the length `dt`, (...): arrays (..., n, n), as `jf.motion.discretize`.

        Raises:
            ValueError: If a concrete `dt` is negative or not finite.
        """
        return _steps(self, step_length(dt))

    def transition(self, x: Float[Array, " n"], dt: ArrayLike) -> Float[Array, " n"]:
        """The expected state after a step; for `jf.extended_kalman`, whose inputs are then the lengths of the steps.

        Raises:
            ValueError: If `x` has another length than `size`, or a concrete `dt` is negative or not finite.
        """
        if x.shape != (self.size,):
            raise ValueError(f"x must have the shape ({self.size},), {self.dims} coordinates a block; got {x.shape}.")
        moved = product(self.law(step_length(dt)).F, x.reshape(-1, self.dims))
        return moved.reshape(-1).astype(jnp.result_type(x, moved))

    def process_noise(self, dt: ArrayLike) -> Float[Array, "n n"]:
        """Covariance of the noise of a step; for `jf.extended_kalman`.

        Raises:
            ValueError: If a concrete `dt` is negative or not finite.
        """
        return self.discretize(dt).Q

    def stationary_covariance(self) -> Float[Array, "n n"]:
        """Covariance of the state in the long run, the prior of a process that has always been going on.

        Raises:
            ValueError: If the model has none, because its variance grows without bound.
        """
        if self.stationary is None:
            raise ValueError("the motion must be stationary, as ornstein_uhlenbeck and matern; its variance grows.")
        return _kron(self.stationary, self._spread(self.stationary.dtype))

    def _spread(self, dtype):
        return jnp.diag(jnp.broadcast_to(self.intensity, (self.dims,)).astype(dtype))


@jax.jit
def _steps(model: Motion, dt: Array) -> Step:
    F, Q = model.law(dt)
    return Step(_kron(F, jnp.eye(model.dims, dtype=F.dtype)), _kron(Q, model._spread(Q.dtype)))


def integrated_wiener(order: int, spectral_density: ArrayLike, *, dims: int = 1) -> Motion:
    r"""White noise drives the derivative of order `order + 1`: a Wiener process, integrated `order` times.

    Order 0 is a random walk, 1 constant velocity, 2 constant acceleration. With q the spectral density,
    $F_{ij} = h^{j-i} / (j-i)!$ and $Q_{ij} = q\,h^{2p+1-i-j} / ((2p+1-i-j)\,(p-i)!\,(p-j)!)$ (Y. Bar-Shalom, X. R. Li
    and T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 6.2).

    Args:
        order: Derivatives of the position in the state, from 0 to 20.
        spectral_density: Variance that the derivative of order `order` gains per unit of time, () or (dims,), not
            negative.
        dims: Number of space dimensions.

    Returns:
        The model, with the state `(p, p', ...)` of length `dims * (order + 1)`.

    Raises:
        ValueError: If `order` or `dims` is out of range, or a concrete `spectral_density` is negative or not finite.

    Examples:
        >>> import jaxfilters as jf
        >>> F, Q = jf.motion.integrated_wiener(1, 3.0).discretize(2.0)
        >>> F.tolist(), Q.tolist()
        ([[1.0, 2.0], [0.0, 1.0]], [[8.0, 6.0], [6.0, 6.0]])
    """
    if isinstance(order, bool) or not isinstance(order, int) or not 0 <= order <= _LARGEST_ORDER:
        raise ValueError(f"order must be an integer from 0 to {_LARGEST_ORDER}; got {order!r}.")
    _check_dims(dims)
    intensity = _not_negative("spectral_density", spectral_density, dims)
    return Motion(Wiener(order), intensity, None, order, dims)


def constant_velocity(spectral_density: ArrayLike, *, dims: int = 1) -> Motion:
    """Constant velocity with white noise acceleration: `integrated_wiener(1, ...)`, the state `(p, v)`.

    Args:
        spectral_density: Variance that the velocity gains per unit of time, () or (dims,), not negative.
        dims: Number of space dimensions.

    Returns:
        The model, with a state of length `2 * dims`.

    Raises:
        ValueError: As for `integrated_wiener`.

    Examples:
        Readings of a place in the plane, at uneven times.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> motion = jf.motion.constant_velocity(0.5, dims=2)
        >>> prior, R = jf.Gaussian(jnp.zeros(4), 10.0 * jnp.eye(4)), 0.1 * jnp.eye(2)
        >>> filter = jf.extended_kalman(prior, motion.transition, motion.process_noise, lambda x: x[:2], R)
        >>> dt = jnp.array([1.0, 0.1, 2.5])
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.ones((3, 2)), dt)
        >>> last.mean.shape
        (4,)
    """
    return integrated_wiener(1, spectral_density, dims=dims)


def constant_acceleration(spectral_density: ArrayLike, *, dims: int = 1) -> Motion:
    """Constant acceleration with white noise jerk: `integrated_wiener(2, ...)`, the state `(p, v, a)`.

    Args:
        spectral_density: Variance that the acceleration gains per unit of time, () or (dims,), not negative.
        dims: Number of space dimensions.

    Returns:
        The model, with a state of length `3 * dims`.

    Raises:
        ValueError: As for `integrated_wiener`.

    Examples:
        >>> import jaxfilters as jf
        >>> jf.motion.constant_acceleration(1.0).discretize(2.0).F.tolist()
        [[1.0, 2.0, 2.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]]
    """
    return integrated_wiener(2, spectral_density, dims=dims)


def ornstein_uhlenbeck(time_constant: ArrayLike, std: ArrayLike, *, dims: int = 1) -> Motion:
    r"""Ornstein-Uhlenbeck process about zero, with the covariance $\sigma^2 e^{-|t - t'| / \tau}$.

    Args:
        time_constant: Time $\tau$ in which the process forgets to 1/e, positive.
        std: Standard deviation $\sigma$ in the long run, () or (dims,), not negative.
        dims: Number of space dimensions.

    Returns:
        The model, with a state of length `dims`.

    Raises:
        ValueError: If `dims < 1`, or a concrete parameter has the wrong sign or is not finite.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> motion = jf.motion.ornstein_uhlenbeck(2.0, 3.0)
        >>> round(float(motion.transition(jnp.ones(1), 2.0)[0]), 3), motion.stationary_covariance().tolist()
        (0.368, [[9.0]])
    """
    _check_dims(dims)
    rate = 1 / _positive("time_constant", time_constant)
    variance = jnp.square(_not_negative("std", std, dims))
    return Motion(Decay(rate), variance, jnp.ones((1, 1)), 0, dims)


def integrated_ornstein_uhlenbeck(time_constant: ArrayLike, std: ArrayLike, *, dims: int = 1) -> Motion:
    """A position whose velocity is an Ornstein-Uhlenbeck process: motion with friction, the state `(p, v)`.

    Args:
        time_constant: Time in which a velocity decays to 1/e, positive.
        std: Standard deviation of the velocity in the long run, () or (dims,), not negative.
        dims: Number of space dimensions.

    Returns:
        The model, with a state of length `2 * dims`.

    Raises:
        ValueError: As for `ornstein_uhlenbeck`.

    Examples:
        In one time constant, a velocity of 1 covers 1 - 1/e and decays to 1/e.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> motion = jf.motion.integrated_ornstein_uhlenbeck(1.0, 3.0)
        >>> [round(v, 3) for v in motion.transition(jnp.array([0.0, 1.0]), 1.0).tolist()]
        [0.632, 0.368]
    """
    return _driven_by_decay(1, time_constant, std, dims)


def singer(time_constant: ArrayLike, std: ArrayLike, *, dims: int = 1) -> Motion:
    """Manoeuvring target: the acceleration is an Ornstein-Uhlenbeck process, the state `(p, v, a)`.

    R. A. Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", IEEE Transactions on
    Aerospace and Electronic Systems 6(4), 1970. Short steps and long time constants lose no accuracy, unlike in the
    closed form of the paper.

    Args:
        time_constant: Time in which an acceleration decays to 1/e, positive.
        std: Standard deviation of the acceleration in the long run, () or (dims,), not negative.
        dims: Number of space dimensions.

    Returns:
        The model, with a state of length `3 * dims`.

    Raises:
        ValueError: As for `ornstein_uhlenbeck`.

    Examples:
        In one time constant, an acceleration of 1 adds 1 - 1/e to the velocity and decays to 1/e.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> motion = jf.motion.singer(1.0, 3.0)
        >>> [round(v, 3) for v in motion.transition(jnp.array([0.0, 0.0, 1.0]), 1.0).tolist()]
        [0.368, 0.632, 0.368]
    """
    return _driven_by_decay(2, time_constant, std, dims)


def matern(smoothness: float, length_scale: ArrayLike, std: ArrayLike, *, dims: int = 1) -> Motion:
    r"""Gaussian process with a Matern covariance as a state-space model, the state its value and derivatives.

    A Kalman filter and an RTS smoother on it give the posterior of Gaussian process regression in a time that is linear
    in the number of readings, with `stationary_covariance` as the covariance of the prior (J. Hartikainen and
    S. Särkkä, "Kalman filtering and smoothing solutions to temporal Gaussian process regression models", IEEE Workshop
    on Machine Learning for Signal Processing, 2010).

    Args:
        smoothness: $\nu$, one of 1/2, 3/2, 5/2 and 7/2.
        length_scale: $\ell$, in the unit of time, positive; the rate of the process is $\sqrt{2 \nu} / \ell$.
        std: Standard deviation of the value, () or (dims,), not negative.
        dims: Number of independent processes.

    Returns:
        The model, with a state of length `dims * (smoothness + 1/2)`.

    Raises:
        ValueError: If `smoothness` is another number, `dims < 1`, or a concrete parameter has the wrong sign or is not
            finite.

    Examples:
        >>> import jaxfilters as jf
        >>> process = jf.motion.matern(1.5, 2.0, 3.0)
        >>> [[round(v, 3) for v in row] for row in process.stationary_covariance().tolist()]
        [[9.0, 0.0], [0.0, 6.75]]
    """
    if smoothness not in (0.5, 1.5, 2.5, 3.5):
        raise ValueError(f"smoothness must be 0.5, 1.5, 2.5 or 3.5; got {smoothness!r}.")
    order = int(smoothness - 0.5)
    length = _positive("length_scale", length_scale)
    if order == 0:
        return ornstein_uhlenbeck(length, std, dims=dims)
    _check_dims(dims)
    variance = jnp.square(_not_negative("std", std, dims))
    law = Matern(math.sqrt(2 * smoothness) / length, order)
    powers = law.powers()
    stationary = powers[:, None] * matern_unit(order)[2].astype(powers.dtype) * powers
    return Motion(law, variance, stationary, order, dims)


def _driven_by_decay(order, time_constant, std, dims):
    _check_dims(dims)
    rate = 1 / _positive("time_constant", time_constant)
    variance = jnp.square(_not_negative("std", std, dims))
    return Motion(DrivenByDecay(rate, order), variance, None, order, dims)


def _kron(a: Array, b: Array) -> Array:
    """Kronecker product of matrices (..., k, k) with one (d, d)."""
    size = a.shape[-1] * b.shape[-1]
    return (a[..., :, None, :, None] * b[:, None, :]).reshape(*a.shape[:-2], size, size)


def _check_dims(dims):
    if isinstance(dims, bool) or not isinstance(dims, int) or dims < 1:
        raise ValueError(f"dims must be an integer of at least 1; got {dims!r}.")


def _not_negative(name, value, dims):
    """A parameter () or (dims,) that is not negative: NaN where it is traced and negative."""
    if jnp.shape(value) not in ((), (dims,)):
        raise ValueError(f"{name} must have the shape () or ({dims},); got {jnp.shape(value)}.")
    known = checks.concrete(value)
    if known is not None and not np.all(np.isfinite(known) & (known >= 0)):
        raise ValueError(f"{name} must be zero or positive and finite; got {known.tolist()}.")
    value = jnp.asarray(value, dtype=float)
    return jnp.where(value >= 0, value, jnp.nan)


def _positive(name, value):
    """A parameter () that is positive: NaN where it is traced and not."""
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must be one number; got the shape {jnp.shape(value)}.")
    known = checks.concrete(value)
    if known is not None and not (np.isfinite(known) and known > 0):
        raise ValueError(f"{name} must be positive and finite; got {known}.")
    value = jnp.asarray(value, dtype=float)
    return jnp.where(value > 0, value, jnp.nan)
