"""The rigid part of a change of shape: full alignment, and the removal of infinitesimal motions."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._full_precision import qr
from jaxfilters.math import linalg


def align(
    source: Float[Array, "K 3"], target: Float[Array, "K 3"], weights: Float[Array, " K"] | None = None
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Rotation R, of determinant 1 always, and translation t of least `sum_k w_k |R source_k + t - target_k|^2`.

    From the singular vectors of the covariance of the centred points (W. Kabsch, "A solution for the best rotation to
    relate two sets of vectors", Acta Crystallographica A32, 1976). Not determined, nor differentiable, for points on a
    line. Without weights all are 1.
    """
    w = jnp.ones_like(source[:, 0]) if weights is None else weights
    w = (w / jnp.sum(w))[:, None]
    source_center, target_center = jnp.sum(w * source, axis=0), jnp.sum(w * target, axis=0)
    covariance = _product((w * (source - source_center)).T, target - target_center)
    U, _, Vt = jnp.linalg.svd(covariance)
    proper = jnp.sign(jnp.linalg.det(U) * jnp.linalg.det(Vt))
    R = _product(Vt.T * jnp.stack([jnp.ones_like(proper)] * 2 + [proper]), U.T)
    return R, target_center - _product(R, source_center)


EXPRESSION_STD = np.array(
    [
        *((0.13, 0.24, 0.18), (0.09, 0.12, 0.05), (0.09, 0.12, 0.05), (0.13, 0.24, 0.18)),
        *((3.12, 3.54, 4.16), (3.12, 3.54, 4.16), (1.52, 0.96, 0.71), (1.52, 0.96, 0.71)),
        *((0.27, 0.88, 0.16), (0.27, 0.88, 0.16)),
    ]
)
"""(10, 3) millimetres: root mean square displacement of the landmarks along x, y, z over the expressions of the ICT
face model without those of the gaze (light-stage scans; R. Li et al., "Learning formation of physically-based face
attributes", 2020; MIT License, see the file `NOTICE`)."""
MEASURED_STD = 0.1
"""Millimetres: of a measured landmark."""
ROUNDS, DEGREES_OF_FREEDOM = 8, 1.0


def remove_motion(residual: Float[Array, "K 3"], mean: Float[Array, "K 3"]) -> Float[Array, "K 3"]:
    """What is left of a change of shape after the small rigid motion that is likeliest beside an expression.

    As `remove_rigid`, but every coordinate speaks for the skull as little as expressions move it, and those that do
    not fit hardly speak at all: Student's t by reweighting, since one expression moves few landmarks far.

    Args:
        residual: Change of the ten landmarks, millimetres.
        mean: Shape that changes, millimetres.
    """
    T = _motions(mean)
    variance = jnp.asarray(EXPRESSION_STD**2 + MEASURED_STD**2, residual.dtype).ravel()
    r = residual.ravel()

    def left(weights: Array) -> Array:
        root = linalg.safe_sqrt(weights)
        Q, R = qr(root[:, None] * T)
        return r - _product(T, jax.scipy.linalg.solve_triangular(R, _product(Q.T, root * r)))

    def reweighted(_: Array | int, rest: Array) -> Array:
        return left((DEGREES_OF_FREEDOM + 1) / (DEGREES_OF_FREEDOM * variance + rest**2))

    return jax.lax.fori_loop(0, ROUNDS, reweighted, left(1 / variance)).reshape(residual.shape)


def motion_covariance(mean: Float[Array, "K 3"]) -> Float[Array, "6 6"]:
    """How well the skull's motion is known beside an ordinary expression: of a shift (mm) and a turn (rad).

    The covariance of the small motion that `remove_motion` takes out, in the model frame, where every coordinate errs
    as expressions move it.
    """
    T = _motions(mean)
    variance = jnp.asarray(EXPRESSION_STD**2 + MEASURED_STD**2, mean.dtype).ravel()
    scale = jnp.concatenate([jnp.ones(3, mean.dtype), jnp.full(3, _size(mean))])
    return jnp.linalg.inv(_product((T / variance[:, None]).T, T)) / jnp.outer(scale, scale)


def remove_rigid(
    residual: Float[Array, "K 3"], mean: Float[Array, "K 3"], weights: Float[Array, " K"]
) -> Float[Array, "K 3"]:
    """What weighted least squares leaves of a change of shape after small rigid motions (section 2.10).

    `r - T (T^T W T)^-1 T^T W r`, with three translations and the cross products of three axes with the mean shape as
    the columns of T.

    Args:
        residual: Change of the shape, millimetres.
        mean: Shape that changes, millimetres, not on a line.
        weights: How far each landmark speaks for the skull; three or more positive.
    """
    T = _motions(mean)
    root = linalg.safe_sqrt(jnp.repeat(weights, 3))
    Q, R = qr(root[:, None] * T)
    motion = jax.scipy.linalg.solve_triangular(R, _product(Q.T, root * residual.ravel()))
    return residual - _product(T, motion).reshape(residual.shape)


def _motions(mean: Array) -> Array:
    """Columns: three translations and three turns of a shape, in coordinates landmark by landmark."""
    centred = mean - jnp.mean(mean, axis=0)
    # In units of the shape's own size, all columns of T are about as long.
    centred = centred / _size(mean)
    axes = jnp.eye(3, dtype=mean.dtype)
    turns = jnp.cross(axes, centred[:, None])
    T = jnp.concatenate([jnp.broadcast_to(axes, turns.shape), turns], axis=1)
    return jnp.swapaxes(T, 1, 2).reshape(-1, 6)


def _size(mean):
    """Root mean square distance from the centroid."""
    centred = mean - jnp.mean(mean, axis=0)
    return jnp.sqrt(jnp.mean(jnp.sum(centred**2, axis=-1)))


def _product(A, B):
    """Matrix product in full precision on every device."""
    return jnp.matmul(A, B, precision="highest")
