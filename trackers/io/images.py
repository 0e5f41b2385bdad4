"""Pictures in folders."""

import struct
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.input_files import check_regular

MOST_PIXELS = 128 * 2**20
_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}


def images_in(folder: Path) -> list[Path]:
    """The pictures of a folder in the order of their names.

    Raises:
        InputError: there are none.
    """
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    if not files:
        raise InputError(f"{folder}: no images in it ({', '.join(sorted(_SUFFIXES))}).")
    return files


def read_image(path: Path) -> np.ndarray:
    """(rows, cols, 3) uint8, blue, green, red.

    Raises:
        InputError: no file, or no picture in it that can be decoded.
    """
    try:
        check_regular(path, "expected an image")
        encoded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    check_pixels(encoded, path)
    try:
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: not a complete image.")
    return image


def check_pixels(encoded: np.ndarray, path: Path) -> None:
    """Raise `InputError` where the header of a PNG claims more pixels than any camera has: before it allocates them."""
    header = encoded[:24].tobytes()
    if header.startswith(b"\x89PNG") and len(header) == 24:
        columns, rows = struct.unpack(">II", header[16:])
        if columns * rows > MOST_PIXELS:
            raise InputError(f"{path}: {columns}x{rows} pixels; at most {MOST_PIXELS >> 20} million can be read.")
