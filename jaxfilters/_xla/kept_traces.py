"""Traced programs, kept in a folder from run to run.

JAX looks for a compiled program in its cache by what tracing and lowering yield, so every process traces a known
program again: a quarter of a tracker's second run. Here the traced program itself is found, by `trace_key`. The numbers
are bit for bit those of `jax.jit`. The results lie on one device, or on each device where the program divides its work
between the devices.
"""

import hashlib
import inspect
import os
import pickle
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax import export
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

from jaxfilters._xla.trace_key import is_described_by_sources, key_of, scoped_settings

R = TypeVar("R")

MEGABYTES = 64
"""At most so much is kept; what was not read for longest is removed first. A tracker has about half a megabyte."""
_DIGEST_BYTES = 32
_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)

_folder: Path | None = None


def keep_traces(folder: Path | None) -> None:
    """Keep the traced programs of this process in `folder`, and take known ones from there.

    Files of the folder are unpickled: as with a cache of compiled programs, whoever may write to it decides what runs.

    Args:
        folder: Made when something is kept; None to keep nothing from now on.
    """
    global _folder
    _folder = folder


def traces_are_kept() -> bool:
    """Whether a folder has been named."""
    return _folder is not None


class KeptPrograms(Generic[R]):
    """A function of arrays whose traced programs are kept, one for each set of types and static arguments.

    Args:
        function: Any function; the programs of those are kept that are at the top of a module of this package.
        compiler_options: As for `jax.jit`.
        settings: Further arguments of `jax.jit`; of these, `static_argnames` and `static_argnums` are used.
    """

    def __init__(self, function: Callable[..., R], compiler_options: dict[str, bool | int], settings: dict[str, Any]):
        self._function = function
        self._compiler_options = compiler_options or None
        self._settings = settings
        self._programs: dict[Any, Callable[..., R] | None] = {}

    def find(self, args: tuple, kwargs: dict[str, Any]) -> Callable[[], R] | None:
        """The call of the program for these arguments.

        Returns:
            None where `jax.jit` must be called in its place: what cannot be named, exported or written as a file, and
            arguments that `jax.jit` refuses, with a message of its own.
        """
        if not is_described_by_sources(self._function):
            return None
        try:
            arrays = dict(self._signature.bind(*args, **kwargs).arguments)
            static = {name: arrays.pop(name) for name in self._static_names if name in arrays}
            leaves, tree = jax.tree.flatten(arrays)
            types = tuple(map(jax.typeof, leaves))
            known = tree, types, tuple((name, type(value), value) for name, value in static.items()), scoped_settings()
            is_new = known not in self._programs
        except (TypeError, ValueError, OverflowError):
            return None
        if is_new:
            self._programs[known] = self._program(tree, types, static)
        program = self._programs[known]
        if program is None or any(map(_is_divided, leaves)):
            return None
        return lambda: program(*leaves)

    @cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self._function)

    @cached_property
    def _static_names(self) -> list[str]:
        names, numbers = (self._settings.get(f"static_{kind}", ()) for kind in ("argnames", "argnums"))
        parameters = list(self._signature.parameters)
        named = [names] if isinstance(names, str) else list(names)
        return named + [parameters[number] for number in ([numbers] if isinstance(numbers, int) else numbers)]

    def _program(self, tree: Any, types: tuple, static: dict[str, Any]) -> Callable[..., R] | None:
        # Functions of users are within arguments: whatever they raise here, they raise again within `jax.jit`.
        with suppress(Exception):
            is_named = all(one.kind in _NAMED for one in self._signature.parameters.values())
            key = key_of(self._function, tree, types, static) if is_named else None
            if key is None or _folder is None:
                return None
            file = _folder / f"{self._function.__name__}-{key}"
            payload = _read(file)
            if payload is None:
                payload = self._traced(tree, types, static)
                _write(file, payload)
            serialized, outputs = pickle.loads(payload)
            if serialized is not None:
                return self._compiled(export.deserialize(serialized), jax.tree.structure(outputs))
        return None

    def _traced(self, tree: Any, types: tuple, static: dict[str, Any]) -> bytes:
        """The program that takes and returns leaves, and the structure of its result with a number for each leaf.

        Pickled; None in place of both where a result is weakly typed, which exported programs do not remember.
        """
        structures: list[Any] = []

        def of_leaves(*leaves: Any) -> list:
            results, structure = jax.tree.flatten(self._function(**jax.tree.unflatten(tree, leaves), **static))
            structures.append(structure)
            return results

        arguments = [jax.ShapeDtypeStruct(type.shape, type.dtype, weak_type=type.weak_type) for type in types]
        exported = export.export(jax.jit(of_leaves))(*arguments)
        if any(result.weak_type for result in exported.out_avals):
            return pickle.dumps((None, None))
        outputs = jax.tree.unflatten(structures[-1], range(structures[-1].num_leaves))
        return pickle.dumps((bytes(exported.serialize()), outputs))

    def _compiled(self, exported: export.Exported, structure: Any) -> Callable[..., R]:
        def run(*leaves: Any) -> list:
            return exported.call(*leaves)

        # Left to JAX, the first call would have arguments of no device, and the second ones of a device: two programs.
        devices = jax.local_devices()[: exported.nr_devices]
        everywhere: Sharding = SingleDeviceSharding(devices[0])
        if len(devices) > 1:
            everywhere = NamedSharding(Mesh(np.array(devices), ("devices",)), PartitionSpec())
        run.__name__ = self._function.__name__  # in profiles, and of the compiled program that is kept
        options = self._compiler_options
        compiled = jax.jit(run, in_shardings=everywhere, out_shardings=everywhere, compiler_options=options)
        return lambda *leaves: jax.tree.unflatten(structure, compiled(*leaves))


def _is_divided(leaf: Any) -> bool:
    """Whether the parts of an array lie on several devices."""
    return isinstance(leaf, jax.Array) and not leaf.sharding.is_fully_replicated


def _read(file: Path) -> bytes | None:
    """What was kept, or None where there is none or it is damaged."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    with suppress(OSError):  # of another user
        os.utime(file)
    digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    return payload if hashlib.sha256(payload).digest() == digest else None


def _write(file: Path, payload: bytes) -> None:
    """Keep `payload`, whole or not at all, since other processes may read the folder; nothing more where that fails."""
    unfinished = file.with_name(f"{file.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_bytes(hashlib.sha256(payload).digest() + payload)
        unfinished.replace(file)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        keep_traces(None)
        warnings.warn(f"{file.parent}: {error.strerror}; traced programs are not kept from here on", stacklevel=2)
        return
    with suppress(OSError):
        _make_room(file.parent)


def _make_room(folder: Path) -> None:
    """Remove what has not been read for longest; what another process removes meanwhile is gone."""
    kept = []
    for file in folder.iterdir():
        with suppress(FileNotFoundError):
            kept.append((file.stat().st_mtime, file.stat().st_size, file))
    total = 0
    for _, size, file in sorted(kept, reverse=True):
        total += size
        if total > MEGABYTES * 1_000_000:
            file.unlink(missing_ok=True)
