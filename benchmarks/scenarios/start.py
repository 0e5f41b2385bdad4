"""Processor seconds of `jaxfilters track` on its synthetic recording, for the first time and for the second.

`first_run_s_<system>` is a whole command, from the start of Python to the last picture, whose folder of compiled
programs is empty. `second_run_s_<system>` is the same command again, which finds there what the first one left. Both
are medians over the rounds, and processor times of the process with its threads. Drawing the video is part of both.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.trackers.registry import SYSTEMS

ROUNDS = 3
QUICK_SYSTEMS = ("articulated",)
COMMAND = (sys.executable, "-P", "-m", "jaxfilters.trackers.app.cli", "track")
_CACHE = "JAX_COMPILATION_CACHE_DIR"


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Track each synthetic recording twice a round; they are those of the commands, and `out` is not used."""
    del seed, out
    names = QUICK_SYSTEMS if quick else tuple(one.name for one in SYSTEMS)
    found: dict[str, Metric] = {}
    for name in names:
        rounds = [_both(name) for _ in range(1 if quick else ROUNDS)]
        for which, seconds in zip(("first", "second"), zip(*rounds, strict=True), strict=True):
            found[f"{which}_run_s_{name.replace('-', '_')}"] = Metric(statistics.median(seconds), "s", "lower")
    return found


def _both(name: str) -> tuple[float, float]:
    """Of a system, without and with what the first run compiled."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [*COMMAND, name, "--out"]
        first, second = (_seconds([*arguments, f"{folder}/{run}"], f"{folder}/compiled") for run in ("first", "second"))
    return first, second


def _seconds(command: Sequence[str], cache: str) -> float:
    """Of processors, which other work on the machine hardly changes.

    Raises:
        RuntimeError: the command failed; the message has its last line.
    """
    before = os.times()
    ended = subprocess.run(command, capture_output=True, text=True, env=os.environ | {_CACHE: cache})
    after = os.times()
    if ended.returncode:
        raise RuntimeError(f"{' '.join(command)}: {(ended.stderr.splitlines() or ['no message'])[-1]}")
    return after.children_user + after.children_system - before.children_user - before.children_system
