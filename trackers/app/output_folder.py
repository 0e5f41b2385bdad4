"""The folder that a run writes its results into, held by one run at a time."""

import errno
import os
import tempfile
from pathlib import Path

from filelock import FileLock, Timeout

from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.io.input_files import exists, is_folder

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
    _check_writable(path, f"cannot write into {path}")
    if exists(path / LOCK):
        OutputFolder(path).close()


def check_file(path: Path) -> None:
    """Refuse a file that cannot be written, before what goes into it is computed; neither it nor a folder is made.

    Raises:
        OutputError: Nobody can write it, or it is a folder.
    """
    refused = f"cannot write {path}"
    if is_folder(path):
        raise OutputError(f"{refused}: it is a folder.")
    if not exists(path):
        _check_writable(path.parent, refused, path.name)
    elif os.path.isfile(path):
        # Pipes and devices are left alone: opening one may wait for whoever reads it.
        try:
            with path.open("ab"):
                pass
        except OSError as error:
            raise OutputError(f"{refused}: {reason(error)}.") from None


def _check_writable(path: Path, refused: str, *names: str) -> None:
    """Make a folder of this name, and folders with further `names` in it, where nothing is in their way; remove them.

    Asking for permissions is not enough: all are granted to the superuser, also where a file system takes no files.

    Raises:
        OutputError: The folder cannot be made, or nothing can be made in it; the message begins with `refused`.
    """
    nearest = next(folder for folder in (path, *path.absolute().parents) if exists(folder))
    if not is_folder(nearest):
        raise OutputError(f"{refused}: {nearest} is not a folder.")
    try:
        with tempfile.TemporaryDirectory(prefix=".jaxfilters-", dir=nearest) as trial:
            Path(trial, path.absolute().relative_to(nearest.absolute()), *names).mkdir(parents=True, exist_ok=True)
    except FileNotFoundError:
        raise OutputError(f"{refused}: no files can be made in {nearest}.") from None
    except OSError as error:
        raise OutputError(f"{refused}: {reason(error)}.") from None


def reason(error: OSError) -> str:
    """Why nothing could be written, in a few words."""
    return "no space left on the device" if error.errno == errno.ENOSPC else error.strerror or str(error)
