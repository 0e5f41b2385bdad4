"""Kalman filter atoms on roots of covariances: one triangularisation each, no subtraction anywhere.

Roots may have any width: `root root^T` is the covariance.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters import linalg
from jaxfilters.gaussian import GaussianRoot
from jaxfilters.kalman import info


def predict(
    belief: GaussianRoot,
    F: Float[Array, "k n"],
    root_Q: Float[Array, "k _"],
    b: Float[Array, " k"] | float = 0.0,
) -> GaussianRoot:
    """Belief in `x' = F x + b + root_Q q`, q ~ N(0, I)."""
    return GaussianRoot(F @ belief.mean + b, linalg.tria(jnp.hstack([linalg.matmul(F, belief.root), root_Q])))


def update(
    belief: GaussianRoot,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    root_R: Float[Array, "m _"],
    y_hat: Float[Array, " m"] | None = None,
    mask: Bool[Array, " m"] | None = None,
) -> tuple[GaussianRoot, info.KalmanInfo]:
    """Belief after seeing `y = y_hat + H (x - mean) + root_R r`, r ~ N(0, I), and its diagnostics.

    `y_hat` is `H mean` unless given: for a nonlinear observation it is the predicted one, and H its Jacobian.
    Components where `mask` is False are as if they were not there, whatever `y`, `y_hat` and the rows of `H` and
    `root_R` hold, NaN included. The array algorithm of T. Kailath, A. Sayed, B. Hassibi, "Linear Estimation", 2000,
    section 12.3.
    """
    m = y.size
    y, H, root_R = (info.observed(mask, rows) for rows in (y, H, root_R))
    y_hat = None if y_hat is None else info.observed(mask, y_hat)
    seen = jnp.hstack([linalg.matmul(H, belief.root), root_R])
    state = jnp.pad(belief.root, ((0, 0), (0, root_R.shape[1])))
    joint = linalg.tria(jnp.vstack([seen, state]))
    innovation_root, cross = joint[:m, :m], joint[m:, :m]
    deviation = info.innovation(belief.mean, y, H, y_hat)
    mean = belief.mean + cross @ linalg.solve_triangular(innovation_root, deviation)
    return GaussianRoot(mean, joint[m:, m:]), info.report(deviation, innovation_root)
