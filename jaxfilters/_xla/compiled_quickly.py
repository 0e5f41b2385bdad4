"""Programs that run a few times in a process, compiled in an eighth of the time at the price of their speed."""

from collections.abc import Callable
from functools import wraps
from importlib.metadata import version
from typing import Any, ParamSpec, TypeVar

import jax

P, R = ParamSpec("P"), TypeVar("R")

OPTIONS: dict[str, bool | int] = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Of XLA, for CPUs. LLVM optimises each of a program's hundreds of loops for milliseconds; it runs for microseconds."""
if version("jaxlib").startswith("0.10."):
    # The newer emitters take some milliseconds a loop as well. From 0.11 on there are no older ones.
    OPTIONS["xla_cpu_use_fusion_emitters"] = False


def compiled_quickly(function: Callable[P, R], **settings: Any) -> Callable[P, R]:
    """`jax.jit` of a function that is called a few times: what starts a track, or says something at its end.

    The results are those of `jax.jit` up to rounding. Within another function that is traced, and on other devices than
    CPUs, it is `jax.jit`.

    Args:
        function: Called with arrays, of which one at least is an argument.
        settings: Of `jax.jit`, such as `static_argnames`.
    """
    usual, quick = jax.jit(function, **settings), jax.jit(function, compiler_options=OPTIONS, **settings)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        is_traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs)))
        return (usual if is_traced or jax.default_backend() != "cpu" else quick)(*args, **kwargs)

    return call
