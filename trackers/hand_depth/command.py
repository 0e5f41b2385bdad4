"""`jaxfilters track hand-depth` and `jaxfilters demo`."""

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.app.run import RunSpec, run
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.detect import check_unit
from jaxfilters.trackers.hand_depth.drawing import depth_range, draw_hand, write_overlay
from jaxfilters.trackers.hand_depth.recording import DepthSequence
from jaxfilters.trackers.hand_depth.summary import mean_joint_error, write_summary
from jaxfilters.trackers.hand_depth.table import HAND_TABLE, TimedHandTrack
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import as_input_error


def track(options: argparse.Namespace) -> str:
    """Track as the command line says, leave the results in `options.out`, and report in a few lines.

    Raises:
        InputError: the recording or an option cannot be used.
        OutputError: the results cannot be written.
        CheckpointError: what lies in the folder does not fit.
    """
    return run(spec(options), options)


def spec(options: argparse.Namespace) -> RunSpec:
    """A hand in a depth recording, as the command line says.

    Raises:
        InputError: the recording or an option cannot be used.
    """
    config = as_input_error(partial(config_from_args, HandDepthConfig(), options))
    sequence = open_depth(options.input) if options.input else _synthetic(config.seed)
    if warning := as_input_error(partial(check_unit, sequence[0])):
        warn(f"{sequence.name}: {warning}")
    return RunSpec(
        sequence,
        as_input_error(partial(hand_depth.build, sequence.camera, config)),
        config,
        HAND_TABLE,
        partial(_errors, sequence),
        partial(_draw_summary, sequence),
        partial(_draw_overlay, sequence),
        partial(_pictures, sequence),
    )


def _synthetic(seed: int) -> DepthSequence:
    sequence, joints = hand_depth.synthetic_sequence(seed)
    return dataclasses.replace(sequence, joints=np.asarray(joints))


def _errors(sequence: DepthSequence, results: TimedHandTrack) -> dict[str, float | None]:
    error = mean_joint_error(sequence, results)
    return {"mean_joint_error_m": None if error is None else round(error, 5)}


def _draw_summary(sequence: DepthSequence, path: Path, results: TimedHandTrack) -> None:
    write_summary(path, sequence, results)


def _draw_overlay(
    sequence: DepthSequence, path: Path, results: TimedHandTrack, rate: float, on_progress: Callable[[int], None]
) -> None:
    write_overlay(path, sequence, results, rate, on_progress)


def _pictures(
    sequence: DepthSequence, first: int, frames: list[np.ndarray], rows: TimedHandTrack
) -> Iterator[np.ndarray]:
    limits = depth_range(rows.joints)
    for i, frame in enumerate(frames):
        truth = None if sequence.joints is None else sequence.joints[first + i]
        yield draw_hand(frame, sequence.camera, rows.joints[i], limits, truth)
