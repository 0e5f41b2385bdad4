"""Traced programs, kept in a folder from run to run.

JAX looks for a compiled program in its cache by what tracing and lowering yield, so every process traces a known
program again: a quarter of a tracker's second run. Here the traced program itself is found, by all that tracing
depends on: the function, the shapes, types and static parts of its arguments, the sources of this package, the versions
of the packages that it calls, the devices, and JAX's configuration. Results are bit for bit those of `jax.jit`.
"""

import hashlib
import inspect
import os
import pickle
import platform
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import BuiltinFunctionType, FunctionType
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax import export
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

R = TypeVar("R")

PACKAGE = "jaxfilters"
TRACED_PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "optimistix", "equinox", "lineax", "jaxopt", "optax")
"""Whose code may be part of a traced program, or whose classes of its key."""
MEGABYTES = 64
"""The programs that have not been asked for longest make room for others. A tracker has about half a megabyte."""
_DIGEST_BYTES = 32
_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)

_folder: Path | None = None


def keep_traces(folder: Path | None) -> None:
    """Keep the traced programs of this process in `folder`, and take known ones from there; none where it is None.

    JAX's configuration must not change afterwards: it is read when a function is first called with some types.
    Files of the folder are unpickled: as with a cache of compiled programs, whoever may write to it decides what runs.
    """
    global _folder
    _folder = folder


def traces_are_kept() -> bool:
    """Whether a folder has been named."""
    return _folder is not None


class KeptPrograms(Generic[R]):
    """A function of arrays whose traced programs are kept, one for each set of shapes, types and static arguments.

    Args:
        function: Any; only functions at the top of a module of this package are kept.
        compiler_options: Of `jax.jit`.
        settings: Of `jax.jit`: `static_argnames` or `static_argnums`.
    """

    def __init__(self, function: Callable[..., R], compiler_options: dict[str, bool | int], settings: dict[str, Any]):
        self._function = function
        self._compiler_options = compiler_options or None
        self._settings = settings
        self._programs: dict[Any, Callable[..., R] | None] = {}

    def find(self, args: tuple, kwargs: dict[str, Any]) -> Callable[[], R] | None:
        """The call of the program for these arguments, or None where no key would describe all of it."""
        signature = self._signature
        if signature is None:
            return None
        arrays = dict(signature.bind(*args, **kwargs).arguments)
        static = {name: arrays.pop(name) for name in self._static_names if name in arrays}
        leaves, tree = jax.tree.flatten(arrays)
        types = tuple(map(jax.typeof, leaves))
        known = (tree, types, tuple(static.items()))
        if known not in self._programs:
            self._programs[known] = self._program(tree, types, static)
        program = self._programs[known]
        return None if program is None else lambda: program(*leaves)

    @cached_property
    def _signature(self) -> inspect.Signature | None:
        if not _is_of_package(self._function):
            return None
        signature = inspect.signature(self._function)
        return signature if all(one.kind in _NAMED for one in signature.parameters.values()) else None

    @cached_property
    def _static_names(self) -> list[str]:
        names, numbers = (self._settings.get(f"static_{kind}", ()) for kind in ("argnames", "argnums"))
        parameters = list(inspect.signature(self._function).parameters)
        named = [names] if isinstance(names, str) else list(names)
        return named + [parameters[number] for number in ([numbers] if isinstance(numbers, int) else numbers)]

    def _program(self, tree: Any, types: tuple, static: dict[str, Any]) -> Callable[..., R] | None:
        key = _key(self._function, tree, types, static)
        if key is None or _folder is None:
            return None
        file = _folder / f"{self._function.__name__}-{key}"
        payload = _read(file)
        if payload is None:
            payload = self._traced(tree, types, static)
            _write(file, payload)
        serialized, outputs = pickle.loads(payload)
        if serialized is None:
            return None
        return self._compiled(export.deserialize(serialized), jax.tree.structure(outputs))

    def _traced(self, tree: Any, types: tuple, static: dict[str, Any]) -> bytes:
        """The program that takes and returns leaves, and the structure of its result with a number for each leaf.

        None in place of the program where a result is weakly typed, which exported programs do not remember.
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

        # What was traced for several devices gets its arguments, and leaves its results, on all of them. Left to JAX,
        # the first call would have arguments of no device, and the second ones of a device: two programs.
        devices = jax.local_devices()[: exported.nr_devices]
        everywhere: Sharding = SingleDeviceSharding(devices[0])
        if len(devices) > 1:
            everywhere = NamedSharding(Mesh(np.array(devices), ("devices",)), PartitionSpec())
        run.__name__ = self._function.__name__  # in profiles, and of the compiled program that is kept
        settings = {"in_shardings": everywhere, "out_shardings": everywhere}
        compiled = jax.jit(run, compiler_options=self._compiler_options, **settings)
        return lambda *leaves: jax.tree.unflatten(structure, compiled(*leaves))


def _is_of_package(function: Any) -> bool:
    """Whether the package's sources say all about a function: not where it has values of its own, as closures have."""
    if not isinstance(function, FunctionType) or function.__module__.partition(".")[0] != PACKAGE:
        return False
    is_undecorated = function.__closure__ is None and function.__name__ == function.__qualname__
    return is_undecorated or getattr(sys.modules.get(function.__module__), function.__name__, None) is function


def _key(function: FunctionType, tree: Any, types: tuple, static: dict[str, Any]) -> str | None:
    """A name for all that tracing depends on; None where something of it is not described by its content."""
    shapes = [(type.shape, str(type.dtype), type.weak_type) for type in types]
    name = (function.__module__, function.__name__)
    try:
        described = _described((name, _parts(tree), shapes, static))
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    sources = _sources()
    return sources and hashlib.sha256(sources + repr(_configuration()).encode() + described).hexdigest()[:32]


def _parts(tree: Any) -> tuple:
    """The types and the static data of a structure, level by level."""
    return tree.node_data(), tuple(map(_parts, tree.children()))


class _Describer(pickle.Pickler):
    """Refuses functions and classes of packages that may change while their names stay."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, (type, FunctionType, BuiltinFunctionType)):
            package = value.__module__.partition(".")[0]
            if package not in (PACKAGE, *TRACED_PACKAGES) and package not in sys.stdlib_module_names:
                raise pickle.PicklingError(f"{value} is no part of a key")
        return NotImplemented


def _described(value: Any) -> bytes:
    written = BytesIO()
    _Describer(written).dump(value)
    return written.getvalue()


@cache
def _sources() -> bytes | None:
    """Digest of this package's files, code and data; None where they are not files."""
    packages = [name for name in sys.modules if name == PACKAGE or name.rpartition(".")[0] == PACKAGE]
    roots = {(name, path) for name in packages for path in getattr(sys.modules[name], "__path__", ())}
    digest, count = hashlib.sha256(), 0
    for name, root in sorted(roots):
        for file in sorted(Path(root).rglob("*")):
            if "__pycache__" not in file.parts and file.is_file():
                digest.update(f"{name} {file.relative_to(root)}".encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
                count += 1
    return digest.digest() if count else None


def _configuration() -> list[Any]:
    """Versions, devices and JAX's settings. Where caches are, and what is logged, changes no program."""
    settings = [
        (name, getattr(jax.config, name, None))
        for name in sorted(jax.config.values)
        if not any(word in name for word in ("cache", "log", "dump"))
    ]
    versions = [version(package) for package in TRACED_PACKAGES]
    return [platform.python_version(), versions, jax.default_backend(), len(jax.local_devices()), settings]


def _read(file: Path) -> bytes | None:
    """What was kept, or None where there is none or it is damaged."""
    try:
        content = file.read_bytes()
        os.utime(file)
    except OSError:
        return None
    digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    return payload if hashlib.sha256(payload).digest() == digest else None


def _write(file: Path, payload: bytes) -> None:
    """Keep `payload`, whole or not at all: other processes may read the folder."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as unfinished:
            unfinished.write(hashlib.sha256(payload).digest() + payload)
        os.replace(unfinished.name, file)
        _make_room(file.parent)
    except OSError as error:
        warnings.warn(f"{file}: {error.strerror}; the program will be traced again in the next run", stacklevel=2)


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
