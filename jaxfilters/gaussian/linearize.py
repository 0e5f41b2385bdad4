r"""Linear stand-ins for a function of a Gaussian: Taylor polynomials and sigma points.

A strategy takes a function f and the belief about its argument, and answers with
$f(x) \approx v + F (x - m) + \Lambda^{1/2} e$, e ~ N(0, I): a value, a matrix, and a root of what the matrix loses.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._xla import last_axis
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.math import linalg

Function = Callable[[Float[Array, " n"]], Float[Array, " k"]]


class Linearization(NamedTuple):
    """A function of a Gaussian, as if it were linear."""

    value: Float[Array, " k"]
    """Where the mean goes."""
    F: Float[Array, "k n"]
    lost_root: Float[Array, "k w"]
    """Root, of any width, of the covariance of the function that F does not explain; width 0 where it is ignored."""


@runtime_checkable
class Linearize(Protocol):
    """Make a function of a Gaussian linear."""

    def __call__(self, f: Function, belief: Gaussian | GaussianRoot, /) -> Linearization: ...


def taylor(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    """Value and Jacobian at the mean; what is lost is ignored."""
    value, F = _value_and_jacobian(f, belief.mean)
    return Linearization(value, F, jnp.zeros((value.size, 0), value.dtype))


def second_order_covariance_only(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    r"""Value and Jacobian at the mean; what is lost is the covariance of the quadratic term.

    With Hessians $F_k$ and a covariance $P = L L^T$, $\Lambda_{kl} = \frac12 \operatorname{tr}(F_k P F_l P)
    = \frac12 \langle L^T F_k L, L^T F_l L \rangle$ (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with
    Applications to Tracking and Navigation", 2001, section 10.3.2).
    """
    return _second_order(f, belief)[0]


def second_order(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    r"""As `second_order`, with the mean of the quadratic term, $\frac12 \operatorname{tr}(F_k P)$, in the value."""
    linearization, along = _second_order(f, belief)
    return linearization._replace(value=linearization.value + 0.5 * jnp.trace(along, axis1=1, axis2=2))


def cubature(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    """Regression on the 2n points of the third-degree spherical-radial rule (Arasaratnam and Haykin 2009, eq. 32)."""
    return _sigma_points(f, belief, belief.mean.size, -1.0)


def unscented(alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> Linearize:
    r"""Regression on the 2n + 1 points of the scaled unscented transform (Wan and van der Merwe 2000, eq. 15).

    The points lie $\alpha \sqrt{n + \kappa}$ standard deviations away. The mean is exact for cubic functions; with
    `beta` 2 the variance is for a quadratic one of a scalar. A small `alpha` loses digits: 1e-3 leaves none of
    float32's in the curvature.

    Raises:
        ValueError: If `alpha` is not positive, `beta` or `kappa` negative: the covariance could be indefinite.
    """
    if not alpha > 0:
        raise ValueError(f"alpha must be positive; got {alpha!r}.")
    if not (beta >= 0 and kappa >= 0):
        raise ValueError(f"beta and kappa must be at least 0; got {beta!r} and {kappa!r}.")
    return _Unscented(float(alpha), float(beta), float(kappa))


@dataclass(frozen=True)
class _Unscented:
    alpha: float
    beta: float
    kappa: float

    def __call__(self, f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
        spread = self.alpha**2 * (belief.mean.size + self.kappa)
        return _sigma_points(f, belief, spread, self.beta - self.alpha**2)


def lower_root(belief: Gaussian | GaussianRoot) -> Float[Array, "n n"]:
    """Lower root of the covariance; zero diagonal elements where components are certain or dependent."""
    return factor.root(belief.covariance) if isinstance(belief, Gaussian) else linalg.tria(belief.root)


def _value_and_jacobian(f, x):
    def along(direction):
        return jax.jvp(f, (x,), (direction,))

    value, F = last_axis.vmap(along, out_axes=(None, -1))(factor.identity(x.size, x.dtype))
    # vmap leaves F transposed in memory. XLA would fold that into the products of F, for which it then has no fast
    # kernel on a CPU; behind the barrier it makes a copy.
    return value, F if max(F.shape) <= factor.UNROLLED else jax.lax.optimization_barrier(F)


def _second_order(f, belief):
    root = factor.root(belief.covariance) if isinstance(belief, Gaussian) else belief.root

    def slopes(x):
        # Directions without variance are columns of zeros, and stay out of all that follows.
        return jax.vmap(lambda direction: jax.jvp(f, (x,), (direction,))[1], in_axes=-1, out_axes=-1)(root)

    value, F = _value_and_jacobian(f, belief.mean)
    bend = lambda direction: jax.jvp(slopes, (belief.mean,), (direction,))[1]
    along = jax.vmap(bend, in_axes=-1, out_axes=-1)(root)
    return Linearization(value, F, along.reshape(value.size, -1) / math.sqrt(2)), along


def _sigma_points(f, belief, spread, excess):
    # The points m +- sqrt(c) L e_i give differences from f(m) with an even part E and an odd part. The odd part is the
    # regression, F L; the even part is all it loses: E E^T / c + (beta - alpha^2) b b^T, with b = E 1 / c.
    n = belief.mean.size
    root, scale = lower_root(belief), math.sqrt(spread)
    centre = f(belief.mean)

    def pair(column):
        ahead, behind = f(belief.mean + scale * column) - centre, f(belief.mean - scale * column) - centre
        return 0.5 * (ahead + behind), 0.5 * (ahead - behind)

    even, odd = jax.vmap(pair, in_axes=-1, out_axes=-1)(root)
    F = linalg.solve_triangular(root, odd.T / scale, transpose=True).T
    mean = jnp.mean(even, axis=1)
    share = math.sqrt(1 + excess * n / spread) - 1
    lost = (even + share * mean[:, None]) / scale
    return Linearization(centre + n / spread * mean, F, lost)
