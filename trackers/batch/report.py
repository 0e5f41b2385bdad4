"""What came of the recordings of a batch: a file for each that is finished, and one report of all."""

import csv
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

from jaxfilters.trackers.batch.claims import write_whole
from jaxfilters.trackers.batch.manifest import Entry
from jaxfilters.trackers.io.errors import InputError, shortened
from jaxfilters.trackers.io.input_files import read_bytes
from jaxfilters.trackers.io.json_files import read_json, read_json_value

DONE, FAILED, WAITING = "done", "failed", "waiting"
_COLUMNS = ("name", "tracker", "status", "seconds", "frames", "frames_per_second", "attempts", "machine", "error")
_SHOWN = ("name", "status", "seconds", "frames", "error")


class Result(NamedTuple):
    """What came of one recording."""

    status: str
    """`DONE` or `FAILED`; `WAITING` in a report that is written before its turn came or its process was finished."""
    seconds: float | None = None
    """Wall time of the last attempt."""
    frames: int | None = None
    frames_per_second: float | None = None
    """By the report of the tracker, which leaves out compilation."""
    attempts: int = 0
    machine: str = ""
    """Host of the last attempt."""
    error: str = ""
    """One line; empty if there was none."""


class Results:
    """The results of the entries of a manifest in the folder of a batch."""

    def __init__(self, out: Path, entries: list[Entry]):
        """Results in `out`, which is made if need be.

        Raises:
            InputError: `out` holds the result of another recording under the name of an entry.
            OSError: `out` cannot be written.
        """
        self._out, self._entries = out, {entry.name: entry for entry in entries}
        self._folder = out / ".batch" / "results"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._finished: dict[str, Result] = {}
        self.finished()

    def finished(self) -> dict[str, Result]:
        """The results that exist by now, of any process. Files that were read once are not read again."""
        for path in self._folder.glob("*.json"):
            name = path.name.removesuffix(".json")
            if name in self._entries and name not in self._finished:
                self._finished[name] = self._read(path, self._entries[name])
        return self._finished

    def add(self, name: str, result: Result) -> None:
        """Keep the result of a recording."""
        entry = self._entries[name]
        document = {"entry": list(map(_plain, entry)), "result": result._asdict()}
        write_whole(self._path(name), json.dumps(document, indent=2) + "\n")
        self._finished[name] = result

    def forget(self, names: list[str]) -> None:
        """Remove the results of recordings, which are then tracked again."""
        for name in names:
            self._path(name).unlink(missing_ok=True)
            self._finished.pop(name, None)

    def write_report(self) -> dict[str, Result]:
        """Write `report.json` and `report.csv`, and return the results of all recordings in the manifest's order."""
        while True:
            found = dict(self.finished())
            results = {name: found.get(name, Result(WAITING)) for name in self._entries}
            trackers = {name: entry.tracker for name, entry in self._entries.items()}
            rows = [{"name": name, "tracker": trackers[name], **r._asdict()} for name, r in results.items()]
            write_whole(self._out / "report.json", json.dumps(rows, indent=2, allow_nan=False) + "\n")
            text = io.StringIO(newline="")
            table = csv.DictWriter(text, _COLUMNS)
            table.writeheader()
            table.writerows(rows)
            write_whole(self._out / "report.csv", text.getvalue())
            # Another process that ends now may have written its report before this one, with a result more.
            if len(self.finished()) == len(found):
                return results

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def _read(self, path: Path, entry: Entry) -> Result:
        try:
            document = read_json(path, "expected a result of a batch")
            was, result = document["entry"], Result(**document["result"])
        except (InputError, KeyError, TypeError):
            raise InputError(f"{path}: not a result of a batch; delete it to track the recording again.") from None
        if was != list(map(_plain, entry)):
            raise InputError(
                f"{entry.name}: {self._out} holds its results with another tracker, input or options; "
                f"choose another name or --out, or delete {path}."
            )
        return result


def aligned(results: dict[str, Result]) -> str:
    """A table of all recordings for people."""
    rows = [_SHOWN, *((name, *(_cell(getattr(r, field)) for field in _SHOWN[1:])) for name, r in results.items())]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_SHOWN))]
    return "\n".join(
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def report_of(folder: Path) -> dict[str, Any]:
    """What the report of a tracker in `folder` says, nothing if there is none that can be read."""
    try:
        found = read_json_value(folder / "report.json", "expected the report of a tracker")
    except InputError:
        return {}
    return found if isinstance(found, dict) else {}


def error_in(log: Path) -> str:
    """The error that a command has written last, or its last line."""
    try:
        text = read_bytes(log, "expected the log of a tracker").decode(errors="replace")
    except InputError:
        return ""
    lines = [line for line in text.splitlines() if line.strip()]
    prefix = "jaxfilters: error: "
    errors = [line.removeprefix(prefix) for line in lines if line.startswith(prefix)]
    return shortened((errors or lines or [""])[-1], 400)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.1f}" if isinstance(value, float) else str(value)
