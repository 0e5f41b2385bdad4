"""Standard errors of fitted parameters, and a check of the gradient of a log density."""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters.fit.constraints import Fixed, free
from jaxfilters.fit.density import at_step
from jaxfilters.fit.parametrization import Parametrization, check_start, parametrize
from jaxfilters.math import linalg
from jaxfilters.typing import as_pytree

_QUANTILE = 1.959964
"""The 97.5 % quantile of the standard normal distribution."""


class ErrorStatus(enum.IntEnum):
    """Whether a parameter has a standard error, and why it has none."""

    DETERMINED = 0
    AT_BOUND = 1
    FLAT = 2
    NEGATIVE_CURVATURE = 3
    NOT_FINITE = 4
    NOT_COMPUTED = 5
    FIXED = 6

    @property
    def reason(self) -> str:
        """The reason in words, for reports."""
        return _REASONS[self]


_REASONS = {
    ErrorStatus.DETERMINED: "",
    ErrorStatus.AT_BOUND: "at its bound",
    ErrorStatus.FLAT: "flat direction: the data do not determine it",
    ErrorStatus.NEGATIVE_CURVATURE: "noisy information, or not a maximum: negative curvature",
    ErrorStatus.NOT_FINITE: "second derivatives are not finite",
    ErrorStatus.NOT_COMPUTED: "not computed",
    ErrorStatus.FIXED: "fixed",
}


class Uncertainty(NamedTuple):
    """The covariance of the coordinates at a maximum, and which of its rows are meaningful."""

    covariance: Float[Array, "d d"]
    """Rows and columns are NaN where `status` is not `DETERMINED`."""
    status: Int[Array, " d"]
    """An `ErrorStatus` for each coordinate."""


Errors = Callable[[Callable, Array], Uncertainty]
"""`(loss, z) -> Uncertainty` of the coordinates."""


def observed_information(loss: Callable[[Array], Array], z: Float[Array, " d"]) -> Uncertainty:
    """The inverse of the observed information, the Hessian of minus the log density.

    A coordinate without positive curvature, given those before it, is not determined: its rows are NaN, and the
    covariance of the others is conditional on its value. So a variance whose estimate tends to zero has no standard
    error, and the other parameters keep theirs. The Hessian of a particle filter's estimate is itself a noisy estimate.

    Args:
        loss: Minus the log density as a function of the coordinates.
        z: (d,), coordinates of the maximum.

    Examples:
        The loss is quadratic in the first coordinate, and does not depend on the second one.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> found = jax.jit(lambda z: jf.fit.observed_information(lambda z: 2 * z[0] ** 2, z))(jnp.zeros(2))
        >>> round(float(found.covariance[0, 0]), 3), [jf.fit.ErrorStatus(code).name for code in found.status.tolist()]
        (0.25, ['DETERMINED', 'FLAT'])
    """
    information = jax.hessian(loss)(z)
    finite = jnp.all(jnp.isfinite(information), axis=1)
    information = jnp.where(finite[:, None] & finite, information, jnp.eye(z.size, dtype=z.dtype))
    diagonal = jnp.diagonal(information)
    # Scaled to ones on the diagonal: coordinates have different units.
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    inverse, pivots = _inverse(scale[:, None] * information * scale)
    tolerance = _pivot_tolerance(z.dtype)
    status = jnp.where(pivots > tolerance, ErrorStatus.DETERMINED, ErrorStatus.FLAT)
    status = jnp.where(pivots < -tolerance, ErrorStatus.NEGATIVE_CURVATURE, status)
    status = jnp.where(finite, status, ErrorStatus.NOT_FINITE).astype(jnp.int32)
    determined = status == ErrorStatus.DETERMINED
    covariance = scale[:, None] * inverse * scale
    return Uncertainty(jnp.where(determined[:, None] & determined, covariance, jnp.nan), status)


def _pivot_tolerance(dtype: Any) -> float:
    """The curvature, relative to the diagonal, that counts as zero."""
    return float(jnp.finfo(dtype).eps) ** 0.5


def _inverse(S: Float[Array, "d d"]) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """The inverse of a symmetric matrix with ones on its diagonal by the sweep operator, and its pivots.

    Pivots that are not positive are skipped (J. H. Goodnight, "A tutorial on the SWEEP operator", The American
    Statistician 33(3), 1979).
    """
    if not S.shape[0]:
        return S, jnp.zeros(0, S.dtype)
    tolerance = _pivot_tolerance(S.dtype)

    def sweep(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        A, pivots = state
        pivot = A[i, i]
        usable = pivot > tolerance
        divisor = jnp.where(usable, pivot, 1.0)
        row = A[i] / divisor
        swept = A - jnp.outer(A[:, i], row)
        swept = swept.at[i].set(row).at[:, i].set(row).at[i, i].set(-1 / divisor)
        return jnp.where(usable, swept, A), pivots.at[i].set(pivot)

    A, pivots = jax.lax.fori_loop(0, S.shape[0], sweep, (S, jnp.zeros(S.shape[0], S.dtype)))
    return -A, pivots


def no_errors(loss: Callable[[Array], Array], z: Float[Array, " d"]) -> Uncertainty:
    """No standard errors: NaN, without the cost of the Hessian.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> found = jf.fit.no_errors(lambda z: jnp.sum(z**2), jnp.zeros(2))
        >>> found.covariance.shape, jf.fit.ErrorStatus(int(found.status[0])).reason
        ((2, 2), 'not computed')
    """
    del loss
    status = jnp.full(z.size, ErrorStatus.NOT_COMPUTED, jnp.int32)
    return Uncertainty(jnp.full((z.size, z.size), jnp.nan, z.dtype), status)


class Intervals(NamedTuple):
    """Standard errors and 95 % confidence intervals, each a tree like the parameters."""

    standard_errors: PyTree
    status: PyTree
    lower: PyTree
    upper: PyTree


def intervals(parametrization: Parametrization, z: Float[Array, " d"], uncertainty: Uncertainty) -> Intervals:
    """Standard errors by the delta method, and the ends of 95 % intervals.

    Fixed parameters, and those at a bound, have a standard error of 0. The interval of a parameter with a coordinate of
    its own is that of the coordinate, within its bounds, mapped; of any other it is symmetric.
    """
    undetermined = uncertainty.status > ErrorStatus.AT_BOUND
    variance = jnp.diagonal(uncertainty.covariance)
    deviation = jnp.where(undetermined, jnp.nan, linalg.safe_sqrt(variance))
    known = jnp.where(undetermined[:, None] | undetermined, 0.0, uncertainty.covariance)
    theta = parametrization.constrain(z)
    tree = jax.tree.structure(theta)

    def numbers(z: Array) -> list[Array]:
        # Fixed parameters may be integers, which have no derivative.
        return [leaf.astype(z.dtype) for leaf in jax.tree.leaves(parametrization.constrain(z))]

    def error(J: Array) -> Array:
        # A parameter that does not depend on an undetermined coordinate has an error; NaN times zero would be NaN.
        variance = jnp.sum(J * jnp.matmul(J, known, precision="highest"), axis=-1)
        return jnp.where(jnp.any((J != 0) & undetermined, axis=-1), jnp.nan, linalg.safe_sqrt(variance))

    def status(constraint: Any, J: Array) -> Array:
        if isinstance(constraint, Fixed):
            return jnp.full(J.shape[:-1], ErrorStatus.FIXED, jnp.int32)
        return jnp.max(jnp.where(J != 0, uncertainty.status, 0), axis=-1, initial=0)

    jacobians = jax.jacfwd(numbers)(z)
    errors = list(map(error, jacobians))
    ends = []
    for side in (-1, 1):
        end = jnp.clip(z + side * _QUANTILE * deviation, *parametrization.bounds())
        mapped = jax.tree.leaves(parametrization.constrain(end))
        rows = zip(parametrization.constraints, jax.tree.leaves(theta), errors, mapped, strict=True)
        ends.append([end if c.elementwise else leaf + side * _QUANTILE * e for c, leaf, e, end in rows])
    statuses = list(map(status, parametrization.constraints, jacobians))
    return Intervals(*(jax.tree.unflatten(tree, leaves) for leaves in (errors, statuses, *ends)))


class GradientCheck(NamedTuple):
    """A gradient beside central differences of the log density, both in 64 bits, in the coordinates."""

    names: list[str]
    """The parameter to which each coordinate belongs."""
    gradient: np.ndarray
    differences: np.ndarray
    """(d,): central differences."""

    @property
    def error(self) -> float:
        """The largest difference between the two, relative to the largest component of the gradient."""
        scale = max(np.max(np.abs(self.gradient), initial=0.0), np.finfo(float).tiny)
        return float(np.max(np.abs(self.gradient - self.differences), initial=0.0) / scale)

    def __str__(self) -> str:
        triples = zip(self.names, self.gradient, self.differences, strict=True)
        lines = [f"{name:24}{slope:16.8g}{difference:16.8g}" for name, slope, difference in triples]
        return "\n".join([f"{'coordinate of':24}{'gradient':>16}{'differences':>16}", *lines])


def check_gradient(
    log_density: Callable, theta: PyTree, constraints: PyTree = free, *, step: float = 1e-5
) -> GradientCheck:
    """The gradient at `theta` beside central differences, computed in 64 bits whatever JAX's setting is.

    Only for smooth log densities: the estimate of a particle filter is discontinuous.

    Args:
        log_density: `theta -> log p`, or what `log_evidence` and the like return.
        theta: Parameters at which to compare.
        constraints: As for `maximize`.
        step: Half the distance between the two points of a difference, in the coordinates.

    Raises:
        ValueError: If `constraints` do not fit `theta`, or `theta` violates them.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> check = jf.fit.check_gradient(lambda x: -jnp.sum(x**2), jnp.array([1.0, 2.0]))
        >>> check.gradient.tolist(), check.error < 1e-6
        ([-2.0, -4.0], True)
    """
    with jax.enable_x64(True):
        log_density, theta = jax.tree.map(_as_float64, (as_pytree(log_density), theta))
        parametrization = parametrize(theta, constraints)
        check_start(parametrization, "theta")
        slope, differences = _both_slopes(log_density, parametrization, step)
        return GradientCheck(parametrization.names, np.asarray(slope), np.asarray(differences))


@jax.jit
def _both_slopes(log_density: Callable, parametrization: Parametrization, step: Array | float) -> tuple[Array, Array]:
    z = parametrization.unconstrain(parametrization.origin)

    def value(z: Array) -> Array:
        return at_step(log_density, jnp.zeros((), jnp.int32), parametrization.constrain(z))

    shifts = step * jnp.concatenate([jnp.eye(z.size), -jnp.eye(z.size)])
    ahead, behind = jax.lax.map(lambda shift: value(z + shift), shifts).reshape(2, z.size)
    return jax.grad(value)(z), (ahead - behind) / (2 * step)


def _as_float64(leaf: Any) -> Any:
    is_float = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.asarray(leaf, jnp.float64) if is_float else leaf
