"""The folder that a run writes its results into, held by one run at a time."""

import errno
import os
from pathlib import Path

from filelock import FileLock, Timeout

from jaxfilters.trackers.io.errors import OutputError

LOCK = ".lock"


class OutputFolder:
    """A folder that one run writes into; no other run can until it is closed or its process ends."""

    def __init__(self, path: Path):
        """Make the folder if need be, and lock it.

        Raises:
            OutputError: it cannot be written, or another run writes into it.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(path / LOCK, timeout=0, thread_local=False)
            self._lock.acquire()
        except Timeout:
            raise OutputError(f"{path}: another run writes into it; choose another --out.") from None
        except OSError as error:
            raise OutputError(f"cannot write into {path}: {reason(error)}.") from None

    def close(self) -> None:
        """Let other runs have it."""
        # Removed while it is held: a run that comes between would hold a file that is not there any more.
        (self.path / LOCK).unlink(missing_ok=True)
        self._lock.release()


def check_free(path: Path) -> None:
    """Refuse a folder that cannot be written, before the recording is read; the folder is not made.

    Raises:
        OutputError: Another run writes into it, or nobody can.
    """
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        why = "no permission" if nearest.is_dir() else f"{nearest} is not a folder"
        raise OutputError(f"cannot write into {path}: {why}.")
    if (path / LOCK).exists():
        OutputFolder(path).close()


def reason(error: OSError) -> str:
    """Why nothing could be written, in a few words."""
    return "no space left on the device" if error.errno == errno.ENOSPC else error.strerror or str(error)
