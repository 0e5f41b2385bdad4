"""Arrays of `.npz` files of unknown origin: nothing is allocated that the file cannot hold."""

import math
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.input_files import check_regular

MOST_BYTES = 8 * 2**30
"""Of all arrays that are read from one file."""
_MOST_COMPRESSION = 1032
"""Bytes that one byte of a deflated stream can stand for, at most (P. Deutsch, RFC 1951)."""
_KINDS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_ENCRYPTED = 1


class ArrayHeader(NamedTuple):
    """What the header of an array says."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype


def read_npz(path: Path, wanted: str, known: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a file by name.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        known: Names to read, those that are there; all of them without. Others may hold anything.

    Raises:
        InputError: a file that cannot be read, is damaged or encrypted, holds anything but arrays of numbers or text,
            claims more elements than it holds, or holds more than 8 GiB.
    """
    arrays, left = {}, MOST_BYTES
    with _opened(path, wanted) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if known is not None and name not in known:
                continue
            left -= entry.file_size
            if left < 0:
                raise InputError(f"{path}: arrays of more than {MOST_BYTES >> 30} GiB; {wanted}.")
            arrays[name] = _array(path, archive, entry, wanted)
    return arrays


def names_in_npz(path: Path, wanted: str) -> list[str]:
    """The names of the arrays of a file; what they hold is not looked at.

    Raises:
        InputError: a file that cannot be read, or is no `.npz`.
    """
    with _opened(path, wanted) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_array_header(stream: Any) -> ArrayHeader:
    """The header of an array in NumPy's format; the stream is then at its first element.

    Raises:
        ValueError: no such header, or an array of objects.
    """
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"version {version[0]}.{version[1]} of NumPy's format")
    header = ArrayHeader(*read(stream))
    if header.dtype.hasobject:
        raise ValueError("objects, not numbers")
    return header


class _opened:
    """An archive whose faults, found while it is open, are errors that name the file."""

    def __init__(self, path: Path, wanted: str):
        self._path, self._wanted = path, wanted
        check_regular(path, wanted)
        try:
            with path.open("rb") as content:
                if content.read(6) == b"\x93NUMPY":
                    raise InputError(f"{path}: a single array; {wanted}.")
            self._archive = zipfile.ZipFile(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}); {wanted}.") from None
        except (ValueError, EOFError, NotImplementedError, zipfile.BadZipFile) as error:
            raise self._damaged(error) from None

    def __enter__(self) -> zipfile.ZipFile:
        return self._archive

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        self._archive.close()
        damages = (ValueError, EOFError, NotImplementedError, RuntimeError, OSError, zipfile.BadZipFile, zlib.error)
        if isinstance(error, damages) and not isinstance(error, InputError):
            raise self._damaged(error) from None

    def _damaged(self, error: BaseException) -> InputError:
        return InputError(f"{self._path}: not a complete .npz file ({str(error)[:200]}); {self._wanted}.")


def _array(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, wanted: str) -> np.ndarray:
    if entry.flag_bits & _ENCRYPTED:
        raise InputError(f"{path}: {entry.filename} is encrypted; {wanted}.")
    if entry.compress_type not in _KINDS or not entry.filename.endswith(".npy"):
        raise InputError(f"{path}: {entry.filename[:80]} is not an array of NumPy; {wanted}.")
    if entry.file_size > _MOST_COMPRESSION * (entry.compress_size + 1):
        raise ValueError(f"{entry.filename} claims {entry.file_size} bytes in {entry.compress_size}")
    with archive.open(entry) as stream:
        header = read_array_header(stream)
        size = math.prod(header.shape) * header.dtype.itemsize
        if stream.tell() + size != entry.file_size:
            raise ValueError(f"{entry.filename} claims shape {header.shape} of {header.dtype}, and holds others")
        content = stream.read(size)
    flat = np.frombuffer(content, header.dtype, math.prod(header.shape))
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C").copy()
