"""How certain fitted parameters are, and whether their gradient is right."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters.fit.chart import Chart, chart_about
from jaxfilters.fit.constraints import free
from jaxfilters.fit.density import at_step
from jaxfilters.math import linalg
from jaxfilters.typing import as_pytree

Errors = Callable[[Callable, Array], Array]
"""`(loss, z) -> covariance of the coordinates`."""
_QUANTILE = 1.959964
"""Of the standard normal, 97.5 %."""


def observed_information(loss: Callable[[Array], Array], z: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Covariance of the coordinates: the inverse Hessian of the loss.

    A coordinate along which the loss does not curve, given those before it, is not determined: its rows are NaN, and
    the covariance of the others is what it would be if it were known. So a variance that the data want to be zero has
    no error, and takes none away. Of a particle filter the Hessian is as noisy as one draw: the second derivative of
    its weights is an estimate, too.
    """
    information = jax.hessian(loss)(z)
    diagonal = jnp.diagonal(information)
    # Scaled to ones on the diagonal: coordinates have different units.
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    inverse, determined = _inverse(scale[:, None] * information * scale)
    covariance = scale[:, None] * inverse * scale
    return jnp.where(determined[:, None] & determined, covariance, jnp.nan)


def _inverse(S: Float[Array, "d d"]) -> tuple[Float[Array, "d d"], Bool[Array, " d"]]:
    """Inverse of a symmetric matrix with ones on its diagonal, by sweeping; and which pivots were positive."""
    least = float(jnp.finfo(S.dtype).eps) ** 0.5

    def sweep(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        A, determined = state
        pivot = A[i, i]
        sound = pivot > least
        row = A[i] / jnp.where(sound, pivot, 1.0)
        swept = A - jnp.outer(A[:, i], row)
        swept = swept.at[i].set(row).at[:, i].set(row).at[i, i].set(-1 / jnp.where(sound, pivot, 1.0))
        return jnp.where(sound, swept, A), determined.at[i].set(sound)

    A, determined = jax.lax.fori_loop(0, S.shape[0], sweep, (S, jnp.zeros(S.shape[0], bool)))
    return -A, determined


def no_errors(loss: Callable[[Array], Array], z: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Covariance that nobody has computed: NaN."""
    del loss
    return jnp.full((z.size, z.size), jnp.nan, z.dtype)


def intervals(chart: Chart, z: Float[Array, " d"], covariance: Float[Array, "d d"]) -> tuple[PyTree, PyTree, PyTree]:
    """Standard errors by the delta method, and lower and upper ends of 95 % intervals, each like the parameters.

    Fixed parameters have an error of 0.
    """
    deviation = linalg.safe_sqrt(jnp.diagonal(covariance))
    deviation = jnp.where(jnp.isnan(jnp.diagonal(covariance)), jnp.nan, deviation)
    undetermined = jnp.isnan(deviation)
    known = jnp.where(undetermined[:, None] | undetermined, 0.0, covariance)
    theta = chart.point(z)
    floors, ceilings = chart.point(z - _QUANTILE * deviation), chart.point(z + _QUANTILE * deviation)

    def numbers(z: Array) -> list[Array]:
        # Fixed parameters may be whole numbers, which have no derivative.
        return [leaf.astype(z.dtype) for leaf in jax.tree.leaves(chart.point(z))]

    def spread(J: Array) -> Array:
        # Who does not depend on an undetermined coordinate has an error; NaN times zero would say otherwise.
        variance = jnp.sum(J * jnp.matmul(J, known, precision="highest"), axis=-1)
        return jnp.where(jnp.any((J != 0) & undetermined, axis=-1), jnp.nan, linalg.safe_sqrt(variance))

    errors = jax.tree.unflatten(jax.tree.structure(theta), map(spread, jax.jacfwd(numbers)(z)))
    ends = []
    for side, mapped in ((-1, floors), (1, ceilings)):
        triples = zip(chart.constraints, *map(jax.tree.leaves, (theta, errors, mapped)), strict=True)
        leaves = [end if c.elementwise else leaf + side * _QUANTILE * error for c, leaf, error, end in triples]
        ends.append(jax.tree.unflatten(jax.tree.structure(theta), leaves))
    return errors, ends[0], ends[1]


class GradientCheck(NamedTuple):
    """A gradient beside differences of the log density, both in 64 bits, in the coordinates."""

    names: list[str]
    """Path of the parameter of each coordinate."""
    gradient: np.ndarray
    differences: np.ndarray

    @property
    def error(self) -> float:
        """Largest disagreement, relative to the largest component."""
        scale = max(np.max(np.abs(self.gradient), initial=0.0), np.finfo(float).tiny)
        return float(np.max(np.abs(self.gradient - self.differences), initial=0.0) / scale)

    def __str__(self) -> str:
        triples = zip(self.names, self.gradient, self.differences, strict=True)
        lines = [f"{name:24}{slope:16.8g}{difference:16.8g}" for name, slope, difference in triples]
        return "\n".join([f"{'coordinate of':24}{'gradient':>16}{'differences':>16}", *lines])


def check_gradient(
    log_density: Callable, theta: PyTree, constraints: PyTree = free, *, step: float = 1e-5
) -> GradientCheck:
    """The gradient at `theta` beside central differences, computed in 64 bits whatever the setting.

    For log densities that are smooth: the estimate of a particle filter jumps, and its gradient is not its slope.
    """
    with jax.enable_x64(True):
        log_density, theta = jax.tree.map(_wide, (as_pytree(log_density), theta))
        chart = chart_about(theta, constraints)
        slope, differences = _both_slopes(log_density, chart, step)
        return GradientCheck(chart.names, np.asarray(slope), np.asarray(differences))


@jax.jit
def _both_slopes(log_density: Callable, chart: Chart, step: Array | float) -> tuple[Array, Array]:
    z = chart.coordinates(chart.origin)

    def value(z: Array) -> Array:
        return at_step(log_density, jnp.zeros((), jnp.int32), chart.point(z))

    shifts = step * jnp.concatenate([jnp.eye(z.size), -jnp.eye(z.size)])
    ahead, behind = jax.lax.map(lambda shift: value(z + shift), shifts).reshape(2, z.size)
    return jax.grad(value)(z), (ahead - behind) / (2 * step)


def _wide(leaf: Any) -> Any:
    wants = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.asarray(leaf, jnp.float64) if wants else leaf
