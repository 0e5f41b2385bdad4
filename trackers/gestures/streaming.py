"""`jaxfilters fit gestures --stream` and `recognise --stream`: gestures in streams of points, such as hands' joints."""

import argparse
import csv
from pathlib import Path

import jax

from jaxfilters.hmm import Segment
from jaxfilters.models.gesture.poses import RATE_HZ
from jaxfilters.models.gesture.spotting_score import Score, scored, total
from jaxfilters.models.gesture.streams import (
    LATENCY_FRAMES,
    Stream,
    StreamModel,
    learn_streams,
    leave_streams_out,
    spot,
)
from jaxfilters.trackers.io.errors import InputError, OutputError, as_input_error
from jaxfilters.trackers.io.gesture_streams import StreamSet, read_stream_model, read_streams, write_stream_model

COLUMNS = ("stream", "gesture", "first_frame", "last_frame", "start_s", "end_s", "reported_s", "confidence")
_MOST_ROWS = 40


def fit_streams(options: argparse.Namespace) -> str:
    """Estimate a model of gestures in streams, write `options.out`, and say in a few lines what it is.

    Raises:
        InputError: the streams cannot be used.
        OutputError: the model cannot be written.
    """
    if options.data is None:
        raise InputError("--stream: expected DATA, a file or folder of streams.")
    if options.add or options.held_out == "person":
        raise InputError("--stream: goes with --held-out sequence, and without --add.")
    data = read_streams(options.data)
    lines = [_of_data(data, options.data.name)]
    if options.held_out:
        lines += _held_out(data, options.seed)
    model = as_input_error(lambda: learn_streams(jax.random.key(options.seed), data.streams, data.names))
    write_stream_model(options.out, model, options.data.name)
    return "\n".join([*lines, _latency(), f"model in {options.out}"])


def recognise_streams(options: argparse.Namespace) -> str:
    """Say which gestures are in streams; with `options.out` also write that there, a row for each gesture.

    Raises:
        InputError: the model or the streams cannot be used.
        OutputError: the table cannot be written.
    """
    if options.data is None:
        raise InputError("--stream: expected DATA, a file or folder of streams.")
    model, data = read_stream_model(options.model), read_streams(options.data)
    rows, scores = [], []
    for stream in data.streams:
        found = as_input_error(lambda own=stream: spot(model, own))  # type: ignore[misc]
        for one in found:
            label, first, last = one.segment
            times = [f"{frame / stream.rate_hz:.2f}" for frame in (first, last + 1, one.reported + 1)]
            rows.append((stream.name, model.names[label], str(first), str(last), *times, f"{one.confidence:.3f}"))
        if stream.segments:
            scores.append(scored([one.segment for one in found], _in_names_of(model, data, stream)))
    widths = [max(len(row[k]) for row in [COLUMNS, *rows[:_MOST_ROWS]]) for k in range(len(COLUMNS))]
    shown = [
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
        for row in [COLUMNS, *rows[:_MOST_ROWS]]
    ]
    if len(rows) > _MOST_ROWS:
        shown.append(f"... and {len(rows) - _MOST_ROWS} more")
    summary = [f"{len(rows)} gestures in {len(data.streams)} streams"]
    if scores:
        annotated = [stream for stream in data.streams if stream.segments]
        summary.append(_said(total(scores), _minutes(annotated)))
    if options.out:
        _write(options.out, rows)
        summary.append(f"table in {options.out}")
    return "\n".join([*shown, *summary])


def _of_data(data: StreamSet, source: str) -> str:
    whole = [stream for stream in data.streams if not stream.is_example]
    return (
        f"{source}: {len(data.names)} gestures, {sum(len(own.segments) for own in whole)} in {len(whole)} streams "
        f"of {_minutes(whole):.1f} minutes, {len(data.streams) - len(whole)} examples of single ones"
    )


def _held_out(data: StreamSet, seed: int) -> list[str]:
    found = as_input_error(lambda: leave_streams_out(jax.random.key(seed), data.streams, data.names))
    pairs = [(own, stream) for own, stream in zip(found, data.streams, strict=True) if own is not None]
    scores = [scored([one.segment for one in own], stream.segments) for own, stream in pairs]
    return ["streams left out in turn: " + _said(total(scores), _minutes([stream for _, stream in pairs]))]


def _in_names_of(model: StreamModel, data: StreamSet, stream: Stream) -> list[Segment]:
    """Annotations with the labels of the model; of a gesture that it does not know, a label that is never found."""
    labels = [model.names.index(name) if name in model.names else -1 for name in data.names]
    return [segment._replace(label=labels[segment.label]) for segment in stream.segments]


def _said(score: Score, minutes: float) -> str:
    share = 100 * score.detected / max(score.total, 1)
    jaccard = sum(score.jaccard) / max(len(score.jaccard), 1)
    return (
        f"{share:.1f} % of {score.total} gestures found, {score.false_positives / minutes:.2f} false alarms a minute, "
        f"Jaccard index {jaccard:.3f}"
    )


def _latency() -> str:
    return f"a gesture is known {LATENCY_FRAMES / RATE_HZ:.2f} s after its last frame at the earliest"


def _minutes(streams: list[Stream]) -> float:
    return sum(len(stream.points) / stream.rate_hz for stream in streams) / 60


def _write(path: Path, rows: list[tuple[str, ...]]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as content:
            csv.writer(content).writerows([COLUMNS, *rows])
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None
