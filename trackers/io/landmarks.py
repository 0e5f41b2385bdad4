"""Landmarks of a face that a person has marked, the ten or the 68 of iBUG: CSV with the columns name, u, v."""

from pathlib import Path

import numpy as np

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.landmark_sets import NAMES_68
from jaxfilters.trackers.io.tables import exactly, read_table

_COLUMNS = ("name", "u", "v")
_WANTED = f"expected a header {','.join(_COLUMNS)} and one row each for {', '.join(NAMES)}; or for 0 to 67"


def read_landmarks(path: Path, image_size: tuple[int, int]) -> np.ndarray:
    """(10, 2) pixels in the order of `NAMES`, or (68, 2) in iBUG's, in an image of `image_size` (columns, rows).

    Raises:
        InputError: an unreadable file, unknown, missing or repeated names, or pixels that are none of the image.
    """
    table = read_table(path, _WANTED, exactly(path, _WANTED, _COLUMNS, ("name",)))
    points: dict[str, np.ndarray] = {}
    pixels = np.stack([table.numbers["u"], table.numbers["v"]], axis=-1)
    for line, name, pixel in zip(table.lines, table.words["name"], pixels, strict=True):
        place = f"{path}: line {line}"
        if name not in (*NAMES, *NAMES_68):
            raise InputError(f"{place}: {_WANTED}; got {shown(name)}.")
        if name in points:
            raise InputError(f"{place}: {name} comes twice.")
        if not (np.all(pixel >= -0.5) and np.all(pixel < np.asarray(image_size) - 0.5)):
            size = f"{image_size[0]}x{image_size[1]}"
            raise InputError(f"{place}: ({pixel[0]:g}, {pixel[1]:g}) lies outside an image of {size}.")
        points[name] = pixel
    names = NAMES_68 if points and next(iter(points)) in NAMES_68 else NAMES
    if missing := [name for name in names if name not in points]:
        raise InputError(f"{path}: without {shortened(', '.join(missing))}; {_WANTED}.")
    if other := [name for name in points if name not in names]:
        raise InputError(f"{path}: {other[0]} beside landmarks of another kind; {_WANTED}.")
    return np.stack([points[name] for name in names])
