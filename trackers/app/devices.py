"""Settings of the whole process, for programs alone: a host device per core, memory, and what decoders write."""

import ctypes
import gc
import os
import platform
from pathlib import Path

_QUIET = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_LOG_LEVEL": "SILENT"}
"""Settings that OpenCV reads when it is imported; -8 is FFmpeg's AV_LOG_QUIET."""
_FLAG = "--xla_force_host_platform_device_count"
_MALLOC = {-3: 32 << 20, -1: 512 << 20, -2: 16 << 20}
"""Of glibc's `mallopt`, bytes: from what size on an array is mapped on its own (the largest allowed), how much free
memory is kept at the end of the heap, and by how much more than is needed the heap grows."""

_OBJECTS, _YOUNG, _OLD = 200_000, 20, 100
"""For `gc.set_threshold`: by how many objects the memory grows until Python looks for unreachable ones among the newest
ones, and after how many such rounds it looks among the older and the oldest ones."""


def use_all_cores() -> None:
    """Let XLA see every core as a device of its own, unless `XLA_FLAGS` says otherwise already.

    Work that is split over particles then uses all of them; without it, XLA's CPU backend runs such loops on one.
    Has no effect once JAX has computed anything.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}={available_cores()}".strip()


def keep_freed_memory() -> None:
    """Let the C library use the memory of one image for the next.

    Otherwise every image of a few megabytes is mapped and unmapped, and the kernel clears each of its pages anew: 3 of
    19 processor seconds of synthetic fingertips. Only glibc has these settings; elsewhere nothing changes.
    """
    if platform.libc_ver()[0] == "glibc":
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, size in _MALLOC.items():
            mallopt(parameter, size)


def silence_decoders() -> None:
    """Let FFmpeg and OpenCV write nothing to standard error: a command says in one line of its own what is wrong.

    Without effect once `cv2` is imported, and where the environment has these settings already. What libpng says of a
    damaged image cannot be switched off.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)


def collect_rarely() -> None:
    """Let Python look for unreachable objects in cycles less often than after every 700 new ones.

    While JAX traces, it makes millions of small objects that stay; looking through them took a tenth of a second run.
    """
    gc.freeze()
    gc.set_threshold(_OBJECTS, _YOUNG, _OLD)


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
