"""All that an accelerator should be good at, on whatever device JAX has: time, arithmetic, memory, other libraries.

Depth images of a hand under 512 and 1e5 poses (in chunks), particle filters up to 1e8 particle-steps, Rao-Blackwellized
filters, 1e5 tracks, resampling, smoothing in turn and parallel in time up to 1e6 frames, hidden Markov models, and
gradients. `*_ms_N` is the median time of a call of size N, compilation excluded; `*_gflop_per_s_N` and `*_gb_per_s_N`
are XLA's count of arithmetic and of bytes, the body of a loop times its steps, over that time; `*_mb_N` is the memory
of the program. On a device whose limits are known, `*_share_N` is the larger of both rates as a share of its limit.
`ratio_*` compare with smcx, blackjax, dynamax and cuthbert on the same device, in turns. A task ends with the size that
takes longer than two seconds.

With `--out DIR` a run that was cut off goes on after the last task that it had finished, and on a GPU
`DIR/profile.txt` has the kernels in which each task spends its time, at the largest size that takes less than .1 s.

    jaxfilters bench accelerator --json accelerator.json --out DIR
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _accelerator_profile as profile
from jaxfilters.benchmarks.scenarios._accelerator_tasks import Task, Work, tasks
from jaxfilters.benchmarks.timing import interleaved, spent

ROUNDS, QUICK_ROUNDS = 9, 1
LONGEST_S = 2.0
PROFILED_S = 0.1
"""Longer programs are not profiled: a trace has every launch."""
LIMITS = {
    "H200": (67e12, 4.8e12),
    "H100": (67e12, 3.35e12),
    "A100": (19.5e12, 1.555e12),
    "V100": (15.7e12, 0.9e12),
    "L4": (30.3e12, 0.3e12),
    "T4": (8.1e12, 0.32e12),
}
"""Float32 operations and bytes a second by the data sheets of NVIDIA, by a part of the name of the device."""


class Counted(NamedTuple):
    """A compiled program, and what it costs by XLA's count."""

    call: Callable[[], Any]
    operations: float
    bytes: float
    """Read and written."""
    memory: float
    """Bytes of arguments, results and intermediate values."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure every task, and write profiles of a GPU into `out`."""
    kept = Finished(out, scenario="accelerator", quick=quick, seed=seed)
    found: dict[str, Metric] = {}
    for name, task in tasks(seed).items():
        with jax.enable_x64(task.float64):
            found |= kept.metrics(name, partial(measured, name, task, quick=quick, out=out))
    return found


def measured(name: str, task: Task, *, quick: bool, out: Path | None = None) -> dict[str, Metric]:
    """Metrics of one task, up to the size that takes too long; on a GPU its kernels are written into `out`."""
    found: dict[str, Metric] = {}
    profiled: tuple[str, Callable[[], Any]] | None = None
    for size in (task.quick,) if quick else task.sizes:
        work = task.work(size)
        program = counted(work)
        jax.block_until_ready(program.call())
        first = spent(program.call).wall
        calls = {"ours": program.call} | ({} if first > LONGEST_S else dict(work.others))
        seconds = interleaved(calls, 1 if first > 1 else QUICK_ROUNDS if quick else ROUNDS)
        found |= _rates(name, size, program, seconds["ours"])
        for peer in calls.keys() - {"ours"}:
            found[f"ratio_{name}_{size}_to_{peer}"] = Metric(seconds["ours"] / seconds[peer], "", "lower")
        sys.stderr.write(f"  {name} {size}: {1e3 * seconds['ours']:.3g} ms\n")
        if first < PROFILED_S:
            profiled = f"{name} {size}", program.call
        if first > LONGEST_S:
            break
    if out is not None and profiled is not None and jax.default_backend() == "gpu":
        profile.append(out / "profile.txt", profiled[0], profile.kernels(profiled[1]))
    return found


def counted(work: Work) -> Counted:
    """The compiled program."""
    compiled = jax.jit(work.function).lower(*work.arguments).compile()
    cost = compiled.cost_analysis() or {}
    memory = compiled.memory_analysis()
    sizes = ("temp_size_in_bytes", "argument_size_in_bytes", "output_size_in_bytes")
    return Counted(
        partial(compiled, *work.arguments),
        work.loops * cost.get("flops", 0.0),
        work.loops * cost.get("bytes accessed", 0.0),
        sum(getattr(memory, size, 0) for size in sizes),
    )


def lowered_for(platform: str, work: Work) -> str:
    """The program as it would be compiled for another platform, of which no device is needed."""
    return jax.jit(work.function).trace(*work.arguments).lower(lowering_platforms=(platform,)).as_text()


def _rates(name: str, size: int, program: Counted, seconds: float) -> dict[str, Metric]:
    found = {
        f"{name}_ms_{size}": Metric(1e3 * seconds, "ms", "lower"),
        f"{name}_gflop_per_s_{size}": Metric(1e-9 * program.operations / seconds, "1e9/s", "higher"),
        f"{name}_gb_per_s_{size}": Metric(1e-9 * program.bytes / seconds, "GB/s", "higher"),
        f"{name}_mb_{size}": Metric(1e-6 * program.memory, "MB", "lower"),
    }
    kind = jax.devices()[0].device_kind
    limits = next((limits for part, limits in LIMITS.items() if part in kind), None)
    if limits is not None:
        share = max(program.operations / limits[0], program.bytes / limits[1]) / seconds
        found[f"{name}_share_{size}"] = Metric(share, "", "higher")
    return found
