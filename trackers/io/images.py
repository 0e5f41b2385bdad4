"""Pictures in folders: PNG, JPEG, BMP and TIFF, none larger than what a camera delivers."""

import struct
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.input_files import read_bytes

MOST_PIXELS = 128 * 2**20
_WANTED = "expected an image (PNG, JPEG, BMP or TIFF)"
_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
_MARKERS_WITHOUT_SIZE = {0x01, *range(0xD0, 0xD9)}
_NO_FRAMES = {0xC4, 0xC8, 0xCC}
"""Among the markers from 0xC0 to 0xCF of JPEG, which begin a frame (ITU-T T.81, table B.1)."""
_COLUMNS_TAG, _ROWS_TAG, _SHORT = 256, 257, 3
"""Of TIFF 6.0, section 8; the other type of a size is a long."""


def images_in(folder: Path) -> list[Path]:
    """The pictures of a folder in the order of their names.

    Raises:
        InputError: there are none, or the folder cannot be read.
    """
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); expected a folder of images.") from None
    if not files:
        raise InputError(f"{folder}: no images in it ({', '.join(sorted(_SUFFIXES))}).")
    return files


def read_image(path: Path, *, as_it_is: bool = False) -> np.ndarray:
    """(rows, cols, 3) uint8, blue, green, red.

    Args:
        path: The file.
        as_it_is: With the channels and the type that the file has.

    Raises:
        InputError: no file, no picture in it that can be decoded, or one of more pixels than any camera has.
    """
    encoded = read_bytes(path, _WANTED)
    kind = check_size(encoded, path)
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED if as_it_is else cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: not a complete {kind} image (truncated or damaged).")
    return image


def check_size(encoded: bytes, path: Path) -> str:
    """The format of an image, once its header is known to claim no more pixels than a camera has.

    Raises:
        InputError: another format, no size in the header, or too many pixels, which nothing has allocated yet.
    """
    found = next((entry for start, entry in _FORMATS.items() if encoded.startswith(start)), None)
    if found is None:
        raise InputError(f"{path}: not a complete image; {_WANTED}.")
    kind, size_of = found
    try:
        size = size_of(encoded)
    except (struct.error, IndexError):
        size = None
    if size is None:
        raise InputError(f"{path}: not a complete {kind} image (truncated or damaged).")
    check_num_pixels(*size, path)
    return kind


def check_num_pixels(columns: int, rows: int, place: str | Path) -> None:
    """Raise `InputError`, for `place`, unless the number of pixels is one that a camera has."""
    if columns * rows > MOST_PIXELS:
        raise InputError(f"{place}: {columns}x{rows} pixels; at most {MOST_PIXELS >> 20} million can be read.")


def _png_size(data: bytes) -> tuple[int, int]:
    return struct.unpack(">II", data[16:24])


def _bmp_size(data: bytes) -> tuple[int, int]:
    if struct.unpack("<I", data[14:18])[0] == 12:
        return struct.unpack("<HH", data[18:22])
    columns, rows = struct.unpack("<ii", data[18:26])
    # Rows from top to bottom are counted negative.
    return abs(columns), abs(rows)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Of the first frame."""
    place = 2
    while place + 4 <= len(data):
        if data[place] != 0xFF:
            place += 1
            continue
        marker = data[place + 1]
        if marker == 0xFF:
            place += 1
        elif marker in _MARKERS_WITHOUT_SIZE or marker == 0:
            place += 2
        elif 0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES:
            rows, columns = struct.unpack(">HH", data[place + 5 : place + 9])
            return columns, rows
        else:
            place += 2 + struct.unpack(">H", data[place + 2 : place + 4])[0]
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Of the first directory."""
    order = "<" if data[:1] == b"I" else ">"
    (start,) = struct.unpack(order + "I", data[4:8])
    (count,) = struct.unpack(order + "H", data[start : start + 2])
    sides: dict[int, int] = {}
    for i in range(count):
        entry = data[start + 2 + 12 * i : start + 14 + 12 * i]
        tag, kind = struct.unpack(order + "HH", entry[:4])
        if tag in (_COLUMNS_TAG, _ROWS_TAG):
            (sides[tag],) = struct.unpack(
                order + ("H" if kind == _SHORT else "I"), entry[8 : 10 if kind == _SHORT else 12]
            )
    return (sides[_COLUMNS_TAG], sides[_ROWS_TAG]) if len(sides) == 2 else None


_FORMATS = {
    b"\x89PNG": ("PNG", _png_size),
    b"\xff\xd8": ("JPEG", _jpeg_size),
    b"BM": ("BMP", _bmp_size),
    b"II*\x00": ("TIFF", _tiff_size),
    b"MM\x00*": ("TIFF", _tiff_size),
}
"""How files begin, and how large their images are."""
