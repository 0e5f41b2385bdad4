"""Log evidence of the same problems by other libraries; each is imported only where it is asked for."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.scenarios._gaussian_models import Coupled, Problem, Ranging

LogEvidence = Callable[[Coupled | Ranging, Float[Array, "t m"]], Array]


def installed() -> list[str]:
    """Those of dynamax, cuthbert and filterpy that can be imported."""
    return [name for name in ("dynamax", "cuthbert", "filterpy") if find_spec(name) is not None]


def dynamax(problem: Problem) -> LogEvidence:
    """Extended Kalman filter of dynamax, which starts with an update: its prior is predicted once before."""
    ssm = import_module("dynamax.nonlinear_gaussian_ssm")
    Q, R = _noises(problem)
    mean, P = problem.start.mean, problem.start.covariance

    def log_evidence(model: Coupled | Ranging, readings: Float[Array, "t m"]) -> Array:
        F = jax.jacfwd(model.move)(mean)
        params = ssm.ParamsNLGSSM(model.move(mean), F @ P @ F.T + Q, model.move, Q, model.observe, R)
        found = ssm.extended_kalman_filter(params, readings, output_fields=["filtered_means"])
        return found.marginal_loglik

    return log_evidence


def cuthbert(problem: Problem) -> LogEvidence:
    """Square-root filter of cuthbert on Taylor moments."""
    library, moments = import_module("cuthbert"), import_module("cuthbert.gaussian.moments")
    root_Q, root_R, root_P = (jnp.sqrt(C) for C in (*_noises(problem), problem.start.covariance))

    def log_evidence(model: Coupled | Ranging, readings: Float[Array, "t m"]) -> Array:
        filtering = moments.build_filter(
            problem.start.mean,
            root_P,
            lambda state, _reading: (lambda x: (model.move(x), root_Q), state.mean),
            lambda state, reading: (lambda x: (model.observe(x), root_R), state.mean, reading),
        )
        states = library.filter(filtering, readings, filtering.init_prepare())
        return states.log_normalizing_constant[-1]

    return log_evidence


def filterpy(problem: Problem) -> Callable[[], float]:
    """Extended Kalman filter of filterpy in numpy and float64, with the Jacobians of `Coupled` written out."""
    kalman = import_module("filterpy.kalman")
    Q, R = (np.asarray(noise, np.float64) for noise in _noises(problem))
    model = problem.model
    if not isinstance(model, Coupled):
        raise TypeError(f"model must be Coupled; got {type(model).__name__}.")
    A, C = (np.asarray(matrix, np.float64) for matrix in (model.A, model.C))
    readings = np.asarray(problem.readings, np.float64)

    def observe(x: np.ndarray) -> np.ndarray:
        return C @ x + 0.1 * np.tanh(C @ x)

    def slope(x: np.ndarray) -> np.ndarray:
        return C + 0.1 * (1 - np.tanh(C @ x) ** 2)[:, None] * C

    def log_evidence() -> float:
        filtering = kalman.ExtendedKalmanFilter(dim_x=A.shape[0], dim_z=C.shape[0])
        filtering.x, filtering.P = np.zeros(A.shape[0]), np.asarray(problem.start.covariance, np.float64)
        filtering.Q, filtering.R = Q, R
        filtering.predict_x = lambda *_: None
        total = 0.0
        for y in readings:
            filtering.F = A + 0.05 * np.diag(np.cos(filtering.x))
            ahead = A @ filtering.x + 0.05 * np.sin(filtering.x)
            filtering.predict()
            filtering.x = ahead
            filtering.update(y, slope, observe)
            total += filtering.log_likelihood
        return total

    return log_evidence


def _noises(problem):
    size, count = problem.start.mean.size, problem.readings.shape[1]
    return problem.process_variance * jnp.eye(size), problem.reading_variance * jnp.eye(count)
