"""Random variations of strokes, for symbols of which there are few examples.

Few examples of a symbol by few people show neither all sizes and slants nor the movements by which other hands come to
a stroke and leave it, in the air above all, where no contact of a pen marks its ends. Copies of the strokes do: each
goes through a random linear map, loses a part of either end, and may have a straight tail at it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxfilters.models.gesture.discriminative import distortions
from jaxfilters.models.gesture.stroke import Drawn

COPIES = 16
LONGEST_CUT = 0.1
"""Of a stroke's samples, at either end."""
TAIL_SHARE, LONGEST_TAIL = 0.3, 0.2
"""Of the ends, that have a tail, and of the stroke's length, that it has at most."""
TAIL_SAMPLES, FEWEST_SAMPLES = 0.1, 3
"""Of the stroke's, in a tail, and at least."""


def with_variations(strokes: Sequence[Drawn], labels: Sequence[str], *, seed: int = 0) -> tuple[list[Drawn], list[str]]:
    """Strokes followed by `COPIES` of each that are varied at random, and the labels of all.

    Args:
        strokes: All of as many dimensions; those without a sample are not varied.
        labels: The symbol of each.
        seed: Of the random variations; the same seed gives the same copies.
    """
    rng = np.random.default_rng(seed)
    everything, names = list(strokes), list(labels)
    dimensions = next((np.shape(piece)[1] for pieces, _ in strokes for piece in pieces if len(piece)), 0)
    for _ in range(COPIES if dimensions else 0):
        changes = distortions(rng, len(strokes), dimensions)
        everything += [
            (_varied(rng, [np.asarray(piece, float) @ change.T for piece in pieces if len(piece)]), fingers)
            for (pieces, fingers), change in zip(strokes, changes, strict=True)
        ]
        names += labels
    return everything, names


def _varied(rng: np.random.Generator, pieces: list[np.ndarray]) -> list[np.ndarray]:
    """With other ends."""
    if not pieces:
        return pieces
    begin, end = (int(rng.uniform(0, LONGEST_CUT) * len(pieces[i])) for i in (0, -1))
    pieces = [*pieces[:-1], pieces[-1][: len(pieces[-1]) - end]]
    pieces = [pieces[0][begin:], *pieces[1:]]
    whole = np.concatenate(pieces)
    length = float(np.linalg.norm(np.diff(whole, axis=0), axis=1).sum())
    count = max(FEWEST_SAMPLES, int(TAIL_SAMPLES * len(whole)))
    before, after = (_tail(rng, length, count, whole.shape[1]) for _ in range(2))
    pieces = [np.concatenate([pieces[0][0] + before[::-1], pieces[0]]), *pieces[1:]]
    return [*pieces[:-1], np.concatenate([pieces[-1], pieces[-1][-1] + after])]


def _tail(rng: np.random.Generator, length: float, count: int, dimensions: int) -> Float[np.ndarray, "n d"]:
    """Places on a line from the end of a stroke, which is not among them; most ends have none."""
    if rng.uniform() >= TAIL_SHARE:
        return np.zeros((0, dimensions))
    direction = rng.normal(size=dimensions)
    step = direction / np.linalg.norm(direction) * rng.uniform(0, LONGEST_TAIL) * length
    return np.linspace(0, 1, count + 1)[1:, None] * step
