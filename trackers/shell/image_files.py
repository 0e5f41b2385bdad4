"""Pictures in folders."""

from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.recording import InputError

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
        encoded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
    if image is None:
        raise InputError(f"{path}: not a complete image.")
    return image
