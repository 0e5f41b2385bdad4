r"""Linear approximations of a function of a Gaussian: Taylor polynomials and sigma points.

A strategy takes a function f and the belief $N(m, P)$ about its argument, and returns
$f(x) \approx v + F (x - m) + \Lambda^{1/2} e$, e ~ N(0, I): a value, a matrix, and a root of the covariance of the
linearisation error.
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
    """A linear approximation of a function of a Gaussian."""

    value: Float[Array, " k"]
    """Value at the mean of the argument: v."""
    F: Float[Array, "k n"]
    """Matrix of the linear part, e.g. the Jacobian."""
    residual_root: Float[Array, "k w"]
    """Root, of any width w, of the covariance of the linearisation error; width 0 where it is ignored."""


@runtime_checkable
class Linearize(Protocol):
    """Approximate a function of a Gaussian by a linear one."""

    def __call__(self, f: Function, belief: Gaussian | GaussianRoot, /) -> Linearization: ...


def taylor(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    """First-order Taylor polynomial at the mean, for the extended Kalman filter; the linearisation error is ignored.

    Args:
        f: Function, (n,) to (k,).
        belief: Belief about its argument.

    Returns:
        Value and Jacobian, with a `residual_root` of width 0.

    Examples:
        The square of x, whose derivative at 3 is 6.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([3.0]), jnp.eye(1))
        >>> found = jf.linearize.taylor(lambda x: x**2, belief)
        >>> found.value.tolist(), found.F.tolist(), found.residual_root.shape
        ([9.0], [[6.0]], (1, 0))
    """
    value, F = _value_and_jacobian(f, belief.mean)
    return Linearization(value, F, jnp.zeros((value.size, 0), value.dtype))


def second_order_covariance_only(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    r"""Value and Jacobian at the mean; the linearisation error has the covariance of the quadratic term.

    With Hessians $F_k$ and a covariance $P = L L^T$, $\Lambda_{kl} = \frac12 \operatorname{tr}(F_k P F_l P)
    = \frac12 \langle L^T F_k L, L^T F_l L \rangle$. Unlike in the second-order filter of the textbooks, `second_order`,
    the value is that at the mean, without the mean of the quadratic term.

    Args:
        f: Function, (n,) to (k,).
        belief: Belief about its argument.

    Returns:
        Value, Jacobian, and a `residual_root` of width n^2 (n the columns of the belief's root).

    Examples:
        With x = 3 + e, x^2 = 9 + 6 e + e^2, and e^2 has the variance 2.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([3.0]), jnp.eye(1))
        >>> found = jf.linearize.second_order_covariance_only(lambda x: x**2, belief)
        >>> parts = found.value[0], found.F[0, 0], found.residual_root[0, 0] ** 2
        >>> tuple(round(float(x), 3) for x in parts)
        (9.0, 6.0, 2.0)
    """
    return _second_order(f, belief)[0]


def second_order(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    r"""Second-order Taylor polynomial at the mean: its mean, its Jacobian, and the covariance of its quadratic term.

    The value is $f(m) + \frac12 [\operatorname{tr}(F_k P)]_k$ with the Hessians $F_k$, the covariance of the
    linearisation error $\Lambda_{kl} = \frac12 \operatorname{tr}(F_k P F_l P)$ (Y. Bar-Shalom, X. R. Li and T.
    Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 10.3.2).

    Args:
        f: Function, (n,) to (k,).
        belief: Belief about its argument.

    Returns:
        Mean, Jacobian, and a `residual_root` of width n^2 (n the columns of the belief's root).

    Examples:
        With x = 3 + e, x^2 = 9 + 6 e + e^2, and e^2 has the mean 1 and the variance 2.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([3.0]), jnp.eye(1))
        >>> found = jf.linearize.second_order(lambda x: x**2, belief)
        >>> parts = found.value[0], found.F[0, 0], found.residual_root[0, 0] ** 2
        >>> tuple(round(float(x), 3) for x in parts)
        (10.0, 6.0, 2.0)
    """
    linearization, curvature = _second_order(f, belief)
    return linearization._replace(value=linearization.value + 0.5 * jnp.trace(curvature, axis1=1, axis2=2))


def cubature(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    """Regression on the 2 n points of the third-degree spherical-radial rule, for the cubature Kalman filter.

    I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54(6), 2009,
    equation 32.

    Args:
        f: Function, (n,) to (k,).
        belief: Belief about its argument.

    Returns:
        Mean, matrix of the regression, and a `residual_root` of width n.

    Examples:
        The points of N(3, 1) are 2 and 4; their squares have the mean 10 and the slope 6.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([3.0]), jnp.eye(1))
        >>> found = jf.linearize.cubature(lambda x: x**2, belief)
        >>> round(float(found.value[0]), 3), round(float(found.F[0, 0]), 3)
        (10.0, 6.0)
    """
    return _sigma_points(f, belief, belief.mean.size, -1.0)


def unscented(alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> Linearize:
    r"""Regression on the 2 n + 1 points of the scaled unscented transform, for the unscented Kalman filter.

    The points lie $\alpha \sqrt{n + \kappa}$ standard deviations from the mean (E. A. Wan and R. van der Merwe, "The
    unscented Kalman filter for nonlinear estimation", AS-SPCC 2000, equation 15). The mean is exact for cubic
    functions; with `beta` 2 the variance is exact for a quadratic function of a scalar. A small `alpha` costs digits:
    with 1e-3 no digit of the curvature is left in float32.

    Args:
        alpha: Relative distance of the points, positive.
        beta: Weight of the centre point in the covariance, at least 0.
        kappa: Addition to the dimension n, at least 0.

    Returns:
        The strategy, `(f, belief) -> Linearization`; those of equal numbers are equal.

    Raises:
        ValueError: If `alpha` is not positive, or `beta` or `kappa` is negative: the covariance could be indefinite.

    Examples:
        With x = 3 + e, x^2 = 9 + 6 e + e^2, and e^2 has the mean 1 and the variance 2.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([3.0]), jnp.eye(1))
        >>> found = jf.linearize.unscented()(lambda x: x**2, belief)
        >>> parts = found.value[0], found.F[0, 0], found.residual_root[0, 0] ** 2
        >>> tuple(round(float(x), 3) for x in parts)
        (10.0, 6.0, 2.0)
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
    """Lower root of the covariance of a belief; zero diagonal elements where components are certain or dependent."""
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
    second = lambda direction: jax.jvp(slopes, (belief.mean,), (direction,))[1]
    curvature = jax.vmap(second, in_axes=-1, out_axes=-1)(root)
    return Linearization(value, F, curvature.reshape(value.size, -1) / math.sqrt(2)), curvature


def _sigma_points(f, belief, spread, excess):
    # The points m +- sqrt(c) L e_i give differences from f(m) with an even part E and an odd part. The odd part is the
    # regression, F L; the even part is its error: E E^T / c + (beta - alpha^2) b b^T, with b = E 1 / c.
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
    return Linearization(centre + n / spread * mean, F, (even + share * mean[:, None]) / scale)
