"""`jaxfilters track articulated`."""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.run import RunSpec, run
from jaxfilters.trackers.articulated import tracker as articulated_hand
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.drawing import draw_frame, scene, write_overlay
from jaxfilters.trackers.articulated.recording import FeatureSequence
from jaxfilters.trackers.articulated.summary import errors_of, write_summary
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack, articulated_table
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.features import open_features


def track(options: argparse.Namespace) -> str:
    """Track as the command line says, leave the results in `options.out`, and report in a few lines.

    Raises:
        InputError: the recording or an option cannot be used.
        OutputError: the results cannot be written.
        CheckpointError: what lies in the folder does not fit.
    """
    return run(spec(options), options)


def spec(options: argparse.Namespace) -> RunSpec:
    """A hand in a recording of features, as the command line says.

    Raises:
        InputError: the recording or an option cannot be used.
    """
    config = as_input_error(partial(config_from_args, ArticulatedConfig(), options))
    sequence = _sequence(options, config)
    hand = as_input_error(partial(articulated_hand.hand_model, sequence, config))
    return RunSpec(
        sequence,
        as_input_error(partial(articulated_hand.build, sequence, config)),
        config,
        articulated_table(hand.layout),
        partial(_errors, sequence, hand),
        partial(_draw_summary, sequence, hand),
        partial(_draw_overlay, sequence, hand),
        partial(_pictures, sequence, hand),
    )


def _sequence(options: argparse.Namespace, config: ArticulatedConfig) -> FeatureSequence:
    of_input = {"--image-size": options.image_size, "--noise": options.noise, "--fps": options.fps}
    if options.input is None:
        if unused := [name for name, value in of_input.items() if value is not None]:
            raise InputError(f"{', '.join(unused)}: of no use without a recording; the synthetic one has its own.")
        return articulated_hand.synthetic_sequence(config.seed)
    return open_features(
        options.input,
        hand=config.hand,
        image_size=options.image_size,
        noise_px=options.noise,
        fps=options.fps,
    )


def _errors(
    sequence: FeatureSequence, hand: ArticulatedHand, results: TimedArticulatedTrack
) -> dict[str, float | None]:
    errors = errors_of(sequence, hand.layout, results)
    return {
        "mean_angle_error_rad": None if errors is None else round(float(np.deg2rad(errors.angle_deg)), 5),
        "mean_length_error_px": None if errors is None else round(errors.length_px, 3),
        "lengths_within_2_sigma_percent": None if errors is None else round(100 * errors.within_2_sigma, 1),
    }


def _draw_summary(sequence: FeatureSequence, hand: ArticulatedHand, path: Path, results: TimedArticulatedTrack) -> None:
    write_summary(path, sequence, hand.layout, scene(sequence, hand, results), results)


def _draw_overlay(
    sequence: FeatureSequence,
    hand: ArticulatedHand,
    path: Path,
    results: TimedArticulatedTrack,
    rate: float,
    on_progress: Callable[[int], None],
) -> None:
    write_overlay(path, scene(sequence, hand, results), results, rate, on_progress)


def _pictures(
    sequence: FeatureSequence, hand: ArticulatedHand, first: int, frames: list[Any], rows: TimedArticulatedTrack
) -> Iterator[np.ndarray]:
    drawn = scene(sequence, hand, rows, first=first)
    return (draw_frame(drawn, i) for i in range(len(frames)))
