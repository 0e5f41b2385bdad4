"""`jaxfilters track head-stereo`."""

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfilters.trackers.head.session import HeadSession
from jaxfilters.trackers.head.state import HeadOptions, HeadTrack
from jaxfilters.trackers.recording import InputError
from jaxfilters.trackers.shell.head_draw import draw_frame
from jaxfilters.trackers.shell.head_input import Place, place_of
from jaxfilters.trackers.shell.head_report import errors, shares
from jaxfilters.trackers.shell.head_summary import write_summary
from jaxfilters.trackers.shell.head_table import STATUS_WORDS, TRACKED, TimedHeadTrack, head_table, with_gaps
from jaxfilters.trackers.shell.paired_input import PairedInput
from jaxfilters.trackers.shell.progress import ProgressLine
from jaxfilters.trackers.shell.results import OutputError, TrackWriter, begin, versions
from jaxfilters.trackers.shell.track_command import given, refusing
from jaxfilters.trackers.shell.video import OverlayVideo
from jaxfilters.trackers.shell.video_input import LiveCamera, Moment

MOST_WAITING = 32
"""Moments after which rows are written, however few of them are whole."""
_UNKNOWN_LENGTH = 1_000_000


class Followed(NamedTuple):
    """What came of a run beside its rows."""

    frames_per_second: float
    """Reading, drawing and writing included, without the first chunk, which compiles; NaN with one chunk."""
    tracking_ms: float
    """Median time of the session alone, milliseconds a frame; NaN with one chunk."""
    interrupted: bool
    failure: InputError | None
    """A source that could not be read any further."""
    trouble: list[str]


def track_head(options: argparse.Namespace) -> str:
    """Follow a head, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: a source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: before anything was tracked.
    """
    settings = refusing(partial(given, HeadOptions, options))
    place = place_of(options)
    if any(isinstance(source, LiveCamera) for source in place.sources):
        settings = dataclasses.replace(settings, chunk=1, live=True)
    writer = _writer(options, place)
    if place.note:
        _warn(place.note)
    run = _Run(
        options, place, refusing(lambda: HeadSession(place.rig, settings, place.points)), writer, chunk=settings.chunk
    )
    followed = run.follow()
    if not writer.frames:
        if followed.interrupted:
            raise KeyboardInterrupt(writer.kept())
        raise followed.failure or InputError("; ".join(followed.trouble or ["the sources hold no images"]) + ".")
    report = _report(options, settings, run, followed)
    writer.finish(report, **_learnt(run.session))
    truth = None if place.truth is None else place.truth.poses
    write_summary(options.out / "summary.png", writer.results, run.session.model, truth)
    for trouble in followed.trouble:
        _warn(trouble)
    if followed.failure is not None:
        raise InputError(f"{str(followed.failure).removesuffix('.')}; {writer.kept()}.")
    return _told(report, options)


def _writer(options: argparse.Namespace, place: Place) -> TrackWriter:
    if (path := options.out / "track.csv").exists():
        raise OutputError(f"{path}: holds the track of another run; choose another --out.")
    return begin(options.out, {}, head_table(place.rig.num_cameras), overwrite=True)


class _Run:
    """The way of images from the cameras through the session into rows and pictures."""

    def __init__(
        self, options: argparse.Namespace, place: Place, session: HeadSession, writer: TrackWriter, *, chunk: int
    ):
        self.session, self.frame_of = session, list[int]()
        self.place, self._options, self.writer = place, options, writer
        self._video: OverlayVideo | None = None
        self._failure: InputError | None = None
        self._last = "no images of one moment"
        self._ends, self._costs = list[tuple[float, int]](), list[float]()
        self._chunk = chunk

    def follow(self) -> Followed:
        """Track until the sources end, the time is over, or Ctrl-C."""
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
        return Followed(rate, 1000 * cost, interrupted, self._failure, paired.trouble())

    def _take(self, paired: PairedInput) -> None:
        total = min((getattr(source, "frames", 0) for source in self.place.sources), default=0) or _UNKNOWN_LENGTH
        waiting: list[Moment] = []
        with ProgressLine("tracking", total) as line:
            for moment in self._readable(paired):
                waiting.append(moment)
                is_last = bool(self._options.seconds) and moment.time_s >= self._options.seconds
                if is_last or sum(map(_is_whole, waiting)) == self._chunk or len(waiting) == MOST_WAITING:
                    self._advance(waiting)
                    line.show(min(self.writer.frames, total), self._last)
                    waiting = []
                if is_last:
                    return
            if waiting:
                self._advance(waiting)
                line.show(min(self.writer.frames, total), self._last)

    def _readable(self, paired: PairedInput) -> Iterator[Moment]:
        """The straightened images up to the first that cannot be read."""
        try:
            for moment in paired:
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
        rows = with_gaps(track, times_s, whole, self.place.rig.num_cameras)
        self.writer.append(times_s, rows[1:])
        if self._options.video:
            self._draw(moments, rows)
        self._ends.append((time.perf_counter(), self.writer.frames))

    def _track(self, moments: list[Moment]) -> HeadTrack | None:
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

    def _draw(self, moments: list[Moment], rows: TimedHeadTrack) -> None:
        for i, moment in enumerate(moments):
            picture = draw_frame(list(moment.images), self.place.rig, rows, i)
            if self._video is None:
                fps = max(source.fps for source in self.place.sources)
                self._video = OverlayVideo(self._options.out / "overlay.mp4", fps, picture.shape)
            self._video.write(picture)


def _is_whole(moment: Moment) -> bool:
    return all(image is not None for image in moment.images)


def _learnt(session: HeadSession) -> dict[str, np.ndarray]:
    """What `track.npz` holds beside the track."""
    learnt = {"status_names": np.asarray(STATUS_WORDS)}
    if session.model is not None:
        names = ("mean", "basis", "deviation", "templates")
        learnt |= {f"model_{name}": np.asarray(getattr(session.model, name)) for name in names}
    return learnt


def _report(options: argparse.Namespace, settings: HeadOptions, run: _Run, followed: Followed) -> dict[str, Any]:
    results, place = run.writer.results, run.place
    events = [{"frame": run.frame_of[min(i, len(run.frame_of) - 1)], "what": what} for i, what in run.session.events]
    return {
        "input": [source.name for source in place.sources],
        **shares(results),
        "frames_per_second": _finite(followed.frames_per_second),
        "tracking_ms_per_frame": _finite(followed.tracking_ms),
        "interrupted": followed.interrupted,
        "trouble": followed.trouble,
        "note": place.note,
        "events": events,
        "learnt_contribution": _finite(float(run.session.contribution)),
        "errors": errors(results, place.truth),
        "config": dataclasses.asdict(settings),
        "options": {
            name: str(value) if value is not None else None
            for name, value in (("rig", options.rig), ("camera", options.camera), ("points", options.points))
        },
        "versions": versions(),
    }


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def _told(report: dict[str, Any], options: argparse.Namespace) -> str:
    speed, share = report["frames_per_second"], report["share_tracked"]
    lines = [
        f"{report['frames']} frames"
        + (f" at {speed:.0f} frames/s" if speed else "")
        + (f", {100 * share:.0f} % tracked" if share is not None else "")
        + f", longest stretch without loss {report['longest_stretch_s']:.1f} s"
        + (", interrupted" if report["interrupted"] else "")
    ]
    if report["errors"]:
        rmse = ", ".join(f"{axis.replace('_', ' ')} {value:.2f}" for axis, value in report["errors"]["rmse"].items())
        lines.append(f"errors, root mean square: {rmse}")
    if not any(report["status"][STATUS_WORDS[code]] for code in TRACKED):
        last = f"; last: {report['events'][-1]['what']}" if report["events"] else ""
        lines.append(f"no face was followed{last}")
    lines.append(
        f"results in {options.out}: track.csv, track.npz, report.json, summary.png"
        + (", overlay.mp4" if options.video else "")
    )
    return "\n".join(lines)


def _warn(text: str) -> None:
    sys.stderr.write(f"jaxfilters: warning: {text}\n")
