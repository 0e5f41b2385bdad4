"""What a run of the fingertip tracker leaves while it goes on: `tips.csv` and `events.jsonl`."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from jaxfilters.trackers.app.results import OutputFolder
from jaxfilters.trackers.fingertips.events import Event
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.io.errors import OutputError

COLUMNS = (
    *("frame", "time_s", "hand", "id", "x", "y", "sd", "vx", "vy"),
    *("status", "is_thumb", "thumb_probability"),
)
"""Places in pixels, velocities in pixels per 1/30 s; the id says the hand, too."""
OBSERVED, COASTED = "observed", "coasted"


class FingertipFiles:
    """Rows and lines that are on disk when `append` returns."""

    def __init__(self, folder: Path):
        """Begin both files.

        Raises:
            OutputError: the folder cannot be written, holds another run's tips, or another run writes into it.
        """
        self._output = OutputFolder(folder)
        self.tips, self.events = folder / "tips.csv", folder / "events.jsonl"
        if self.tips.exists():
            self._output.close()
            raise OutputError(f"{self.tips}: holds the tips of another run; choose another --out.")
        try:
            self._tips: TextIO = self.tips.open("w", newline="")
            self._events: TextIO = self.events.open("w", encoding="utf-8")
        except OSError as error:
            self._output.close()
            raise OutputError(f"cannot write into {folder}: {error.strerror}.") from None
        self._rows = csv.writer(self._tips)
        self._explained(self.tips, lambda: self._rows.writerow(COLUMNS))

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


def event_entry(event: Event) -> dict[str, Any]:
    """An event for JSON."""
    head = {"frame": event.frame, "time_s": round(event.time_s, 6), "hand": event.hand}
    return head | {"event": event.name, "phase": event.phase} | event.quantities
