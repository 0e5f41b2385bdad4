"""Landmark positions from grey levels, near a prediction of the shape (Oka and Sato 2006, equations 25-28).

The energy that is minimised over the shape M, with windows of 16 x 16 pixels about the landmarks'
images m = P(pose, M):

    sum_windows rho |I_t(m) - I_{t-1}|^2 + |I_t(m) - I_1|^2  +  epsilon |M - M_estimated|^2

A window depends on its own landmark only, so that the normal equations are 3 x 3 for each.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer, Num, Real

from jaxfilters.math import linalg
from jaxfilters.models.face.correlation import cut, inside
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape


class Recalculation(NamedTuple):
    """How a recalculation ended."""

    iterations: Int[Array, ""]
    step_mm: Float[Array, " K"]
    """Largest coordinate of each landmark's last step, millimetres."""
    residual: Float[Array, " K"]
    """Root mean square difference to the first frame where the last step began, grey levels; NaN if no camera sees
    the landmark, which then moves to its estimate."""


class NormalEquations(NamedTuple):
    """The minimum of the linearised energy is the step `-matrix^-1 vector` of each landmark ([S3.17])."""

    matrix: Float[Array, "K 3 3"]
    """Grey levels^2 / mm^2; positive definite."""
    vector: Float[Array, "K 3"]
    """Grey levels^2 / mm: the gradient of the energy."""
    residual: Float[Array, " K"]
    """As in `Recalculation`."""


def patches(
    images: Num[Array, "C rows cols"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, "6"],
    rig: CameraRig,
    *,
    size: int = 16,
) -> Float[Array, "C K {size} {size}"]:
    """Windows about the images of the landmarks of a posed shape; what the next frame is compared with."""
    uv, _ = project_shape(rig, shape, pose)
    return jax.vmap(lambda image, points: cut(image, points, size))(images, uv)


def normal_equations(
    shape: Float[Array, "K 3"],
    estimated: Float[Array, "K 3"],
    images: Num[Array, "C rows cols"],
    previous: Num[Array, "C K T T"],
    first: Num[Array, "C K T T"],
    pose: Float[Array, "6"],
    rig: CameraRig,
    *,
    rho: Real[ArrayLike, ""] = 4.0,
    epsilon: Real[ArrayLike, ""] = 2000.0,
) -> NormalEquations:
    """The exact normal equations about a shape, with 2 epsilon in both sides ([S3.17]).

    `D = 2 (rho + 1) sum K^T K + 2 epsilon 1` and `d = 2 sum K^T (rho dI + dI_0) + 2 epsilon (M - M_estimated)`. As
    printed in [S3.18] and [S3.19] they hold epsilon in place of 2 epsilon, which is half of `epsilon` here. A camera
    in which the window with a border of one pixel leaves the image says nothing about the landmark.
    """
    rho, epsilon = jnp.asarray(rho, shape.dtype), jnp.asarray(epsilon, shape.dtype)
    size = first.shape[-1]
    uv, _ = project_shape(rig, shape, pose)
    observed = inside(rig.shape, uv, size + 2)[..., None, None]
    by_shape = jnp.where(observed, jacobian(rig, shape, pose)[0], 0.0)
    window = jnp.where(observed, patches(images, shape, pose, rig, size=size + 2), 0.0)
    gradient = jnp.stack(
        [window[..., 1:-1, 2:] - window[..., 1:-1, :-2], window[..., 2:, 1:-1] - window[..., :-2, 1:-1]], axis=2
    )
    gradient = gradient.reshape(*uv.shape, size**2) / 2
    here = window[..., 1:-1, 1:-1]
    since_first = jnp.where(observed, here - first, 0.0).reshape(*observed.shape[:2], size**2)
    since_previous = jnp.where(observed, here - previous, 0.0).reshape(*observed.shape[:2], size**2)
    product = lambda spec, *a: jnp.einsum(spec, *a, precision="highest")
    structure = product("ckip,ckjp->ckij", gradient, gradient)
    slope = product("ckip,ckp->cki", gradient, rho * since_previous + since_first)
    matrix = 2 * (rho + 1) * product("ckia,ckij,ckjb->kab", by_shape, structure, by_shape)
    vector = 2 * product("ckia,cki->ka", by_shape, slope) + 2 * epsilon * (shape - estimated)
    count = size**2 * jnp.sum(observed[..., 0, 0], axis=0)
    mean_square = jnp.sum(since_first**2, axis=(0, 2)) / jnp.maximum(count, 1)
    residual = jnp.where(count > 0, linalg.safe_sqrt(mean_square), jnp.nan)
    return NormalEquations(matrix + 2 * epsilon * jnp.eye(3, dtype=matrix.dtype), vector, residual)


def recalculate(
    start: Float[Array, "K 3"],
    estimated: Float[Array, "K 3"],
    images: Num[Array, "C rows cols"],
    previous: Num[Array, "C K T T"],
    first: Num[Array, "C K T T"],
    pose: Float[Array, "6"],
    rig: CameraRig,
    *,
    rho: Real[ArrayLike, ""] = 4.0,
    epsilon: Real[ArrayLike, ""] = 2000.0,
    max_iterations: Integer[ArrayLike, ""] = 10,
    tolerance_mm: Real[ArrayLike, ""] = 0.02,
    step_mm: Real[ArrayLike, ""] = 6.0,
) -> tuple[Float[Array, "K 3"], Recalculation]:
    """Shape of least energy by Gauss-Newton steps, in model coordinates; differentiable in forward mode.

    Args:
        start: Shape from which the steps start, millimetres: that of the frame before if it was recalculated.
        estimated: Shape near which the result stays, millimetres: that of the filter.
        images: Grey levels.
        previous: Windows about the recalculated landmarks in the frame before, grey levels.
        first: Windows about the landmarks in the first frame, which keep the result from drifting.
        pose: Of the head in this frame.
        rig: Cameras.
        rho: Weight of the frame before against the first one.
        epsilon: Weight of the distance from `estimated`, grey levels^2 / mm^2.
        max_iterations: Largest number of steps.
        tolerance_mm: The steps end when no coordinate moves farther.
        step_mm: Largest length of a landmark's step.
    """

    def advance(carry):
        shape, info = carry
        equations = normal_equations(shape, estimated, images, previous, first, pose, rig, rho=rho, epsilon=epsilon)
        L = jax.vmap(linalg.cholesky)(equations.matrix)
        half = jax.vmap(linalg.solve_triangular)(L, -equations.vector)
        step = jax.vmap(lambda L, b: linalg.solve_triangular(L, b, transpose=True))(L, half)
        length = linalg.safe_norm(step)
        step = step * jnp.minimum(1.0, step_mm / jnp.where(length > 0, length, 1.0))[:, None]
        moved = jnp.max(jnp.abs(step), axis=-1)
        return shape + step, Recalculation(info.iterations + 1, moved, equations.residual)

    def unfinished(carry):
        _, info = carry
        return (info.iterations < max_iterations) & ~(jnp.max(info.step_mm) < tolerance_mm)

    nothing_yet = jnp.full(start.shape[0], jnp.inf, start.dtype)
    return lax.while_loop(unfinished, advance, (start, Recalculation(jnp.array(0), nothing_yet, nothing_yet)))
