"""`jaxfilters track hand-depth` and `jaxfilters demo`."""

import argparse
import dataclasses
import math
import platform
import sys
import time
from collections import Counter
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from jaxfilters.trackers import hand_depth
from jaxfilters.trackers.depth_sequence import DepthSequence, InputError
from jaxfilters.trackers.shell.depth_files import open_depth
from jaxfilters.trackers.shell.draw import write_overlay
from jaxfilters.trackers.shell.progress import ProgressLine
from jaxfilters.trackers.shell.results import OutputError, TimedTrack, TrackWriter, begin, can_resume, resume
from jaxfilters.trackers.shell.session import Progress, follow
from jaxfilters.trackers.shell.summary import mean_joint_error, write_summary
from jaxfilters.trackers.tracker import STATUS_NAMES, SequenceTracker


def track_hand(options: argparse.Namespace) -> None:
    """Follow a hand as the command line says, and leave the results in `options.out`.

    Raises:
        InputError: the recording or an option cannot be used.
        CheckpointError: `--resume` does not fit what lies in the folder, or is missing.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text.
    """
    began = time.perf_counter()
    config = _config(options)
    sequence = open_depth(options.input) if options.input else _synthetic(config.seed)
    tracker = _tracker(sequence, config)
    state = tracker.start(jax.random.key(config.seed), sequence[0])
    writer, state = _writer(options, _identity(sequence, config), state)
    try:
        rate = _follow(sequence, tracker, state, writer)
        report = _report(sequence, writer.results, rate, time.perf_counter() - began, config)
        writer.finish(report)
        _write_pictures(options, sequence, writer, rate)
    except InputError as error:
        raise InputError(_with_what_is_kept(error, writer)) from None
    except KeyboardInterrupt:
        raise KeyboardInterrupt(writer.kept()) from None
    _tell(report, options)


def _config(options: argparse.Namespace) -> hand_depth.HandDepthConfig:
    names = (field.name for field in dataclasses.fields(hand_depth.HandDepthConfig))
    given = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    try:
        return hand_depth.HandDepthConfig(**given)
    except ValueError as error:
        raise InputError(str(error)) from None


def _synthetic(seed: int) -> DepthSequence:
    sequence, joints = hand_depth.synthetic_sequence(seed)
    return dataclasses.replace(sequence, joints=np.asarray(joints))


def _tracker(sequence: DepthSequence, config: hand_depth.HandDepthConfig) -> SequenceTracker:
    try:
        return hand_depth.build(sequence.camera, config)
    except ValueError as error:
        raise InputError(str(error)) from None


def _identity(sequence: DepthSequence, config: hand_depth.HandDepthConfig) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    return {
        "input": sequence.fingerprint(),
        "version": version("jaxfilters"),
        **{f"config.{name}": value for name, value in dataclasses.asdict(config).items()},
    }


def _writer(options: argparse.Namespace, run: dict[str, Any], state: Any) -> tuple[TrackWriter, Any]:
    if options.resume and can_resume(options.out):
        writer, state = resume(options.out, run, state)
        print(f"continuing after frame {writer.frames} of {options.out}", file=sys.stderr)
        return writer, state
    if options.resume:
        print(f"nothing to resume in {options.out}: starting with the first frame", file=sys.stderr)
    return begin(options.out, run, overwrite=options.overwrite), state


def _follow(sequence: DepthSequence, tracker: SequenceTracker, state: Any, writer: TrackWriter) -> float:
    with ProgressLine("tracking", len(sequence)) as line:

        def show(progress: Progress) -> None:
            speed = "" if math.isnan(progress.frames_per_second) else f"{progress.frames_per_second:.0f} frames/s  "
            line.show(progress.done, speed + progress.status)

        return follow(sequence, tracker, state, writer, show)


def _write_pictures(options: argparse.Namespace, sequence: DepthSequence, writer: TrackWriter, rate: float) -> None:
    results = writer.results
    try:
        if options.video:
            with ProgressLine("drawing", len(results.times_s)) as line:
                write_overlay(options.out / "overlay.mp4", sequence, results, rate, line.show)
        write_summary(options.out / "summary.png", sequence, results)
    except OutputError as error:
        raise OutputError(_with_what_is_kept(error, writer)) from None


def _with_what_is_kept(error: Exception, writer: TrackWriter) -> str:
    return f"{str(error).removesuffix('.')}; {writer.kept()}."


def _report(
    sequence: DepthSequence,
    results: TimedTrack,
    rate: float,
    seconds: float,
    config: hand_depth.HandDepthConfig,
) -> dict[str, Any]:
    counts = Counter(STATUS_NAMES[int(status)] for status in results.status)
    error = mean_joint_error(sequence, results)
    evidence = float(np.nansum(results.log_evidence, dtype=float))
    return {
        "input": sequence.name,
        "frames": len(results.times_s),
        "frames_per_second": None if math.isnan(rate) else round(rate, 2),
        "seconds": round(seconds, 2),
        "status": {name: counts[name] for name in STATUS_NAMES},
        "log_evidence": evidence if math.isfinite(evidence) else None,
        "mean_joint_error_mm": None if error is None else round(1000 * error, 2),
        "config": dataclasses.asdict(config),
        "versions": {
            "jaxfilters": version("jaxfilters"),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def _tell(report: dict[str, Any], options: argparse.Namespace) -> None:
    speed, error = report["frames_per_second"], report["mean_joint_error_mm"]
    print(
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + "".join(f", {report['status'][name]} {name}" for name in ("lost", "searching"))
        + (f", mean joint error {error:.1f} mm" if error is not None else "")
        + f"\nresults in {options.out}: track.csv, track.npz, report.json, summary.png"
        + (", overlay.mp4" if options.video else "")
    )
