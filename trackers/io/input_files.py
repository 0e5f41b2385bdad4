"""What every reader checks before it opens a file."""

from pathlib import Path

from jaxfilters.trackers.io.errors import InputError


def check_regular(path: Path, wanted: str) -> int:
    """The size of a regular file in bytes; reading a pipe or a device could block for ever.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.

    Raises:
        InputError: no file, or something else than a regular file.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "a pipe or a device"
        raise InputError(f"{path}: {kind}; {wanted}.")
    return size
