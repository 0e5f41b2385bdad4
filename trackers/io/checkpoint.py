"""A pytree of arrays in one `.npz` file, written all or nothing."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.trackers.io.errors import CheckpointError

SCHEMA = 1
"""Version of the layout below; a file of another version is refused."""


def save(path: Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write `tree` and the JSON-able `meta` so that `path` holds either the old file or the whole new one.

    Leaves are keyed by their place in the tree; typed random keys are stored as their data.
    """
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    arrays = {_name(place): np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf) for place, leaf in leaves}
    header = json.dumps({"schema": SCHEMA, "meta": meta})
    write_npz(path, {"header": np.asarray(header), **arrays})


def load(path: Path, template: Any) -> tuple[Any, dict[str, Any]]:
    """`(tree, meta)` as saved; `template` gives the structure, shapes and types. NumPy leaves stay on the host.

    Raises:
        CheckpointError: damaged file, other schema, or leaves that do not fit the template.
    """
    arrays, meta = _read(path)
    leaves, treedef = jax.tree_util.tree_flatten_with_path(template)
    if (expected := {_name(place) for place, _ in leaves}) != set(arrays):
        raise CheckpointError(f"{path}: its arrays differ from the expected ones in {sorted(expected ^ set(arrays))}.")
    return jax.tree.unflatten(treedef, [_restore(path, _name(p), arrays[_name(p)], leaf) for p, leaf in leaves]), meta


def load_names(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays by their places in the tree, as `jax.tree_util.keystr` after "tree", and the `meta`.

    Raises:
        CheckpointError: damaged file, or other schema.
    """
    return _read(path)


def load_meta(path: Path) -> dict[str, Any]:
    """The `meta` of a checkpoint, without its arrays being looked at."""
    return _read(path)[1]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file that `write_npz` wrote.

    Raises:
        CheckpointError: no such file, or a damaged one.
    """
    try:
        with path.open("rb") as content, np.load(content, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{path}: not a complete checkpoint ({error}).") from None


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """`np.savez` beside `path`, then one rename: a full disk or a crash leaves the old file as it was."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = read_arrays(path)
    try:
        header = json.loads(str(arrays.pop("header")))
        schema, meta = header["schema"], header["meta"]
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: not a complete checkpoint ({error}).") from None
    if schema != SCHEMA:
        raise CheckpointError(f"{path}: schema {schema}, but this version reads {SCHEMA}.")
    return arrays, meta


def _restore(path: Path, name: str, saved: np.ndarray, leaf: Any) -> Any:
    expected = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
    if (saved.shape, saved.dtype) != (expected.shape, expected.dtype):
        raise CheckpointError(
            f"{path}: {name} is {saved.shape} {saved.dtype}; expected {expected.shape} {expected.dtype}."
        )
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(saved), impl=jax.random.key_impl(leaf))
    return jnp.asarray(saved) if isinstance(leaf, jax.Array) else saved


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _name(place: tuple[Any, ...]) -> str:
    return "tree" + jax.tree_util.keystr(place)
