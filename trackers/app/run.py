"""A tracker on a recording from the command line: results, pictures and a report in one folder."""

import argparse
import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.app.chunks import Progress, track_recording
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.app.rerun_log import RerunLog, open_log
from jaxfilters.trackers.app.results import TrackTable, TrackWriter, open_writer, versions
from jaxfilters.trackers.innovations import contradiction, innovation_share
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.recording import Recording
from jaxfilters.trackers.tracker import STATUS_NAMES, Tracker

Errors = dict[str, float | None]
"""Errors against the truth by name, with units in the names; None where no truth is known."""
_SHOWN = {"m": (1000.0, "mm"), "rad": (math.degrees(1.0), "degrees")}
"""Factors and units in which a person reads what a report holds in metres and radians."""


class RunSpec(NamedTuple):
    """What one command tracks, with which tracker, and how the results are shown."""

    recording: Recording
    tracker: Tracker
    config: Any
    """A dataclass of Python values, with `seed`."""
    table: TrackTable
    errors: Callable[[Any], Errors]
    draw_summary: Callable[..., None]
    """`(path, results)`; raises `OutputError`."""
    draw_overlay: Callable[..., None]
    """`(path, results, frames_per_second, on_progress)`; raises `OutputError`."""
    pictures: Callable[..., Iterable[np.ndarray]]
    """`(first, frames, rows)`: pictures (rows, cols, 3) of a chunk of frames and their rows."""


def run(spec: RunSpec, options: argparse.Namespace) -> str:
    """Track a recording, leave the results in `options.out`, and report in a few lines.

    Raises:
        InputError: the recording or an option cannot be used.
        CheckpointError: `--resume` does not fit what lies in the folder, or is missing.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text.
    """
    began = time.perf_counter()
    writer, saved = open_writer(options, _identity(spec), spec.table)
    log = None
    try:
        log = open_log(options, spec.table)
        state = spec.tracker.init(jax.random.key(spec.config.seed), spec.recording[0]) if saved is None else saved
        rate = _track(spec, state, writer, log)
        errors = spec.errors(writer.results)
        report = _report(spec, writer.results, errors, rate, time.perf_counter() - began)
        writer.finish(report)
        _write_pictures(options, spec, writer, rate)
    except InputError as error:
        raise InputError(_with_what_is_kept(error, writer)) from None
    except KeyboardInterrupt as interrupt:
        raise type(interrupt)(writer.kept()) from None
    finally:
        if log is not None:
            log.close()
        writer.close()
    return _summary(report, errors, options)


def _identity(spec: RunSpec) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    return {
        "input": spec.recording.fingerprint(),
        "version": version("jaxfilters"),
        **{f"config.{name}": value for name, value in dataclasses.asdict(spec.config).items()},
    }


def _track(spec: RunSpec, state: Any, writer: TrackWriter, log: RerunLog | None) -> float:
    with ProgressLine("tracking", len(spec.recording), done=writer.frames) as line:

        def show(progress: Progress) -> None:
            speed = "" if math.isnan(progress.frames_per_second) else f"{progress.frames_per_second:.0f} frames/s  "
            line.show(progress.done, speed + progress.status)

        def send(first: int, frames: list[Any], rows: Any) -> None:
            if log is None:
                return
            log.rows(first, rows)
            for i, picture in enumerate(spec.pictures(first, frames, rows)):
                log.picture(first + i, rows.times_s[i], picture)

        return track_recording(spec.recording, spec.tracker, state, writer, show, send)


def _write_pictures(options: argparse.Namespace, spec: RunSpec, writer: TrackWriter, rate: float) -> None:
    results = writer.results
    try:
        if options.video:
            with ProgressLine("drawing", len(results.times_s)) as line:
                spec.draw_overlay(options.out / "overlay.mp4", results, rate, line.show)
        spec.draw_summary(options.out / "summary.png", results)
    except OutputError as error:
        raise OutputError(_with_what_is_kept(error, writer)) from None


def _with_what_is_kept(error: Exception, writer: TrackWriter) -> str:
    return f"{str(error).removesuffix('.')}; {writer.kept()}."


def _report(spec: RunSpec, results: Any, errors: Errors, rate: float, seconds: float) -> dict[str, Any]:
    counts = Counter(STATUS_NAMES[int(status)] for status in results.status)
    evidence = float(np.nansum(results.log_evidence, dtype=float))
    return {
        "input": spec.recording.name,
        "frames": len(results.times_s),
        "frames_per_second": None if math.isnan(rate) else round(rate, 2),
        "seconds": round(seconds, 2),
        "status": {name: counts[name] for name in STATUS_NAMES},
        "log_evidence": evidence if math.isfinite(evidence) else None,
        "innovations": innovation_share(results.innovations).report(),
        **errors,
        "config": dataclasses.asdict(spec.config),
        "versions": versions(),
    }


def _summary(report: dict[str, Any], errors: Errors, options: argparse.Namespace) -> str:
    speed = report["frames_per_second"]
    return (
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + "".join(f", {report['status'][name]} {name}" for name in ("lost", "searching"))
        + "".join(f", {_in_words(name, value)}" for name, value in errors.items() if value is not None)
        + contradiction(report["innovations"])
        + f"\nresults in {options.out}: track.csv, track.npz, report.json, summary.png"
        + (", overlay.mp4" if options.video else "")
    )


def _in_words(name: str, value: float) -> str:
    """`mean joint error 1.5 mm` of `mean_joint_error_m`, as people read lengths and angles."""
    *words, unit = name.split("_")
    factor, shown = _SHOWN.get(unit, (1.0, unit))
    return f"{' '.join(words)} {factor * value:.1f} {shown}"
