r"""First-order Gauss-Markov processes: errors that last for a while, and are forgotten.

$$b_t = \Phi_t b_{t-1} + q_t,\qquad q_t \sim N(0, B - \Phi_t B \Phi_t^T),\qquad \Phi_t = e^{-\Delta t_t / \tau},$$

the stationary process with the covariance B and the time constant $\tau$ (G. E. Uhlenbeck and L. S. Ornstein, "On the
theory of the Brownian motion", Physical Review 36, 1930; A. Gelb, "Applied Optimal Estimation", 1974, section 3.8).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import linalg
from jaxfilters.motion.discretization import discretize, step_length


@pytree_dataclass
class GaussMarkov:
    r"""A first-order Gauss-Markov process of k numbers: an error that lasts, or with an infinite time constant a bias.

    With different time constants of its numbers, the process of a full covariance exists only if the matrix with the
    elements $B_{ij} (1 / \tau_i + 1 / \tau_j)$ is positive semidefinite; for a matrix T of time constants it is
    $T^{-1} B + B T^{-T}$.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> noise = jf.GaussMarkov(jnp.array(2.0), jnp.array([4.0, 9.0]))
        >>> [round(float(p), 3) for p in noise.decay(1.0)]
        [0.607, 0.607]
    """

    time_constant: Float[ArrayLike, "..."]
    """Time after which the autocorrelation is 1/e, in the unit of the steps: one number, one for each of the k numbers,
    (k,), or a matrix T of the model db = -T^-1 b dt + noise, (k, k). Positive; infinity makes a constant."""
    covariance: Float[Array, "..."]
    """Stationary covariance B, (k, k), or the variances of independent numbers, (k,)."""

    @property
    def size(self) -> int:
        """Number k of components."""
        return self.covariance.shape[0]

    def decay(self, dt: ArrayLike) -> Float[Array, "..."]:
        """Factors of a step of the length `dt`, (k,), or its transition matrix where time constants are a matrix."""
        dt = step_length(dt, self.covariance.dtype)
        if jnp.ndim(self.time_constant) == 2:
            return discretize(self._drift(), jnp.zeros((self.size, 0), self.covariance.dtype), dt).F
        return jnp.exp(-dt * self._rates())

    def added(self, dt: ArrayLike) -> Float[Array, "..."]:
        """Covariance of the noise of a step, (k, k), or its variances, (k,), where the components are independent."""
        dt = step_length(dt, self.covariance.dtype)
        B = self.covariance
        if jnp.ndim(self.time_constant) == 2:
            B = jnp.diag(B) if B.ndim == 1 else B
            growth = linalg.matmul(-self._drift(), B)
            return discretize(self._drift(), factor.root(growth + growth.T), dt).Q
        rates = self._rates()
        # In single precision 1 - exp(-2 dt / tau) of short steps is rounding error.
        if B.ndim == 1:
            return -B * jnp.expm1(-2 * dt * rates)
        return -B * jnp.expm1(-dt * (rates[:, None] + rates))

    def decay_matrix(self, dt: ArrayLike) -> Float[Array, "k k"]:
        """Transition matrix of a step, whatever form the time constants have."""
        return as_matrix(self.decay(dt))

    def added_matrix(self, dt: ArrayLike) -> Float[Array, "k k"]:
        """Covariance of the noise of a step, whatever form the covariance has."""
        return as_matrix(self.added(dt))

    def prior(self) -> Gaussian:
        """The stationary distribution, N(0, B): the belief before anything is observed."""
        return Gaussian(jnp.zeros(self.size, self.covariance.dtype), as_matrix(self.covariance))

    def _rates(self) -> Float[Array, " k"]:
        rates = 1 / jnp.asarray(self.time_constant, self.covariance.dtype)
        return jnp.broadcast_to(rates, (self.size,))

    def _drift(self) -> Float[Array, "k k"]:
        return -jnp.linalg.inv(jnp.asarray(self.time_constant, self.covariance.dtype))


def as_matrix(values: Float[Array, "..."]) -> Float[Array, "k k"]:
    """A matrix as it is, and the diagonal matrix of a vector."""
    return values if values.ndim == 2 else factor.diagonal_matrix(values)


def rooted(covariance: Float[Array, "..."]) -> Float[Array, "k k"]:
    """A root of a covariance, given in full or by its diagonal."""
    return factor.root(covariance) if covariance.ndim == 2 else factor.diagonal_matrix(linalg.safe_sqrt(covariance))


def check_process(name: str, noise: Any) -> None:
    """Raise an error unless `noise` is a `GaussMarkov` whose numbers fit one another and are possible."""
    if not isinstance(noise, GaussMarkov):
        raise TypeError(f"{name} must be a GaussMarkov; got a {type(noise).__name__}.")
    B, tau = noise.covariance, noise.time_constant
    checks.floating(f"{name}.covariance", B)
    if B.ndim not in (1, 2) or B.shape != (B.shape[0],) * B.ndim or B.shape[0] == 0:
        raise ValueError(f"{name}.covariance must be variances (k,) or a covariance (k, k); got {B.shape}.")
    known = checks.concrete(B)
    if B.ndim == 2:
        checks.noise(f"{name}.covariance", B, B.shape[0], is_root=False)
    elif known is not None and not np.all(np.isfinite(known) & (known >= 0)):
        raise ValueError(f"{name}.covariance must be finite variances of at least 0; got {known.tolist()}.")
    k = B.shape[0]
    if jnp.shape(tau) not in ((), (k,), (k, k)):
        raise ValueError(f"{name}.time_constant must have the shape (), ({k},) or ({k}, {k}); got {jnp.shape(tau)}.")
    _check_time_constants(name, tau, known)


def _check_time_constants(name: str, tau: Any, B: np.ndarray | None) -> None:
    known = None if isinstance(tau, jax.core.Tracer) else np.asarray(tau, float)
    if known is None:
        return
    if known.ndim < 2 and not np.all(known > 0):
        raise ValueError(f"{name}.time_constant must be positive, in the unit of the steps; got {known.min()}.")
    if known.ndim == 2:
        rates = np.linalg.eigvals(known).real
        if not np.all(np.isfinite(known)) or np.any(rates <= 0):
            raise ValueError(
                f"{name}.time_constant must be a finite matrix whose eigenvalues have positive real parts; "
                f"the least is {rates.min():.6g}."
            )
    if B is None or (known.ndim < 2 and B.ndim < 2):
        return
    B = np.diag(B) if B.ndim == 1 else B
    if known.ndim == 2:
        half = np.linalg.solve(known, B.astype(float))
        growth = half + half.T
    else:
        rates = np.broadcast_to(1 / known, (len(B),))
        growth = B * (rates[:, None] + rates)
    least, largest = np.linalg.eigvalsh(growth)[[0, -1]]
    if least < -1e-5 * max(largest, 0.0):
        raise ValueError(
            f"{name}.covariance is that of no process with these time constants: its components are correlated more "
            f"than their different times allow (the noise that they need has a negative variance, {least:.3g})."
        )
