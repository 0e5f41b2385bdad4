"""A session over images from cameras, live or recorded: rows, pictures and checkpoints, until the images end."""

import argparse
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxfilters.trackers.app.output_folder import reason
from jaxfilters.trackers.app.progress import ProgressLine, warn
from jaxfilters.trackers.app.rerun_log import RerunLog, open_log
from jaxfilters.trackers.app.results import CHECKPOINT_EVERY_S, TrackTable, open_writer
from jaxfilters.trackers.app.video import OverlayVideo
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.video_input import FrameSet, VideoSource, continued

_MOST_COSTS = 10_000
"""Times of the session that count for their median; the last ones, so that a long run needs no more memory."""


@runtime_checkable
class Session(Protocol):
    """What follows something in images, with all that one system needs for its rows and pictures."""

    @property
    def status(self) -> str:
        """What is followed now, in a few words."""
        ...

    def is_due(self, waiting: Sequence[FrameSet]) -> bool:
        """Whether these moments are to be processed now; otherwise one more is waited for."""
        ...

    def process(self, moments: Sequence[FrameSet]) -> Any:
        """The rows that these moments add to the table, with the fields of its track."""
        ...

    def pictures(self, moments: Sequence[FrameSet], rows: Any) -> Iterable[np.ndarray]:
        """A picture (rows, cols, 3) uint8 for each of the moments that were processed last."""
        ...

    def saved(self) -> Any:
        """All that the next moment needs beside the rows; None where a run cannot go on from here."""
        ...

    def restore(self, saved: Any, rows: Any) -> None:
        """Go on from what `saved` gave, with the rows up to then."""
        ...


class StreamSpec(NamedTuple):
    """What one command follows, and with what."""

    sources: Sequence[VideoSource]
    moments: Iterable[FrameSet]
    """From the first one."""
    trouble: Callable[[], list[str]]
    """What went wrong with the sources, for a person."""
    session: Session
    table: TrackTable
    identity: dict[str, Any]
    """What must be equal for a run to be continued (input, configuration, versions), JSON-able."""
    frames: int | None
    """How many there will be; None where that is not known."""
    prime: Callable[[], None] = lambda: None
    """What a new run reads of the sources before their first images: with the folder of the results held, and not in a
    run that is continued: its saved state has all that came of it, or `restore` of the session reads it again."""


class RunResult(NamedTuple):
    """What came of a run beside its rows."""

    frames_per_second: float
    """Reading, drawing and writing included, without what was processed first, which compiles; NaN if that was all."""
    tracking_ms: float
    """Median time of the session alone, milliseconds a frame; NaN where all of it compiled."""
    interrupt: KeyboardInterrupt | None
    """Ctrl-C or SIGTERM, which ended the run."""
    failure: InputError | None
    """A source that could not be read any further."""
    trouble: list[str]


def check_unused(options: argparse.Namespace) -> None:
    """Refuse a folder with the results of another run, before anything is read or compiled.

    Raises:
        OutputError: there is a track, and the run is not to be continued.
    """
    if not options.resume and (path := options.out / "track.csv").exists():
        raise OutputError(f"{path}: holds the track of another run; choose another --out, or --resume.")


class StreamRun:
    """The way of images from the cameras through a session into rows and pictures."""

    def __init__(self, options: argparse.Namespace, spec: StreamSpec):
        """A run before its first image, or with `--resume` after its last checkpoint.

        Raises:
            OutputError: the folder holds another run's track, or cannot be written.
            CheckpointError: the run that is to be resumed is another one, or its checkpoint is damaged.
        """
        check_unused(options)
        self.spec, self._options = spec, options
        self.writer, saved = open_writer(options, spec.identity, spec.table)
        self._first, self._last_s = self.writer.frames, 0.0
        self._log: RerunLog | None = None
        try:
            if saved is not None:
                self._last_s = float(saved["time_s"])
                spec.session.restore(saved["session"], self.writer.results)
            else:
                spec.prime()
            self._log = open_log(options, spec.table)
        except BaseException:
            self._release()
            raise
        self._saved_at = time.monotonic()
        self._video: OverlayVideo | None = None
        self._failure: InputError | None = None
        self._ends: list[tuple[float, int]] = []
        self._costs: deque[float] = deque(maxlen=_MOST_COSTS)

    def follow(self) -> RunResult:
        """Track until the sources end, the time is over, or Ctrl-C or SIGTERM, which the result tells.

        Raises:
            InputError: nothing could be read.
            OutputError: the results cannot be written.
            KeyboardInterrupt: before anything was tracked.
        """
        interrupt: KeyboardInterrupt | None = None
        try:
            self._take()
        except KeyboardInterrupt as error:
            interrupt = error
        finally:
            if self._video is not None:
                self._video.close()
        if self._video is not None:
            self._video.check()
        trouble = self.spec.trouble()
        if not self.writer.frames:
            if interrupt is not None:
                raise type(interrupt)(self.writer.kept())
            raise self._failure or InputError("; ".join(trouble or ["the sources hold no images"]) + ".")
        seconds = self._ends[-1][0] - self._ends[0][0] if self._ends else 0.0
        rate = (self._ends[-1][1] - self._ends[0][1]) / seconds if seconds else math.nan
        costs = [cost for cost in self._costs if not math.isnan(cost)]
        cost = float(np.median(costs)) if costs else math.nan
        return RunResult(rate, 1000 * cost, interrupt, self._failure, trouble)

    def conclude(self, result: RunResult, summary: str) -> str:
        """Say what went wrong on the way; the summary of a run that ended by itself.

        Args:
            result: Of `follow`, whose results are written by now.
            summary: A few lines for a person.

        Raises:
            InputError: a source could not be read to its end.
            KeyboardInterrupt: as the run was, with what is kept and the summary as its text.
        """
        for trouble in result.trouble:
            warn(trouble)
        if result.failure is not None:
            raise InputError(f"{str(result.failure).removesuffix('.')}; {self.writer.kept()}.")
        if result.interrupt is not None:
            raise type(result.interrupt)(f"{self.writer.kept()}\n{summary}")
        return summary

    def close(self) -> None:
        """Let other runs write into the folder."""
        if self._log is not None:
            self._log.close()
        self._release()

    def _release(self) -> None:
        """Let go of the folder; without a frame, no table is left that would be taken for the results of a run."""
        try:
            if not self.writer.frames:
                (self._options.out / "track.csv").unlink(missing_ok=True)
        finally:
            self.writer.close()

    def _take(self) -> None:
        waiting: list[FrameSet] = []
        with ProgressLine("tracking", self.spec.frames, done=self._first) as line:
            for moment in self._readable():
                waiting.append(moment)
                is_last = bool(self._options.seconds) and moment.time_s >= self._options.seconds
                if is_last or self.spec.session.is_due(waiting):
                    self._advance(waiting)
                    line.show(self.writer.frames, self.spec.session.status)
                    waiting = []
                    self._checkpoint()
                if is_last:
                    return
            if waiting:
                self._advance(waiting)
                line.show(self.writer.frames, self.spec.session.status)
        if self._failure is None:
            self._checkpoint(complete=True)

    def _readable(self) -> Iterator[FrameSet]:
        """The moments after the last checkpoint, up to the first that cannot be read."""
        try:
            yield from continued(iter(self.spec.moments), self.spec.sources, self._first, self._last_s)
        except InputError as error:
            self._failure = error

    def _advance(self, moments: Sequence[FrameSet]) -> None:
        began = time.perf_counter()
        rows = self.spec.session.process(moments)
        self._costs.append((time.perf_counter() - began) / len(moments) if self._ends else math.nan)
        first = self.writer.frames
        self.writer.append_rows(len(moments), rows)
        self._last_s = moments[-1].time_s
        if self._log is not None:
            self._log.rows(first, rows)
        if self._options.video or self._log is not None:
            for i, picture in enumerate(self.spec.session.pictures(moments, rows)):
                self._draw(picture, first + i, moments[i].time_s)
        self._ends = [*self._ends[:1], (time.perf_counter(), self.writer.frames)]

    def _checkpoint(self, *, complete: bool = False) -> None:
        """Save what the next images need, unless that was done a moment ago."""
        if not complete and time.monotonic() - self._saved_at < CHECKPOINT_EVERY_S:
            return
        try:
            saved = self.spec.session.saved() if self.writer.frames else None
        except OSError as error:
            raise OutputError(f"cannot write a checkpoint: {reason(error)}; {self.writer.kept()}.") from error
        if saved is not None:
            self.writer.checkpoint({"session": saved, "time_s": np.asarray(self._last_s)}, complete=complete)
            self._saved_at = time.monotonic()

    def _draw(self, picture: np.ndarray, frame: int, time_s: float) -> None:
        if self._log is not None:
            self._log.picture(frame, time_s, picture)
        if not self._options.video:
            return
        if self._video is None:
            name = f"overlay_from_{self._first}.mp4" if self._first else "overlay.mp4"
            fps = max(source.fps for source in self.spec.sources)
            self._video = OverlayVideo(self._options.out / name, fps, picture.shape)
        self._video.write(picture)
