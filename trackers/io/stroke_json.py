"""Strokes in JSON: a list of objects, or an object a line (`.ndjson`), as "Quick, Draw!" distributes drawings.

Each object has the points of its pieces in one of three spellings: `points`, `[[x, y], ...]` of a single piece;
`pieces`, a list of such lists; or `drawing`, a list of pieces `[[x, ...], [y, ...]]` by coordinate, after which times
may follow that are not used. It may have `label` or `word`, `person`, `fingers`, and `id` or `key_id`; y is down.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfilters.models.gesture.codes import MOST_TIPS
from jaxfilters.trackers.io.errors import InputError, shown
from jaxfilters.trackers.io.input_files import are_finite, read_text
from jaxfilters.trackers.io.json_files import parse_json, read_json_value

SUFFIXES = (".json", ".ndjson")
_WANTED = 'expected strokes such as [{"label": "a", "points": [[x, y], ...]}, ...]'
_SPELLINGS = ("points", "pieces", "drawing")


class JsonStroke(NamedTuple):
    """One entry of a file."""

    pieces: list[Float[np.ndarray, "_ d"]]
    fingers: int
    label: str
    person: str
    id: str


def read_json_strokes(path: Path) -> list[JsonStroke]:
    """The strokes of a file.

    Raises:
        InputError: an unreadable file, no JSON, an entry without points, or points that are not finite numbers; the
            message names the entry.
    """
    if path.suffix.lower() == ".ndjson":
        lines = [(i, line) for i, line in enumerate(read_text(path, _WANTED).splitlines(), 1) if line.strip()]
        entries = [(f"{path}: line {i}", parse_json(line, f"{path}: line {i}", _WANTED)) for i, line in lines]
    else:
        value = read_json_value(path, _WANTED)
        if isinstance(value, dict) and isinstance(value.get("strokes"), list):
            value = value["strokes"]
        if not isinstance(value, list):
            raise InputError(f"{path}: {_WANTED}; got a {type(value).__name__}.")
        entries = [(f"{path}: stroke {i}", entry) for i, entry in enumerate(value)]
    return [_stroke(entry, i, place) for i, (place, entry) in enumerate(entries)]


def _stroke(entry: Any, index: int, place: str) -> JsonStroke:
    spellings = [name for name in _SPELLINGS if name in entry] if isinstance(entry, dict) else []
    if len(spellings) != 1:
        raise InputError(f"{place}: {_WANTED}; got {shown(entry)}.")
    spelling = spellings[0]
    listed = [entry["points"]] if spelling == "points" else entry[spelling]
    if not isinstance(listed, list):
        raise InputError(f"{place}: {spelling} must be a list; got {shown(listed)}.")
    pieces = [_by_coordinate(one, place) if spelling == "drawing" else _points(one, place) for one in listed]
    if len({piece.shape[1] for piece in pieces}) > 1:
        raise InputError(f"{place}: some pieces have two coordinates and some three.")
    fingers = entry.get("fingers", 1)
    if type(fingers) is not int or not 0 <= fingers <= MOST_TIPS:
        raise InputError(f"{place}: fingers must be from 0 to {MOST_TIPS}; got {shown(fingers)}.")
    return JsonStroke(
        pieces,
        fingers,
        _word(entry, ("label", "word"), place),
        _word(entry, ("person", "subject"), place),
        _word(entry, ("id", "key_id"), place) or str(index),
    )


def _points(listed: Any, place: str) -> np.ndarray:
    try:
        points = np.asarray(listed, float)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if isinstance(listed, list) and not listed:
        return np.zeros((0, 2))
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not are_finite(points):
        raise InputError(f"{place}: points must be finite numbers (n, 2 or 3); got {shown(listed)}.")
    return points


def _by_coordinate(piece: Any, place: str) -> np.ndarray:
    if not isinstance(piece, list) or len(piece) not in (2, 3) or not all(isinstance(axis, list) for axis in piece[:2]):
        raise InputError(f"{place}: a piece of drawing must be [[x, ...], [y, ...]]; got {shown(piece)}.")
    if len(piece[0]) != len(piece[1]):
        raise InputError(f"{place}: a piece of drawing has {len(piece[0])} x and {len(piece[1])} y.")
    return _points([list(pair) for pair in zip(piece[0], piece[1], strict=True)], place)


def _word(entry: dict[str, Any], names: tuple[str, ...], place: str) -> str:
    value = next((entry[name] for name in names if name in entry), "")
    if not isinstance(value, str | int) or isinstance(value, bool):
        raise InputError(f"{place}: {names[0]} must be text; got {shown(value)}.")
    return str(value).strip()
