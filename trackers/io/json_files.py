"""JSON of unknown origin, and descriptions that people write by hand: a mistake is named with its file and entry."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.images import check_num_pixels
from jaxfilters.trackers.io.input_files import LARGEST, MOST_BYTES, are_finite, read_text

_MOST_DESCRIBED = 4 * 2**20
"""Bytes of a description."""
_MOST_DIGITS = 18
"""Integers of so many digits fit into 64 bits."""
_SHORTEST_FOCAL, _LONGEST_FOCAL = 1.0, 1e6
"""Pixels."""


def read_json_value(path: Path, wanted: str, most: int = MOST_BYTES) -> Any:
    """The value in a JSON file.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        most: Number of bytes.

    Raises:
        InputError: a file that cannot be read or is no JSON, nested too deeply, or too large.
    """
    return parse_json(read_text(path, wanted, most), str(path), wanted)


def parse_json(text: str, place: str, wanted: str) -> Any:
    """The value of a JSON text.

    Args:
        text: The text.
        place: Where it comes from, for messages.
        wanted: Describes a right one, for messages.

    Raises:
        InputError: no JSON, integers that do not fit into 64 bits, or nested too deeply.
    """
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise InputError(f"{place}: not JSON that can be read (nested too deeply); {wanted}.") from None
    except ValueError as error:
        raise InputError(f"{place}: not JSON ({error}); {wanted}.") from None


def read_json(path: Path, wanted: str) -> dict[str, Any]:
    """The entries of a JSON file that holds one object; `wanted` describes a right one, for messages.

    Raises:
        InputError: an unreadable file, no JSON, or no object.
    """
    settings = read_json_value(path, wanted, _MOST_DESCRIBED)
    if not isinstance(settings, dict):
        raise InputError(f"{path}: {wanted}; got a {type(settings).__name__}.")
    return settings


def refuse_unknown(settings: dict[str, Any], known: set[str], place: str | Path) -> None:
    """Raise `InputError` for entries that are not `known`."""
    if unknown := set(settings) - known:
        raise InputError(f"{place}: unknown entries {shown(sorted(unknown))}; known are {sorted(known)}.")


def image_size_of(settings: dict[str, Any], place: str | Path) -> tuple[int, int]:
    """Columns and rows.

    Raises:
        InputError: `image_size` is missing, no two positive integers, or more pixels than any camera has.
    """
    size = settings.get("image_size")
    if not isinstance(size, list) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise InputError(f"{place}: image_size must be [columns, rows], two positive integers; got {shown(size)}.")
    check_num_pixels(size[0], size[1], f"{place}: image_size")
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
        got = shown(settings[entry])
        raise InputError(f"{place}: {entry} must be numbers of shape {shape}; got {got}.") from None
    if value.shape != shape:
        raise InputError(f"{place}: {entry} must be finite numbers of shape {shape}; got shape {value.shape}.")
    wrong = np.argwhere(~np.isfinite(value))
    if len(wrong):
        where = "".join(f"[{i}]" for i in wrong[0])
        raise InputError(f"{place}: {entry} must be finite numbers; got {value[tuple(wrong[0])]} at {entry}{where}.")
    if not are_finite(value):
        raise InputError(f"{place}: {entry} must be numbers of at most {LARGEST:g}; got {np.abs(value).max():.3g}.")
    return value


def check_intrinsics(K: np.ndarray, place: str | Path) -> None:
    """Raise `InputError` unless `K` (3, 3) is of a camera without skew, in pixels."""
    if np.any(K[2] != (0, 0, 1)) or K[1, 0] != 0 or K[0, 1] != 0 or K[0, 0] <= 0 or K[1, 1] <= 0:
        got = shown(K.tolist(), 160)
        raise InputError(f"{place}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0; got {got}.")
    focal = K[[0, 1], [0, 1]]
    if focal.min() < _SHORTEST_FOCAL or focal.max() > _LONGEST_FOCAL or not are_finite(K):
        bounds = f"from {_SHORTEST_FOCAL:g} to {_LONGEST_FOCAL:g} pixels"
        got = f"{focal[0]:.3g} and {focal[1]:.3g}, cx and cy {K[0, 2]:.3g} and {K[1, 2]:.3g}"
        raise InputError(f"{place}: fx and fy must be {bounds}, cx and cy at most {LARGEST:g}; got {got}.")


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


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)
