"""Switching linear systems by other means: filterpy's interacting multiple models, and filters in plain numpy."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class System(NamedTuple):
    """A point on a line that cruises or manoeuvres: a Markov chain of linear Gaussian models, in float64."""

    F: Array
    """(k, n, n)."""
    Q: Array
    """(k, n, n)."""
    H: Array
    """(1, n)."""
    R: Array
    """(1, 1)."""
    chain: Array
    """(k, k), rows sum to one."""
    initial: Array
    """(k,)."""
    readings: Array
    """(t, 1)."""


def simulated(seed: int, num_steps: int) -> System:
    """Readings of a system of two modes: constant velocity with little noise, and velocity that decays and jumps."""
    rng = np.random.default_rng(seed)
    shape = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    F, Q = np.array([[[1.0, 1.0], [0.0, 1.0]], [[1.0, 1.0], [0.0, 0.6]]]), np.stack([0.01 * shape, shape])
    system = System(
        F, Q, np.eye(1, 2), 0.25 * np.eye(1), np.array([[0.95, 0.05], [0.2, 0.8]]), np.full(2, 0.5), np.zeros((0, 1))
    )
    mode, x, readings = rng.choice(2), rng.normal(size=2), []
    for _ in range(num_steps):
        mode = rng.choice(2, p=system.chain[mode])
        x = F[mode] @ x + np.linalg.cholesky(Q[mode]) @ rng.normal(size=2)
        readings.append(system.H @ x + np.sqrt(system.R[0]) * rng.normal(size=1))
    return system._replace(readings=np.array(readings))


def has_filterpy() -> bool:
    """Whether filterpy can be imported."""
    return find_spec("filterpy") is not None


def filterpy_imm(system: System) -> Callable[[], Array]:
    """Combined means of filterpy's IMM estimator, (t, n)."""
    kalman = import_module("filterpy.kalman")

    def means() -> Array:
        filters = []
        for F, Q in zip(system.F, system.Q, strict=True):
            one = kalman.KalmanFilter(2, 1)
            one.x, one.P, one.F, one.Q, one.H, one.R = np.zeros(2), np.eye(2), F, Q, system.H, system.R
            filters.append(one)
        estimator, found = kalman.IMMEstimator(filters, system.initial, system.chain), []
        for y in system.readings:
            estimator.predict()
            estimator.update(y)
            found.append(estimator.x.copy())
        return np.array(found)

    return means


def numpy_mixture_kalman(system: System, num_particles: int, seed: int) -> float:
    """Log evidence by the mixture Kalman filter in a few lines of numpy, vectorised over particles.

    Modes are drawn from their posterior given the next reading, and particles are resampled systematically where the
    effective sample size is below one half (Chen and Liu, 2000).
    """
    rng, n = np.random.default_rng(seed), num_particles
    m, P, s = np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), rng.choice(2, size=n, p=system.initial)
    w, log_evidence = np.full(n, 1 / n), 0.0
    for y in system.readings:
        if 1 / np.sum(w**2) < n / 2:
            chosen = np.searchsorted(np.cumsum(w), (rng.random() + np.arange(n)) / n).clip(max=n - 1)
            m, P, s, w = m[chosen], P[chosen], s[chosen], np.full(n, 1 / n)
        joint, means, covariances = [], [], []
        for F, Q, chance in zip(system.F, system.Q, system.chain.T, strict=True):
            ahead, spread = m @ F.T, F @ P @ F.T + Q
            S, e = spread[:, 0, 0] + system.R[0, 0], y - ahead[:, 0]
            gain = spread[:, :, 0] / S[:, None]
            joint.append(chance[s] * np.exp(-0.5 * e**2 / S) / np.sqrt(2 * np.pi * S))
            means.append(ahead + gain * e[:, None])
            covariances.append(spread - gain[:, :, None] * spread[:, :1])
        total = joint[0] + joint[1]
        s, rows = (rng.random(n) * total > joint[0]).astype(int), np.arange(n)
        m, P = np.stack(means)[s, rows], np.stack(covariances)[s, rows]
        w = w * total
        log_evidence += np.log(w.sum())
        w = w / w.sum()
    return float(log_evidence)
