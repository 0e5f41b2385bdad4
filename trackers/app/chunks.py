"""A recording through a tracker, chunk by chunk, with every finished chunk kept."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxfilters.trackers.app.results import TrackWriter
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.recording import Recording
from jaxfilters.trackers.tracker import CHUNK, STATUS_NAMES, Tracker, step_chunk


class Progress(NamedTuple):
    """How far a run is."""

    done: int
    total: int
    frames_per_second: float
    """Reading and writing included, without the first chunk, which compiles; NaN until the second chunk is done."""
    status: str


def track_recording(
    recording: Recording,
    tracker: Tracker,
    state: Any,
    writer: TrackWriter,
    on_progress: Callable[[Progress], None],
    on_chunk: Callable[[int, list[Any], Any], None] = lambda first, frames, track: None,  # noqa: ARG005
) -> float:
    """Track the frames that `writer` does not have yet; frames per second, NaN if all of them compiled.

    Args:
        recording: The frames.
        tracker: What tracks them.
        state: Of the tracker, before the first of these frames.
        writer: Where rows go.
        on_progress: Called after every chunk.
        on_chunk: Called with the number of the first frame, the frames, and their rows.

    Raises:
        InputError: a frame cannot be read. The frames before it are in `track.csv`, the chunks before it saved.
        OutputError: the disk is full or the folder gone.
    """
    chunk_ends: list[float] = []
    for first in range(writer.frames, len(recording), CHUNK):
        frames, failure = _read(recording, first, min(first + CHUNK, len(recording)))
        if frames:
            times_s = recording.times_s[first : first + len(frames)]
            state, track = step_chunk(tracker, state, frames, times_s - recording.times_s[0])
            chunk_ends.append(time.perf_counter())
            on_chunk(first, frames, writer.append(times_s, track))
            status = STATUS_NAMES[int(track.status[-1])]
            on_progress(Progress(writer.frames, len(recording), _rate(chunk_ends), status))
        if failure is not None:
            raise failure
        writer.checkpoint(state, complete=writer.frames == len(recording))
    return _rate(chunk_ends) if chunk_ends else float("nan")


def _rate(chunk_ends: list[float]) -> float:
    """Frames per second after the first chunk; the frames that fill up the last chunk cost as much as others."""
    seconds = chunk_ends[-1] - chunk_ends[0]
    return CHUNK * (len(chunk_ends) - 1) / seconds if seconds else float("nan")


def _read(recording: Recording, first: int, end: int) -> tuple[list[Any], InputError | None]:
    """The frames up to the first unreadable one, and its error."""
    frames: list[Any] = []
    try:
        for i in range(first, end):
            frames.append(recording[i])
    except InputError as error:
        return frames, error
    return frames, None
