"""Parts of a long benchmark that are done, kept in its folder, so that a run that was cut off goes on where it was."""

import hashlib
import json
import math
import os
from collections.abc import Callable
from importlib.metadata import distributions
from pathlib import Path
from typing import cast, get_args

import numpy as np

from jaxfilters._sources import digest_of, package_folders
from jaxfilters.benchmarks.environment import environment
from jaxfilters.benchmarks.metrics import Direction, Metric
from jaxfilters.benchmarks.recordings import VARIABLE
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.npz import read_npz

_WANTED = "without it, it is measured anew"


class Finished:
    """What was measured before by the same code with the same settings on the same machine."""

    def __init__(self, out: Path | None, **settings: object) -> None:
        """Without a folder nothing is kept, and everything is measured.

        Args:
            out: Folder of the run; what is finished goes into one beneath it.
            settings: What the results depend on beside code, machine and recordings; JSON-able.
        """
        self._folder = None if out is None else out / f"finished-{_digest(settings)}"

    def arrays(self, name: str, measure: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """What `measure` gives, or gave under this name.

        Raises:
            InputError: what was kept cannot be read.
            OSError: the folder cannot be written.
        """
        if self._folder is None:
            return measure()
        path = self._folder / f"{name}.npz"
        if path.exists():
            return read_npz(path, _WANTED)
        measured = measure()
        self._folder.mkdir(parents=True, exist_ok=True)
        write_npz(path, measured)
        return measured

    def metrics(self, name: str, measure: Callable[[], dict[str, Metric]]) -> dict[str, Metric]:
        """As `arrays`, of numbers with their names."""
        kept = self.arrays(name, lambda: _as_arrays(measure()))
        rows = zip(kept["name"], kept["value"], kept["unit"], kept["better"], strict=True)
        return {str(key): Metric(float(value), str(unit), _better(str(of))) for key, value, unit, of in rows}


def _better(text: str) -> Direction | float:
    return cast(Direction, text) if text in get_args(Direction) else float(text)


def _as_arrays(metrics: dict[str, Metric]) -> dict[str, np.ndarray]:
    of = list(metrics.values())
    return {
        "name": np.array(list(metrics), str),
        "value": np.array([metric.value for metric in of], float),
        "unit": np.array([metric.unit for metric in of], str),
        "better": np.array([str(metric.better) for metric in of], str),
    }


def _digest(settings: dict[str, object]) -> str:
    """Changes with whatever may change a result: numbers of other code never mix with those of this one."""
    machine = {name: value for name, value in environment().items() if name != "load"}
    # Any package may matter: a part leaves out what needs one that is missing.
    installed = sorted(f"{one.name} {one.version}" for one in distributions())
    code = repr(digest_of(package_folders(), before_s=math.inf))
    message = json.dumps([settings, machine, installed, os.environ.get(VARIABLE), code], sort_keys=True)
    return hashlib.sha256(message.encode()).hexdigest()[:12]
