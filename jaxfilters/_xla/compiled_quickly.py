"""Programs of many small loops that take longer to compile than to run: with less of the compiler's work."""

from collections.abc import Callable
from functools import wraps
from importlib.metadata import version
from typing import Any, TypeVar

import jax
import numpy as np

from jaxfilters._xla.kept_traces import KeptPrograms, traces_are_kept

R = TypeVar("R")
_ZERO = np.zeros((), np.float32)

# Of XLA, for CPUs. The newer emitters take some milliseconds for each of a program's hundreds of loops, for little
# speed where these are small. From jaxlib 0.11 on there are no others.
_HAS_OLDER_EMITTERS = version("jaxlib").startswith("0.10.")
_OLDER: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False} if _HAS_OLDER_EMITTERS else {}
_UNOPTIMISED = _OLDER | {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""LLVM as well takes milliseconds a loop, which runs for microseconds."""
_LIGHTLY = _OLDER | {"xla_backend_optimization_level": 1} if _HAS_OLDER_EMITTERS else {}


def compiled_quickly(function: Callable[..., R], **settings: Any) -> Callable[..., R]:
    """`jax.jit` in an eighth of the time, for what is called a few times, such as the start of a track.

    The results are those of `jax.jit` up to rounding. Within another function that is traced, and on other devices than
    CPUs, it is `jax.jit`.

    Args:
        function: Called with arrays, of which one at least is an argument.
        settings: Of `jax.jit`, such as `static_argnames`.
    """
    return _compiled(function, _UNOPTIMISED, settings)


def compiled_lightly(function: Callable[..., R], **settings: Any) -> Callable[..., R]:
    """As `compiled_quickly`, for a program of hundreds of small loops that runs in every frame.

    With jaxlib 0.10 it compiles in three fifths of the time of `jax.jit`, and is as fast. With later ones it is
    `jax.jit`.
    """
    return _compiled(function, _LIGHTLY, settings)


def compiled_fully(function: Callable[..., R], **settings: Any) -> Callable[..., R]:
    """`jax.jit` for a large program, whose traced form is kept where `keep_traces` has named a folder.

    The traced forms of `compiled_quickly` and `compiled_lightly` are kept there as well.

    Args:
        function: Called with arrays, of which one at least is an argument.
        settings: Of `jax.jit`, such as `static_argnames`.
    """
    return _compiled(function, {}, settings)


def _compiled(function: Callable[..., R], options: dict[str, bool | int], settings: dict[str, Any]) -> Callable[..., R]:
    usual, quick = jax.jit(function, **settings), jax.jit(function, compiler_options=options or None, **settings)
    kept = KeptPrograms(function, options, settings)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> R:
        if not options and not traces_are_kept():
            return usual(*args, **kwargs)
        is_traced = any(_is_tracer(leaf) for leaf in jax.tree.leaves((args, kwargs)))
        if is_traced or jax.default_backend() != "cpu" or _within_program():
            return usual(*args, **kwargs)
        known = kept.find(args, kwargs) if traces_are_kept() and not jax.config.values["jax_disable_jit"] else None
        return known() if known else quick(*args, **kwargs)

    return call


def _is_tracer(leaf: Any) -> bool:
    return isinstance(leaf, jax.core.Tracer)


def _within_program() -> bool:
    """Whether a program is being traced, though perhaps not the arguments: its options are those of the whole."""
    return _is_tracer(jax.device_put(_ZERO))
