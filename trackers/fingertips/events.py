"""What hands do, as things that begin and end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

PINCH, MOVE, ROTATE, RESIZE, SYMBOL = "pinch", "move", "rotate", "resize", "symbol"


class Event(NamedTuple):
    """Something that began or ended."""

    frame: int
    time_s: float
    hand: int
    name: str
    """One of `PINCH`, `MOVE`, `ROTATE`, `RESIZE`, `SYMBOL`."""
    phase: str
    """`begin` or `end`; a symbol only ends."""
    quantities: dict[str, Any]
    """Numbers and words by name, with units in the names; ready for JSON."""


class HandFrame(NamedTuple):
    """One hand in one frame, on the host: the rows of its fingertips."""

    frame: int
    time_s: float
    identity: Int[np.ndarray, " tips"]
    position: Float[np.ndarray, "tips 2"]
    is_thumb: Bool[np.ndarray, " tips"]
    palm: Float[np.ndarray, "2"]
    axis: Float[np.ndarray, "2"]
    mode: int
    """Place in `state.MODE_NAMES`."""
    displacement: Float[np.ndarray, "2"]
    """Mean over the tips that were there in the frame before as well, pixels."""
    code: int
    """Of that: 1 to 16, or 17."""


class Stroke(NamedTuple):
    """What fingers drew, from the first frame in which they moved to the last."""

    points: Float[np.ndarray, "frames 2"]
    """Pixels: where the fingertips were on average at first, and where they went together."""
    codes: Int[np.ndarray, " frames"]
    """Of directions, 1 to 17."""
    counts: Int[np.ndarray, " frames"]
    """Of fingertips, 0 to 5."""
    times_s: Float[np.ndarray, " frames"]
    first_frame: int


class Recognised(NamedTuple):
    """What a stroke is taken for."""

    label: str | None
    """None: no symbol that is known."""
    confidence: float


Recogniser = Callable[[Stroke], Recognised]
