"""All filters against dynamax, cuthbert, smcx and particles, and against what one writes first.

Kalman filters (linear, extended, unscented), their gradient and smoother; 1000 sequences at once; the bootstrap filter
of 1e3, 1e5 and 1e6 particles; Rao-Blackwellized filters, with a covariance for each particle and one for all, against
`vmap` of LAPACK (`ratio_rbpf_*_to_vmap`; `_wide` with 3 + 6 states instead of 1 + 3); resampling against a search;
hidden Markov models. All libraries find the same log evidence of the same readings, particle filters within 4 standard
errors, or nothing is timed. They take turns in every round, in one process that is bound to one core; a ratio is the
median over the rounds of processor times, which other work on the machine hardly changes. Suffixes: `_float64`; and
`_two_cores`, where ratios are of wall times. `first_call_s_*` is a first call in a fresh process with its compilation
(`ratio_first_call_*` to that of a peer, in turns),
`repeat_call_ratio` a call as it is used, without a `jit` around it, to a compiled one.

Peers that the running Python lacks can be in others: `JAXFILTERS_PEERS` lists their interpreters, separated as in
`PATH`; this library has to be installed there, too. A peer that none of them has is named, and its ratios are missing.
"""

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._filter_peers import PEERS
from jaxfilters.benchmarks.scenarios._filter_worker import Request
from jaxfilters.trackers.app.devices import available_cores

ROUNDS, QUICK_ROUNDS = 15, 3
FIRST_CALL_ROUNDS = 5
SCALE = 1.0
"""Of the sizes of all problems; below 1 to see that they run."""
GAUSSIAN = ["gaussian", "batched"]
PARTICLES = ["particle 1000 200", "particle 100000 20"]
REST = ["marginal", "resampler", "hidden_markov"]
MANY = "particle 1000000 3"
FIRST_CALLS = {"ekf": "dynamax", "gradient": "dynamax", "pf": "smcx"}
WORKER = "jaxfilters.benchmarks.scenarios._filter_worker"
INTERPRETERS = "JAXFILTERS_PEERS"


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure in processes of their own; `out` is not used."""
    del out
    found: dict[str, Metric] = {}
    rounds = QUICK_ROUNDS if quick else ROUNDS
    of_python = peers_of_interpreters()
    absent = set(PEERS) - {peer for peers in of_python.values() for peer in peers}
    if absent:
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    for python, peers in of_python.items():
        request = Request(GAUSSIAN + PARTICLES + REST, peers, rounds, seed, SCALE)
        measured = ask(python, request)
        if not quick:
            measured |= ask(python, request._replace(tasks=[MANY]))
            measured |= _suffixed("float64", ask(python, request._replace(float64=True)))
            if available_cores() > 1:
                two = request._replace(tasks=["gaussian", *PARTICLES, MANY, "resampler"], clock="wall")
                measured |= _suffixed("two_cores", ask(python, two, cores=2))
            for what, peer in FIRST_CALLS.items():
                measured |= first_calls(python, request, what, ["ours"] + [peer] * (peer in peers))
        # Of several interpreters the first says how this library does alone.
        found |= {name: value for name, value in measured.items() if name not in found}
    return found


def first_calls(python: str, request: Request, what: str, libraries: list[str]) -> dict[str, Metric]:
    """Seconds of a first call by each library in turn, medians over fresh processes; and their ratio."""
    rounds = []
    for i in range(FIRST_CALL_ROUNDS):
        measured: dict[str, Metric] = {}
        for library in libraries[:: 1 if i % 2 == 0 else -1]:
            measured |= ask(python, request._replace(tasks=[f"first_call {what} {library}"]))
        rounds.append([measured[f"first_call_s_{what}_{library}"].value for library in libraries])
    found = {
        f"first_call_s_{what}_{library}": Metric(statistics.median(seconds), "s", "lower")
        for library, seconds in zip(libraries, zip(*rounds, strict=True), strict=True)
    }
    if len(libraries) > 1:
        ratio = statistics.median(ours / peer for ours, peer in rounds)
        found[f"ratio_first_call_{what}_to_{libraries[1]}"] = Metric(ratio, "", "lower")
    return found


def peers_of_interpreters() -> dict[str, list[str]]:
    """The interpreters to measure with, this one first, and the peers that each is the first to have.

    Raises:
        RuntimeError: If an interpreter of `JAXFILTERS_PEERS` cannot run this library.
    """
    others = [python for python in os.environ.get(INTERPRETERS, "").split(os.pathsep) if python]
    known: set[str] = set()
    found: dict[str, list[str]] = {}
    for python in dict.fromkeys([sys.executable, *others]):
        new = [peer for peer in _answer([python, "-m", WORKER, "peers"], python) if peer not in known]
        known |= set(new)
        found[python] = new
    # One that has no peer measures nothing that another does not.
    useful = {python: peers for python, peers in found.items() if peers}
    return useful or {sys.executable: []}


def ask(python: str, request: Request, cores: int = 1) -> dict[str, Metric]:
    """What a fresh process measures, bound to so many cores.

    Raises:
        RuntimeError: If it fails, e.g. because libraries do not agree.
    """
    command = [python, "-m", WORKER, json.dumps(request._asdict())]
    if hasattr(os, "sched_setaffinity"):
        chosen = ",".join(map(str, sorted(os.sched_getaffinity(0))[-cores:]))
        command = [*command, chosen]
    answer = _answer(command, python)
    return {name: Metric(value, unit, better) for name, (value, unit, better) in answer.items()}


def _answer(command: list[str], python: str):
    # One device for a process, whatever this one was given: particles of one filter are compared.
    # A program that is found in a cache is not compiled: first calls of libraries could not be compared.
    environment = os.environ | {"XLA_FLAGS": "", "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, check=False)
    if finished.returncode != 0:
        raise RuntimeError(f"{python} failed to measure; is jaxfilters installed there? It said what above.")
    return json.loads(finished.stdout.splitlines()[-1])


def _suffixed(suffix: str, metrics: Mapping[str, Metric]) -> dict[str, Metric]:
    return {f"{name}_{suffix}": metric for name, metric in metrics.items()}
