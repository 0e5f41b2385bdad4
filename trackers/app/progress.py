"""A progress bar for a terminal, and a line now and then for a log file."""

import sys
from types import TracebackType

_WIDTH = 24
_LINES_IN_A_LOG = 5


class ProgressLine:
    """`with ProgressLine("tracking", total) as line: line.show(done, note)`; writes to standard error."""

    def __init__(self, label: str, total: int):
        self._label, self._total = label, total
        self._redraws = sys.stderr.isatty()
        self._shown = 0

    def __enter__(self) -> "ProgressLine":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._redraws and self._shown:
            sys.stderr.write("\n")

    def show(self, done: int, note: str = "") -> None:
        """Show that `done` of the total are finished."""
        if self._redraws:
            filled = _WIDTH * done // self._total
            bar = "#" * filled + "-" * (_WIDTH - filled)
            sys.stderr.write(f"\r\x1b[K{self._label} [{bar}] {done}/{self._total}  {note}")
            self._shown = done
        elif done == self._total or (done - self._shown) * _LINES_IN_A_LOG >= self._total:
            sys.stderr.write(f"{self._label} {done}/{self._total}  {note}\n")
            self._shown = done
        sys.stderr.flush()
