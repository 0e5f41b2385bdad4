"""What a run of the fingertip tracker leaves while it goes on: `tips.csv`, `events.jsonl` and `checkpoint/`."""

import csv
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from jaxfilters.trackers.app.output_folder import OutputFolder
from jaxfilters.trackers.app.results import CHECKPOINT_EVERY_S, can_resume
from jaxfilters.trackers.fingertips.events import Event
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError, OutputError
from jaxfilters.trackers.io.input_files import read_text
from jaxfilters.trackers.io.json_files import parse_json

COLUMNS = (
    *("frame", "time_s", "hand", "id", "x", "y", "sd", "vx", "vy"),
    *("status", "is_thumb", "thumb_probability"),
)
"""Places in pixels, velocities in pixels per 1/30 s; the id says the hand, too."""
OBSERVED, COASTED = "observed", "coasted"


class FingertipFiles:
    """Rows and lines that are on disk when `append` returns, and `checkpoint/` to continue from."""

    def __init__(self, folder: Path, run: dict[str, Any], *, resume: bool):
        """Begin both files, or open those of an interrupted run.

        Args:
            folder: Where the results go.
            run: What must be equal for a run to be continued, JSON-able.
            resume: Whether an interrupted run is continued, where there is one.

        Raises:
            OutputError: the folder cannot be written, holds another run's tips, or another run writes into it.
            CheckpointError: the interrupted run is another one, or its files are damaged.
        """
        self._output = OutputFolder(folder)
        self.tips, self.events = folder / "tips.csv", folder / "events.jsonl"
        self._run, self._saved_at = run, time.monotonic()
        self._folder = folder
        self.saved: Any = None
        """What `checkpoint` was given before the interruption; None where the run begins anew."""
        try:
            if resume and can_resume(folder):
                checkpoint.check_same_run(folder, run)
                self.saved, meta = checkpoint.load(checkpoint.state_path(folder))
                self._tips, self._events = (_cut(path, meta["bytes"]) for path in (self.tips, self.events))
            elif self.tips.exists():
                raise OutputError(f"{self.tips}: holds the tips of another run; choose another --out, or --resume.")
            else:
                self._tips = self.tips.open("w", newline="", encoding="utf-8")
                self._events = self.events.open("w", encoding="utf-8")
        except BaseException as error:
            self._output.close()
            if isinstance(error, OSError) and not isinstance(error, OutputError):
                raise OutputError(f"cannot write into {folder}: {error.strerror}.") from None
            raise
        self._rows = csv.writer(self._tips)
        if self.saved is None:
            self._explained(self.tips, lambda: self._rows.writerow(COLUMNS))

    def checkpoint(self, state: Callable[[], Any]) -> None:
        """Save what the next images need, unless that was done a moment ago; its cost does not grow with the run.

        Raises:
            OutputError: as for `append`; the last checkpoint is as it was.
        """
        if time.monotonic() - self._saved_at < CHECKPOINT_EVERY_S:
            return
        path = checkpoint.state_path(self._folder)
        sizes = {file.name: file.stat().st_size for file in (self.tips, self.events)}

        def save() -> None:
            path.parent.mkdir(exist_ok=True)
            checkpoint.save(path, state(), {"run": self._run, "bytes": sizes})

        self._explained(path, save)
        self._saved_at = time.monotonic()

    def append(self, frame: int, time_s: float, report: HandReport, events: list[Event]) -> None:
        """Add a frame; `report` is of all hands in it.

        Raises:
            OutputError: the disk is full or the folder gone; what was appended before is kept.
        """
        rows = tip_rows(frame, time_s, report)
        if rows:
            self._explained(self.tips, lambda: self._rows.writerows(rows))
        if events:
            text = "".join(json.dumps(event_entry(event), allow_nan=False) + "\n" for event in events)
            self._explained(self.events, lambda: self._events.write(text))

    def close(self) -> None:
        """Nothing more comes."""
        self._tips.close()
        self._events.close()
        self._output.close()

    def _explained(self, path: Path, write: Callable[[], Any]) -> None:
        try:
            write()
            self._tips.flush()
            self._events.flush()
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; earlier rows are kept.") from None


def _cut(path: Path, sizes: dict[str, int]) -> TextIO:
    """A file of an interrupted run, without what was written after its checkpoint."""
    size = sizes[path.name]
    if not path.exists() or path.stat().st_size < size:
        raise CheckpointError(f"{path}: cannot be continued; expected {size} bytes or more.")
    os.truncate(path, size)
    return path.open("a", newline="", encoding="utf-8")


def name_of(hand: int, identity: int) -> str:
    """The id of a fingertip, which begins with that of its hand."""
    return f"{hand}-{identity}"


def tip_rows(frame: int, time_s: float, report: HandReport) -> list[list[Any]]:
    """A row for every fingertip of every hand."""
    rows = []
    for hand, slot in np.argwhere(report.is_tip):
        numbers = (*report.position[hand, slot], report.sd[hand, slot], *report.velocity[hand, slot])
        rows.append(
            [
                *(frame, f"{time_s:.6f}", int(hand), name_of(int(hand), int(report.identity[hand, slot]))),
                *(f"{number:.3f}" for number in numbers),
                OBSERVED if report.is_observed[hand, slot] else COASTED,
                int(report.is_thumb[hand, slot]),
                f"{report.thumb_probability[hand, slot]:.4f}",
            ]
        )
    return rows


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
