"""A recording through a tracker, chunk by chunk, with every finished chunk kept."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.app.results import TrackWriter
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.recording import Recording
from jaxfilters.trackers.tracker import STATUS_NAMES, SequenceTracker

CHUNK = 16
"""Frames in one compiled call: enough to hide the call, few enough to report progress several times a second."""


class Progress(NamedTuple):
    """How far a run is."""

    done: int
    total: int
    frames_per_second: float
    """Reading and writing included, without the first chunk, which compiles; NaN until the second chunk is done."""
    status: str


def follow(
    sequence: Recording,
    tracker: SequenceTracker,
    state: Any,
    writer: TrackWriter,
    on_progress: Callable[[Progress], None],
) -> float:
    """Track the frames that `writer` does not have yet; frames per second, NaN if all of them compiled.

    Raises:
        InputError: a frame cannot be read. The frames before it are in `track.csv`, the chunks before it saved.
        OutputError: the disk is full or the folder gone.
    """
    chunk_ends: list[float] = []
    for first in range(writer.frames, len(sequence), CHUNK):
        frames, failure = _read(sequence, first, min(first + CHUNK, len(sequence)))
        if frames:
            times_s = sequence.times_s[first : first + len(frames)]
            state, track = tracker.advance(state, *_filled(frames, times_s - sequence.times_s[0]))
            track = _first(len(frames), track)
            chunk_ends.append(time.perf_counter())
            writer.append(times_s, track)
            status = STATUS_NAMES[int(track.status[-1])]
            on_progress(Progress(writer.frames, len(sequence), _rate(chunk_ends), status))
        if failure is not None:
            raise failure
        writer.checkpoint(state, complete=writer.frames == len(sequence))
    return _rate(chunk_ends) if chunk_ends else float("nan")


def _rate(chunk_ends: list[float]) -> float:
    """Frames per second after the first chunk; the frames that fill up the last chunk cost as much as others."""
    seconds = chunk_ends[-1] - chunk_ends[0]
    return CHUNK * (len(chunk_ends) - 1) / seconds if seconds else float("nan")


def _first(frames: int, track: Any) -> Any:
    """The first `frames` frames, on the host."""
    return jax.tree.map(lambda array: np.asarray(array)[:frames], track)


def _read(sequence: Recording, first: int, end: int) -> tuple[list[Any], InputError | None]:
    """The frames up to the first unreadable one, and its error."""
    frames: list[Any] = []
    try:
        for i in range(first, end):
            frames.append(sequence[i])
    except InputError as error:
        return frames, error
    return frames, None


def _filled(frames: list[Any], times_s: np.ndarray) -> tuple[Any, np.ndarray]:
    """Frames and times up to `CHUNK`, the last frame held still: one shape, one compilation, nothing to search."""
    missing = CHUNK - len(frames)
    later = times_s[-1] + np.arange(1, missing + 1) / 30
    held = jax.tree.map(lambda *leaves: np.stack(leaves), *frames, *[frames[-1]] * missing)
    return held, np.concatenate([times_s, later]).astype(np.float32)
