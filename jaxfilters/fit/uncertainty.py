"""How certain fitted parameters are, and whether their gradient is right."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxfilters import linalg
from jaxfilters.fit.chart import Chart, chart_about
from jaxfilters.fit.constraints import free
from jaxfilters.fit.density import at_step
from jaxfilters.typing import as_pytree

Errors = Callable[[Callable, Array], Array]
"""`(loss, z) -> covariance of the coordinates`."""
_QUANTILE = 1.959964
"""Of the standard normal, 97.5 %."""


def observed_information(loss: Callable[[Array], Array], z: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Covariance of the coordinates: the inverse Hessian of the loss; NaN where it is not positive definite.

    Of a particle filter it is as noisy as one draw: the second derivative of its weights is an estimate, too.
    """
    if z.size == 0:
        return jnp.zeros((0, 0), z.dtype)
    information = jax.hessian(loss)(z)
    # Scaled to ones on the diagonal: coordinates have different units.
    diagonal = jnp.diagonal(information)
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, jnp.nan))
    root = linalg.cholesky(scale[:, None] * information * scale)
    inverse = linalg.solve_triangular(root, jnp.eye(z.size, dtype=z.dtype))
    definite = jnp.all(jnp.diagonal(root) > 0)
    covariance = scale[:, None] * jnp.matmul(inverse.T, inverse, precision="highest") * scale
    return jnp.where(definite, covariance, jnp.nan)


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
    theta = chart.point(z)
    floors, ceilings = chart.point(z - _QUANTILE * deviation), chart.point(z + _QUANTILE * deviation)

    def numbers(z: Array) -> list[Array]:
        # Fixed parameters may be whole numbers, which have no derivative.
        return [leaf.astype(z.dtype) for leaf in jax.tree.leaves(chart.point(z))]

    def spread(J: Array) -> Array:
        variance = jnp.sum(J * jnp.matmul(J, covariance, precision="highest"), axis=-1)
        return jnp.where(jnp.isnan(variance), jnp.nan, linalg.safe_sqrt(variance))

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

    ahead, behind = (jax.lax.map(lambda shift: value(z + shift), side * step * jnp.eye(z.size)) for side in (1, -1))
    return jax.grad(value)(z), (ahead - behind) / (2 * step)


def _wide(leaf: Any) -> Any:
    wants = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.asarray(leaf, jnp.float64) if wants else leaf
