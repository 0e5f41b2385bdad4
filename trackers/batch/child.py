"""The process of one recording of a batch: `jaxfilters track`, which ends when the process that started it does.

`python -m jaxfilters.trackers.batch.child track ...`, with a pipe as its standard input that nobody writes into.
"""

import os
import signal
import sys
import threading
import time

from jaxfilters.trackers.app.cli import command

_GRACE_S = 20.0
"""Until a process that was asked to end is ended; a chunk of frames takes less."""


def _end_with_parent() -> None:
    # Not through `sys.stdin`, whose lock would be held when the interpreter ends.
    os.read(sys.stdin.fileno(), 1)
    # As a scheduler would: what is tracked is kept, and whoever takes over continues from there.
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    os._exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.exit(command())
