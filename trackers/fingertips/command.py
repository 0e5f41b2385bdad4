"""`jaxfilters track fingertips`."""

import argparse
import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.gesture import coded
from jaxfilters.trackers.app.progress import ProgressLine, note, warn
from jaxfilters.trackers.app.results import versions
from jaxfilters.trackers.app.video import OverlayVideo
from jaxfilters.trackers.fingertips.events import Recognised, Recogniser, Stroke
from jaxfilters.trackers.fingertips.files import FingertipFiles, read_events
from jaxfilters.trackers.fingertips.images import OPEN_HAND_IMAGES, User, angles_of, estimate_user, hands_in
from jaxfilters.trackers.fingertips.input import DemoHand, open_hands, shown
from jaxfilters.trackers.fingertips.pictures import FingertipPictures
from jaxfilters.trackers.fingertips.session import USUAL, FingertipSession
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.fingertips.tally import Tally
from jaxfilters.trackers.head.common.outcome import finite
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.gesture_models import SymbolsFile, default_symbols, read_symbols
from jaxfilters.trackers.io.video_input import Moment, continued
from jaxfilters.trackers.people.files import write_report


class RunResult(NamedTuple):
    """What came of a run."""

    tally: Tally
    frames_per_second: float
    """Without the first frame, which compiles; NaN with one."""
    interrupted: bool
    failure: InputError | None


def track(options: argparse.Namespace) -> str:
    """Follow hands, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: the source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: before anything was tracked.
    """
    symbols = _symbols(options.gestures)
    source = open_hands(
        options.video_source,
        options.mask,
        fps=options.fps,
        seed=options.seed,
        keypoints=options.keypoints,
        image_size=options.image_size,
    )
    files = FingertipFiles(options.out, _identity(source, options), resume=options.resume)
    began = time.perf_counter()
    try:
        user = _user(source, options.mask)
        if not user.has_open_hand:
            usual = "no open hand in the first images; thumbs are recognised by the usual angles"
            warn(f"{source.name}: {usual}{_advice(options)}")
        session = FingertipSession(
            angles_of(user),
            handedness=user.parameters.handedness,
            num_hands=options.hands,
            height=float(source.image_size[1]),
            fps=source.fps,
            config=dataclasses.replace(USUAL, posture=user.posture),
            recogniser=recogniser_of(symbols),
        )
        followed = _follow(source, user, session, files, options)
    finally:
        files.close()
    if not followed.tally.frames:
        if followed.interrupted:
            raise KeyboardInterrupt("nothing was kept")
        raise followed.failure or InputError(f"{source.name}: no image.")
    report = _report(source, user, session, followed, options, time.perf_counter() - began)
    write_report(options.out / "report.json", report)
    for trouble in report["trouble"]:
        warn(trouble)
    if followed.failure is not None:
        kept = f"the first {followed.tally.frames} frames are in {files.tips}"
        raise InputError(f"{str(followed.failure).removesuffix('.')}; {kept}.")
    return _told(report, options)


def recogniser_of(file: SymbolsFile) -> Recogniser:
    """What names strokes by the models of a file: of paths, or of direction codes."""

    def recognise(stroke: Stroke) -> Recognised:
        if file.dimensions:
            # Symbols with margins of their own need no common one.
            margin = coded.MARGIN if file.symbols.margins is None else 0.0
            found = coded.recognise_path(file.symbols, stroke.points, stroke.counts, margin=margin)
        else:
            found = coded.recognise(file.symbols, stroke.codes, stroke.counts, margin=0.0)
        label = int(found.label)
        return Recognised(file.symbols.names[label] if label >= 0 else None, float(np.max(found.confidence)))

    return recognise


def _advice(options: argparse.Namespace) -> str:
    brightest = options.mask == "infrared" and options.keypoints is None
    return "; where hands are not the brightest of all, --mask colour may find them" if brightest else ""


def _symbols(path: str) -> SymbolsFile:
    file = default_symbols() if path == "default" else read_symbols(path)
    if file.dimensions == 3:
        raise InputError(f"--gestures: {path} is of strokes in space; fingertips move in a plane.")
    return file


def _user(source: Any, mask: str) -> User:
    """The user, from images of the recording; of a live camera the first ones, which are then gone."""
    try:
        return estimate_user(source.sample(OPEN_HAND_IMAGES), mask)
    except ValueError as error:
        raise InputError(f"{source.name}: {error}") from None


def _identity(source: Any, options: argparse.Namespace) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    given = {name: str(getattr(options, name)) for name in ("mask", "hands", "gestures", "seed")}
    size, rate = list(source.image_size), source.fps
    return {"input": source.name, "image_size": size, "fps": rate, "version": version("jaxfilters"), **given}


def _follow(
    source: Any, user: User, session: FingertipSession, files: FingertipFiles, options: argparse.Namespace
) -> RunResult:
    tally = Tally()
    if files.saved is not None:
        tally = files.saved["tally"]
        session.restore(files.saved["session"], read_events(files.events))
        note(f"continuing after frame {tally.frames} of {options.out}")
    name = f"overlay_from_{tally.frames}.mp4" if tally.frames else "overlay.mp4"
    pictures, video, ends = FingertipPictures(), None, list[float]()
    interrupted, failure, reported = False, None, len(session.events)
    total = getattr(source, "frames", 0) or None
    try:
        with ProgressLine("tracking", total, done=tally.frames) as line:
            moments = _moments(source, options.seconds)
            image: Any
            for time_s, (image,) in continued(moments, [source], tally.frames, tally.time_s):
                found = session.process(hands_in(image, user, options.hands), np.array([time_s]))
                report = HandReport(*(field[0] for field in found))
                events, reported = session.events[reported:], len(session.events)
                files.append(tally.frames, time_s, report, events)
                if options.video:
                    picture = pictures.drawn(shown(image), tally.frames, time_s, report, events)
                    video = video or OverlayVideo(options.out / name, source.fps, picture.shape)
                    video.write(picture)
                tally = tally.add(time_s, report, source.truth[-1] if isinstance(source, DemoHand) else None)
                files.checkpoint(partial(_saved, session, tally))
                ends.append(time.perf_counter())
                done = tally.frames if total is None else min(tally.frames, total)
                line.show(done, f"{int(report.num_tips.sum())} fingertips")
    except InputError as error:
        failure = error
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if video is not None:
            video.close()
    if video is not None:
        video.check()
    session.finish()
    if session.events[reported:]:
        files.append(tally.frames, 0.0, _NOTHING, session.events[reported:])
    rate = (len(ends) - 1) / (ends[-1] - ends[0]) if len(ends) > 1 else math.nan
    return RunResult(tally, rate, interrupted, failure)


_NOTHING: Any = HandReport(*[np.zeros((0, 0), bool)] * len(HandReport._fields))  # type: ignore[arg-type]


def _saved(session: FingertipSession, tally: Tally) -> dict[str, Any]:
    """What the next images need."""
    return {"session": session.saved(), "tally": tally}


def _moments(source: Any, seconds: float | None) -> Iterator[Moment]:
    first = None
    for time_s, image in source.images():
        first = time_s if first is None else first
        if image is not None:
            yield Moment(time_s - first, (image,))
        if seconds and time_s - first >= seconds:
            return


def _report(
    source: Any,
    user: User,
    session: FingertipSession,
    followed: RunResult,
    options: argparse.Namespace,
    seconds: float,
) -> dict[str, Any]:
    tally = followed.tally
    right = tally.right_counts / tally.frames if isinstance(source, DemoHand) else math.nan
    return {
        "input": source.name,
        "frames": tally.frames,
        "frames_per_second": finite(followed.frames_per_second),
        "seconds": round(seconds, 2),
        "fingertips": len(tally.frames_by_fingertip),
        "frames_by_fingertip": tally.frames_by_fingertip,
        "frames_by_count": dict(sorted(tally.frames_by_count.items(), key=lambda item: int(item[0]))),
        "events": dict(Counter(f"{event.name} {event.phase}" for event in session.events)),
        "mean_error_px": finite(tally.mean_error_px),
        "share_of_right_counts": finite(float(right)),
        "interrupted": followed.interrupted,
        "trouble": [trouble] if (trouble := source.trouble()) else [],
        "open_hand": user.has_open_hand,
        "hand": dataclasses.asdict(user.parameters),
        "mask": None if options.keypoints else options.mask,
        "gestures": str(options.gestures),
        "config": dataclasses.asdict(session.config) | {"posture": session.config.posture._asdict()},
        "versions": versions(),
    }


def _told(report: dict[str, Any], options: argparse.Namespace) -> str:
    speed, error = report["frames_per_second"], report["mean_error_px"]
    symbols = report["events"].get("symbol end", 0)
    lines = [
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + f", {report['fingertips']} fingertips, {symbols} {'symbol' if symbols == 1 else 'symbols'}"
        + (f", mean error {error:.2f} px" if error is not None else "")
        + (", interrupted" if report["interrupted"] else ""),
        f"results in {options.out}: tips.csv, events.jsonl, report.json" + (", overlay.mp4" if options.video else ""),
    ]
    return "\n".join(lines)
