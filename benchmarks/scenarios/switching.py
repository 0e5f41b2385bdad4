"""Switching linear systems: interacting multiple models against filterpy, mixture Kalman filters against numpy.

A point on a line cruises or manoeuvres, two modes of two states, 100 noisy positions (1000 for the interacting multiple
models). `imm`: all means of the same readings, which have to agree with filterpy. `switching`: the mixture Kalman
filter with optimal resampling, the one of numpy (modes drawn from their posterior, systematic resampling) and the
bootstrap filter of this library on mode and state, each with 100 and with 1000 particles. `log_evidence_std` is the
standard deviation over random keys of the log evidence; `ratio_*_ms` are of processor times of one run, in turns;
`ratio_*_cost` are of variance times processor time, i.e. of the times in which both reach the same error. All estimates
agree within 4 standard errors, or nothing is reported. Without filterpy its ratio is missing.
"""

import statistics
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _switching_peers as peers
from jaxfilters.benchmarks.scenarios._switching_peers import System
from jaxfilters.benchmarks.timing import taking_turns

NUM_STEPS, NUM_LONG_STEPS = 100, 1000
SIZES = (100, 1000)
RUNS, QUICK_RUNS = 200, 20
ROUNDS, QUICK_ROUNDS = 15, 3
AGREES = 1e-3
"""Of means, in a state of order ten, in float32 against float64."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check that all agree, then time them; `out` is not used."""
    del out
    rounds, runs = (QUICK_ROUNDS, QUICK_RUNS) if quick else (ROUNDS, RUNS)
    metrics = _multiple_models(peers.simulated(seed, NUM_LONG_STEPS), rounds)
    system = peers.simulated(seed, NUM_STEPS)
    for size in SIZES:
        metrics |= _mixture(system, size, rounds, runs, seed)
    return metrics


def filters_of(system: System) -> list[jf.Filter]:
    """One Kalman filter for each mode."""
    prior = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
    H, R = (jnp.asarray(matrix, dtype=float) for matrix in (system.H, system.R))
    return [
        jf.kalman(prior, jnp.asarray(F, dtype=float), jnp.asarray(Q, dtype=float), H, R)
        for F, Q in zip(system.F, system.Q, strict=True)
    ]


def bootstrap(system: System, num_particles: int) -> jf.Filter:
    """Bootstrap filter of mode and state together."""
    F, root = jnp.asarray(system.F, dtype=float), jnp.asarray(np.linalg.cholesky(system.Q), dtype=float)
    log_chain = jnp.log(jnp.asarray(system.chain, dtype=float))
    log_initial = jnp.log(jnp.asarray(system.initial, dtype=float))
    std = float(np.sqrt(system.R[0, 0]))

    def sample_prior(key: Array) -> tuple[Array, Array]:
        mode_key, key = jax.random.split(key)
        return jax.random.categorical(mode_key, log_initial), jax.random.normal(key, (2,))

    def move(key: Array, particle: tuple[Array, Array]) -> tuple[Array, Array]:
        mode_key, key = jax.random.split(key)
        mode = jax.random.categorical(mode_key, log_chain[particle[0]])
        return mode, F[mode] @ particle[1] + root[mode] @ jax.random.normal(key, (2,))

    def log_likelihood(particle: tuple[Array, Array], y: Array) -> Array:
        return jax.scipy.stats.norm.logpdf(y[0], particle[1][0], std)

    return jf.bootstrap(sample_prior, move, log_likelihood, num_particles=num_particles)


def keep_mean(state: jf.IMMState, info: PyTree) -> Float[Array, " n"]:
    """The combined mean of every step."""
    del info
    return state.combined.mean


def _multiple_models(system, rounds):
    filter = jf.imm(filters_of(system), system.chain, system.initial)
    readings = jnp.asarray(system.readings, dtype=float)
    calls = {"ours": lambda: jf.run(filter, jax.random.key(0), readings, collect=keep_mean)[1]}
    found = np.asarray(calls["ours"]())
    if peers.has_filterpy():
        calls["filterpy"] = peers.filterpy_imm(system)
        error = abs(found - calls["filterpy"]()).max()
        if not error <= AGREES:
            raise RuntimeError(f"the means of filterpy and ours differ by {error:.2g}.")
    else:
        sys.stdout.write("not installed, and missing below: filterpy\n")
    times = _times(calls, rounds)
    metrics = {f"imm_ms_{name}": _milliseconds(seconds) for name, seconds in times.items()}
    if "filterpy" in times:
        metrics["ratio_imm_to_filterpy"] = Metric(_ratio(times, "filterpy"), "", "lower")
    return metrics


def _mixture(system, size, rounds, runs, seed):
    readings = jnp.asarray(system.readings, dtype=float)
    ours = jf.switching(filters_of(system), system.chain, system.initial, num_particles=size)
    estimates: dict[str, Callable[[int], float]] = {
        "ours": partial(_log_evidence, ours, readings),
        "bootstrap": partial(_log_evidence, bootstrap(system, size), readings),
        "numpy": partial(peers.numpy_mixture_kalman, system, size),
    }
    values = {
        name: np.array([estimate(seed + i) for i in range(runs)], np.float64) for name, estimate in estimates.items()
    }
    check({name: of for name, of in values.items() if name != "bootstrap"})
    times = _times({name: partial(estimate, seed) for name, estimate in estimates.items()}, rounds)
    metrics = {}
    for name in estimates:
        spread = float(values[name].std(ddof=1))
        metrics[f"switching_log_evidence_std_{name}_{size}"] = Metric(spread, "", "lower")
        metrics[f"switching_ms_{name}_{size}"] = _milliseconds(times[name])
    for name in ("numpy", "bootstrap"):
        ratio, variances = _ratio(times, name), values["ours"].var() / values[name].var()
        metrics[f"ratio_switching_ms_to_{name}_{size}"] = Metric(ratio, "", "lower")
        metrics[f"ratio_switching_cost_to_{name}_{size}"] = Metric(float(ratio * variances), "", "lower")
    return metrics


def check(log_evidences: dict[str, np.ndarray]) -> None:
    """Refuse to compare filters of different models.

    Raises:
        RuntimeError: If two means of evidences differ by more than 4 standard errors and 1e-3 of their size.
    """
    (name, ours), *others = log_evidences.items()
    scale = ours.mean()
    for other, theirs in others:
        means = [np.exp(values - scale).mean() for values in (ours, theirs)]
        errors = [np.exp(values - scale).std(ddof=1) / np.sqrt(len(values)) for values in (ours, theirs)]
        if not abs(means[0] - means[1]) <= 4 * np.hypot(*errors) + 1e-3:
            raise RuntimeError(f"the evidences of {name} and {other} are in the ratio {means[0] / means[1]:.3g}.")


def _log_evidence(filter, readings, seed):
    return float(jf.log_evidence(filter, jax.random.key(seed), readings))


def _times(calls, rounds):
    turns = taking_turns(calls, rounds)
    return {name: [spent.processor for spent in of] for name, of in turns.items()}


def _milliseconds(seconds):
    return Metric(1e3 * statistics.median(seconds), "ms", "lower")


def _ratio(times, name):
    return statistics.median(ours / theirs for ours, theirs in zip(times["ours"], times[name], strict=True))
