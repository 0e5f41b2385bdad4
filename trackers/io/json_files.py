"""Descriptions in JSON that people write by hand: every mistake is named with its file and entry."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.json_text import read_json_text


def read_json(path: Path, wanted: str) -> dict[str, Any]:
    """The entries of a JSON file that holds one object; `wanted` describes a right one, for messages.

    Raises:
        InputError: an unreadable file, no JSON, or no object.
    """
    settings = read_json_text(path, wanted)
    if not isinstance(settings, dict):
        raise InputError(f"{path}: {wanted}; got a {type(settings).__name__}.")
    return settings


def refuse_unknown(settings: dict[str, Any], known: set[str], place: str | Path) -> None:
    """Raise `InputError` for entries that are not `known`."""
    if unknown := set(settings) - known:
        raise InputError(f"{place}: unknown entries {sorted(unknown)}; known are {sorted(known)}.")


def image_size_of(settings: dict[str, Any], place: str | Path) -> tuple[int, int]:
    """Columns and rows.

    Raises:
        InputError: `image_size` is missing, or no two positive integers.
    """
    size = settings.get("image_size")
    if not isinstance(size, list) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise InputError(f"{place}: image_size must be [columns, rows], two positive integers; got {size!r}.")
    return size[0], size[1]


def numbers_of(settings: dict[str, Any], entry: str, shape: tuple[int, ...], place: str | Path) -> np.ndarray | None:
    """The array under `entry`, None where there is none.

    Raises:
        InputError: no finite numbers of that shape.
    """
    if entry not in settings:
        return None
    try:
        value = np.asarray(settings[entry], float)
    except (TypeError, ValueError):
        got = repr(settings[entry])[:80]
        raise InputError(f"{place}: {entry} must be numbers of shape {shape}; got {got}.") from None
    if value.shape != shape or not np.isfinite(value).all():
        raise InputError(f"{place}: {entry} must be finite numbers of shape {shape}; got shape {value.shape}.")
    return value


def check_intrinsics(K: np.ndarray, place: str | Path) -> None:
    """Raise `InputError` unless `K` (3, 3) is of a camera without skew."""
    if np.any(K[2] != (0, 0, 1)) or K[1, 0] != 0 or K[0, 1] != 0 or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"{place}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0; got {K.tolist()}.")


def write_json(path: str | Path, text: str) -> None:
    """Write the text of a description; its folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(text)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def one_entry_a_line(settings: dict[str, Any], indent: str = "") -> str:
    """An object as JSON that people can read: matrices stay on one line each."""
    lines = ",\n".join(
        f"{indent}  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in settings.items()
    )
    return f"{indent}{{\n{lines}\n{indent}}}"
