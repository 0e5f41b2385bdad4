"""Trees of arrays and plain values, taken apart into named arrays and JSON, and put together again."""

import dataclasses
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_PACKAGE = "jaxfilters."


def taken_apart(tree: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """The structure of a tree, JSON-able, and its numbers.

    Args:
        tree: Nested tuples, lists, dictionaries with texts as keys, named tuples, and dataclasses of this package. At
            its ends are arrays of JAX or NumPy, typed random keys, numbers, texts, truth values or None.

    Returns:
        What `put_together` needs besides the arrays, and the arrays by their places in the tree.

    Raises:
        TypeError: A part of the tree is something else.
    """
    arrays: dict[str, np.ndarray] = {}
    return _structure(tree, "tree", arrays), arrays


def put_together(structure: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The tree that `taken_apart` was given, with the same types, bit for bit.

    Classes are looked up among the modules that are imported; nothing is imported or executed.

    Raises:
        ValueError: The structure is not one of `taken_apart`, or it names a class or an array that does not exist.
    """
    try:
        ((kind, content),) = structure.items()
        return _BUILDERS[kind](content, arrays)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"cannot be put together: {type(error).__name__}: {error}") from None


def _structure(tree: Any, place: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    part = lambda name, value: _structure(value, f"{place}.{name}", arrays)
    if tree is None or isinstance(tree, bool | int | str):
        return {"value": tree}
    if isinstance(tree, jax.Array) and jnp.issubdtype(tree.dtype, jax.dtypes.prng_key):
        arrays[place] = np.asarray(jax.random.key_data(tree))
        return {"key": [place, str(jax.random.key_impl(tree))]}
    if isinstance(tree, jax.Array | np.ndarray | np.generic | float):
        arrays[place] = np.asarray(tree)
        return {_leaf_kind(tree): place}
    if isinstance(tree, dict) and all(isinstance(name, str) for name in tree):
        return {"dict": {name: part(name, value) for name, value in tree.items()}}
    if dataclasses.is_dataclass(tree) or hasattr(tree, "_fields"):
        names = getattr(tree, "_fields", None) or [field.name for field in dataclasses.fields(tree)]
        _class_of(name := f"{type(tree).__module__}:{type(tree).__qualname__}")
        return {"fields": [name, {name: part(name, getattr(tree, name)) for name in names}]}
    if isinstance(tree, list | tuple):
        kind = "list" if isinstance(tree, list) else "tuple"
        return {kind: [part(str(i), value) for i, value in enumerate(tree)]}
    raise TypeError(f"{place} must be arrays and plain values; got {type(tree).__name__}.")


def _leaf_kind(leaf: Any) -> str:
    if isinstance(leaf, float) and not isinstance(leaf, np.generic):
        return "float"
    return "jax" if isinstance(leaf, jax.Array) else "scalar" if isinstance(leaf, np.generic) else "numpy"


def _class_of(name: str) -> Any:
    module, _, qualified = name.partition(":")
    found = getattr(sys.modules.get(module), qualified, None)
    if isinstance(found, type):
        if issubclass(found, tuple) and hasattr(found, "_fields"):
            return found
        # To make one may run code of its class.
        if dataclasses.is_dataclass(found) and module.startswith(_PACKAGE):
            return found
    raise TypeError(f"{name} is no named tuple of an imported module, nor a dataclass of this package.")


_BUILDERS: dict[str, Callable[[Any, dict[str, np.ndarray]], Any]] = {
    "value": lambda value, _: value,
    "float": lambda place, arrays: float(arrays[place]),
    "scalar": lambda place, arrays: arrays[place][()],
    "numpy": lambda place, arrays: arrays[place],
    "jax": lambda place, arrays: jnp.asarray(arrays[place]),
    "key": lambda content, arrays: jax.random.wrap_key_data(jnp.asarray(arrays[content[0]]), impl=content[1]),
    "list": lambda parts, arrays: [put_together(part, arrays) for part in parts],
    "tuple": lambda parts, arrays: tuple(put_together(part, arrays) for part in parts),
    "dict": lambda parts, arrays: {name: put_together(part, arrays) for name, part in parts.items()},
    "fields": lambda content, arrays: _class_of(content[0])(
        **{name: put_together(part, arrays) for name, part in content[1].items()}
    ),
}
