"""A pytree of arrays in one `.npz` file, written all or nothing."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.io.errors import CheckpointError, InputError, shortened, shown
from jaxfilters.trackers.io.json_files import parse_json
from jaxfilters.trackers.io.npz import read_npz
from jaxfilters.trackers.io.trees import put_together, taken_apart

_WANTED = "expected a checkpoint"
SCHEMA = 3
"""Version of the layout below; a file of another version is refused."""


def save(path: Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write `tree`, as `trees.taken_apart` takes it, and the JSON-able `meta`.

    `path` holds either the old file or the whole new one.
    """
    structure, arrays = taken_apart(tree)
    header = json.dumps({"schema": SCHEMA, "meta": meta, "structure": structure})
    write_npz(path, {"header": np.asarray(header), **arrays})


def load(path: Path) -> tuple[Any, dict[str, Any]]:
    """`(tree, meta)` as saved, with the same types, bit for bit.

    Raises:
        CheckpointError: damaged file, or other schema.
    """
    arrays, header = _read(path)
    try:
        return put_together(header.get("structure"), arrays), header["meta"]
    except ValueError as error:
        raise CheckpointError(f"{path}: not a complete checkpoint ({shortened(str(error), 160)})") from None


def load_meta(path: Path) -> dict[str, Any]:
    """The `meta` of a checkpoint, without its arrays being looked at."""
    return _read(path)[1]["meta"]


def state_path(folder: Path) -> Path:
    """Where a folder of results has the state of its tracker."""
    return folder / "checkpoint" / "state.npz"


def check_same_run(folder: Path, run: dict[str, Any]) -> None:
    """Whether the run whose checkpoint lies in `folder` may be continued by another one.

    Raises:
        CheckpointError: It was of another input, configuration or version, or its checkpoint is damaged.
    """
    was = load_meta(state_path(folder)).get("run", {})
    if different := sorted(key for key in run | was if run.get(key) != was.get(key)):
        changes = ", ".join(f"{key} was {was.get(key)!r} and is {run.get(key)!r}" for key in different)
        raise CheckpointError(f"{folder} cannot be resumed: {changes}.")


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file that `write_npz` wrote.

    Raises:
        CheckpointError: no such file, or a damaged one.
    """
    try:
        return read_npz(path, _WANTED)
    except InputError as error:
        reason = shortened(str(error).removeprefix(f"{path}: "), 160)
        raise CheckpointError(f"{path}: not a complete checkpoint ({reason})") from None


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
        header = parse_json(str(arrays.pop("header", "")), f"{path}: header", _WANTED)
    except InputError as error:
        reason = shortened(str(error).removeprefix(f"{path}: "), 160)
        raise CheckpointError(f"{path}: not a complete checkpoint ({reason})") from None
    if not isinstance(header, dict) or not isinstance(header.get("meta"), dict):
        raise CheckpointError(f"{path}: not a complete checkpoint (without schema and meta).")
    if header.get("schema") != SCHEMA:
        raise CheckpointError(f"{path}: schema {shown(header.get('schema'))}, but this version reads {SCHEMA}.")
    return arrays, header
