"""One process of `bench filters`: its Python, its cores and its floats are the caller's to choose.

`python -m jaxfilters.benchmarks.scenarios._filter_worker REQUEST [CORES]` prints a JSON object of metrics as its last
line.
"""

import json
import os
import sys
from typing import NamedTuple

import jax

from jaxfilters.benchmarks.scenarios import _filter_cases as cases
from jaxfilters.benchmarks.scenarios._filter_peers import installed


class Request(NamedTuple):
    """What to measure, and beside whom."""

    tasks: list[str]
    """Names of functions in `_filter_cases`, each with its arguments."""
    peers: list[str]
    rounds: int
    seed: int
    scale: float = 1.0
    """Of all sizes; below 1 to see that it runs."""
    float64: bool = False
    clock: str = "processor"
    """`processor` or `wall`: which of the two the ratios are of."""


def measure(request: Request) -> dict[str, tuple[float, str, str]]:
    """Value, unit and better direction of every metric."""
    setting = cases.Setting(request.peers, request.rounds, request.seed, request.scale, request.clock)
    found: dict[str, tuple[float, str, str]] = {}
    with jax.enable_x64(request.float64):
        for task in request.tasks:
            function, *arguments = task.split()
            metrics = getattr(cases, function)(setting, *arguments)
            found |= {name: (float(m.value), m.unit, m.better) for name, m in metrics.items()}
    return found


def main(argv: list[str]) -> None:
    """Answer one request, or `peers`: which of them this Python has."""
    if argv == ["peers"]:
        answer: object = installed()
    else:
        # Threads keep the cores of the thread that starts them: before JAX starts any.
        if len(argv) > 1:
            os.sched_setaffinity(0, map(int, argv[1].split(",")))
        request = Request(**json.loads(argv[0]))
        # For all threads: cuthbert calls back from one of its own.
        jax.config.update("jax_enable_x64", request.float64)
        answer = measure(request)
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
