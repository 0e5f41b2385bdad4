"""The interface between a tracker and the application that runs it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

STATUS_NAMES = ("searching", "tracking", "lost")
"""Words for the integers in `HandTrack.status`."""


class SequenceTracker(NamedTuple):
    """A tracker in chunks of frames: one compiled call for many frames, a state that can be saved between calls."""

    start: Callable[..., Any]
    """`(key, frame (rows, cols)) -> state`, a pytree of arrays; the random key lives in it from here on."""
    advance: Callable[..., tuple[Any, Any]]
    """`(state, frames (b, rows, cols), times (b,)) -> (state, track)`: metres with NaN for no reading, seconds.

    `track` is a named tuple of arrays with the frame axis first (`HandTrack` for a hand). Row `i` depends on
    frames `0..i` only: the application fills up the last chunk by holding its last frame, and drops those rows.
    """


class HandTrack(NamedTuple):
    """What is known of the hand in each of `b` frames, in the camera frame."""

    pose: Float[Array | np.ndarray, "b 22"]
    """Wrist position (metres), unit quaternion (w, x, y, z), fifteen joint angles (radians)."""
    pose_std: Float[Array | np.ndarray, "b 21"]
    """Standard deviations in the tangent space: position (metres), rotation vector (radians), angles (radians)."""
    joints: Float[Array | np.ndarray, "b 21 3"]
    """Metres: wrist, thumb 1-4, index, middle, ring, little, base to tip."""
    ess: Float[Array | np.ndarray, " b"]
    """Effective number of particles, from 1 to their number; 0 where the hand was not seen."""
    log_evidence: Float[Array | np.ndarray, " b"]
    """log p(frame | earlier frames), up to the constant of the likelihood."""
    status: Int[Array | np.ndarray, " b"]
    """Index into `STATUS_NAMES`."""
