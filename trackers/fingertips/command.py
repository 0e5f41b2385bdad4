"""`jaxfilters track fingertips`."""

import argparse
import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from jaxfilters.models.gesture import coded
from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.app.results import finite, versions
from jaxfilters.trackers.app.stream import RunResult, StreamRun, StreamSpec, check_unused
from jaxfilters.trackers.fingertips.config import RunConfig
from jaxfilters.trackers.fingertips.events import Recognised, Recogniser, Stroke
from jaxfilters.trackers.fingertips.files import EventFile
from jaxfilters.trackers.fingertips.images import OPEN_HAND_IMAGES, angles_of, estimate_user, hands_in
from jaxfilters.trackers.fingertips.input import DemoHand, open_hands
from jaxfilters.trackers.fingertips.run import Begun, FingertipStream
from jaxfilters.trackers.fingertips.session import VARIANTS, FingertipSession
from jaxfilters.trackers.fingertips.summary import write_summary
from jaxfilters.trackers.fingertips.table import STATUS, TIP_TABLE
from jaxfilters.trackers.innovations import contradiction, innovation_share
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.gesture_models import SymbolsFile, default_symbols, read_symbols
from jaxfilters.trackers.io.video_input import FrameSet, is_live


def track(options: argparse.Namespace) -> str:
    """Follow hands, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: the source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text; what was tracked before is written.
    """
    check_unused(options)
    run_config = as_input_error(partial(config_from_args, RunConfig(), options))
    symbols = _symbols(options.gestures)
    source = open_hands(
        options.video_source,
        run_config.mask,
        fps=options.fps,
        seed=run_config.seed,
        depth=options.depth,
        keypoints=options.keypoints,
        image_size=options.image_size,
    )
    with closing(EventFile(options.out / "events.jsonl")) as events:
        stream = FingertipStream(source, partial(_begun, source, run_config, options, symbols), events)
        total = getattr(source, "frames", 0) or None
        spec = StreamSpec(
            *([source], _moments(source, options.seconds), lambda: [*filter(None, [source.trouble()])], stream),
            *(TIP_TABLE, _identity(source, run_config, options), total, stream.prime),
        )
        with closing(StreamRun(_limited(source, options), spec)) as run:
            return _tracked(source, stream, run, run_config, options)


def _begun(source: Any, run_config: RunConfig, options: argparse.Namespace, symbols: SymbolsFile) -> Begun:
    """The user, from images of the recording, and a session for the user's hands; a live camera's images are gone."""
    images = source.sample(OPEN_HAND_IMAGES)
    try:
        user = estimate_user(images, run_config.mask)
    except ValueError as error:
        raise InputError(f"{source.name}: {error}") from None
    if not user.has_open_hand:
        usual = "no open hand in the first images; thumbs are recognised by the usual angles"
        warn(f"{source.name}: {usual}{_advice(run_config, options)}")
    config, method = VARIANTS[options.variant]
    session = FingertipSession(
        angles_of(user),
        handedness=user.parameters.handedness,
        num_hands=run_config.hands,
        height=float(source.image_size[1]),
        fps=source.fps,
        config=dataclasses.replace(config, posture=user.posture),
        method=method,
        recogniser=recogniser_of(symbols),
    )
    return Begun(user, lambda image: as_input_error(partial(hands_in, image, user, run_config.hands)), session)


def _tracked(
    source: Any, stream: FingertipStream, run: StreamRun, config: RunConfig, options: argparse.Namespace
) -> str:
    began = time.perf_counter()
    result = run.follow()
    stream.finish()
    results = run.writer.results
    report = _report(source, stream, result, config, options, time.perf_counter() - began) | {
        "innovations": innovation_share(results.innovations, results.frame).report()
    }
    run.writer.finish(report, status_names=np.asarray(STATUS))
    write_summary(options.out / "summary.png", results, stream.tally, stream.begun.session.events, source.image_size)
    return run.conclude(result, format_report(report, options))


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


def _advice(config: RunConfig, options: argparse.Namespace) -> str:
    brightest = config.mask == "infrared" and options.keypoints is None
    return "; where hands are not the brightest of all, --mask colour may find them" if brightest else ""


def _symbols(path: str) -> SymbolsFile:
    file = default_symbols() if path == "default" else read_symbols(path)
    if file.dimensions == 3:
        raise InputError(f"--gestures: {path} is of strokes in space; fingertips move in a plane.")
    return file


def _identity(source: Any, config: RunConfig, options: argparse.Namespace) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    given = {name: str(value) for name, value in dataclasses.asdict(config).items()}
    given |= {"gestures": str(options.gestures), "variant": options.variant}
    size, rate = list(source.image_size), source.fps
    return {"input": source.name, "image_size": size, "fps": rate, "version": version("jaxfilters"), **given}


def _moments(source: Any, seconds: float | None) -> Iterator[FrameSet]:
    """Those with an image; a live camera may have none when the time is over. Its clock began some time before."""
    first = None
    for time_s, image in source.images():
        first = time_s if first is None else first
        if image is not None:
            yield FrameSet(time_s - first if is_live(source) else time_s, (image,))
        if seconds and time_s - first >= seconds:
            return


def _limited(source: Any, options: argparse.Namespace) -> argparse.Namespace:
    """The options with `seconds` on the clock of the source, whose first frame need not be at 0."""
    seconds = options.seconds and getattr(source, "began_s", 0.0) + options.seconds
    return argparse.Namespace(**vars(options) | {"seconds": seconds})


def _report(
    source: Any,
    stream: FingertipStream,
    result: RunResult,
    config: RunConfig,
    options: argparse.Namespace,
    seconds: float,
) -> dict[str, Any]:
    (user, _, session), tally = stream.begun, stream.tally
    right = tally.right_counts / tally.frames if isinstance(source, DemoHand) else math.nan
    return {
        "input": source.name,
        "frames": tally.frames,
        "frames_per_second": finite(result.frames_per_second),
        "seconds": round(seconds, 2),
        "fingertips": len(tally.frames_by_fingertip),
        "frames_by_fingertip": tally.frames_by_fingertip,
        "frames_by_count": dict(sorted(tally.frames_by_count.items(), key=lambda item: int(item[0]))),
        "events": dict(Counter(f"{event.name} {event.phase}" for event in session.events)),
        "mean_error_px": finite(tally.mean_error_px),
        "share_of_right_counts": finite(float(right)),
        "interrupted": result.interrupt is not None,
        "trouble": result.trouble,
        "open_hand": user.has_open_hand,
        "hand": dataclasses.asdict(user.parameters),
        "mask": None if options.keypoints else config.mask,
        "gestures": str(options.gestures),
        "config": dataclasses.asdict(session.config) | {"posture": session.config.posture._asdict()},
        "versions": versions(),
    }


def format_report(report: dict[str, Any], options: argparse.Namespace) -> str:
    """The report in a few lines for a person."""
    speed, error = report["frames_per_second"], report["mean_error_px"]
    symbols = report["events"].get("symbol end", 0)
    lines = [
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + f", {report['fingertips']} fingertips, {symbols} {'symbol' if symbols == 1 else 'symbols'}"
        + (f", mean error {error:.2f} px" if error is not None else "")
        + (", interrupted" if report["interrupted"] else "")
        + contradiction(report["innovations"]),
        f"results in {options.out}: track.csv, track.npz, events.jsonl, report.json, summary.png"
        + (", overlay.mp4" if options.video else ""),
    ]
    return "\n".join(lines)
