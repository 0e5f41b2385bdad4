"""Landmarks in space of several people with the same expressions: what a model of the face is estimated from.

An `.npz` holds `shapes` (S people, A expressions, K landmarks, 3) in millimetres, x to the image's right, y down, z
away from a camera that the face faces; a face that is missing is NaN throughout. Ten landmarks are in the trackers'
order, 68 in iBUG's; of other landmarks the file must hold `pairs` (P, 2), the (right, left) indices of the subject,
and may hold `names` (K,). With `neutral`, the index of the neutral expression, faces are first aligned rigidly: every
face to its person's neutral one on eye corners and nostrils, and the people's neutral faces to their mean (ten or 68
landmarks). Without it they are taken to be so already.

A folder holds one CSV file for each person, with the columns `expression,name,x_mm,y_mm,z_mm` and a row for each
landmark of each expression that there is; names are those of the ten landmarks, or numbers from 0 to 67. An expression
called `neutral`, in capital letters or small ones, is the one that faces are aligned to.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfilters.models.face.landmarks import FROM_68, NAMES
from jaxfilters.models.face.mirroring import PAIRS, PAIRS_68, Pairs, mirror_map
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import exists, is_folder, too_large
from jaxfilters.trackers.io.npz import read_npz
from jaxfilters.trackers.io.tables import exactly, read_table

_COLUMNS = ("expression", "name", "x_mm", "y_mm", "z_mm")
NAMES_68 = tuple(str(k) for k in range(68))
_KNOWN = {10: (NAMES, PAIRS), 68: (NAMES_68, PAIRS_68)}
_WANTED_NPZ = "expected shapes (people, expressions, landmarks, 3) in millimetres"
_WANTED_CSV = f"expected a header {','.join(_COLUMNS)}"


class LandmarkSets(NamedTuple):
    """Faces to learn from."""

    shapes: np.ndarray
    """(S, A, K, 3) millimetres; NaN where a face is missing."""
    names: tuple[str, ...]
    """Of the landmarks."""
    pairs: Pairs
    """(right, left) indices."""
    neutral: int | None
    """Index of the neutral expression, if faces are to be aligned."""

    @property
    def observed(self) -> np.ndarray:
        """(S, A) whether there is such a face."""
        return np.isfinite(self.shapes).all(axis=(2, 3))


def read_landmark_sets(path: Path) -> LandmarkSets:
    """The faces of an `.npz` file or a folder of CSV files.

    Raises:
        InputError: an unreadable file, wrong shapes, names or numbers, faces of which only a part is there, or
            landmarks of which left and right are not known.
    """
    if not exists(path):
        raise InputError(f"{path}: no such file or folder.")
    sets = _of_folder(path) if is_folder(path) else _of_npz(path)
    shapes = sets.shapes
    partly = np.isnan(shapes).any(axis=(2, 3)) & ~np.isnan(shapes).all(axis=(2, 3))
    if partly.any() or too_large(shapes).any():
        raise InputError(f"{path}: faces must be finite, or NaN throughout where they are missing.")
    if sets.neutral is not None and not np.isfinite(shapes[:, sets.neutral]).all():
        raise InputError(f"{path}: everybody must have the neutral expression, number {sets.neutral}.")
    return sets


def ten_of(sets: LandmarkSets) -> LandmarkSets:
    """The ten tracked landmarks among 68.

    Raises:
        InputError: there are neither ten nor 68.
    """
    if len(sets.names) == len(NAMES):
        return sets
    if len(sets.names) != len(NAMES_68):
        raise InputError(f"--points 10 is for files of 10 or 68 landmarks; got {len(sets.names)}.")
    return LandmarkSets(sets.shapes[:, :, list(FROM_68)], NAMES, PAIRS, sets.neutral)


def _of_npz(path: Path) -> LandmarkSets:
    arrays = read_npz(path, _WANTED_NPZ)
    shapes = arrays.get("shapes", np.zeros(0))
    if shapes.ndim != 4 or shapes.shape[3] != 3 or shapes.dtype.kind not in "fiu" or 0 in shapes.shape:
        raise InputError(f"{path}: {_WANTED_NPZ}; got {shapes.shape} {shapes.dtype}.")
    num_landmarks = shapes.shape[2]
    names: tuple[str, ...]
    pairs: Pairs | None
    names, pairs = _KNOWN.get(num_landmarks, (tuple(str(k) for k in range(num_landmarks)), None))
    if "pairs" in arrays:
        pairs = _pairs(arrays["pairs"], num_landmarks, path)
    if pairs is None:
        raise InputError(f"{path}: of {num_landmarks} landmarks, pairs (P, 2) must say which are right and left.")
    if "names" in arrays:
        names = tuple(str(name) for name in arrays["names"].ravel())
        if len(names) != num_landmarks:
            raise InputError(f"{path}: names must be of {num_landmarks} landmarks; got {len(names)}.")
    return LandmarkSets(shapes.astype(float), names, pairs, _neutral(arrays, shapes.shape, path))


def _pairs(array: np.ndarray, num_landmarks: int, path: Path) -> Pairs:
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise InputError(f"{path}: pairs must be integers (P, 2); got {array.shape} {array.dtype}.")
    pairs = tuple((int(right), int(left)) for right, left in array)
    try:
        mirror_map(pairs, num_landmarks)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return pairs


def _neutral(arrays: dict[str, np.ndarray], shape: tuple[int, ...], path: Path) -> int | None:
    if "neutral" not in arrays:
        return None
    neutral = arrays["neutral"]
    if neutral.shape != () or neutral.dtype.kind not in "iu" or not 0 <= neutral < shape[1]:
        raise InputError(
            f"{path}: neutral must be the index of one of {shape[1]} expressions; got {shortened(str(neutral))}."
        )
    if shape[2] not in _KNOWN:
        raise InputError(
            f"{path}: neutral is for 10 or 68 landmarks; got {shape[2]}. Align the faces, and leave it out."
        )
    return int(neutral)


def _of_folder(folder: Path) -> LandmarkSets:
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise InputError(f"{folder}: no CSV files of people, and no ICT face model; {_WANTED_CSV}.")
    people = [_person(file) for file in files]
    expressions = list(dict.fromkeys(expression for person in people for expression, _ in person))
    found = {name for person in people for _, name in person}
    names, pairs = _KNOWN[10] if found <= set(NAMES) else _KNOWN[68]
    if unknown := found - set(names):
        raise InputError(
            f"{folder}: unknown landmarks {shown(sorted(unknown))}; names are {', '.join(NAMES)}, or 0 to 67."
        )
    shapes = np.full((len(people), len(expressions), len(names), 3), np.nan)
    for person, points in enumerate(people):
        for (expression, name), point in points.items():
            shapes[person, expressions.index(expression), names.index(name)] = point
    neutral = next((i for i, name in enumerate(expressions) if name.casefold() == "neutral"), None)
    return LandmarkSets(shapes, names, pairs, neutral)


def _person(file: Path) -> dict[tuple[str, str], np.ndarray]:
    """Points by expression and name."""
    table = read_table(file, _WANTED_CSV, exactly(file, _WANTED_CSV, _COLUMNS, ("expression", "name")))
    points: dict[tuple[str, str], np.ndarray] = {}
    coordinates = np.stack([table.numbers[axis] for axis in _COLUMNS[2:]], axis=-1)
    for line, *label, point in zip(
        table.lines, table.words["expression"], table.words["name"], coordinates, strict=True
    ):
        expression, name = label
        if (expression, name) in points:
            raise InputError(f"{file}: line {line}: {shortened(name)} of {shortened(expression)} comes twice.")
        points[expression, name] = point
    return points
