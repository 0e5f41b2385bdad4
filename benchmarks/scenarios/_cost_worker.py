"""One process of the scaling part of `bench cost`: its devices, and whether it is one of several, are the caller's.

`python -m jaxfilters.benchmarks.scenarios._cost_worker REQUEST [RANK PORT]` prints a JSON object as its last line.
"""

import json
import statistics
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfilters import run as run_filter
from jaxfilters import weights
from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.timing import taking_turns
from jaxfilters.filter import keep_info
from jaxfilters.particle.sharding import sharded

NUM_STEPS = 4


class Request(NamedTuple):
    """What to run."""

    processes: int
    counts: list[int]
    """Numbers of particles, over all devices together, that are timed."""
    rounds: int
    seed: int
    runs: int
    """Independent runs whose posterior is reported, with the first of `counts`."""


def answer(request: Request) -> dict[str, Any]:
    """Processor seconds of a step of this process by number of particles; log evidence and a last mean of all runs."""
    mesh = jax.make_mesh((len(jax.devices()),), ("particles",))
    problem, key = models.drift(request.seed, NUM_STEPS), jax.random.key(request.seed)
    calls = {}
    for count in request.counts:
        filter = sharded(models.plain(problem.model, count), mesh)
        state, _ = run_filter(filter, key, problem.readings, collect=keep_info)

        def steps(filter=filter, state=state) -> Array:
            return run_filter(filter, key, problem.readings, state=state, collect=keep_info)[1].log_evidence

        jax.block_until_ready(steps())
        calls[str(count)] = steps
    times = taking_turns(calls, request.rounds)
    seconds = {name: statistics.median(one.processor for one in of) / NUM_STEPS for name, of in times.items()}
    return {"seconds": seconds} | _posterior(request, mesh, problem)


def _posterior(request: Request, mesh: Any, problem: models.DriftProblem) -> dict[str, list[float]]:
    filter = sharded(models.plain(problem.model, request.counts[0]), mesh)
    found = []
    for i in range(request.runs):
        key = jax.random.key(request.seed + 1 + i)
        _, (means, evidence) = run_filter(filter, key, problem.readings, collect=_last)
        found.append((float(jnp.sum(evidence)), float(means[-1])))
    return {"log_evidence": [one[0] for one in found], "mean": [one[1] for one in found]}


def _last(state: Any, info: Any) -> tuple[Array, Array]:
    return weights.mean(state.particles, state.log_weights)[0], info.log_evidence


def main(argv: list[str]) -> None:
    """Answer one request."""
    request = Request(**json.loads(argv[0]))
    if request.processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"localhost:{argv[2]}", request.processes, int(argv[1]))
    sys.stdout.write(json.dumps(answer(request)) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
