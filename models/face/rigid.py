"""The rigid part of a change of shape: full alignment, and the removal of infinitesimal motions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import linalg


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
    centred = mean - jnp.mean(mean, axis=0)
    # In units of the shape's own size, all columns of T are about as long.
    centred = centred * jax.lax.rsqrt(jnp.mean(jnp.sum(centred**2, axis=-1)))
    axes = jnp.eye(3, dtype=mean.dtype)
    turns = jnp.cross(axes, centred[:, None])
    T = jnp.concatenate([jnp.broadcast_to(axes, turns.shape), turns], axis=1)
    T = jnp.swapaxes(T, 1, 2).reshape(-1, 6)
    root = linalg.safe_sqrt(jnp.repeat(weights, 3))
    Q, R = jnp.linalg.qr(root[:, None] * T)
    motion = jax.scipy.linalg.solve_triangular(R, _product(Q.T, root * residual.ravel()))
    return residual - _product(T, motion).reshape(residual.shape)


def _product(A, B):
    """Matrix product in full precision on every device."""
    return jnp.matmul(A, B, precision="highest")
