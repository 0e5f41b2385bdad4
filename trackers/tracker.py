"""The interface between a tracking system and the application that runs it, and a tracker run from Python.

There are two such interfaces. The hands in depth images and in features are a `Tracker`: all that happens to a frame is
one compiled program, so a chunk of frames is one call, and the state is a pytree of arrays. Heads, people and
fingertips are a `jaxfilters.trackers.app.stream.Session`, an object with a method for the next frames. They also follow
live cameras, several of them at different rates, of which some have no image at a moment; and between their compiled
parts they work on images on the host, with OpenCV: undistortion, background subtraction, connected components,
detectors of faces and hands. What these find decides which program is next, and how many rows a frame has. As a pure
function a session would be one program that calls back to the host in every frame, which compiles for longer and gains
nothing. The price is that a session names what it saves (`saved`, `restore`), and that tests, not types, ensure that a
row depends on no later frame and that a run which was continued equals one that was not interrupted.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

STATUS_NAMES = ("searching", "tracking", "lost", "doubtful")
"""Words for the integers in `status` of a track."""
STATUS_WORDS = (*STATUS_NAMES, "predicted", "tentative", "skipped")
"""All words that a table of results has for the state of what is followed: not found yet; observed; not found any more;
observed, but not surely; not observed, and moved on by the model; observed too shortly to count; without a frame."""
CHUNK = 16
"""Frames in one compiled call: enough to hide the call, few enough to report progress several times a second."""
_PACE_S = 1 / 30


class Tracker(NamedTuple):
    """A system that follows something in frames: two functions on pytrees of arrays.

    `track_frames` runs one over frames in memory; `jaxfilters.trackers.app.run` runs one over a recording on disk.
    """

    init: Callable[..., Any]
    """`(key, frame) -> state` before the first frame, which shows where to begin. The state is a pytree of arrays,
    with the random key in it: it is saved and restored as it is."""
    step: Callable[..., tuple[Any, Any]]
    """`(state, frames, times_s) -> (state, track)` for a chunk of frames: pytrees whose leaves have the frame axis
    first. Row i of the track depends on frames 0 to i, and on what the tracker was built with, alone.

    How a track becomes columns is not said by metadata of its fields but by `jaxfilters.trackers.app.results.Columns`:
    a field of 22 numbers is 22 columns, some columns are computed (standard deviations from a covariance, those along a
    line of sight from the cameras as well), and names and units depend on the model (fingers, expressions, pixels or
    metres). Fields of a named tuple have no metadata either."""


class HandTrack(NamedTuple):
    """The estimated hand in each of `b` frames, in the camera frame."""

    pose: Float[Array | np.ndarray, "b 22"]
    """Wrist position (metres), unit quaternion (w, x, y, z), fifteen joint angles (radians)."""
    pose_std: Float[Array | np.ndarray, "b 21"]
    """Standard deviations in the tangent space: position (metres), rotation vector (radians), angles (radians)."""
    joints: Float[Array | np.ndarray, "b 21 3"]
    """Metres: wrist, thumb 1-4, index, middle, ring, little, base to tip."""
    innovations: Int[Array | np.ndarray, "b 2"]
    """How many coordinates of the pose the frame has corrected, and how many of these by less than 1.96 of the standard
    deviations that the filter claims for a correction: 95 % if it is right."""
    effective_sample_size: Float[Array | np.ndarray, " b"]
    """Effective number of particles, from 1 to their number; 0 where too little was read to compare the hand with, NaN
    while it is searched for."""
    log_evidence: Float[Array | np.ndarray, " b"]
    """log p(frame | earlier frames), up to the constant of the likelihood; 0 and NaN as `effective_sample_size`."""
    status: Int[Array | np.ndarray, " b"]
    """Index into `STATUS_NAMES`."""


def checked_times(times_s: Any, count: int | None = None) -> np.ndarray:
    """The times of a recording in seconds, as float64.

    Args:
        times_s: One for each frame.
        count: Of the frames; None where that is not known yet.

    Raises:
        ValueError: There are none, more or fewer than frames, or they are not finite and strictly increasing.
    """
    seconds = np.asarray(times_s, float)
    if seconds.ndim != 1 or not len(seconds) or count not in (None, len(seconds)):
        frames = "each frame, at least one" if count is None else f"each of {count} frames, at least one"
        raise ValueError(f"times_s: expected one for {frames}; got shape {seconds.shape}.")
    wrong = np.flatnonzero(~np.isfinite(seconds))
    if len(wrong):
        raise ValueError(f"times_s: expected finite seconds; got {seconds[wrong[0]]} for frame {wrong[0]}.")
    wrong = np.flatnonzero(np.diff(seconds) <= 0)
    if len(wrong):
        before, after = seconds[wrong[0] : wrong[0] + 2]
        raise ValueError(
            f"times_s: expected strictly increasing seconds; got {before:.6f} for frame {wrong[0]}, "
            f"{after:.6f} for frame {wrong[0] + 1}."
        )
    return seconds


def step_chunk(tracker: Tracker, state: Any, frames: Sequence[Any], times_s: np.ndarray) -> tuple[Any, Any]:
    """State and track after at most `CHUNK` frames, by the one program that serves every chunk.

    A shorter chunk is filled up by its last frame. The filled rows are dropped; the state then includes them, and is of
    use only where nothing follows.

    Args:
        tracker: The tracker.
        state: Its state.
        frames: 1 to `CHUNK` frames, each an array or a pytree of arrays.
        times_s: (frames,) seconds since the first frame of the recording.

    Returns:
        The state, and the track on the host, a row for each of the frames.

    Raises:
        ValueError: `frames` and `times_s` differ in length, or there are none or too many.
    """
    if not 0 < len(frames) <= CHUNK or np.shape(times_s) != (len(frames),):
        raise ValueError(f"frames: expected 1 to {CHUNK}, with a time each; got {len(frames)} and {np.shape(times_s)}.")
    missing = CHUNK - len(frames)
    later = times_s[-1] + np.arange(1, missing + 1) * _PACE_S
    filled = jax.tree.map(lambda *leaves: np.stack(leaves), *frames, *[frames[-1]] * missing)
    state, track = tracker.step(state, filled, np.concatenate([times_s, later]).astype(np.float32))
    return state, jax.tree.map(lambda leaf: np.asarray(leaf)[: len(frames)], track)


def track_frames(tracker: Tracker, key: Array, frames: Iterable[Any], times_s: np.ndarray) -> Any:
    """The track of all frames, equal to that of the command line with the same seed.

    Args:
        tracker: The tracker.
        key: Random key.
        frames: One frame after another, in memory or read when asked for; at least one.
        times_s: (frames,) seconds, strictly increasing.

    Returns:
        The track as NumPy arrays, the frame axis first.

    Raises:
        ValueError: There are no frames, or more or fewer than times, or see `checked_times`.
    """
    source, since, parts, done = iter(frames), checked_times(times_s), [], 0
    state = None
    while chunk := list(islice(source, CHUNK)):
        if done + len(chunk) > len(since):
            raise ValueError(f"times_s: expected one for each frame; got {len(since)}, and more frames.")
        state = tracker.init(key, chunk[0]) if state is None else state
        state, track = step_chunk(tracker, state, chunk, since[done : done + len(chunk)] - since[0])
        parts.append(track)
        done += len(chunk)
    if not parts or done != len(since):
        raise ValueError(f"times_s: expected one for each frame, at least one; got {len(since)} for {done} frames.")
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
