"""A tracker on a recording from the command line: results, pictures and a report in one folder."""

import argparse
import dataclasses
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.app.results import TrackTable, TrackWriter, begin, can_resume, resume, versions
from jaxfilters.trackers.app.session import Progress, follow
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.recording import Recording
from jaxfilters.trackers.tracker import STATUS_NAMES, SequenceTracker

Made = TypeVar("Made")


class Job(NamedTuple):
    """What one command follows, with what, and how it is shown."""

    sequence: Recording
    tracker: SequenceTracker
    config: Any
    """A dataclass of Python values, with `seed`."""
    table: TrackTable
    errors: Callable[[Any], dict[str, float | None]]
    """`results -> errors` against the truth by name, with units in the names; None where no truth is known."""
    draw_summary: Callable[..., None]
    """`(path, results)`; raises `OutputError`."""
    draw_overlay: Callable[..., None]
    """`(path, results, frames_per_second, on_progress)`; raises `OutputError`."""


def given(config: Callable[..., Made], options: argparse.Namespace) -> Made:
    """A configuration with the options that were given; the others keep the defaults that stand there."""
    names = (field.name for field in dataclasses.fields(config))  # type: ignore[arg-type]
    return config(**{name: value for name in names if (value := getattr(options, name, None)) is not None})


def refusing(make: Callable[[], Made]) -> Made:
    """What `make` returns; what it finds wrong is the input's fault.

    Raises:
        InputError: for a `ValueError`.
    """
    try:
        return make()
    except ValueError as error:
        raise InputError(str(error)) from None


def track(job: Job, options: argparse.Namespace) -> None:
    """Do the job, and leave the results in `options.out`.

    Raises:
        InputError: the recording or an option cannot be used.
        CheckpointError: `--resume` does not fit what lies in the folder, or is missing.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text.
    """
    began = time.perf_counter()
    state = job.tracker.start(jax.random.key(job.config.seed), job.sequence[0])
    writer, state = _writer(options, job, state)
    try:
        rate = _follow(job, state, writer)
        errors = job.errors(writer.results)
        report = _report(job, writer.results, errors, rate, time.perf_counter() - began)
        writer.finish(report)
        _write_pictures(options, job, writer, rate)
    except InputError as error:
        raise InputError(_with_what_is_kept(error, writer)) from None
    except KeyboardInterrupt:
        raise KeyboardInterrupt(writer.kept()) from None
    _tell(report, errors, options)


def _identity(job: Job) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    return {
        "input": job.sequence.fingerprint(),
        "version": version("jaxfilters"),
        **{f"config.{name}": value for name, value in dataclasses.asdict(job.config).items()},
    }


def _writer(options: argparse.Namespace, job: Job, state: Any) -> tuple[TrackWriter, Any]:
    run = _identity(job)
    if options.resume and can_resume(options.out):
        writer, state = resume(options.out, run, job.table, state)
        print(f"continuing after frame {writer.frames} of {options.out}", file=sys.stderr)
        return writer, state
    if options.resume:
        print(f"nothing to resume in {options.out}: starting with the first frame", file=sys.stderr)
    return begin(options.out, run, job.table, overwrite=options.overwrite), state


def _follow(job: Job, state: Any, writer: TrackWriter) -> float:
    with ProgressLine("tracking", len(job.sequence)) as line:

        def show(progress: Progress) -> None:
            speed = "" if math.isnan(progress.frames_per_second) else f"{progress.frames_per_second:.0f} frames/s  "
            line.show(progress.done, speed + progress.status)

        return follow(job.sequence, job.tracker, state, writer, show)


def _write_pictures(options: argparse.Namespace, job: Job, writer: TrackWriter, rate: float) -> None:
    results = writer.results
    try:
        if options.video:
            with ProgressLine("drawing", len(results.times_s)) as line:
                job.draw_overlay(options.out / "overlay.mp4", results, rate, line.show)
        job.draw_summary(options.out / "summary.png", results)
    except OutputError as error:
        raise OutputError(_with_what_is_kept(error, writer)) from None


def _with_what_is_kept(error: Exception, writer: TrackWriter) -> str:
    return f"{str(error).removesuffix('.')}; {writer.kept()}."


def _report(job: Job, results: Any, errors: dict[str, float | None], rate: float, seconds: float) -> dict[str, Any]:
    counts = Counter(STATUS_NAMES[int(status)] for status in results.status)
    evidence = float(np.nansum(results.log_evidence, dtype=float))
    return {
        "input": job.sequence.name,
        "frames": len(results.times_s),
        "frames_per_second": None if math.isnan(rate) else round(rate, 2),
        "seconds": round(seconds, 2),
        "status": {name: counts[name] for name in STATUS_NAMES},
        "log_evidence": evidence if math.isfinite(evidence) else None,
        **errors,
        "config": dataclasses.asdict(job.config),
        "versions": versions(),
    }


def _tell(report: dict[str, Any], errors: dict[str, float | None], options: argparse.Namespace) -> None:
    speed = report["frames_per_second"]
    print(
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + "".join(f", {report['status'][name]} {name}" for name in ("lost", "searching"))
        + "".join(f", {_in_words(name, value)}" for name, value in errors.items() if value is not None)
        + f"\nresults in {options.out}: track.csv, track.npz, report.json, summary.png"
        + (", overlay.mp4" if options.video else "")
    )


def _in_words(name: str, value: float) -> str:
    """`mean joint error 1.5 mm` of `mean_joint_error_mm`."""
    *words, unit = name.split("_")
    return f"{' '.join(words)} {value:.1f} {unit}"
