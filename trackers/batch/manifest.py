"""The list of recordings of `jaxfilters batch`, from a JSON or a CSV file that people or scripts write."""

import argparse
import csv
import io
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from jaxfilters.trackers.io.errors import InputError, shown
from jaxfilters.trackers.io.input_files import read_text
from jaxfilters.trackers.io.json_files import parse_json
from jaxfilters.trackers.registry import SYSTEMS, system

FIELDS = ("name", "tracker", "input", "options")
"""The last two may be missing or empty."""
_WANTED = "expected a list of recordings with name, tracker, input and options"
_MOST_BYTES = 64 * 2**20
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,127}")
_TAKEN = ("report.json", "report.csv")
"""Files that a batch writes beside the folders of the recordings."""


class Entry(NamedTuple):
    """One recording of a manifest."""

    name: str
    """Of the folder of its results."""
    tracker: str
    input: tuple[str, ...]
    """Files or folders, relative to the folder of the manifest; none for a synthetic recording."""
    options: tuple[str, ...]
    """As on the command line of the tracker, without `--out` and `--resume`."""

    def arguments(self, out: Path) -> list[str]:
        """The words after `jaxfilters` that track it, with results in `out`, or continue where an earlier run ended."""
        return ["track", self.tracker, *self.input, *self.options, "--out", str(out), "--resume"]


def read_manifest(path: Path) -> list[Entry]:
    """The recordings of a manifest, every one checked.

    Args:
        path: A `.json` file, a list of objects, or a `.csv` file with the fields as its header. `input` is a text or,
            in JSON, a list of texts; `options` is a text in the syntax of a shell or, in JSON, a list of words.

    Raises:
        InputError: The file cannot be read, or a row is wrong: the message names the row, from 1, and the field.
    """
    text = read_text(path, _WANTED, _MOST_BYTES)
    if path.suffix.lower() == ".csv":
        rows = _csv_rows(text, path)
    elif path.suffix.lower() == ".json":
        rows = parse_json(text, str(path), _WANTED)
    else:
        raise InputError(f"{path}: expected a name that ends in .json or .csv.")
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{path}: {_WANTED}; got {'none' if rows == [] else f'a {type(rows).__name__}'}.")
    entries = [_entry(row, f"{path}: row {number}") for number, row in enumerate(rows, 1)]
    first: dict[str, int] = {}
    for number, entry in enumerate(entries, 1):
        # Some file systems do not tell upper case from lower case.
        other = first.setdefault(entry.name.lower(), number)
        if other != number:
            raise InputError(f"{path}: row {number}: name: {shown(entry.name)} is the name of row {other} already.")
    return entries


def _csv_rows(text: str, path: Path) -> list[dict[str, Any]]:
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        rows: list[dict[Any, Any]] = list(reader)
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: not CSV ({error}); {_WANTED}.") from None
    for number, row in enumerate(rows, 1):
        if None in row:
            raise InputError(f"{path}: row {number}: more cells than the header has; quote cells with commas.")
    return [{field: value for field, value in row.items() if value} for row in rows]


def _entry(row: Any, place: str) -> Entry:
    if not isinstance(row, dict):
        raise InputError(f"{place}: expected an object with {', '.join(FIELDS)}; got {shown(row)}.")
    if unknown := [field for field in row if field not in FIELDS]:
        raise InputError(f"{place}: {shown(unknown[0])}: unknown field; known are {', '.join(FIELDS)}.")
    name, tracker = row.get("name"), row.get("tracker")
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name.lower() in _TAKEN:
        expected = "letters, digits, and _ . + - after the first, at most 128, and no report.json or report.csv"
        raise InputError(f"{place}: name: expected {expected}; got {shown(name)}.")
    if tracker not in (known := [one.name for one in SYSTEMS]):
        raise InputError(f"{place}: tracker: expected one of {', '.join(known)}; got {shown(tracker)}.")
    entry = Entry(name, tracker, _inputs(row.get("input"), place), _words(row.get("options"), place))
    _check_options(entry, place)
    return entry


def _inputs(value: Any, place: str) -> tuple[str, ...]:
    inputs = [] if value is None else [value] if isinstance(value, str) else value
    if not isinstance(inputs, list) or not all(isinstance(one, str) and one for one in inputs):
        raise InputError(f"{place}: input: expected a text or a list of texts; got {shown(value)}.")
    if wrong := [one for one in inputs if one.startswith("-")]:
        raise InputError(f"{place}: input: {shown(wrong[0])} looks like an option; write ./{shown(wrong[0])[1:-1]}.")
    return tuple(inputs)


def _words(value: Any, place: str) -> tuple[str, ...]:
    try:
        words = [] if value is None else shlex.split(value) if isinstance(value, str) else value
    except ValueError as error:
        raise InputError(f"{place}: options: {error} in {shown(value)}.") from None
    if not isinstance(words, list) or not all(isinstance(one, str) for one in words):
        raise InputError(f"{place}: options: expected a text or a list of texts; got {shown(value)}.")
    return tuple(words)


class _Parser(argparse.ArgumentParser):
    """Raises its errors."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def _check_options(entry: Entry, place: str) -> None:
    """Let the tracker's own parser judge the options: what is wrong is known before the first recording begins."""
    parser = _Parser(add_help=False)
    system(entry.tracker).part("options", "add_options")(parser)
    try:
        found = parser.parse_args([*entry.input, "--out", "", *entry.options])
    except InputError as error:
        raise InputError(f"{place}: options: {error}.") from None
    if found.out != Path(""):
        raise InputError(f"{place}: options: --out is set by the batch; choose the folder by the name.")
