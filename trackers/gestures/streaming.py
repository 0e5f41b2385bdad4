"""`jaxfilters fit gestures --stream` and `recognise --stream`: gestures in streams of points, such as hands' joints."""

import argparse

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
from jaxfilters.trackers.gestures.table import table_lines, write_table
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.gesture_streams import StreamSet, read_stream_model, read_streams, write_stream_model

COLUMNS = ("stream", "gesture", "first_frame", "last_frame", "start_s", "end_s", "reported_s", "confidence")


def fit_streams(options: argparse.Namespace) -> str:
    """Estimate a model of gestures in streams, write `options.out`, and say in a few lines what it is.

    Raises:
        InputError: the streams cannot be used.
        OutputError: the model cannot be written.
    """
    if options.data is None:
        raise InputError("--stream: expected DATA, a file or folder of streams.")
    _refuse(options, "add", "states", "ways")
    if options.held_out == "person":
        raise InputError("--held-out person: of no use with --stream; expected --held-out sequence.")
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
    _refuse(options, "margin", "seed")
    if str(options.model) == "default":
        raise InputError(
            "default: the package has no model of gestures in streams; make one with "
            "`jaxfilters fit gestures --stream DATA --out MODEL.npz`, from streams with annotated gestures."
        )
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
    summary = [f"{len(rows)} gestures in {len(data.streams)} streams"]
    if scores:
        annotated = [stream for stream in data.streams if stream.segments]
        summary.append(_said(total(scores), _minutes(annotated)))
    if options.out:
        write_table(options.out, COLUMNS, rows)
        summary.append(f"table in {options.out}")
    return "\n".join([*table_lines(COLUMNS, rows), *summary])


def _refuse(options: argparse.Namespace, *names: str) -> None:
    """Refuse options that are for strokes.

    Raises:
        InputError: one of them is given.
    """
    given = [f"--{name}" for name in names if getattr(options, name) is not None]
    if given:
        raise InputError(f"{', '.join(given)}: of no use with --stream, only for strokes.")


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
