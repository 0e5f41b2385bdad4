"""The way of a head's images from the cameras through a session into rows and pictures."""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib.metadata import version
from typing import Any, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np

from jaxfilters.trackers.app.progress import ProgressLine, warn
from jaxfilters.trackers.app.results import CHECKPOINT_EVERY_S, TrackTable, open_writer
from jaxfilters.trackers.app.video import OverlayVideo
from jaxfilters.trackers.head.common.drawing import draw_frame
from jaxfilters.trackers.head.common.input import Setup
from jaxfilters.trackers.head.common.table import SKIPPED, STATUS_WORDS, HeadRows, with_gaps
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.paired_input import PairedInput
from jaxfilters.trackers.io.video_input import Moment, continued

MOST_WAITING = 32
"""Moments after which rows are written, however few of them are whole."""


@runtime_checkable
class Session(Protocol):
    """What follows a head."""

    @property
    def events(self) -> list[tuple[int, str]]:
        """(frame index, what happened), in order."""
        ...

    def process(self, images: np.ndarray, times: np.ndarray) -> Any:
        """Track of the next frames, a row each, with the fields of `HeadTrack`."""
        ...

    def saved(self) -> Any:
        """All that the next frame needs; None where a run cannot go on from here."""
        ...

    def restore(self, saved: Any) -> None:
        """Go on from what `saved` gave."""
        ...


class RunResult(NamedTuple):
    """What came of a run beside its rows."""

    frames_per_second: float
    """Reading, drawing and writing included, without the first chunk, which compiles; NaN with one chunk."""
    tracking_ms: float
    """Median time of the session alone, milliseconds a frame; NaN with one chunk."""
    interrupted: bool
    failure: InputError | None
    """A source that could not be read any further."""
    trouble: list[str]


class RowsOf(NamedTuple):
    """How what a session returns becomes rows of its table."""

    table: TrackTable
    in_metres: Callable[[Any], Any]
    """Of a track in millimetres."""
    nothing: Callable[[int], Any]
    """`frames -> rows` of the right shapes and types."""


class HeadRun:
    """The way of images from the cameras through the session into rows and pictures."""

    def __init__(
        self,
        options: argparse.Namespace,
        place: Setup,
        session: Session,
        rows: RowsOf,
        config: Any,
    ):
        """A run before its first image, or with `--resume` after its last checkpoint.

        Args:
            options: Of the command line.
            place: What is watched.
            session: What follows the head.
            rows: How its track becomes rows.
            config: A dataclass of Python values, with `chunk`: the options of the session.

        Raises:
            OutputError: the folder holds another run's track, or cannot be written.
            CheckpointError: the run that is to be resumed is another one, or its checkpoint is damaged.
        """
        if not options.resume and (path := options.out / "track.csv").exists():
            raise OutputError(f"{path}: holds the track of another run; choose another --out, or --resume.")
        self.session, self.place, self._options, self._rows = session, place, options, rows
        self.writer, saved = open_writer(options, _identity(options, place, config), rows.table)
        self.frame_of = list[int]()
        if saved is not None:
            session.restore(saved)
            self.frame_of = np.flatnonzero(self.writer.results.status != SKIPPED).tolist()
        self._first, self._saved_at = self.writer.frames, time.monotonic()
        self._video: OverlayVideo | None = None
        self._failure: InputError | None = None
        self._last = "no images of one moment"
        self._ends, self._costs = list[tuple[float, int]](), list[float]()
        self._chunk = config.chunk

    def follow(self) -> RunResult:
        """Track until the sources end, the time is over, or Ctrl-C.

        Raises:
            InputError: nothing could be read.
            KeyboardInterrupt: before anything was tracked.
        """
        followed = self._followed()
        if not self.writer.frames:
            if followed.interrupted:
                raise KeyboardInterrupt(self.writer.kept())
            raise followed.failure or InputError("; ".join(followed.trouble or ["the sources hold no images"]) + ".")
        return followed

    def conclude(self, followed: RunResult) -> None:
        """Say what went wrong on the way.

        Raises:
            InputError: a source could not be read to its end.
        """
        for trouble in followed.trouble:
            warn(trouble)
        if followed.failure is not None:
            raise InputError(f"{str(followed.failure).removesuffix('.')}; {self.writer.kept()}.")

    def close(self) -> None:
        """Let other runs write into the folder."""
        self.writer.close()

    def _followed(self) -> RunResult:
        paired = PairedInput(self.place.sources)
        interrupted = False
        try:
            self._take(paired)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            if self._video is not None:
                self._video.close()
        if self._video is not None:
            self._video.check()
        seconds = self._ends[-1][0] - self._ends[0][0] if self._ends else 0.0
        rate = (self._ends[-1][1] - self._ends[0][1]) / seconds if seconds else math.nan
        cost = float(np.median(self._costs[1:])) if len(self._costs) > 1 else math.nan
        return RunResult(rate, 1000 * cost, interrupted, self._failure, paired.trouble())

    def _take(self, paired: PairedInput) -> None:
        total = min((getattr(source, "frames", 0) for source in self.place.sources), default=0) or None
        waiting: list[Moment] = []
        with ProgressLine("tracking", total, done=self._first) as line:
            for moment in self._readable(self._remaining(paired)):
                waiting.append(moment)
                is_last = bool(self._options.seconds) and moment.time_s >= self._options.seconds
                if is_last or sum(map(_is_whole, waiting)) == self._chunk or len(waiting) == MOST_WAITING:
                    self._advance(waiting)
                    line.show(self._done(total), self._last)
                    waiting = []
                    self._checkpoint()
                if is_last:
                    return
            if waiting:
                self._advance(waiting)
                line.show(self._done(total), self._last)
        if self._failure is None:
            self._checkpoint(complete=True)

    def _done(self, total: int | None) -> int:
        return self.writer.frames if total is None else min(self.writer.frames, total)

    def _remaining(self, paired: PairedInput) -> Iterator[Moment]:
        """The moments after the last checkpoint."""
        time_s = float(self.writer.results.times_s[-1]) if self._first else 0.0
        return continued(iter(paired), self.place.sources, self._first, time_s)

    def _checkpoint(self, *, complete: bool = False) -> None:
        """Save what the next images need, unless that was done a moment ago."""
        if not complete and time.monotonic() - self._saved_at < CHECKPOINT_EVERY_S:
            return
        if self.writer.frames and (saved := self.session.saved()) is not None:
            self.writer.checkpoint(saved, complete=complete)
            self._saved_at = time.monotonic()

    def _readable(self, moments: Iterator[Moment]) -> Iterator[Moment]:
        """The straightened images up to the first that cannot be read."""
        try:
            for moment in moments:
                yield self._straightened(moment)
        except InputError as error:
            self._failure = error

    def _straightened(self, moment: Moment) -> Moment:
        return moment._replace(
            images=tuple(
                None if image is None else undistortion.apply(image)
                for image, undistortion in zip(moment.images, self.place.undistortions, strict=True)
            )
        )

    def _advance(self, moments: list[Moment]) -> None:
        """Track the moments that are whole, and write a row for every one."""
        whole = [_is_whole(moment) for moment in moments]
        track = self._track([moment for moment, is_whole in zip(moments, whole, strict=True) if is_whole])
        self.frame_of += [self.writer.frames + int(i) for i in np.flatnonzero(whole)]
        times_s = np.asarray([moment.time_s for moment in moments])
        track = None if track is None else self._rows.in_metres(track)
        rows = with_gaps(track, times_s, whole, self._rows.nothing)
        self.writer.append(times_s, rows[1:])
        if self._options.video:
            self._draw(moments, rows)
        self._ends.append((time.perf_counter(), self.writer.frames))

    def _track(self, moments: list[Moment]) -> Any:
        if not moments:
            return None
        grey = [
            [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in moment.images if image is not None]
            for moment in moments
        ]
        began = time.perf_counter()
        track = self.session.process(np.asarray(grey), np.asarray([moment.time_s for moment in moments]))
        self._costs.append((time.perf_counter() - began) / len(moments))
        self._last = STATUS_WORDS[int(track.status[-1])]
        return track

    def _draw(self, moments: list[Moment], rows: HeadRows) -> None:
        for i, moment in enumerate(moments):
            picture = draw_frame(list(moment.images), self.place.rig, rows, i)
            if self._video is None:
                fps = max(source.fps for source in self.place.sources)
                name = f"overlay_from_{self._first}.mp4" if self._first else "overlay.mp4"
                self._video = OverlayVideo(self._options.out / name, fps, picture.shape)
            self._video.write(picture)


def _identity(options: argparse.Namespace, place: Setup, config: Any) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    given = {name: getattr(options, name, None) for name in ("camera", "rig", "points", "model", "known", "detector")}
    return {
        "input": [source.name for source in place.sources],
        "image_sizes": [list(source.image_size) for source in place.sources],
        "fps": [source.fps for source in place.sources],
        "version": version("jaxfilters"),
        **{f"--{name}": str(value) for name, value in given.items() if value is not None},
        **{f"config.{name}": value for name, value in asdict(config).items()},
    }


def _is_whole(moment: Moment) -> bool:
    return all(image is not None for image in moment.images)
