"""What scale costs: particles on two devices, Kalman filters in parallel in time, transport between many particles.

`sharded_*`: a step of the bootstrap filter of `bench filters` on one device and spread over two virtual ones, in a
process of its own on two cores; wall times, of which the least counts: other work on the machine only adds.
`in_time_*`: filter and smoother of a linear model of four states and two readings by `parallel_in_time`, as a ratio to
one frame after the other with the same square roots, and `_to_covariances` with covariances in place of roots; time of
processors. `transport_ms_*`: one resampling by transport
of particles of ten numbers, and `transport_gradient_ms_*` with its derivative.
"""

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters import run as run_filter
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.scenarios.gaussian import check_agreement
from jaxfilters.benchmarks.timing import Spent, spent, taking_turns
from jaxfilters.filter import Filter, keep_info
from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.linear import kalman
from jaxfilters.gaussian.parallel_in_time import LinearModel, parallel_kalman, parallel_rts
from jaxfilters.gaussian.smoothing import filter_and_smooth
from jaxfilters.particle.differentiable_resampling import transport
from jaxfilters.particle.sharding import sharded

LENGTHS, QUICK_LENGTHS = (100, 1000, 10_000, 100_000), (50,)
ENSEMBLES, QUICK_ENSEMBLES = (100_000, 1_000_000), (2_000,)
TRANSPORTED, QUICK_TRANSPORTED = (100, 200, 400, 800), (20,)
ROUNDS, QUICK_ROUNDS = 9, 2
NUM_STEPS = 4
STATES, READINGS = 4, 2


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure all three; `out` is not used."""
    del out
    rounds = QUICK_ROUNDS if quick else ROUNDS
    found: dict[str, Metric] = {}
    for length in QUICK_LENGTHS if quick else LENGTHS:
        found |= in_time(seed, length, rounds)
    for count in QUICK_TRANSPORTED if quick else TRANSPORTED:
        found |= transported(seed, count, rounds)
    for count in QUICK_ENSEMBLES if quick else ENSEMBLES:
        found |= on_two_devices(seed, count, rounds)
    return found


def in_time(seed: int, length: int, rounds: int) -> dict[str, Metric]:
    """Both ways through one sequence, which have to agree on the evidence and the first smoothed mean."""
    rng = np.random.default_rng(seed)
    F = jnp.asarray(0.95 * np.linalg.qr(rng.normal(size=(STATES, STATES)))[0], float)
    H = jnp.asarray(rng.normal(size=(READINGS, STATES)), float)
    ys = jnp.asarray(rng.normal(size=(length, READINGS)), float)
    prior = GaussianRoot(jnp.zeros(STATES), jnp.eye(STATES))
    root_Q, root_R = 0.3 * jnp.eye(STATES), 0.5 * jnp.eye(READINGS)
    model = LinearModel(F, root_Q, H, root_R)
    filter = kalman(prior, F, root_Q, H, root_R, arithmetic=arithmetic.square_root)
    key = jax.random.key(0)
    both = jax.jit(lambda ys: parallel_rts(parallel_kalman(prior, model, ys)[0], model).mean)
    in_turn = kalman(Gaussian(prior.mean, prior.root), F, root_Q @ root_Q.T, H, root_R @ root_R.T)
    calls: dict[str, Callable[[], Any]] = {
        "filter": lambda: run_filter(filter, key, ys, collect=keep_info)[1].log_evidence,
        "filter_parallel": jax.jit(partial(_log_evidences, prior, model, ys)),
        "smoother": lambda: filter_and_smooth(filter, key, ys)[0].mean,
        "smoother_parallel": partial(both, ys),
        "smoother_covariances": lambda: filter_and_smooth(in_turn, key, ys)[0].mean,
    }
    values = {name: call() for name, call in calls.items()}
    check_agreement({name: np.sum(values[name]) for name in ("filter", "filter_parallel")})
    error = float(np.max(np.abs(values["smoother"] - values["smoother_parallel"])))
    if not error < 1e-3:
        raise RuntimeError(f"smoothed means in parallel and one after the other differ by {error:.2g}.")
    times = taking_turns(calls, rounds)
    found = {}
    of_covariances = [
        a.processor / b.processor
        for a, b in zip(times["smoother_parallel"], times["smoother_covariances"], strict=True)
    ]
    found[f"in_time_smoother_to_covariances_t{length}"] = Metric(statistics.median(of_covariances), "", "lower")
    for name in ("filter", "smoother"):
        ratios = [a.processor / b.processor for a, b in zip(times[f"{name}_parallel"], times[name], strict=True)]
        found[f"in_time_{name}_ratio_t{length}"] = Metric(statistics.median(ratios), "", "lower")
        found[f"in_time_{name}_ms_t{length}"] = Metric(_milliseconds(times[f"{name}_parallel"]), "ms", "lower")
    return found


def transported(seed: int, count: int, rounds: int) -> dict[str, Metric]:
    """One resampling of weighted particles, and one with the derivative of a sum of what comes out."""
    rng = np.random.default_rng(seed)
    x = jnp.asarray(rng.normal(size=(10, count)), float)
    log_weights = jax.nn.log_softmax(jnp.asarray(rng.normal(size=count), float))
    scheme, key = transport(0.5), jax.random.key(0)

    def moved(x: Float[Array, "d n"]) -> Array:
        return jnp.sum(jnp.sin(scheme.resample(key, x, log_weights).particles))

    calls = {"transport": partial(jax.jit(moved), x), "transport_gradient": partial(jax.jit(jax.grad(moved)), x)}
    for call in calls.values():
        jax.block_until_ready(call())
    times = taking_turns(calls, rounds)
    return {f"{name}_ms_n{count}": Metric(_milliseconds(times[name]), "ms", "lower") for name in calls}


def on_two_devices(seed: int, count: int, rounds: int) -> dict[str, Metric]:
    """Ask a process that sees two devices."""
    flags = "--xla_force_host_platform_device_count=2"
    command = [sys.executable, "-m", "jaxfilters.benchmarks.scenarios.scale", *map(str, (seed, count, rounds))]
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, check=True)
    least = json.loads(finished.stdout.splitlines()[-1])
    found = {f"sharded_wall_ms_{name}_n{count}": Metric(value, "ms", "lower") for name, value in least.items()}
    for name in ("two", "exchanging"):
        found[f"sharded_wall_ratio_{name}_n{count}"] = Metric(least[name] / least["one"], "", "lower")
    return found


def steps_on_devices(seed: int, count: int, rounds: int) -> dict[str, float]:
    """Least milliseconds of a step: on one device, spread over all, and exchanging in every step."""
    problem = models.drift(seed, NUM_STEPS)
    filter, mesh = models.plain(problem.model, count), jax.make_mesh((2,), ("particles",))
    ways = {
        "one": filter,
        "two": sharded(filter, mesh),
        "exchanging": sharded(filter, mesh, island_threshold=1.0),
    }
    calls = {name: _from_a_start(way, problem.readings) for name, way in ways.items()}
    times = taking_turns(calls, rounds)
    return {name: 1e3 * min(one.wall for one in of) / NUM_STEPS for name, of in times.items()}


def _from_a_start(filter: Filter, readings: Float[Array, "t 3"]) -> Callable[[], Any]:
    """Steps from an ensemble that is there already, compiled."""
    key = jax.random.key(0)
    state, _ = run_filter(filter, key, readings, collect=keep_info)
    call = lambda: run_filter(filter, key, readings, state=state, collect=keep_info)[1].log_evidence
    spent(call)
    return call


def _log_evidences(prior, model, ys):
    return parallel_kalman(prior, model, ys)[1]


def _milliseconds(times: list[Spent]) -> float:
    return 1e3 * statistics.median(one.processor for one in times)


def main(arguments: list[str]) -> None:
    """Answer `on_two_devices`."""
    seed, count, rounds = map(int, arguments)
    answer: Mapping[str, float] = steps_on_devices(seed, count, rounds)
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
