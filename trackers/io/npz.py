"""Arrays of `.npz` files of unknown origin: nothing is allocated that the file cannot hold."""

import errno
import math
import warnings
import weakref
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import check_regular
from jaxfilters.trackers.io.json_files import parse_json

MOST_BYTES = 512 * 2**20
"""Of all arrays that are read from one file at once."""
_LONGEST_REASON = 120
_MOST_COMPRESSION = 1032
"""Bytes that one byte of a deflated stream can stand for, at most (P. Deutsch, RFC 1951)."""
_KINDS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_ENCRYPTED = 1
_PIECE = 2**24
"""Bytes that are decompressed at once."""
_UNREADABLE = {errno.ENOENT, errno.EACCES, errno.EIO, errno.EPERM}
"""Errors of the system that say nothing of what is in the file."""


class ArrayHeader(NamedTuple):
    """What the header of an array says."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Bytes of all elements."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_npz(path: Path, wanted: str, known: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a file by name.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        known: Names to read, those that are there; all of them without. Others may hold anything.

    Raises:
        InputError: a file that cannot be read, is damaged or encrypted, holds anything but arrays of numbers or text,
            claims more elements than it holds, or holds more than 512 MiB.
    """
    arrays, left = {}, MOST_BYTES
    with _faults_named(path, wanted), _opened(path, wanted) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if known is not None and name not in known:
                continue
            left -= entry.file_size
            if left < 0:
                raise InputError(f"{path}: arrays of more than {MOST_BYTES >> 20} MiB; {wanted}.")
            arrays[name] = _array(path, archive, entry, wanted)
    return arrays


def names_in_npz(path: Path, wanted: str) -> list[str]:
    """The names of the arrays of a file; what they hold is not looked at.

    Raises:
        InputError: a file that cannot be read, or is no `.npz`.
    """
    with _faults_named(path, wanted), _opened(path, wanted) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_header(
    arrays: dict[str, np.ndarray], path: Path, wanted: str, format: str, version: int, units: str | None = None
) -> dict[str, Any]:
    """The text `header` of arrays, an object in JSON.

    Args:
        arrays: Those of the file.
        path: Of the file, for messages.
        wanted: Describes a right one, for messages.
        format: What the header must say that the file is.
        version: Of that format.
        units: What it must say of lengths, if anything.

    Raises:
        InputError: no JSON, another format or version, or other units.
    """
    if "header" not in arrays:
        raise InputError(f"{path}: without header; {wanted}.")
    header = parse_json(str(arrays["header"]), f"{path}: header", wanted)
    if not isinstance(header, dict) or header.get("format") != format or header.get("units") != units:
        also = f' and units "{units}"' if units else ""
        raise InputError(f'{path}: header must say format "{format}"{also}; {wanted}.')
    if header.get("version") != version:
        raise InputError(f"{path}: version {shown(header.get('version'))}; this program reads version {version}.")
    if not isinstance(header.setdefault("parameters", {}), dict):
        raise InputError(f"{path}: parameters must be an object; got {shown(header['parameters'])}.")
    return header


def read_array_header(stream: Any) -> ArrayHeader:
    """The header of an array in NumPy's format; the stream is then at its first element.

    Raises:
        ValueError: no such header, or an array of objects.
    """
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"version {version[0]}.{version[1]} of NumPy's format")
    with warnings.catch_warnings():
        # Of headers that Python 2 wrote, and of types that have another name now.
        warnings.simplefilter("ignore")
        header = ArrayHeader(*read(stream))
    if header.dtype.hasobject:
        raise ValueError("objects, not numbers")
    return header


class ArrayStream:
    """One array of an `.npz` whose first axis is read piece by piece; the others stay in the file."""

    def __init__(self, path: Path, name: str, wanted: str):
        """Open the file.

        Raises:
            InputError: as of `read_npz`, or no such array.
        """
        self._path, self._name, self._wanted = path, name, wanted
        self._stream: Any = None
        with _faults_named(path, wanted):
            self._open()

    def _open(self) -> None:
        with _opened(self._path, self._wanted) as archive:
            entry = next((entry for entry in archive.infolist() if entry.filename == f"{self._name}.npy"), None)
            if entry is None:
                raise InputError(f"{self._path}: {self._name} missing; {self._wanted}.")
            _check_entry(self._path, entry, self._wanted)
            # The stream keeps the file open after the archive is closed.
            self._stream = archive.open(entry)
            # Whoever stops reading in the middle, as where a disk is full, has nothing to close.
            weakref.finalize(self, self._stream.close)
            self.header = _checked_header(self._stream, entry)
            self._first_byte = self._stream.tell()

    def read(self, index: int) -> np.ndarray:
        """The part `index` along the first axis; reading forward goes on where the last part ended.

        Raises:
            InputError: the file is damaged there.
        """
        shape, order, dtype = self.header
        size = math.prod(shape[1:]) * dtype.itemsize
        with _faults_named(self._path, self._wanted, f"frame {index} of {self._name}"):
            if self._stream.closed:
                self._open()
            try:
                self._stream.seek(self._first_byte + index * size)
                content = self._stream.read(size)
                if len(content) != size:
                    raise ValueError("it ends there")
            except Exception:
                # Where a stream is after a fault is not defined; the next part is read from a new one.
                self._stream.close()
                raise
        return np.frombuffer(content, dtype).reshape(shape[1:], order="F" if order else "C")


def _opened(path: Path, wanted: str) -> zipfile.ZipFile:
    check_regular(path, wanted)
    with path.open("rb") as content:
        if content.read(6) == b"\x93NUMPY":
            raise InputError(f"{path}: a single array; {wanted}.")
    return zipfile.ZipFile(path)


@contextmanager
def _faults_named(path: Path, wanted: str, part: str = "") -> Iterator[None]:
    """Turns what is found wrong with an archive into an error that names the file."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, EOFError, NotImplementedError, RuntimeError, OSError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, OSError) and error.strerror and error.errno in _UNREADABLE:
            raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None
        reason = shortened(str(error), _LONGEST_REASON)
        where = f"{part}: " if part else ""
        raise InputError(f"{path}: not a complete .npz file ({where}{reason}); {wanted}.") from None


def _check_entry(path: Path, entry: zipfile.ZipInfo, wanted: str) -> None:
    name = shortened(entry.filename)
    if entry.flag_bits & _ENCRYPTED:
        raise InputError(f"{path}: {name} is encrypted; {wanted}.")
    if entry.compress_type not in _KINDS or not entry.filename.endswith(".npy"):
        raise InputError(f"{path}: {name} is not an array of NumPy; {wanted}.")
    if entry.file_size > _MOST_COMPRESSION * (entry.compress_size + 1):
        raise ValueError(f"{name} claims {entry.file_size} bytes in {entry.compress_size}")


def _checked_header(stream: Any, entry: zipfile.ZipInfo) -> ArrayHeader:
    """The header of an array that the entry holds whole, and nothing beside it."""
    header = read_array_header(stream)
    if min(header.shape, default=0) < 0 or stream.tell() + header.size != entry.file_size:
        name = shortened(entry.filename)
        raise ValueError(
            f"{name} claims shape {shown(header.shape)} of {shortened(str(header.dtype))}, and holds others"
        )
    return header


def _array(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, wanted: str) -> np.ndarray:
    _check_entry(path, entry, wanted)
    stream: Any
    with archive.open(entry) as stream:
        header = _checked_header(stream, entry)
        content, done = np.empty(header.size, np.uint8), 0
        while done < header.size:
            count = stream.readinto(content.data[done : done + _PIECE])
            if not count:
                raise ValueError(f"{shortened(entry.filename)} ends before its last element")
            done += count
    flat = np.frombuffer(content, header.dtype, math.prod(header.shape))
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")
