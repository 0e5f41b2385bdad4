"""Tables of unknown origin: CSV with a header, whose numbers are read as numbers at once."""

import csv
import io
import sys
from array import array
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import LARGEST, read_text


class Columns(NamedTuple):
    """What is read of a table; other columns may hold anything."""

    numbers: tuple[str, ...]
    words: tuple[str, ...] = ()
    may_lack: frozenset[str] = frozenset()
    """Numbers that may be empty or `nan`, and are NaN then."""


class Table(NamedTuple):
    """A table by column."""

    numbers: dict[str, np.ndarray]
    """(rows,) each; finite, or NaN where a number may be lacking."""
    words: dict[str, list[str]]
    """Without space around them."""
    lines: np.ndarray
    """(rows,) where each row ends in the file, counted from 1."""


def read_table(path: Path, wanted: str, choose: Callable[[list[str]], Columns]) -> Table:
    """The columns of a CSV file that are of use.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        choose: Gets the names of all columns, without space around them and in lower case; raises `InputError` where
            they are not the right ones.

    Raises:
        InputError: a file that cannot be read or is no CSV, two columns of one name, rows that are longer or shorter
            than the header, or entries that are not the numbers they should be.
    """
    reader = csv.reader(io.StringIO(read_text(path, wanted), newline=""), skipinitialspace=True)
    try:
        rows = ((reader.line_num, row) for row in reader if row)
        _, header = next(rows, (0, []))
        names = [name.strip().lower() for name in header]
        if len(set(names)) < len(names):
            raise InputError(f"{path}: two columns of one name; the header is {shortened(','.join(header))}; {wanted}.")
        return _read(path, rows, names, choose(names))
    except csv.Error as error:
        raise InputError(f"{path}: no CSV ({error}); {wanted}.") from None


def exactly(
    path: Path, wanted: str, header: Sequence[str], words: Collection[str] = ()
) -> Callable[[list[str]], Columns]:
    """What `read_table` is to choose of a table that must have these columns in this order, and no other.

    Args:
        path: The file, for messages.
        wanted: Describes a right one, for messages.
        header: The columns.
        words: Those among them that hold no numbers.
    """

    def choose(names: list[str]) -> Columns:
        if names != list(header):
            raise InputError(f"{path}: {wanted}; the header is {shortened(','.join(names))!r}.")
        return Columns(tuple(name for name in header if name not in words), tuple(words))

    return choose


def _read(path: Path, rows: Iterable[tuple[int, list[str]]], names: list[str], columns: Columns) -> Table:
    places = {name: place for place, name in enumerate(names)}
    numbers = {name: array("d") for name in columns.numbers}
    words: dict[str, list[str]] = {name: [] for name in columns.words}
    lines: list[int] = []
    for line, row in rows:
        if len(row) != len(names):
            entries = f"{len(row)} entries, its header {len(names)}"
            raise InputError(f"{path}: line {line} has {entries} (truncated?): {shortened(','.join(row))}.")
        for name, values in numbers.items():
            values.append(_number(row[places[name]], name, columns, f"{path}: line {line}"))
        for name, texts in words.items():
            # Most words come again in other rows.
            texts.append(sys.intern(row[places[name]].strip()))
        lines.append(line)
    return Table({name: np.array(values) for name, values in numbers.items()}, words, np.asarray(lines, int))


def _number(text: str, name: str, columns: Columns, place: str) -> float:
    """The number in a cell; NaN where there is none and there may be none."""
    may_lack = name in columns.may_lack
    try:
        value = float(text) if text.strip() or not may_lack else np.nan
    except ValueError:
        raise InputError(f"{place}: {name} must be a number; got {shown(text)}.") from None
    if not (abs(value) <= LARGEST or (may_lack and np.isnan(value))):
        raise InputError(f"{place}: {name} must be a finite number of at most {LARGEST:g}; got {shortened(text)}.")
    return value
