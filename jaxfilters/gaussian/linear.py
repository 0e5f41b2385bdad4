"""The Kalman filter of a linear Gaussian model, given by its matrices."""

import jax
from jaxtyping import Array, Float, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.arithmetic import Arithmetic, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import extended_kalman


def kalman(
    prior: Gaussian | GaussianRoot,
    F: Float[Array, "n n"],
    Q: Float[Array, "n _"],
    H: Float[Array, "m n"],
    R: Float[Array, "m _"],
    *,
    arithmetic: Arithmetic = arithmetics.joseph,
) -> Filter:
    """Kalman filter of `x' = F x + q`, `y = H x + r` with `q ~ N(0, Q)` and `r ~ N(0, R)`.

    Args:
        prior: Belief before the first observation.
        F: Transition matrix, (n, n).
        Q: Covariance of the process noise, (n, n); a root of it for `arithmetic.square_root`.
        H: Observation matrix, (m, n).
        R: Covariance of the observation noise, (m, m); a root of it for `arithmetic.square_root`.
        arithmetic: `jaxfilters.arithmetic.joseph`, `square_root` or `fast`.
    """
    return extended_kalman(
        prior, jax.tree_util.Partial(_moved, F), Q, jax.tree_util.Partial(factor.apply, H), R, arithmetic=arithmetic
    )


def _moved(F: Array, x: Array, control: PyTree) -> Array:
    del control
    return factor.apply(F, x)
