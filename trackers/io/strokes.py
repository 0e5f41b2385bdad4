"""Strokes that a person drew, labelled or not: what models of symbols are trained on and what is recognised.

An `.npz` holds `points` (N, d), two or three coordinates in any one unit, y down; `length`, the number of points of
each piece; where a stroke has several pieces, as those of a pen, `pieces`, the number of pieces of each stroke; and may
hold `label` and `person`, a word for each stroke, and `fingers`, how many drew it. Other names of these arrays that are
understood are in `ARRAYS`.

A `.csv` holds a row for each point, with the columns `stroke,x,y` and, if known, `z`, `time`, `label`, `person` and
`fingers`, the number of fingertips in that moment. Rows of a stroke without times are in the order of the file.

A folder holds such a `.csv` for each stroke, without the column `stroke`, in a folder with the name of the symbol, or
in such a folder in the folder of a person. Files of UNIPEN, InkML and JSON are read by `unipen`, `inkml` and
`stroke_json`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.gesture.coded import voted
from jaxfilters.models.gesture.codes import MOST_TIPS
from jaxfilters.models.gesture.stroke import Drawn
from jaxfilters.trackers.io import inkml, stroke_json
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import LARGEST, exists, is_folder, too_large
from jaxfilters.trackers.io.npz import read_npz
from jaxfilters.trackers.io.tables import Columns, Table, read_table
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
_WORDS, _NUMBERS = ("stroke", "label", "person"), ("time", "x", "y", "z", "fingers")
"""Columns."""
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
    faults: tuple[str, ...] = ()
    """Of each stroke: why nothing can recognise it and where in the file, empty where something can."""

    @property
    def pieces(self) -> int:
        """Of the stroke that has most."""
        return max((len(pieces) for pieces, _ in self.strokes), default=0)


class _Own(NamedTuple):
    """A stroke of a table."""

    points: np.ndarray
    fingers: int
    id: str
    words: dict[str, str]
    fault: str


def read_strokes(path: Path) -> StrokeSet:
    """The strokes of a file or folder.

    A stroke without points, of a single one, without extent or with a coordinate that is NaN has its entry in `faults`.

    Raises:
        InputError: an unreadable file, other columns or arrays, coordinates that are no numbers, or no stroke.
    """
    found = _read(path)
    if found.faults:
        return found
    named = zip(found.strokes, found.ids, strict=True)
    return found._replace(faults=tuple(_fault(pieces, name, str(path)) for (pieces, _), name in named))


def usable(strokes: StrokeSet) -> StrokeSet:
    """Without the strokes that have a fault, which become warnings.

    Raises:
        InputError: if a coordinate is NaN, or none of the strokes of a symbol is usable.
    """
    broken = next((fault for fault in strokes.faults if fault.endswith(_NOT_A_NUMBER)), "")
    if broken:
        raise InputError(f"{broken}.")
    kept = [i for i, fault in enumerate(strokes.faults) if not fault]
    if lost := set(strokes.labels) - {strokes.labels[i] for i in kept}:
        reason = next(fault for fault, label in zip(strokes.faults, strokes.labels, strict=True) if label in lost)
        raise InputError(f"no usable stroke of {shown(sorted(lost))}: {reason}.")
    names = ("strokes", "ids", "labels", "people")
    chosen: dict[str, Any] = {name: tuple(getattr(strokes, name)[i] for i in kept) for name in names}
    warnings = (*strokes.warnings, *(f"{fault}; it is left out" for fault in strokes.faults if fault))
    return strokes._replace(**chosen, warnings=warnings, faults=("",) * len(kept))


_NOT_A_NUMBER = "has a coordinate that is no number"


def _row(before: int, point: int) -> str:
    return f"row {before + point}: "


def _line(lines: np.ndarray, point: int) -> str:
    return f"line {lines[point]}: "


def _fault(pieces: Sequence[np.ndarray], name: str, path: str, place: Callable[[int], str] = lambda _: "") -> str:
    """Why a stroke cannot be recognised; it says the place of the point that is no number, or of the first one."""
    points = np.concatenate(pieces) if len(pieces) else np.zeros((0, 2))
    lacks = np.asarray(~np.isfinite(points).all(axis=1))
    first = int(np.argmax(lacks)) if len(lacks) else 0
    where = f"{path}: {place(first)}" if len(points) else f"{path}: "
    if lacks.any():
        return f"{where}stroke {shortened(name)} {_NOT_A_NUMBER}"
    if len(points) < 2:
        return f"{where}stroke {shortened(name)} holds {'a single point' if len(points) else 'no point'}"
    if np.all(points == points[0]):
        return f"{where}stroke {shortened(name)} does not move"
    return ""


def _read(path: Path) -> StrokeSet:
    if not exists(path):
        raise InputError(f"{path}: no such file or folder.")
    if is_folder(path):
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
    if path.suffix.lower() in inkml.SUFFIXES:
        return _of_inkml(path)
    if path.suffix.lower() in stroke_json.SUFFIXES:
        return _of_json(path)
    return _joined(_of_table(_table(path, ("stroke",)), path), path)


def _of_inkml(path: Path) -> StrokeSet:
    found, ids, person = inkml.read_inkml(path)
    if not found:
        raise InputError(f"{path}: no trace holds any points.")
    strokes = tuple((pieces, 1) for pieces, _ in found)
    dimensions = found[0][0][0].shape[1]
    return StrokeSet(strokes, tuple(ids), tuple(label for _, label in found), (person,) * len(found), dimensions)


def _of_json(path: Path) -> StrokeSet:
    found = stroke_json.read_json_strokes(path)
    if not found:
        raise InputError(f"{path}: no stroke in it.")
    dimensions = {piece.shape[1] for own in found for piece in own.pieces if len(piece)}
    if len(dimensions) > 1:
        raise InputError(f"{path}: some strokes have two coordinates and some three.")
    size = dimensions.pop() if dimensions else 2
    empty = [np.zeros((0, size))]
    return StrokeSet(
        tuple(([piece for piece in own.pieces if len(piece)] or empty, own.fingers) for own in found),
        tuple(own.id for own in found),
        tuple(own.label for own in found),
        tuple(own.person for own in found),
        size,
    )


def _of_npz(path: Path) -> StrokeSet:
    known = [name for names in ARRAYS.values() for name in names]
    held = read_npz(path, _WANTED_NPZ, known)
    arrays = {wanted: held[name] for wanted, names in ARRAYS.items() for name in names if name in held}
    points, lengths = arrays.get("points", np.zeros(0)), arrays.get("length", np.zeros(0))
    if points.ndim != 2 or points.shape[1] not in (2, 3) or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: {_WANTED_NPZ}; got points {points.shape} {points.dtype}.")
    pieces = arrays.get("pieces", np.ones(len(lengths), int))
    if too_large(points).any():
        raise InputError(f"{path}: points must be numbers of at most {LARGEST:g}, or NaN.")
    _check_parts(lengths, len(points), "length", path)
    _check_parts(pieces, len(lengths), "pieces", path)
    words = {name: arrays.get(name, np.full(len(pieces), "")) for name in ("label", "person")}
    fingers = arrays.get("fingers", np.ones(len(pieces), int))
    if fingers.dtype.kind not in "iu" or not np.all((fingers >= 0) & (fingers <= MOST_TIPS)):
        raise InputError(
            f"{path}: fingers must be counts from 0 to {MOST_TIPS}; got {shown(fingers.ravel().tolist())}."
        )
    for name, values in {**words, "fingers": fingers}.items():
        if values.shape != (len(pieces),):
            raise InputError(
                f"{path}: {name} must have an entry for each of {len(pieces)} strokes; got {values.shape}."
            )
    each = np.split(points.astype(float), np.cumsum(lengths)[:-1])
    first = np.concatenate([[0], np.cumsum(pieces)])
    strokes = tuple((each[a:b], int(n)) for a, b, n in zip(first[:-1], first[1:], fingers, strict=True))
    labels, people = (tuple(str(word) for word in values) for values in words.values())
    ids = tuple(str(i) for i in range(len(strokes)))
    befores = np.concatenate([[0], np.cumsum(lengths)])[first[:-1]]
    faults = tuple(
        _fault(pieces, name, str(path), partial(_row, int(before)))
        for (pieces, _), name, before in zip(strokes, ids, befores, strict=True)
    )
    return StrokeSet(strokes, ids, labels, people, points.shape[1], faults=faults)


def _check_parts(counts: np.ndarray, total: int, name: str, path: Path) -> None:
    if counts.ndim != 1 or not len(counts) or counts.dtype.kind not in "iu" or counts.min() < 0:
        raise InputError(f"{path}: {name} must be counts, at least one; got {counts.shape} {counts.dtype}.")
    # Counts beyond the total could add up to it once their sum has overflowed.
    if counts.max() > total or counts.sum() != total:
        raise InputError(f"{path}: {name} must add up to {total}; got {counts.astype(float).sum():.17g}.")


def _of_folder(folder: Path) -> StrokeSet:
    files = sorted([*folder.glob("*/*.csv"), *folder.glob("*/*/*.csv")])
    if not files:
        raise InputError(f"{folder}: no CSV files in folders with the names of symbols.")
    found = []
    for file in files:
        *person, label = file.relative_to(folder).parts[:-1]
        words = {"label": label, "person": person[0] if person else ""}
        table = _table(file, ())
        # A file is a stroke, whatever it says of itself.
        table = table._replace(words={"stroke": [str(file.relative_to(folder))] * len(table.lines)})
        found += [own._replace(words=words) for own in _of_table(table, file)]
    return _joined(found, folder)


def _table(path: Path, needed: tuple[str, ...]) -> Table:
    def choose(names: list[str]) -> Columns:
        if missing := [name for name in (*needed, "x", "y") if name not in names]:
            header = shortened(",".join(names))
            raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED_CSV}; the header is {header!r}.")
        if unknown := set(names) - {*_NUMBERS, *_WORDS}:
            known = ", ".join((*_WORDS, *_NUMBERS))
            raise InputError(f"{path}: unknown columns {shown(sorted(unknown))}; columns are {known}.")
        there = [tuple(name for name in group if name in names) for group in (_NUMBERS, _WORDS)]
        return Columns(there[0], there[1], frozenset(there[0]))

    return read_table(path, _WANTED_CSV, choose)


def _of_table(table: Table, path: Path) -> list[_Own]:
    """The strokes of a table, in the order of their first rows; all rows are one stroke where none is named."""
    names = np.asarray(table.words.get("stroke", [""] * len(table.lines)))
    if not len(names):
        return []
    _, which = np.unique(names, return_inverse=True)
    axes = [axis for axis in ("x", "y", "z") if axis in table.numbers]
    points = np.stack([table.numbers[axis] for axis in axes], axis=-1)
    # Rows without a time or a number of fingers have the usual ones.
    times = np.nan_to_num(table.numbers.get("time", np.zeros(len(names))), nan=0.0)
    fingers = np.nan_to_num(table.numbers.get("fingers", np.ones(len(names))), nan=1.0)
    found = []
    order = np.argsort(which, kind="stable")
    for rows in sorted(np.split(order, np.cumsum(np.bincount(which))[:-1]), key=lambda rows: rows[0]):
        place = f"{path}: line {table.lines[rows[0]]}"
        counts = fingers[rows]
        if not np.all(np.isin(counts, np.arange(MOST_TIPS + 1))):
            raise InputError(
                f"{place}: fingers must be from 0 to {MOST_TIPS}; got {shown(np.unique(counts).tolist())}."
            )
        in_time = rows[np.argsort(times[rows], kind="stable")]
        own = points[in_time]
        fault = _fault([own], str(names[rows[0]]), str(path), partial(_line, table.lines[in_time]))
        words = [
            _word([table.words[name][row] for row in rows], name, place) for name in _WORDS[1:] if name in table.words
        ]
        labels = dict(zip([name for name in _WORDS[1:] if name in table.words], words, strict=True))
        found.append(_Own(own, voted(counts.astype(int)), str(names[rows[0]]), labels, fault))
    return found


def _joined(found: list[_Own], path: Path) -> StrokeSet:
    if not found:
        raise InputError(f"{path}: no stroke; {_WANTED_CSV}.")
    dimensions = {own.points.shape[1] for own in found}
    if len(dimensions) > 1:
        raise InputError(f"{path}: some strokes have a column z and some have not.")
    return StrokeSet(
        tuple(([own.points], own.fingers) for own in found),
        tuple(own.id for own in found),
        tuple(own.words.get("label", "") for own in found),
        tuple(own.words.get("person", "") for own in found),
        dimensions.pop(),
        faults=tuple(own.fault for own in found),
    )


def _word(words: list[str], name: str, place: str) -> str:
    if len(different := set(words)) > 1:
        raise InputError(f"{place}: one stroke with several entries in {name}, {shown(sorted(different))}.")
    return words[0]
