"""How long `import jaxfilters` takes beyond `import jax`, in fresh processes.

`import_jax_s` and `import_jaxfilters_s` are medians of the processor times of whole processes that import one and do
nothing else, `import_beyond_jax_s` the median of the differences between such a pair: the price of the library for a
program that has JAX. Everything public is imported when it is first used.
"""

import os
import statistics
import subprocess
import sys
from pathlib import Path

from jaxfilters.benchmarks.metrics import Metric

ROUNDS, QUICK_ROUNDS = 15, 3
PROGRAMS = {"jax": "import jax", "jaxfilters": "import jax, jaxfilters"}


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Import each in turn in processes of their own; nothing is random, and `out` is not used."""
    del seed, out
    seconds: dict[str, list[float]] = {name: [] for name in PROGRAMS}
    for i in range(1 + (QUICK_ROUNDS if quick else ROUNDS)):
        for name in list(PROGRAMS)[:: 1 if i % 2 == 0 else -1]:
            spent = _seconds(PROGRAMS[name])
            # The first round writes byte code and fills the caches of the file system.
            if i:
                seconds[name].append(spent)
    beyond = [ours - jax for jax, ours in zip(seconds["jax"], seconds["jaxfilters"], strict=True)]
    found = {f"import_{name}_s": Metric(statistics.median(of), "s", "lower") for name, of in seconds.items()}
    return found | {"import_beyond_jax_s": Metric(statistics.median(beyond), "s", "lower")}


def _seconds(program):
    """Of processors, which other work on the machine hardly changes."""
    before = os.times()
    subprocess.run([sys.executable, "-c", program], check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system
