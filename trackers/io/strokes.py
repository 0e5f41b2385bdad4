"""Strokes that a person drew, labelled or not: what symbols are learnt from and what is recognised.

An `.npz` holds `points` (N, d), two or three coordinates in any one unit, y down; `length`, the number of points of
each piece; where a stroke has several pieces, as those of a pen, `pieces`, the number of pieces of each stroke; and may
hold `label` and `person`, a word for each stroke, and `fingers`, how many drew it. Other names of these arrays that are
understood are in `ARRAYS`.

A `.csv` holds a row for each point, with the columns `stroke,x,y` and, if known, `z`, `time`, `label`, `person` and
`fingers`, the number of fingertips in that moment. Rows of a stroke without times are in the order of the file.

A folder holds such a `.csv` for each stroke, without the column `stroke`, in a folder with the name of the symbol, or
in such a folder in the folder of a person. A file of UNIPEN is read by `unipen_files`.
"""

import csv
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfilters.models.gesture.coded import voted
from jaxfilters.models.gesture.codes import MOST_TIPS
from jaxfilters.models.gesture.stroke import Drawn
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.npz import read_npz
from jaxfilters.trackers.io.unipen import SUFFIXES, read_unipen

ARRAYS = {
    "points": ("points", "xyz_mm", "xy"),
    "length": ("length", "stroke_len"),
    "pieces": ("pieces", "n_strokes"),
    "label": ("label", "gesture"),
    "person": ("person", "subject", "donor"),
    "fingers": ("fingers",),
}
"""What an array of an `.npz` may be called."""
_COLUMNS = ("stroke", "label", "person", "time", "x", "y", "z", "fingers")
_WANTED_NPZ = "expected an .npz with points (N, 2 or 3) and length, the number of points of each piece"
_WANTED_CSV = "expected a CSV file with a header such as stroke,label,time,x,y"


class StrokeSet(NamedTuple):
    """Strokes, each of one or more pieces of points that may be none at all."""

    strokes: tuple[Drawn, ...]
    ids: tuple[str, ...]
    labels: tuple[str, ...]
    """Empty where a stroke has none."""
    people: tuple[str, ...]
    """Who drew each; empty where it is not known."""
    dimensions: int
    warnings: tuple[str, ...] = ()
    """What was left out, a sentence each."""

    @property
    def pieces(self) -> int:
        """Of the stroke that has most."""
        return max((len(pieces) for pieces, _ in self.strokes), default=0)


def read_strokes(path: Path) -> StrokeSet:
    """The strokes of a file or folder.

    Raises:
        InputError: an unreadable file, other columns or arrays, coordinates that are no numbers, or no stroke.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    if path.is_dir():
        return _of_folder(path)
    if path.suffix.lower() == ".npz":
        return _of_npz(path)
    if path.suffix.lower() in SUFFIXES:
        found, warnings = read_unipen(path)
        if not found:
            raise InputError(f"{path}: no segment holds any points.")
        ids = tuple(f"{path.stem} {i}" for i in range(len(found)))
        strokes = tuple((pieces, 1) for pieces, _ in found)
        return StrokeSet(strokes, ids, tuple(label for _, label in found), ("",) * len(found), 2, tuple(warnings))
    return _of_rows(_rows(path, ("stroke",)), path)


def _of_npz(path: Path) -> StrokeSet:
    known = [name for names in ARRAYS.values() for name in names]
    held = read_npz(path, _WANTED_NPZ, known)
    arrays = {wanted: held[name] for wanted, names in ARRAYS.items() for name in names if name in held}
    points, lengths = arrays.get("points", np.zeros(0)), arrays.get("length", np.zeros(0))
    if points.ndim != 2 or points.shape[1] not in (2, 3) or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: {_WANTED_NPZ}; got points {points.shape} {points.dtype}.")
    pieces = arrays.get("pieces", np.ones(len(lengths), int))
    _check_parts(lengths, len(points), "length", path)
    _check_parts(pieces, len(lengths), "pieces", path)
    words = {name: arrays.get(name, np.full(len(pieces), "")) for name in ("label", "person")}
    fingers = arrays.get("fingers", np.ones(len(pieces), int))
    for name, values in {**words, "fingers": fingers}.items():
        if values.shape != (len(pieces),):
            raise InputError(
                f"{path}: {name} must have an entry for each of {len(pieces)} strokes; got {values.shape}."
            )
    each = np.split(points.astype(float), np.cumsum(lengths)[:-1])
    first = np.concatenate([[0], np.cumsum(pieces)])
    strokes = tuple((each[a:b], int(n)) for a, b, n in zip(first[:-1], first[1:], fingers, strict=True))
    labels, people = (tuple(str(word) for word in values) for values in words.values())
    return StrokeSet(strokes, tuple(str(i) for i in range(len(strokes))), labels, people, points.shape[1])


def _check_parts(counts: np.ndarray, total: int, name: str, path: Path) -> None:
    if counts.ndim != 1 or not len(counts) or counts.dtype.kind not in "iu" or counts.min() < 0:
        raise InputError(f"{path}: {name} must be counts, at least one; got {counts.shape} {counts.dtype}.")
    if counts.sum() != total:
        raise InputError(f"{path}: {name} must add up to {total}; got {counts.sum()}.")


def _of_folder(folder: Path) -> StrokeSet:
    files = sorted([*folder.glob("*/*.csv"), *folder.glob("*/*/*.csv")])
    if not files:
        raise InputError(f"{folder}: no CSV files in folders with the names of symbols.")
    rows: list[dict[str, str]] = []
    for file in files:
        *person, label = file.relative_to(folder).parts[:-1]
        own = {"stroke": str(file.relative_to(folder)), "label": label, "person": person[0] if person else ""}
        rows += [{**row, **own} for row in _rows(file, ())]
    return _of_rows(rows, folder)


def _rows(path: Path, needed: tuple[str, ...]) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as content:
            reader = csv.DictReader(content, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = header
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_WANTED_CSV}.") from None
    if missing := [name for name in (*needed, "x", "y") if name not in header]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED_CSV}; the header is {','.join(header)!r}.")
    if unknown := set(header) - set(_COLUMNS):
        raise InputError(f"{path}: unknown columns {sorted(unknown)}; columns are {', '.join(_COLUMNS)}.")
    return [{**row, "row": f"{path}: row {number}"} for number, row in enumerate(rows, 2)]


def _of_rows(rows: list[dict[str, str]], path: Path) -> StrokeSet:
    if not rows:
        raise InputError(f"{path}: no stroke; {_WANTED_CSV}.")
    dimensions = {3 if "z" in row else 2 for row in rows}
    if len(dimensions) > 1:
        raise InputError(f"{path}: some strokes have a column z and some have not.")
    axes = ("x", "y", "z")[: dimensions.pop()]
    by_stroke: dict[str, list[dict[str, str]]] = defaultdict(list)
    for row in rows:
        by_stroke[row["stroke"]].append(row)
    strokes, labels, people = [], [], []
    for own in by_stroke.values():
        points = np.array([[_number(row, axis) for axis in axes] for row in own])
        times = [_number(row, "time", 0.0) for row in own]
        counts = np.array([_number(row, "fingers", 1.0) for row in own])
        if not np.all(np.isin(counts, np.arange(MOST_TIPS + 1))):
            raise InputError(f"{own[0]['row']}: fingers must be from 0 to {MOST_TIPS}; got {np.unique(counts)}.")
        strokes.append(([points[np.argsort(times, kind="stable")]], voted(counts.astype(int))))
        labels.append(_word(own, "label"))
        people.append(_word(own, "person"))
    return StrokeSet(tuple(strokes), tuple(by_stroke), tuple(labels), tuple(people), len(axes))


def _word(rows: list[dict[str, str]], name: str) -> str:
    words = {(row.get(name) or "").strip() for row in rows}
    if len(words) > 1:
        raise InputError(f"{rows[0]['row']}: one stroke with several entries in {name}, {sorted(words)}.")
    return words.pop()


def _number(row: dict[str, str], name: str, otherwise: float | None = None) -> float:
    """The number in a column; `otherwise` where there is none. NaN is allowed: such a stroke is none."""
    text = (row.get(name) or "").strip()
    if not text and otherwise is not None:
        return otherwise
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{row['row']}: {name} must be a number; got {text!r}.") from None
