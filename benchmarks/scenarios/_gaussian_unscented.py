"""An unscented Kalman filter over many readings: the example of filterpy's manual, beside filterpy.

LowLevelParticleFilters.jl publishes times of the same example with 50,000 readings, which a reader may compare:
https://baggepinnen.github.io/LowLevelParticleFilters.jl/dev/benchmark.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.filter import log_evidence
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.sigma_point import unscented_kalman

INTERVAL_S, PROCESS_STD, READING_STD = 0.1, 0.01, 0.1


class Walk(NamedTuple):
    """A point of constant velocity in the plane, state (x, x', y, y'), observed by its position."""

    transition: np.ndarray
    process_noise: np.ndarray
    readings: np.ndarray


def walk(seed: int, num_steps: int) -> Walk:
    """Readings of a point that is simulated with the filter's own model."""
    rng, dt = np.random.default_rng(seed), INTERVAL_S
    gain = np.array([dt**2 / 2, dt])
    transition = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
    states = [np.zeros(4)]
    for noise in rng.normal(0.0, PROCESS_STD, (num_steps - 1, 2)):
        states.append(transition @ states[-1] + np.kron(noise, gain))
    readings = np.array(states)[:, ::2] + rng.normal(0.0, READING_STD, (num_steps, 2))
    return Walk(transition, PROCESS_STD**2 * np.kron(np.eye(2), np.outer(gain, gain)), readings)


def ours(problem: Walk) -> Callable[[], jax.Array]:
    """The compiled log evidence of the readings."""
    F, Q, readings = (jnp.asarray(each, dtype=float) for each in problem)
    filter = unscented_kalman(
        Gaussian(jnp.zeros(4), 0.2 * jnp.eye(4)), lambda x: F @ x, Q, lambda x: x[::2], READING_STD**2 * jnp.eye(2)
    )
    return partial(jax.jit(partial(log_evidence, filter)), jax.random.key(0), readings)


def filterpy(problem: Walk, *, with_evidence: bool) -> Callable[[], float]:
    """The loop of the manual; `with_evidence` sums the log likelihoods, which takes filterpy as long again."""
    kalman = import_module("filterpy.kalman")

    def run() -> float:
        points = kalman.MerweScaledSigmaPoints(4, alpha=0.1, beta=2.0, kappa=-1)
        filtering = kalman.UnscentedKalmanFilter(
            4, 2, INTERVAL_S, fx=lambda x, _dt: problem.transition @ x, hx=lambda x: x[::2], points=points
        )
        filtering.P *= 0.2
        filtering.R = READING_STD**2 * np.eye(2)
        filtering.Q = problem.process_noise
        total = 0.0
        for reading in problem.readings:
            filtering.predict()
            filtering.update(reading)
            total += filtering.log_likelihood if with_evidence else 0.0
        return total

    return run
