"""Kalman filter atoms on covariances, with Joseph's form of the update: never indefinite by subtraction."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters import linalg
from jaxfilters.gaussian import Gaussian
from jaxfilters.kalman import info


def predict(
    belief: Gaussian, F: Float[Array, "k n"], Q: Float[Array, "k k"], b: Float[Array, " k"] | float = 0.0
) -> Gaussian:
    """Belief in `x' = F x + b + q`, q ~ N(0, Q)."""
    return Gaussian(F @ belief.mean + b, _turned(F, belief.covariance) + Q)


def update(
    belief: Gaussian,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    y_hat: Float[Array, " m"] | None = None,
    mask: Bool[Array, " m"] | None = None,
) -> tuple[Gaussian, info.KalmanInfo]:
    """Belief after seeing `y = y_hat + H (x - mean) + r`, r ~ N(0, R), and its diagnostics.

    `y_hat` is `H mean` unless given: for a nonlinear observation it is the predicted one, and H its Jacobian.
    Components where `mask` is False are as if they were not there, whatever `y`, `y_hat` and the rows of `H` and
    `R` hold, NaN included. The covariance is `(I - K H) P (I - K H)^T + K R K^T` (R. Bucy, P. Joseph, "Filtering for
    stochastic processes", 1968).
    """
    y, H, R = info.observed(mask, y), info.observed(mask, H), info.observed(mask, info.observed(mask, R).T)
    y_hat = None if y_hat is None else info.observed(mask, y_hat)
    P = belief.covariance
    HP = linalg.matmul(H, P)
    L = linalg.cholesky(linalg.matmul(HP, H.T) + R)
    gain = linalg.solve_triangular(L, linalg.solve_triangular(L, HP), transpose=True).T
    left = jnp.eye(belief.mean.size, dtype=P.dtype) - linalg.matmul(gain, H)
    deviation = info.innovation(belief.mean, y, H, y_hat)
    posterior = Gaussian(belief.mean + gain @ deviation, _turned(left, P) + _turned(gain, R))
    return posterior, info.report(deviation, L)


def _turned(F, P):
    return linalg.matmul(linalg.matmul(F, P), F.T)
