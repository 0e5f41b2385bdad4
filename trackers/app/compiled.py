"""Compiled programs, kept in the user's cache folder from run to run. For the command; the library never does this."""

import hashlib
import os
import platform
from pathlib import Path

import jax
import platformdirs

from jaxfilters._xla.kept_traces import keep_traces
from jaxfilters.trackers.app.devices import processor

SECONDS_TO_COMPILE = 0.02
"""Programs that compile faster are not kept: reading them takes as long. Of the three dozen of `track people`, which
starts for the second time, those of a tenth of a second and more leave 1.3 s to read and to compile, these 0.9 s."""

_LEAST_SECONDS = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
"""JAX's name for this setting, which a user may have chosen."""

MEGABYTES = 256
"""The programs that have not been asked for longest make room for others. A tracker has 1 to 3 megabytes."""


def keep_compiled_programs() -> str:
    """Let JAX find what earlier runs have compiled, and leave what this one compiles.

    `JAX_COMPILATION_CACHE_DIR` names another folder; `JAX_ENABLE_COMPILATION_CACHE=0` keeps nothing.

    Returns:
        Why nothing is kept, if the folder cannot be written; else an empty string.
    """
    settings = jax.config.values
    if not settings["jax_enable_compilation_cache"]:
        return ""
    if not settings["jax_compilation_cache_dir"]:
        folder = platformdirs.user_cache_path("jaxfilters") / "compiled" / _instruction_set()
        if not os.access(next(path for path in (folder, *folder.parents) if os.path.exists(path)), os.W_OK):
            return f"{folder} cannot be written: what is compiled now is not kept"
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", MEGABYTES * 1_000_000)
    # Above JAX's own border of a second half of a tracker's programs are compiled in every run.
    if _LEAST_SECONDS not in os.environ:
        jax.config.update(_LEAST_SECONDS.lower(), SECONDS_TO_COMPILE)
    place = jax.config.values["jax_compilation_cache_dir"]
    if "://" not in place:  # the address of a bucket is no folder, though JAX can write there
        keep_traces(Path(place) / "traced")
    return ""


def _instruction_set() -> str:
    """A name for what this processor can do: a home folder may be shared by machines that cannot run each other's."""
    text = processor("flags", "Features") or platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
