"""The content of files of unknown origin: regular files only, and none larger than what is expected."""

import math
import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxfilters.trackers.io.errors import InputError

MOST_BYTES = 256 * 2**20
LARGEST = 1e12
"""Of any number that is read: products of three remain finite in single precision."""


def exists(path: Path) -> bool:
    """Whether there is a file or a folder; False for names that no file system takes, at which `Path.exists` raises."""
    return os.path.exists(path)


def is_folder(path: Path) -> bool:
    """Whether the path is a folder; False for names that no file system takes, at which `Path.is_dir` raises."""
    return os.path.isdir(path)


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
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); {wanted}.") from None
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "a pipe or a device"
        raise InputError(f"{path}: {kind}; {wanted}.")
    return size


def read_bytes(path: Path, wanted: str, most: int = MOST_BYTES) -> bytes:
    """The content of a file.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        most: Number of bytes.

    Raises:
        InputError: no regular file, a larger one, or one that cannot be read.
    """
    if check_regular(path, wanted) > most:
        raise InputError(f"{path}: larger than {most >> 20} MiB; {wanted}.")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None


def open_bytes(path: Path, wanted: str) -> BinaryIO:
    """A file of any size, open for reading, of which only parts are read; arguments and errors as of `read_bytes`."""
    check_regular(path, wanted)
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None


def read_text(path: Path, wanted: str, most: int = MOST_BYTES, encoding: str = "utf-8-sig") -> str:
    """The text of a file; arguments and errors as of `read_bytes`.

    Raises:
        InputError: also for bytes that are no text in the encoding.
    """
    try:
        return read_bytes(path, wanted, most).decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not text in {encoding.removesuffix('-sig').upper()} ({error.reason}); {wanted}."
        ) from None


def check_rate(fps: float, name: str = "fps") -> float:
    """A frame rate as it is.

    Raises:
        InputError: it is not finite and positive: frames at such times would have no end.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise InputError(f"{name} must be finite and above 0; got {fps}.")
    return fps


def too_large(values: np.ndarray) -> np.ndarray:
    """Which numbers are infinite or beyond `LARGEST`, of the shape of `values`; NaN is not."""
    if values.dtype == np.float16:
        return np.asarray(np.isinf(values))
    # Both signs: the smallest integer has no absolute value.
    return np.asarray((values > LARGEST) | (values < -LARGEST))


def are_finite(values: np.ndarray) -> bool:
    """Whether all numbers are finite, in single precision as well, and their products in a camera are."""
    return not (np.isnan(values).any() or too_large(values).any())
