"""Sigma-point filters: `extended_kalman` with a regression on points in place of derivatives."""

from typing import Any

from jaxfilters.filter import Filter
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.linearize import cubature, unscented


def unscented_kalman(*model: Any, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0, **options: Any) -> Filter:
    """Unscented Kalman filter (E. A. Wan and R. van der Merwe, 2000): 2 n + 1 points and no derivative.

    Args:
        model: `prior, transition, process_noise, observe, observation_noise`, as for `extended_kalman`.
        alpha: Distance of the points from the mean, relative to the spread that matches the fourth moment.
        beta: Weight of the centre point in the covariance; 2 suits Gaussian states.
        kappa: Added to the dimension of the state in the distance of the points.
        options: `arithmetic`, `manifold`, `residual` and `iterations` of `extended_kalman`.
    """
    return extended_kalman(*model, linearize=unscented(alpha, beta, kappa), **options)


def cubature_kalman(*model: Any, **options: Any) -> Filter:
    """Cubature Kalman filter (I. Arasaratnam and S. Haykin, 2009): 2 n equally weighted points and no derivative.

    Args:
        model: `prior, transition, process_noise, observe, observation_noise`, as for `extended_kalman`.
        options: `arithmetic`, `manifold`, `residual` and `iterations` of `extended_kalman`.
    """
    return extended_kalman(*model, linearize=cubature, **options)
