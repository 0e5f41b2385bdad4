"""Landmarks of a face that a person has marked, the ten or the 68 of iBUG: CSV with the columns name, u, v."""

import csv
from pathlib import Path

import numpy as np

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.landmark_sets import NAMES_68

_COLUMNS = ["name", "u", "v"]
_WANTED = f"expected a header {','.join(_COLUMNS)} and one row each for {', '.join(NAMES)}; or for 0 to 67"


def read_landmarks(path: Path, image_size: tuple[int, int]) -> np.ndarray:
    """(10, 2) pixels in the order of `NAMES`, or (68, 2) in iBUG's, in an image of `image_size` (columns, rows).

    Raises:
        InputError: an unreadable file, unknown, missing or repeated names, or pixels that are none of the image.
    """
    try:
        with path.open(newline="") as file:
            rows = [[entry.strip() for entry in row] for row in csv.reader(file) if row]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_WANTED}.") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: no CSV ({error}); {_WANTED}.") from None
    if not rows or rows[0] != _COLUMNS:
        raise InputError(f"{path}: {_WANTED}; the header is {','.join(rows[0]) if rows else ''!r}.")
    points: dict[str, np.ndarray] = {}
    for number, row in enumerate(rows[1:], 2):
        name, pixel = _point(row, f"{path}: row {number}")
        if name in points:
            raise InputError(f"{path}: row {number}: {name} comes twice.")
        if not (np.all(pixel >= -0.5) and np.all(pixel < np.asarray(image_size) - 0.5)):
            size = f"{image_size[0]}x{image_size[1]}"
            raise InputError(f"{path}: row {number}: ({pixel[0]:g}, {pixel[1]:g}) lies outside an image of {size}.")
        points[name] = pixel
    names = NAMES_68 if points and next(iter(points)) in NAMES_68 else NAMES
    if missing := [name for name in names if name not in points]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED}.")
    if other := [name for name in points if name not in names]:
        raise InputError(f"{path}: {other[0]} beside landmarks of another kind; {_WANTED}.")
    return np.stack([points[name] for name in names])


def _point(row: list[str], place: str) -> tuple[str, np.ndarray]:
    if len(row) != len(_COLUMNS) or row[0] not in (*NAMES, *NAMES_68):
        raise InputError(f"{place}: {_WANTED}; got {row}.")
    try:
        pixel = np.asarray([float(entry) for entry in row[1:]])
    except ValueError:
        pixel = np.full(2, np.nan)
    if not np.isfinite(pixel).all():
        raise InputError(f"{place}: u and v must be finite numbers; got {row[1:]}.")
    return row[0], pixel
