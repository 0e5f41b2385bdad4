"""What a demonstrating hand does over a desk: it shows itself, draws with one finger and two, and handles things."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfilters.models.synthetic.strokes import drawn

SHAPES = ("square", "circle cw", "Z", "triangle", "S")
OPEN_FRAMES, FIST_FRAMES, STILL_FRAMES, HANDLING_FRAMES = 30, 14, 10, 120
MIDDLE = np.array([160.0, 140.0])
"""Of the palm's places, pixels of an image with 240 rows."""
_PER_PIXEL = 0.5
"""Strokes are made for images with 480 rows."""
_OPEN, _FIST, _PINCH = (1, 1, 1, 1, 1), (0, 0, 0, 0, 0), (1, 1, 0, 0, 0)
_POINTING = {1: (0, 1, 0, 0, 0), 2: (0, 1, 1, 0, 0)}


class Symbol(NamedTuple):
    """One drawing in a script."""

    first: int
    """Frame in which it begins."""
    last: int
    label: str
    """Shape and number of fingers."""


class Script(NamedTuple):
    """What is done in every frame."""

    fingers: Bool[np.ndarray, "t 5"]
    """Which are out, the thumb first."""
    poses: Float[np.ndarray, "t 3"]
    """Palm (x, y) in pixels of an image with 240 rows, and lean of the arm, radians."""
    symbols: list[Symbol]


def script(seed: int) -> Script:
    """An open hand, the symbols `SHAPES`, each with one finger or two, and things that are moved and turned."""
    rng = np.random.default_rng(seed)
    drawings = drawn(int(rng.integers(2**31)), 1, shapes=SHAPES)
    fingers: list[tuple[int, ...]] = [_OPEN] * OPEN_FRAMES
    places, symbols, at = [np.tile(MIDDLE, (OPEN_FRAMES, 1))], [], MIDDLE
    for i, shape in enumerate(SHAPES):
        count = 1 + i % 2
        label = f"{shape} {count}"
        column = drawings.labels.index(label)
        stroke = drawings.tips[: drawings.lengths[column], 0, :, column]
        observed = drawings.present[: drawings.lengths[column], 0, column]
        stroke = np.stack(
            [np.interp(np.arange(len(stroke)), np.flatnonzero(observed), axis[observed]) for axis in stroke.T], 1
        )
        path = MIDDLE + _PER_PIXEL * (stroke - 0.5 * (stroke.max(axis=0) + stroke.min(axis=0)))
        approach = np.linspace(at, path[0], FIST_FRAMES)
        pause = np.tile(path[0], (STILL_FRAMES, 1)), np.tile(path[-1], (STILL_FRAMES, 1))
        begin = len(fingers) + FIST_FRAMES + STILL_FRAMES
        symbols.append(Symbol(begin, begin + len(path) - 1, label))
        fingers += [_FIST] * FIST_FRAMES + [_POINTING[count]] * (2 * STILL_FRAMES + len(path))
        places += [approach, pause[0], path, pause[1]]
        at = path[-1]
    phase = np.linspace(0, 2 * np.pi, HANDLING_FRAMES)
    fingers += [_FIST] * FIST_FRAMES + [_PINCH] * HANDLING_FRAMES
    places += [np.linspace(at, MIDDLE, FIST_FRAMES), MIDDLE + np.stack([40 * np.sin(phase), 0 * phase], axis=1)]
    lean = np.zeros(len(fingers))
    lean[-HANDLING_FRAMES:] = 0.35 * np.sin(2 * phase)
    return Script(np.array(fingers, bool), np.column_stack([np.concatenate(places), lean]), symbols)
