"""A model of cost: constants measured on this machine, what they predict, and how far sizes left out differ from it.

Of each computation in `_cost_families`, the processor time of a step is fitted by a sum of terms of its size, with
constants of at least 0 and least relative errors: `NAME_ns_TERM`. `NAME_time_error_SIZE` is by how much the prediction
for a size that was left out differs from the time measured, as a share of the latter. `NAME_bytes_TERM` and
`NAME_memory_error_SIZE` are the same of the memory of the compiled program.

`particle_step_ns_*`: a step of the bootstrap filter of `bench filters` per particle, spread by `jf.sharding.sharded`
over 1, 2, 4 virtual devices of one process (`d`) or processes of `jax.distributed` on this machine (`p`), with the same
number of particles in all (`strong`) and on each (`weak`). Processor time, summed over processes. `*_error_*4` is that
of the prediction for 4 from 1 and 2. `z_*` are the differences of the log evidence and of a posterior mean to those of
one device, in standard errors.
"""

import json
import math
import os
import socket
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._cost_families import FAMILIES, Family, Size, Terms
from jaxfilters.benchmarks.scenarios._cost_worker import Request
from jaxfilters.benchmarks.scenarios.accelerator import counted
from jaxfilters.benchmarks.timing import spent, taking_turns

ROUNDS, QUICK_ROUNDS = 5, 1
PARTICLES, QUICK_PARTICLES = 100_000, 400
RUNS, QUICK_RUNS = 20, 3
DEVICES = (1, 2, 4)


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure constants and scaling; `out` is not used."""
    del out
    rounds = QUICK_ROUNDS if quick else ROUNDS
    found: dict[str, Metric] = {}
    for name, family in FAMILIES.items():
        sizes = family.quick if quick else (family.fitted, family.held_out)
        found |= modelled(name, family, sizes, seed, rounds)
    request = Request(1, [QUICK_PARTICLES if quick else PARTICLES], rounds, seed, QUICK_RUNS if quick else RUNS)
    for kind in "dp":
        found |= scaled(kind, request)
    return found


def modelled(
    name: str, family: Family, sizes: tuple[Sequence[Size], Sequence[Size]], seed: int, rounds: int
) -> dict[str, Metric]:
    """Constants of one family from the first sizes, and the errors of its predictions for the others."""
    fitted, held_out = sizes
    programs, steps = {}, {}
    for size in (*fitted, *held_out):
        work = family.work(seed, size)
        programs[size], steps[size] = counted(work), work.loops
        spent(programs[size].call)
    times = taking_turns({str(size): program.call for size, program in programs.items()}, rounds)
    seconds = {size: statistics.median(one.processor for one in times[str(size)]) / steps[size] for size in programs}
    memory = {size: float(program.memory) for size, program in programs.items()}
    found: dict[str, Metric] = {}
    for of, unit, factor, values in (("time", "ns", 1e9, seconds), ("memory", "bytes", 1.0, memory)):
        constants = fit(family.terms, {size: values[size] for size in fitted})
        found |= {f"{name}_{unit}_{term}": Metric(factor * c, unit, "lower") for term, c in constants.items()}
        for size in held_out:
            error = abs(predicted(family.terms, constants, size) / values[size] - 1)
            found[f"{name}_{of}_error_{'x'.join(map(str, size))}"] = Metric(error, "", "lower")
    sys.stderr.write(f"  {name}\n")
    return found


def fit(terms: Terms, values: dict[Size, float]) -> dict[str, float]:
    """Constants of at least 0 of a sum of terms, with the least squares of relative errors."""
    matrix = np.array([[_term(powers, size) / value for powers in terms.values()] for size, value in values.items()])
    scale = np.linalg.norm(matrix, axis=0)
    constants, _ = nnls(matrix / scale, np.ones(len(values)))
    return dict(zip(terms, map(float, constants / scale), strict=True))


def predicted(terms: Terms, constants: dict[str, float], size: Size) -> float:
    """The sum of the terms at a size."""
    return math.fsum(constants[name] * _term(powers, size) for name, powers in terms.items())


def _term(powers: tuple[int, ...], size: Size) -> float:
    return math.prod(float(number) ** power for number, power in zip(size, powers, strict=True))


def scaled(kind: str, request: Request) -> dict[str, Metric]:
    """Weak and strong scaling over virtual devices (`d`) or processes (`p`), and agreement of the posteriors."""
    base = request.counts[0]
    answers = {}
    for count in DEVICES:
        # Strong scaling has as many particles in all as four devices have in weak scaling.
        counts = sorted({base * count, base * DEVICES[-1]}, reverse=True)
        processes = count if kind == "p" else 1
        answers[count] = asked(request._replace(processes=processes, counts=counts), count // processes)
    found = {}
    of = lambda count, total: answers[count]["seconds"][str(total)]
    for way in ("strong", "weak"):
        for count in DEVICES:
            total = base * (DEVICES[-1] if way == "strong" else count)
            found[f"particle_step_ns_{way}_{kind}{count}"] = Metric(1e9 * of(count, total) / total, "ns", "lower")
    # A constant for each device, and one for each particle.
    terms: Terms = {"devices": (1, 0), "n": (0, 1)}
    known: dict[Size, float] = {(c, n): of(c, n) for c in DEVICES[:-1] for n in (base * c, base * DEVICES[-1])}
    constants, size = fit(terms, known), (DEVICES[-1], base * DEVICES[-1])
    error = abs(predicted(terms, constants, size) / of(*size) - 1)
    found[f"particle_step_device_us_{kind}"] = Metric(1e6 * constants["devices"], "us", "lower")
    found[f"particle_step_error_{kind}{DEVICES[-1]}"] = Metric(error, "", "lower")
    for count in DEVICES[1:]:
        for what in ("log_evidence", "mean"):
            found[f"z_{what}_{kind}{count}"] = Metric(_z(answers[count][what], answers[1][what]), "", "lower")
    return found


def asked(request: Request, num_devices: int) -> dict[str, Any]:
    """The answer of the processes of a request, each with so many devices; seconds are summed over processes."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={num_devices}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    command = [sys.executable, "-m", "jaxfilters.benchmarks.scenarios._cost_worker", json.dumps(request._asdict())]
    started = [
        subprocess.Popen([*command, str(rank), port], stdout=subprocess.PIPE, text=True, env=environment)
        for rank in range(request.processes)
    ]
    texts = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise RuntimeError(f"a process of {request.processes} ended with {[one.returncode for one in started]}.")
    answers = [json.loads(text.splitlines()[-1]) for text in texts]
    seconds = {name: math.fsum(one["seconds"][name] for one in answers) for name in answers[0]["seconds"]}
    return answers[0] | {"seconds": seconds}


def _z(ours: list[float], others: list[float]) -> float:
    """The difference of two means in standard errors."""
    variance = sum(np.var(values, ddof=1) / len(values) for values in (ours, others))
    return float(abs(np.mean(ours) - np.mean(others)) / np.sqrt(variance))
