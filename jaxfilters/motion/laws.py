"""How one coordinate moves in a step: F and Q, as functions of the length of the step, of models with unit intensity.

A law is a pytree of its time constants. Lengths of steps may have any number of axes, which come first in the results.
"""

import functools
import math
from dataclasses import field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.motion.discretization import Step, discretize


@pytree_dataclass
class Wiener:
    """The law of an integrated Wiener process."""

    order: int = field(metadata={"static": True})

    def __call__(self, dt: Float[Array, "..."]) -> Step:
        p = self.order
        i, j = np.indices((p + 1, p + 1))
        factorial = np.array([math.factorial(k) for k in range(p + 1)], float)
        above = np.maximum(j - i, 0)
        F = np.where(j >= i, 1 / factorial[above], 0.0)
        rest = 2 * p + 1 - i - j
        Q = 1 / (rest * factorial[p - i] * factorial[p - j])
        powers = jnp.stack([dt**k for k in range(2 * p + 2)], axis=-1)
        return Step(powers[..., above] * F.astype(dt.dtype), powers[..., rest] * Q.astype(dt.dtype))


@pytree_dataclass
class Decay:
    """The law of an Ornstein-Uhlenbeck process."""

    rate: Float[Array, ""]

    def __call__(self, dt: Float[Array, "..."]) -> Step:
        time = (self.rate * dt)[..., None, None]
        return Step(jnp.exp(-time), -jnp.expm1(-2 * time))


@pytree_dataclass
class DrivenByDecay:
    """The law of a position whose derivative of some order is an Ornstein-Uhlenbeck process."""

    rate: Float[Array, ""]
    order: int = field(metadata={"static": True})

    def __call__(self, dt: Float[Array, "..."]) -> Step:
        # In units of the step all numbers are of order one, however short it is: derivative i is times h^i.
        p, u = self.order, self.rate * dt
        corner = np.zeros((p + 1, p + 1))
        corner[p, p] = 1.0
        A = np.eye(p + 1, k=1).astype(u.dtype) - u[..., None, None] * corner.astype(u.dtype)
        unit = discretize(A, corner[:, p:].astype(u.dtype), jnp.ones_like(u))
        i, j = np.indices((p + 1, p + 1))
        powers = jnp.stack([dt**k for k in range(2 * p + 1)], axis=-1)
        F = powers[..., np.maximum(j - i, 0)] * unit.F
        return Step(F, (2 * u)[..., None, None] * powers[..., 2 * p - i - j] * unit.Q)


@pytree_dataclass
class Matern:
    """The law of a Matern process of unit variance; its rate is the only time, so that derivative i is in rate^i."""

    rate: Float[Array, ""]
    order: int = field(metadata={"static": True})

    def powers(self) -> Float[Array, " k"]:
        """The rate to the power of 0, 1, ..., one for each derivative."""
        return jnp.stack([self.rate**k for k in range(self.order + 1)])

    def __call__(self, dt: Float[Array, "..."]) -> Step:
        A, L, _ = matern_unit(self.order)
        dtype = jnp.result_type(self.rate, dt)
        # Nothing is left of the past after the time at which exp(-time) is no number any more.
        forgotten = 2.0 * math.log(float(jnp.finfo(dtype).max))
        unit = discretize(A.astype(dtype), L.astype(dtype), jnp.minimum(self.rate * dt, forgotten))
        # An exponent of zero gives one exactly, which a quotient of powers would not.
        ratios = [[self.rate ** (i - j) for j in range(self.order + 1)] for i in range(self.order + 1)]
        powers = self.powers().astype(dtype)
        return Step(unit.F * jnp.array(ratios, dtype), unit.Q * (powers[:, None] * powers))


@functools.cache
def matern_unit(order):
    """A, L and the stationary covariance of the process of unit variance and rate (Särkkä, Solin 2019, section 12.3).

    The spectral density is proportional to (1 + w^2)^-(p+1), that of white noise through (s + 1)^-(p+1).
    """
    import scipy.linalg  # it takes as long to import as the rest of a model of motion

    n = order + 1
    A = np.eye(n, k=1)
    A[-1] = [-math.comb(n, k) for k in range(n)]
    density = math.factorial(order) ** 2 * 2 ** (2 * order + 1) / math.factorial(2 * order)
    L = np.zeros((n, 1))
    L[-1] = math.sqrt(density)
    stationary = scipy.linalg.solve_continuous_lyapunov(A, -L @ L.T)
    # Values and odd derivatives are uncorrelated.
    odd = (np.add.outer(np.arange(n), np.arange(n)) % 2).astype(bool)
    return A, L, np.where(odd, 0.0, stationary)
