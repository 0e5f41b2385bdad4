"""Numbers of frames in file names and tables: they count frames, or they are times in microseconds."""

import numpy as np
from jaxtyping import Float, Shaped

_SHORTEST_STEP_US = 1000
"""Numbers whose median step is less count frames: no camera runs at 1 kHz."""


def frames_of(numbers: Shaped[np.ndarray, " frames"]) -> Shaped[np.ndarray, " frames"]:
    """The numbers where they count frames; otherwise the places of the frames, from 0."""
    return np.arange(len(numbers)) if _are_microseconds(numbers) else numbers


def times_of(numbers: Shaped[np.ndarray, " frames"], fps: float) -> Float[np.ndarray, " frames"]:
    """Seconds of the frames of a recording with such numbers, at so many frames a second where they count frames."""
    return numbers * 1e-6 if _are_microseconds(numbers) else numbers / fps


def _are_microseconds(numbers: np.ndarray) -> bool:
    return len(numbers) > 1 and bool(np.median(np.diff(numbers)) >= _SHORTEST_STEP_US)
