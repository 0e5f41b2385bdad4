"""Strokes of a pen in files of UNIPEN 1.0 (I. Guyon et al., "UNIPEN project of on-line data exchange", ICPR 1994).

Understood are `.INCLUDE`, `.COORD`, `.PEN_DOWN`, `.PEN_UP` and `.SEGMENT`. Components are numbered from 0 over the
pen-downs that hold points, those of included files among them. A segment names components, `0-2,4`, or parts of them by
their points, `3:0-3:17`. An included file lies beside the one that names it, or in the folder `include` of one of the
folders above, as in the distribution of UNIPEN.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfilters.trackers.io.errors import InputError

SUFFIXES = (".unipen", ".dat", ".upn")
"""Of files of UNIPEN."""
MOST_INCLUDES = 1000
Pieces = list[Float[np.ndarray, "_ 2"]]


class UnipenFile(NamedTuple):
    """What a file of UNIPEN holds."""

    strokes: list[tuple[Pieces, str]]
    """Pieces, y down, and label of every segment of the smallest kind; the whole file, unlabelled, if it has none."""
    warnings: list[str]
    """Segments that were left out because they hold no points."""


class _Line(NamedTuple):
    where: str
    text: str


def read_unipen(path: Path) -> UnipenFile:
    """The segments of a file.

    Raises:
        InputError: an unreadable or missing file, one that includes itself, text where numbers are expected, or
            segments of components that are not there.
    """
    axes = ["X", "Y"]
    components: list[list[list[float]]] = []
    segments: list[_Line] = []
    is_down = False
    for line in _lines(path, (), [0]):
        word, _, rest = line.text.strip().partition(" ")
        match word.upper().split("\t")[0]:
            case ".COORD":
                axes = rest.upper().split()
                if not {"X", "Y"} <= set(axes):
                    raise InputError(f"{line.where}: .COORD must name X and Y; got {rest.strip()!r}.")
            case ".PEN_DOWN":
                is_down = True
                components.append([])
            case ".PEN_UP":
                is_down = False
            case ".SEGMENT":
                segments.append(_Line(line.where, rest.strip()))
            case _ if word[:1] in set("+-0123456789") and is_down:
                components[-1].append(_point(line, axes))
    if not components:
        raise InputError(f"{path}: without .PEN_DOWN; expected a file of UNIPEN.")
    pieces = [np.array(points, float) * [1, -1] for points in components if points]
    if not segments:
        return UnipenFile([(pieces, "")], [])
    return _segments(segments, pieces)


def _lines(path: Path, including: tuple[Path, ...], count: list[int]):
    """Lines of a file, with those of included files in their place."""
    count[0] += 1
    if path.resolve() in including or count[0] > MOST_INCLUDES:
        raise InputError(f"{path}: includes itself, or more than {MOST_INCLUDES} files.")
    try:
        lines = path.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a file of UNIPEN.") from None
    for number, text in enumerate(lines, 1):
        where = f"{path}: line {number}"
        found = re.match(r"\s*\.INCLUDE\s+(\S+)", text, re.IGNORECASE)
        if found:
            yield from _lines(_included(path, found[1], where), (*including, path.resolve()), count)
        else:
            yield _Line(where, text)


def _included(path: Path, name: str, where: str) -> Path:
    wanted = Path(name)
    if wanted.is_absolute() or ".." in wanted.parts:
        raise InputError(f"{where}: an included file must be named below its folder; got {name!r}.")
    folders = [path.parent, *(folder / "include" for folder in path.absolute().parents)]
    # A file and what it includes often have the same name, in `data` and in `include`.
    for candidate in (folder / wanted for folder in folders):
        if candidate.is_file() and candidate.resolve() != path.resolve():
            return candidate
    raise InputError(f"{where}: {name} is neither beside the file nor in a folder `include` above it.")


def _point(line: _Line, axes: list[str]) -> list[float]:
    try:
        values = [float(entry) for entry in line.text.split()]
        point = [values[axes.index(axis)] for axis in ("X", "Y")]
    except (ValueError, IndexError):
        point = [np.nan]
    if not np.isfinite(point).all():
        raise InputError(f"{line.where}: expected {len(axes)} numbers; got {line.text.strip()[:80]!r}.")
    return point


def _segments(lines: list[_Line], pieces: Pieces) -> UnipenFile:
    """Of the kind that comes last in the file's hierarchy, the smallest one."""
    kinds = [line.text.split(maxsplit=1)[0].upper() if line.text else "" for line in lines]
    found, warnings = [], []
    for line, kind in zip(lines, kinds, strict=True):
        if kind != kinds[-1]:
            continue
        entry = re.match(r'\S+\s+([^\s"]+)(?:\s+[^\s"]+)?(?:\s+"((?:[^"\\]|\\.)*)")?', line.text)
        own = _parts(entry[1], pieces) if entry else None
        if entry is None or own is None:
            expected = f"expected components from 0 to {len(pieces) - 1}"
            raise InputError(f"{line.where}: {expected}; got {line.text[:80]!r}.")
        if not own:
            warnings.append(f"{line.where}: the segment holds no points and is left out: {line.text[:80]}")
            continue
        found.append((own, re.sub(r"\\(.)", r"\1", entry[2] or "")))
    return UnipenFile(found, warnings)


def _parts(text: str, pieces: Pieces) -> Pieces | None:
    """The pieces of a list such as `0-2,4:3-5:7`, without empty ones; None where it is no such list of them."""
    found: Pieces = []
    for part in text.split(","):
        ends = re.fullmatch(r"(\d{1,9})(?::(\d{1,9}))?(?:-(\d{1,9})(?::(\d{1,9}))?)?", part)
        if not ends:
            return None
        first, last = int(ends[1]), int(ends[3] or ends[1])
        if not first <= last < len(pieces):
            return None
        start = int(ends[2] or 0)
        # A single point is named without a range: `4:3`.
        stop = int(ends[4]) + 1 if ends[4] else start + 1 if ends[2] and not ends[3] else None
        for i in range(first, last + 1):
            piece = pieces[i][start if i == first else 0 : stop if i == last else None]
            found += [piece] if len(piece) else []
    return found
