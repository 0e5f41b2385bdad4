"""Where a program spends its time on a GPU: its kernels, from the trace that JAX's profiler writes."""

import gzip
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

CALLS = 3
ROWS = 8
"""Kernels that are listed."""


class Kernel(NamedTuple):
    """All launches of one kernel in a call."""

    name: str
    launches: float
    milliseconds: float


def kernels(call: Callable[[], Any]) -> list[Kernel]:
    """What runs on the device in a call, the kernel with the most time first."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(CALLS):
                jax.block_until_ready(call())
        trace = next(Path(folder).rglob("*.trace.json.gz"))
        return on_device(json.loads(gzip.decompress(trace.read_bytes()))["traceEvents"], CALLS)


def on_device(events: list[dict], calls: int) -> list[Kernel]:
    """The kernels of a trace in Chrome's format, for each of `calls` calls.

    A device is a process of the trace, and each of its CUDA streams a thread; other threads repeat the same time by
    module and by operation.
    """
    names = {
        (e["pid"], e.get("tid"), e["name"]): e["args"]["name"]
        for e in events
        if e.get("ph") == "M" and "name" in e.get("args", {})
    }
    devices = {pid for (pid, _, kind), name in names.items() if kind == "process_name" and "/device:GPU" in name}
    streams = {
        (pid, tid)
        for (pid, tid, kind), name in names.items()
        if kind == "thread_name" and pid in devices and name.startswith("Stream")
    }
    launches: Counter[str] = Counter()
    microseconds: Counter[str] = Counter()
    for event in events:
        if event.get("ph") == "X" and (event["pid"], event["tid"]) in streams:
            launches[event["name"]] += 1
            microseconds[event["name"]] += event["dur"]
    return [Kernel(name, launches[name] / calls, 1e-3 * us / calls) for name, us in microseconds.most_common()]


def append(path: Path, title: str, found: list[Kernel]) -> None:
    """Write the busiest kernels beneath what the file has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    total, launches = sum(one.milliseconds for one in found), sum(one.launches for one in found)
    rows = [f"  {one.milliseconds:10.4f} ms {one.launches:9.0f} x  {one.name}" for one in found[:ROWS]]
    with path.open("a", encoding="utf-8") as file:
        file.write("\n".join([f"{title}: {total:.4f} ms in {launches:.0f} launches", *rows, ""]) + "\n")
