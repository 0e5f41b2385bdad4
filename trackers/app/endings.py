"""How a command ends before its time: by a signal, or by an error that nobody foresaw."""

import signal
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from jaxfilters import __version__
from jaxfilters.trackers.io.input_files import is_folder

ERROR_FILE = "error.txt"
_LONGEST = 200


class Terminated(KeyboardInterrupt):
    """SIGTERM: a scheduler or a person ends the process, and what is finished is to be kept as with Ctrl-C."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Within it, SIGTERM raises `Terminated`. Signals reach the main thread alone; in others nothing is changed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def unforeseen(error: Exception, out: Path | None) -> str:
    """One line about an error of the program itself; its traceback goes into a file beside the results.

    Args:
        error: The error.
        out: The folder or the file of the results, if the command has one.
    """
    text = "".join(traceback.format_exception(error))
    report = f"jaxfilters {__version__}\n{text}"
    places = [] if out is None else [out if is_folder(out) else out.parent]
    for folder in [*places, Path(tempfile.gettempdir())]:
        path = folder / ERROR_FILE
        try:
            # Names of files may hold bytes that are no text.
            path.write_text(report, encoding="utf-8", errors="backslashreplace")
        except OSError:
            continue
        break
    else:
        path = None
    first = (str(error).splitlines() or [""])[0][:_LONGEST]
    kept = f"; please report it with {path}" if path is not None else "; run it again with --debug to see where"
    return f"unforeseen {type(error).__name__}: {first}{kept}."
