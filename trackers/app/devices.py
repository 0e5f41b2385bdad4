"""What this machine computes with: one host device per core, chosen before JAX starts, for programs alone."""

import os
from pathlib import Path

_FLAG = "--xla_force_host_platform_device_count"


def use_all_cores() -> None:
    """Let XLA see every core as a device of its own, unless `XLA_FLAGS` says otherwise already.

    Work that is split over particles then uses all of them; without it, XLA's CPU backend runs such loops on one.
    Has no effect once JAX has computed anything.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}={available_cores()}".strip()


def available_cores() -> int:
    """Cores that this process may use, which a container can restrict below what the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor(*names: str) -> str:
    """What Linux says of the first processor under the first of the names that it knows; empty elsewhere."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    message = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in reversed(lines))}
    return next((message[name] for name in names if name in message), "")
