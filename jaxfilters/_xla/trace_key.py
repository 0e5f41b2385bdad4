"""A name for a traced program: a digest of all that tracing it depends on, so that no other program has the same.

That is the function, the types and the static parts of its arguments, the sources of this package, the versions of the
packages whose code is traced, the devices, and JAX's configuration. Code of other packages is described by their
versions alone: where a package is edited in place, its version stays and so does the name.
"""

import hashlib
import inspect
import pickle
import platform
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from types import BuiltinFunctionType, FunctionType
from typing import Any

import jax

from jaxfilters._sources import PACKAGE, digest_of, package_folders

TRACED_PACKAGES = (
    *("jax", "jaxlib", "numpy", "scipy", "ml_dtypes", "opt_einsum"),
    *("optimistix", "equinox", "lineax", "jaxopt", "optax"),
)
"""Packages whose code may be part of a traced program, or whose classes may be part of its arguments."""
SCOPED = ("jax_enable_x64", "jax_default_matmul_precision", "jax_default_device", "jax_numpy_dtype_promotion")
"""Settings that a program may change for a part of its run."""
_IMPORTED_S = time.time()
_MARGIN_S = 2.0
"""File systems store times with less resolution than clocks have."""


def is_described_by_sources(function: Any) -> bool:
    """Whether a function is the one of its name in a module of this package, perhaps with decorators about it."""
    if not isinstance(function, FunctionType) or str(function.__module__).partition(".")[0] != PACKAGE:
        return False
    of_this_name = getattr(sys.modules.get(function.__module__), function.__name__, None)
    return of_this_name is not None and inspect.unwrap(of_this_name, stop=lambda one: one is function) is function


def key_of(function: Callable, tree: Any, types: tuple, static: dict[str, Any]) -> str | None:
    """A digest as 32 hexadecimal digits.

    Args:
        function: Described by the package's sources.
        tree: Structure of the arguments that are arrays.
        types: Of their leaves, as `jax.typeof` returns them.
        static: The other arguments by name.

    Returns:
        The digest; None where the sources are not files or have changed since they were imported.

    Raises:
        Exception: Whatever `pickle` raises for static parts that it cannot describe.
    """
    sources = _sources()
    if sources is None:
        return None
    shapes = [(type.shape, str(type.dtype), type.weak_type) for type in types]
    described = _described((function.__module__, function.__name__, _parts(tree), shapes, static))
    return hashlib.sha256(sources + repr(_configuration()).encode() + described).hexdigest()[:32]


def scoped_settings() -> tuple:
    """The values of `SCOPED` in the current context."""
    return tuple(getattr(jax.config, name) for name in SCOPED)


def _parts(tree: Any) -> tuple:
    """The types and the static data of a structure, level by level."""
    return tree.node_data(), tuple(map(_parts, tree.children()))


class _Describer(pickle.Pickler):
    """Raises for functions and classes of packages whose versions are not part of the key."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, (type, FunctionType, BuiltinFunctionType)):
            package = str(value.__module__).partition(".")[0]
            if package not in (PACKAGE, *TRACED_PACKAGES) and package not in sys.stdlib_module_names:
                raise pickle.PicklingError(f"{value} belongs to {package}, whose version is not part of a key")
        return NotImplemented


def _described(value: Any) -> bytes:
    written = BytesIO()
    _Describer(written).dump(value)
    return written.getvalue()


@cache
def _sources() -> bytes | None:
    return digest_of(package_folders(), _IMPORTED_S - _MARGIN_S)


@cache
def _versions() -> list[str | None]:
    return [platform.python_version(), *map(_version, TRACED_PACKAGES)]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _configuration() -> list[Any]:
    """Versions, devices and JAX's settings; where caches are, and what is logged, changes no program."""
    settings = [
        (name, getattr(jax.config, name, value))
        for name, value in sorted(jax.config.values.items())
        if not any(word in name for word in ("cache", "_log", "dump"))
    ]
    return [_versions(), jax.default_backend(), len(jax.local_devices()), settings]
