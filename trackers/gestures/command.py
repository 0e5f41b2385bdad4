"""`jaxfilters fit gestures` and `jaxfilters recognise`: symbols estimated from strokes, and strokes recognised."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from jaxfilters.models.gesture.calibration import calibration_error
from jaxfilters.models.gesture.coded import codes_of, recognise_each
from jaxfilters.models.gesture.learning import (
    Evaluated,
    Settings,
    accuracy,
    calibrated,
    cross_calibrated,
    evaluated,
    learn_strokes,
    leave_one_out,
    together,
)
from jaxfilters.models.gesture.stroke import Drawn, to_judge
from jaxfilters.models.gesture.symbols import Recognition, extended, recognise_all
from jaxfilters.models.synthetic.strokes import drawn, tracked
from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.gestures.options import SHOWN_SEED, TRIALS, WRITERS
from jaxfilters.trackers.gestures.streaming import fit_streams, recognise_streams
from jaxfilters.trackers.gestures.table import table_lines, write_table
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.gesture_models import DEFAULT_FILE, SymbolsFile, read_symbols, write_symbols
from jaxfilters.trackers.io.strokes import StrokeSet, read_strokes, usable

COLUMNS = ("stroke", "symbol", "confidence", "lead_nats", "label")
"""Of a table: the symbol is empty where a stroke is rejected; the label is what the data call it."""
_MOST_WARNINGS = 5
_SHOWN_TRIALS = 2
MARGINS = (-0.4, -0.2, 0.0, 0.2, 0.4)
"""Nats a point, for the table of people left out."""


def fit_gestures(options: argparse.Namespace) -> str:
    """Learn symbols, write `options.out`, and say in a few lines what they are.

    Training is in double precision, so that the same examples give the same model on every machine.

    Raises:
        InputError: the strokes cannot be used, or do not go with the model that they are added to.
        OutputError: the model cannot be written.
    """
    if options.stream:
        return fit_streams(options)
    if options.held_out == "sequence":
        raise InputError("--held-out sequence goes with --stream.")
    if options.add and options.states:
        raise InputError("--states: of no use with --add, where all models have as many states.")
    with jax.enable_x64(True):
        examples, source = _examples(options)
        # The generator draws every shape in one way.
        num_variants = 1 if options.ways is None and not options.data else options.ways
        if "" in examples.labels:
            raise InputError(f"{source}: stroke {examples.ids[examples.labels.index('')]} has no label.")
        before = read_symbols(_model(options.add)) if options.add else None
        if before and before.dimensions != examples.dimensions:
            raise InputError(
                f"--add: {options.add} has models of {_features(before.dimensions)}, DATA are for models of "
                f"{_features(examples.dimensions)}."
            )
        # What is added has states and a floor of variances like what is there.
        states = before.symbols.models.log_initial.shape[-1] if before else options.states
        settings = Settings(states, num_variants, before.min_variance if before else None)
        drawings = (examples.strokes, examples.labels, examples.people)
        trained = as_input_error(lambda: learn_strokes(*drawings[:2], settings))
        lines = []
        if options.held_out:
            found = as_input_error(lambda: leave_one_out(*drawings, settings=settings))
            trained = as_input_error(lambda: calibrated(trained, together([one.scores for one in found])))
            lines = _of_held_out(evaluated(found))
        elif options.data:
            trained = as_input_error(lambda: cross_calibrated(trained, *drawings, settings))
        parameters = {"strokes": len(examples.strokes), "people": len(set(examples.people))}
        symbols = as_input_error(lambda: extended(before.symbols, trained)) if before else trained
        source = f"{before.source}; {source}" if before else source
        write_symbols(options.out, SymbolsFile(symbols, source, parameters))
        num_models, num_states = symbols.models.log_initial.shape
        summary = [
            f"{source}: {len(examples.strokes)} strokes of {len(trained.names)} symbols",
            f"{len(symbols.names)} symbols, {num_models} models of {num_states} states",
        ]
    return "\n".join([*summary, *lines, f"model in {options.out}"])


def recognise(options: argparse.Namespace) -> str:
    """Say which symbols strokes are; with `options.out` also write that there, a row for each stroke.

    Raises:
        InputError: the model or the strokes cannot be used.
        OutputError: the table cannot be written.
    """
    if options.stream:
        return recognise_streams(options)
    path = _model(options.model)
    file = read_symbols(path)
    if options.data is None and file.dimensions == 3:
        raise InputError(f"{path} is of strokes in space: DATA must hold some.")
    seed = SHOWN_SEED if options.seed is None else options.seed
    strokes = _to_recognise(options.data) if options.data else _drawn(1, _SHOWN_TRIALS, seed)
    found = as_input_error(lambda: _evaluated(file, strokes, options.margin or 0.0))
    rows = [_row(file.symbols.names, strokes, found, i) for i in range(len(strokes.strokes))]
    if options.out:
        write_table(options.out, COLUMNS, rows)
    lines = [*table_lines(COLUMNS, rows), _summary(strokes, file.symbols.names, found)]
    return "\n".join([*lines, *([f"table in {options.out}"] if options.out else [])])


def _model(path: Path) -> Path:
    """The file of a model; that of the package where `default` is given."""
    return DEFAULT_FILE if str(path) == "default" else path


def _features(dimensions: int) -> str:
    if not dimensions:
        return "direction codes and numbers of fingertips"
    return f"the shapes of strokes in {dimensions} dimensions ({3 * dimensions + 2} features a point)"


def _warned(path: Path, warnings: Sequence[str]) -> None:
    for text in warnings[:_MOST_WARNINGS]:
        warn(text)
    if len(warnings) > _MOST_WARNINGS:
        warn(f"{path}: {len(warnings) - _MOST_WARNINGS} more such strokes")


def _to_recognise(path: Path) -> StrokeSet:
    strokes = read_strokes(path)
    _warned(path, [*strokes.warnings, *(f"{fault}; it is rejected" for fault in strokes.faults if fault)])
    return strokes


def _examples(options: argparse.Namespace) -> tuple[StrokeSet, str]:
    if options.data:
        examples = usable(read_strokes(options.data))
        _warned(options.data, examples.warnings)
        return examples, options.data.name
    return _drawn(WRITERS, TRIALS, options.seed), "symbols drawn by the generator"


def _drawn(num_writers: int, num_trials: int, seed: int) -> StrokeSet:
    """Twelve shapes with one finger and with two, by writers of consecutive seeds."""
    strokes: list[Drawn] = []
    labels: list[str] = []
    people: list[str] = []
    for writer in range(seed, seed + num_writers):
        found = tracked(drawn(writer % 2**63, num_trials))
        strokes += [([points], int(label[-1])) for (points, _), label in zip(found.paths, found.labels, strict=True)]
        labels += found.labels
        people += [f"writer {writer}"] * len(found.labels)
    ids = tuple(str(i) for i in range(len(strokes)))
    return StrokeSet(tuple(strokes), ids, tuple(labels), tuple(people), 2)


def _evaluated(file: SymbolsFile, strokes: StrokeSet, margin: float) -> Recognition:
    if file.dimensions:
        return recognise_all(file.symbols, to_judge(strokes.strokes, file.dimensions), margin=margin)
    if strokes.dimensions != 2:
        raise ValueError("models of direction codes know strokes in a plane; these are in space.")
    paths = [np.concatenate([np.zeros((0, 2)), *pieces]) for pieces, _ in strokes.strokes]
    counts = [np.full(len(path), fingers) for path, (_, fingers) in zip(paths, strokes.strokes, strict=True)]
    usable = [path if np.isfinite(path).all() else path[:0] for path in paths]
    codes = [(own, count[: len(own)]) for own, count in zip(codes_of(usable), counts, strict=True)]
    return recognise_each(file.symbols, codes, margin=margin)


def _row(names: tuple[str, ...], strokes: StrokeSet, found: Recognition, i: int) -> tuple[str, ...]:
    label = int(found.label[i])
    confidence, lead = float(found.confidence[:, i].max()), float(found.lead[i])
    found_symbol = (names[label], f"{confidence:.3f}") if label >= 0 else ("", "")
    return strokes.ids[i], *found_symbol, f"{lead:.3f}" if np.isfinite(lead) else "", strokes.labels[i]


def _summary(strokes: StrokeSet, names: tuple[str, ...], found: Recognition) -> str:
    """Of strokes with a label: how many are right as `fit gestures --held-out` counts them."""
    accepted, labels = np.asarray(found.label) >= 0, np.array(strokes.labels)
    summary = f"{len(labels)} strokes, {np.sum(~accepted)} rejected"
    labelled = labels != ""
    if not labelled.any():
        return summary
    best = np.array(names)[np.argmax(found.log_likelihood, axis=0)]
    # A stroke without features has no symbol.
    right = (best == labels)[labelled] & np.isfinite(np.asarray(found.lead))[labelled]
    share = f"{100 * right.mean():.2f} % right if none is rejected"
    return f"{summary}; of {labelled.sum()} with a label {share}; {_of_accepted(right, accepted[labelled])}"


def _of_held_out(found: list[Evaluated]) -> list[str]:
    """What `recognise` does with strokes of people whom a model does not know, for several margins."""
    right, confidence, beyond = (
        np.concatenate([getattr(one, name) for one in found]) for name in ("right", "confidence", "beyond")
    )
    lines = [
        f"people left out in turn: {accuracy(found):.2f} % right if none is rejected; "
        f"{_of_accepted(right, beyond >= 0)}; confidence is off by {calibration_error(confidence, right):.3f}",
        "  --margin  accepted  right of these",
    ]
    for margin in MARGINS:
        accepted = beyond >= margin
        share = f"{100 * right[accepted].mean():.2f} %" if accepted.any() else "-"
        lines.append(f"  {margin:8.2f}  {100 * accepted.mean():6.2f} %  {share}")
    for one in found:
        own = f"{100 * one.right.mean():.1f} % of {len(one.right)}"
        lines.append(f"  {one.person}: {own}; {_of_accepted(one.right, one.beyond >= 0)}")
    return lines


def _of_accepted(right: np.ndarray, accepted: np.ndarray) -> str:
    share = f", {100 * right[accepted].mean():.2f} % of these right" if accepted.any() else ""
    return f"{100 * accepted.mean():.2f} % accepted{share}"
