"""Files of calibrations that their readers accept."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from jaxfilters.trackers.io.errors import InputError

Read = TypeVar("Read")


def write_checked(path: Path, write: Callable[[Path], None], read: Callable[[Path], Read]) -> Read:
    """Write a file once a draft of it was read, and return what its reader makes of it.

    Args:
        path: The file. What is there stays as it is where the draft is refused.
        write: Writes to a path.
        read: Reads a path, as those do who use the file.

    Raises:
        InputError: the reader refuses what would be written; the message names `path`.
        OutputError: the file cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "draft.json"
        write(draft)
        try:
            made = read(draft)
        except InputError as error:
            reason = str(error).removeprefix(f"{draft}: ")
            raise InputError(f"{path}: not written, since it could not be used: {reason}") from None
    write(path)
    return made
