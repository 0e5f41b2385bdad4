"""Strokes of a pen in files of UNIPEN 1.0 (I. Guyon et al., "UNIPEN project of on-line data exchange", ICPR 1994).

Understood are `.COORD`, `.PEN_DOWN`, `.PEN_UP` and `.SEGMENT`; a file holds its coordinates itself. Components are
counted from 0, pens that are up among them. A segment that begins or ends inside a component has the whole of it.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfilters.trackers.recording import InputError

SUFFIXES = (".unipen", ".dat", ".upn")
"""Of files of UNIPEN."""
Pieces = list[Float[np.ndarray, "_ 2"]]


def read_unipen(path: Path) -> list[tuple[Pieces, str]]:
    """Pieces, y down, and label of every segment of the smallest kind; the whole file, unlabelled, if it has none.

    Raises:
        InputError: an unreadable file, one that includes others, numbers that are none, or components that are missing.
    """
    try:
        lines = path.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); expected a file of UNIPEN.") from None
    axes = ["X", "Y"]
    components: list[tuple[bool, list[list[float]]]] = []
    segments: list[tuple[int, str]] = []
    for number, line in enumerate(lines, 1):
        word, _, rest = line.strip().partition(" ")
        match word.upper():
            case ".INCLUDE":
                raise InputError(f"{path}: line {number}: coordinates in another file, {rest.strip()}: join the files.")
            case ".COORD":
                axes = rest.upper().split()
                if not {"X", "Y"} <= set(axes):
                    raise InputError(f"{path}: line {number}: .COORD must name X and Y; got {rest!r}.")
            case ".PEN_DOWN" | ".PEN_UP":
                components.append((word.upper() == ".PEN_DOWN", []))
            case ".SEGMENT":
                segments.append((number, rest))
            case _ if word[:1] in set("+-0123456789") and components:
                components[-1][1].append(_point(line, axes, f"{path}: line {number}"))
    pieces = [np.array(points, float).reshape(-1, 2) * [1, -1] if down else None for down, points in components]
    if not pieces:
        raise InputError(f"{path}: without .PEN_DOWN; expected a file of UNIPEN.")
    if not segments:
        return [([piece for piece in pieces if piece is not None], "")]
    return _segments(segments, pieces, path)


def _point(line: str, axes: list[str], where: str) -> list[float]:
    try:
        values = [float(entry) for entry in line.split()]
        return [values[axes.index(axis)] for axis in ("X", "Y")]
    except (ValueError, IndexError):
        raise InputError(f"{where}: expected {len(axes)} numbers; got {line.strip()!r}.") from None


def _segments(lines: list[tuple[int, str]], pieces: list[np.ndarray | None], path: Path) -> list[tuple[Pieces, str]]:
    """Of the kind that comes last in the file's hierarchy, the smallest one."""
    kinds = [rest.split(maxsplit=1)[0].upper() if rest.split() else "" for _, rest in lines]
    found = []
    for (number, rest), kind in zip(lines, kinds, strict=True):
        if kind != kinds[-1]:
            continue
        entry = re.match(r'\S+\s+(\S+)(?:\s+[^\s"]+)?(?:\s+"(.*)")?', rest)
        if not entry or not (own := _components(entry[1])) or max(own) >= len(pieces):
            raise InputError(f"{path}: line {number}: expected components from 0 to {len(pieces) - 1}; got {rest!r}.")
        chosen = (pieces[i] for i in own)
        found.append(([piece for piece in chosen if piece is not None], entry[2] or ""))
    return found


def _components(text: str) -> list[int]:
    """Of a list such as `0-2,4:3-5:7`."""
    found: list[int] = []
    for part in text.split(","):
        ends = re.fullmatch(r"(\d+)(?::\d+)?(?:-(\d+)(?::\d+)?)?", part)
        if not ends:
            return []
        found += range(int(ends[1]), int(ends[2] or ends[1]) + 1)
    return found
