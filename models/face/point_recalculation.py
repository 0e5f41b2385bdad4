"""Landmarks of one image recalculated from grey levels, near where a filter has them (Sugano 2007, section 4.3.3).

The energy that is minimised over the pixels m, with windows of 16 x 16 pixels about them:

    sum_windows rho |I_t(m) - I_{t-1}|^2 + |I_t(m) - I_1|^2  +  epsilon |m - m_estimated|^2        [4.42]-[4.44]

Each landmark is a problem of its own in two unknowns. `recalculation` is the same for shapes in space.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer, Num, Real

from jaxfilters.models.face.correlation import cut, inside


class PointEquations(NamedTuple):
    """The minimum of the linearised energy is the step `-matrix^-1 vector` of each landmark ([4.50])."""

    matrix: Float[Array, "K 2 2"]
    """Grey levels^2 / px^2; positive definite."""
    vector: Float[Array, "K 2"]
    """Grey levels^2 / px: the gradient of the energy."""
    residual: Float[Array, " K"]
    """Root mean square difference to the first frame, grey levels; NaN where the window leaves the image."""


class PointRecalculation(NamedTuple):
    """How a recalculation ended."""

    iterations: Int[Array, ""]
    step_px: Float[Array, " K"]
    """Largest coordinate of each landmark's last step."""
    residual: Float[Array, " K"]
    """As in `PointEquations`, where the last step began."""


def point_equations(
    points: Float[Array, "K 2"],
    estimated: Float[Array, "K 2"],
    image: Num[Array, "rows cols"],
    previous: Num[Array, "K T T"],
    first: Num[Array, "K T T"],
    *,
    rho: Real[ArrayLike, ""] = 4.0,
    epsilon: Real[ArrayLike, ""] = 4000.0,
) -> PointEquations:
    """The exact normal equations about pixels, with 2 epsilon in both sides ([4.45]-[4.50]).

    `D = 2 (rho + 1) sum K^T K + 2 epsilon 1` and `d = 2 sum K^T (rho dI + dI_0) + 2 epsilon (m - m')`. As printed in
    [4.51] and [4.52] they hold epsilon in place of 2 epsilon, which is half of `epsilon` here. A window that, with a
    border of one pixel, leaves the image says nothing.
    """
    rho, epsilon = jnp.asarray(rho, points.dtype), jnp.asarray(epsilon, points.dtype)
    size = first.shape[-1]
    observed = inside(image.shape, points, size + 2)[:, None, None]
    window = jnp.where(observed, cut(image, jnp.where(observed[..., 0], points, 0.0), size + 2), 0.0)
    across = (window[:, 1:-1, 2:] - window[:, 1:-1, :-2]) / 2
    down = (window[:, 2:, 1:-1] - window[:, :-2, 1:-1]) / 2
    gradient = jnp.stack([across, down], axis=-1).reshape(len(points), size**2, 2)
    here = window[:, 1:-1, 1:-1]
    flat = lambda difference: jnp.where(observed, difference, 0.0).reshape(len(points), size**2)
    since_first, since_previous = flat(here - first), flat(here - previous)
    product = lambda spec, *a: jnp.einsum(spec, *a, precision="highest")
    matrix = 2 * (rho + 1) * product("kpi,kpj->kij", gradient, gradient) + 2 * epsilon * jnp.eye(2, dtype=points.dtype)
    slope = product("kpi,kp->ki", gradient, rho * since_previous + since_first)
    residual = jnp.where(observed[:, 0, 0], jnp.sqrt(jnp.mean(since_first**2, axis=-1)), jnp.nan)
    return PointEquations(matrix, 2 * slope + 2 * epsilon * (points - estimated), residual)


def recalculate_points(
    start: Float[Array, "K 2"],
    estimated: Float[Array, "K 2"],
    image: Num[Array, "rows cols"],
    previous: Num[Array, "K T T"],
    first: Num[Array, "K T T"],
    *,
    rho: Real[ArrayLike, ""] = 4.0,
    epsilon: Real[ArrayLike, ""] = 4000.0,
    max_iterations: Integer[ArrayLike, ""] = 10,
    tolerance_px: Real[ArrayLike, ""] = 0.02,
    step_px: Real[ArrayLike, ""] = 4.0,
) -> tuple[Float[Array, "K 2"], PointRecalculation]:
    """Pixels of least energy by Gauss-Newton steps; differentiable in forward mode.

    Args:
        start: Where the steps start: the estimate, or with slow motion the points of the frame before.
        estimated: Near which the result stays: projections of the filter's estimate.
        image: Grey levels.
        previous: Windows about the recalculated landmarks in the frame before, grey levels.
        first: Windows about the landmarks in the first frame, which keep the result from drifting.
        rho: Weight of the frame before against the first one.
        epsilon: Weight of the distance from `estimated`, grey levels^2 / px^2.
        max_iterations: Largest number of steps.
        tolerance_px: The steps end when no coordinate moves farther.
        step_px: Largest length of a landmark's step.
    """

    def advance(carry):
        points, info = carry
        equations = point_equations(points, estimated, image, previous, first, rho=rho, epsilon=epsilon)
        (a, b), (_, c) = jnp.moveaxis(equations.matrix, (-2, -1), (0, 1))
        x, y = jnp.moveaxis(equations.vector, -1, 0)
        step = -jnp.stack([c * x - b * y, a * y - b * x], axis=-1) / (a * c - b * b)[:, None]
        length = jnp.linalg.norm(step, axis=-1)
        step = step * jnp.minimum(1.0, step_px / jnp.where(length > 0, length, 1.0))[:, None]
        moved = jnp.max(jnp.abs(step), axis=-1)
        return points + step, PointRecalculation(info.iterations + 1, moved, equations.residual)

    def unfinished(carry):
        _, info = carry
        return (info.iterations < max_iterations) & ~(jnp.max(info.step_px) < tolerance_px)

    nothing_yet = jnp.full(len(start), jnp.inf, start.dtype)
    return lax.while_loop(unfinished, advance, (start, PointRecalculation(jnp.array(0), nothing_yet, nothing_yet)))


def point_windows(
    image: Num[Array, "rows cols"], points: Float[Array, "K 2"], *, size: int = 16
) -> Float[Array, "K {size} {size}"]:
    """Windows about pixels; what the next frame is compared with."""
    return cut(image, points, size)
