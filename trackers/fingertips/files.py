"""What hands do, as lines of `events.jsonl`."""

import json
import os
from pathlib import Path
from typing import Any, TextIO

from jaxfilters.trackers.app.output_folder import reason
from jaxfilters.trackers.fingertips.events import Event
from jaxfilters.trackers.io.errors import CheckpointError, OutputError
from jaxfilters.trackers.io.input_files import read_text
from jaxfilters.trackers.io.json_files import parse_json


class EventFile:
    """Events that are on disk when `append` returns."""

    def __init__(self, path: Path):
        """A file that is begun with the first events, or continued by `cut`."""
        self.path = path
        self._file: TextIO | None = None

    def append(self, events: list[Event]) -> None:
        """Add a line for each.

        Raises:
            OutputError: the disk is full or the folder gone; what was appended before is kept.
        """
        try:
            self._file = self._file or self.path.open("w", encoding="utf-8")
            self._file.write("".join(json.dumps(event_entry(event), allow_nan=False) + "\n" for event in events))
            self._file.flush()
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {reason(error)}; earlier lines are kept.") from None

    def size(self) -> int:
        """Bytes so far."""
        return self.path.stat().st_size if self._file is not None else 0

    def cut(self, size: int) -> list[Event]:
        """Go on after so many bytes of an interrupted run; the events up to there.

        Raises:
            CheckpointError: there are fewer.
        """
        if size and (not self.path.exists() or self.path.stat().st_size < size):
            raise CheckpointError(f"{self.path}: cannot be continued; expected {size} bytes or more.")
        if size:
            os.truncate(self.path, size)
        self._file = self.path.open("a" if size else "w", encoding="utf-8")
        return read_events(self.path)

    def close(self) -> None:
        """Nothing more comes."""
        if self._file is not None:
            self._file.close()


def read_events(path: Path) -> list[Event]:
    """The events of a run, from `events.jsonl`."""
    lines = read_text(path, "expected the events of a run").splitlines()
    return [_event(parse_json(line, f"{path}: line {i}", "expected an event")) for i, line in enumerate(lines, 1)]


def _event(entry: dict[str, Any]) -> Event:
    take = entry.pop
    return Event(take("frame"), take("time_s"), take("hand"), take("event"), take("phase"), entry)


def event_entry(event: Event) -> dict[str, Any]:
    """An event for JSON."""
    head = {"frame": event.frame, "time_s": round(event.time_s, 6), "hand": event.hand}
    return head | {"event": event.name, "phase": event.phase} | event.quantities
