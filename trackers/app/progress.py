"""A progress bar for a terminal, and a line now and then for a log file."""

import sys
import time
from types import TracebackType

_WIDTH = 24
_LINES_IN_A_LOG = 5
_FRAMES_A_LINE = 300
"""In a log, where it is not known how many there will be."""


class ProgressLine:
    """`with ProgressLine("tracking", total) as line: line.show(done, note)`; writes to standard error.

    The total is `None` for a live camera; `done` of the total were finished by an earlier run. The time that is left is
    estimated from the second `show` on, since the first includes compilation.
    """

    def __init__(self, label: str, total: int | None, *, done: int = 0):
        self._label, self._total = label, total
        self._first: tuple[int, float] | None = None
        self._redraws = sys.stderr.isatty()
        self._shown = done

    def __enter__(self) -> "ProgressLine":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._redraws and self._shown:
            sys.stderr.write("\n")

    def show(self, done: int, note: str = "") -> None:
        """Show that `done` of the total are finished; a total that is exceeded was a false claim, and is forgotten."""
        if self._total is not None and done > self._total:
            self._total = None
        if self._total is None:
            self._show(f"{self._label} {done}  {note}", done, done - self._shown >= _FRAMES_A_LINE)
            return
        filled = min(_WIDTH, _WIDTH * done // self._total)
        bar = f"[{'#' * filled}{'-' * (_WIDTH - filled)}] " if self._redraws else ""
        is_due = done == self._total or (done - self._shown) * _LINES_IN_A_LOG >= self._total
        self._show(f"{self._label} {bar}{done}/{self._total}  {note}{self._time_left(done)}", done, is_due)

    def _show(self, text: str, done: int, is_due: bool) -> None:
        if self._redraws:
            sys.stderr.write(f"\r\x1b[K{text}")
        elif is_due:
            sys.stderr.write(f"{text}\n")
        if self._redraws or is_due:
            self._shown = done
        sys.stderr.flush()

    def _time_left(self, done: int) -> str:
        assert self._total is not None
        now = time.monotonic()
        if self._first is None or done <= self._first[0]:
            self._first = (done, now)
            return ""
        first, since = self._first
        seconds = (now - since) / (done - first) * (self._total - done)
        return "" if done >= self._total else f"  {_in_words(seconds)} left"


def _in_words(seconds: float) -> str:
    """`12 s`, `3 min` or `2.5 h`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def note(text: str) -> None:
    """A line on standard error, beside the results."""
    sys.stderr.write(f"{text}\n")


def warn(text: str) -> None:
    """A warning on standard error."""
    note(f"jaxfilters: warning: {text}")
