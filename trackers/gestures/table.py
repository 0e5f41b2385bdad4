"""Tables of what was recognised: lines for a person, and CSV files."""

import csv
from collections.abc import Sequence
from pathlib import Path

from jaxfilters.trackers.io.errors import OutputError

Row = tuple[str, ...]
_MOST_ROWS = 40


def table_lines(columns: Row, rows: Sequence[Row]) -> list[str]:
    """The names of the columns and the first rows, a line each, and how many more rows there are."""
    whole = [columns, *rows[:_MOST_ROWS]]
    widths = [max(len(row[k]) for row in whole) for k in range(len(columns))]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in whole]
    return [*lines, *([f"... and {len(rows) - _MOST_ROWS} more"] if len(rows) > _MOST_ROWS else [])]


def write_table(path: Path, columns: Row, rows: Sequence[Row]) -> None:
    """Write a CSV file; its folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as content:
            csv.writer(content).writerows([columns, *rows])
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None
