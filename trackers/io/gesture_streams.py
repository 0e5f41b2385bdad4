"""Streams of points with annotated gestures, and models of gestures in streams, on disk.

A file of streams is an `.npz`, or a folder of them, with

- `points` (F, J, d): J points in two or three dimensions in every frame of all streams, one stream after the other; a
  frame with NaN is not observed. Or `delta_1e5` (J, c, F), integers: their differences from frame to frame in units of
  1e-5, the first three of the c channels being positions.
- `length` (n,): frames of each stream. Without it there is one stream.
- `annotations` (m, 4): rows of stream, gesture, first frame, last frame. Streams are numbered as `seq_id` (n,) says,
  from 0 without it. Or `gesture` (n,): each stream is one example of this gesture from end to end.
- `fps`: frames a second; 20 without it. `names`: of the gestures, whose numbers then count from 0; without it the
  numbers are the names.

A model holds the arrays of `StreamModel` and a `header` in JSON. `jaxfilters fit gestures --stream` writes it.
"""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.hmm import Segment, SemiMarkovModel
from jaxfilters.models.gesture.frame_classifier import DILATIONS, KERNEL, FrameClassifier
from jaxfilters.models.gesture.poses import RATE_HZ, PoseTemplate, num_features
from jaxfilters.models.gesture.streams import Stream, StreamModel
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.input_files import LARGEST, is_folder, too_large
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters gestures in streams", 1
_WANTED = "expected an .npz with points (F, J, 2 or 3) of F frames, and length, the frames of each stream"
_WANTED_MODEL = "expected an .npz of `jaxfilters fit gestures --stream`"
_ARRAYS = ("points", "delta_1e5", "length", "annotations", "seq_id", "gesture", "fps", "names")
_UNIT = 1e-5
_CHAIN = ("log_initial", "log_transition", "log_end", "log_stay")
_FASTEST_HZ = 1e4
_ROUNDING = 1e-3
"""By which probabilities of a model may miss what they sum to."""
_NUM_LEAVES = 2 + 2 * len(DILATIONS) + 2
"""Arrays of a classifier: mean and deviation of the features, two of each layer, two of the readout."""
_TEMPLATE = ("shape", "weights", "moving", "size", "speed", "bending")


class StreamSet(NamedTuple):
    """Streams, and the names of the gestures in them."""

    streams: tuple[Stream, ...]
    names: tuple[str, ...]


def read_streams(path: Path) -> StreamSet:
    """The streams of a file or of all files `.npz` in a folder.

    Raises:
        InputError: a file that cannot be read or does not fit the others, or a folder without one.
    """
    files = sorted(path.glob("*.npz")) if is_folder(path) else [path]
    if not files:
        raise InputError(f"{path}: no file .npz in this folder; {_WANTED}.")
    parts = [_read(file) for file in files]
    words = {name for _, labels in parts for name in labels}
    names = tuple(sorted(words, key=lambda word: (len(word), word) if word.isdecimal() else (0, word)))
    streams = [
        stream._replace(segments=tuple(Segment(names.index(labels[s.label]), s.start, s.end) for s in stream.segments))
        for own, labels in parts
        for stream in own
    ]
    return StreamSet(tuple(streams), names)


def _read(path: Path) -> tuple[list[Stream], list[str]]:
    arrays = read_npz(path, _WANTED, _ARRAYS)
    points = _points(arrays, path)
    lengths = np.atleast_1d(arrays.get("length", np.array(len(points))))
    is_whole = lengths.dtype.kind in "iu" and lengths.ndim == 1
    # As Python's integers, which do not overflow.
    if not is_whole or np.any(lengths < 1) or sum(lengths.tolist()) != len(points):
        got = shown(lengths.tolist())
        raise InputError(f"{path}: length must be frames of streams, {len(points)} together; got {got}.")
    firsts = np.cumsum(lengths) - lengths
    pieces = [points[first : first + length] for first, length in zip(firsts, lengths, strict=True)]
    if "points" not in arrays:
        pieces = [_UNIT * np.cumsum(piece, axis=0) for piece in pieces]
    rate = _rate(arrays.get("fps", np.asarray(RATE_HZ)), path)
    rows = _annotations(arrays, lengths, path)
    numbers = sorted({row[1] for row in rows})
    words = [str(word) for word in np.atleast_1d(arrays.get("names", np.array([])))]
    if words and numbers and not 0 <= numbers[0] <= numbers[-1] < len(words):
        raise InputError(f"{path}: annotations must have gestures from 0 to {len(words) - 1}; got {numbers[-1]}.")
    labels = words or [str(number) for number in numbers]
    streams = []
    for i, piece in enumerate(pieces):
        own = [row for row in rows if row[0] == i]
        segments = tuple(Segment(g if words else numbers.index(g), first, last) for _, g, first, last in own)
        streams.append(Stream(piece, rate, segments, f"{path.stem} {i}"))
    return streams, labels


def _points(arrays: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Points, or their differences, frames first."""
    if "points" in arrays:
        points = arrays["points"]
        points = points[:, None] if points.ndim == 2 else points
    elif "delta_1e5" in arrays and arrays["delta_1e5"].ndim == 3:
        points = np.moveaxis(arrays["delta_1e5"][:, :3], -1, 0)
    else:
        raise InputError(f"{path}: without points; {_WANTED}.")
    if points.dtype.kind not in "iuf" or points.ndim != 3 or points.shape[2] not in (2, 3) or not points.size:
        raise InputError(f"{path}: points must be numbers (F, J, 2 or 3); got {points.shape} {points.dtype}.")
    if (wrong := too_large(points)).any():
        got = points[wrong][0]
        raise InputError(f"{path}: points must be numbers of at most {LARGEST:g}, or NaN; got {got}.")
    return points.astype(float)


def _rate(fps: np.ndarray, path: Path) -> float:
    """Frames a second, the same of all streams."""
    rates = np.unique(fps)
    if fps.dtype.kind not in "iuf" or len(rates) != 1 or not 0 < rates[0] < _FASTEST_HZ:
        got = shown(fps.tolist())
        raise InputError(
            f"{path}: fps must be one number of frames a second, above 0, below {_FASTEST_HZ:g}; got {got}."
        )
    return float(rates[0])


def _annotations(arrays: dict[str, np.ndarray], lengths: np.ndarray, path: Path) -> list[tuple[int, int, int, int]]:
    """Rows of stream (from 0), gesture, first and last frame."""
    if "annotations" in arrays:
        table = arrays["annotations"]
        numbers = arrays.get("seq_id", np.arange(len(lengths)))
        are_whole = table.dtype.kind in "iu" and numbers.dtype.kind in "iu"
        if table.ndim != 2 or table.shape[1] != 4 or not are_whole or numbers.shape != lengths.shape:
            raise InputError(
                f"{path}: annotations must be integers (m, 4), rows of stream, gesture, first and last frame; "
                f"got {table.shape} {table.dtype}, of {len(lengths)} streams and seq_id {numbers.shape} "
                f"{numbers.dtype}."
            )
        place = {int(number): i for i, number in enumerate(numbers)}
        rows = [(place[int(s)], int(g), int(a), int(b)) for s, g, a, b in table if int(s) in place]
        if wrong := [row for row in rows if not 0 <= row[2] <= row[3] or row[2] >= lengths[row[0]]]:
            raise InputError(f"{path}: annotations must lie in their streams; got {wrong[0]}.")
        return [(i, g, a, min(b, int(lengths[i]) - 1)) for i, g, a, b in rows]
    if "gesture" in arrays:
        if arrays["gesture"].shape != lengths.shape or arrays["gesture"].dtype.kind not in "iu":
            raise InputError(f"{path}: gesture must be an integer for each of {len(lengths)} streams.")
        return [(i, int(g), 0, int(n) - 1) for i, (g, n) in enumerate(zip(arrays["gesture"], lengths, strict=True))]
    return []


def write_stream_model(path: Path, model: StreamModel, source: str) -> None:
    """Write a model; its folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {"format": FORMAT, "version": VERSION, "names": list(model.names), "source": source, "parameters": {}}
    leaves = jax.tree.leaves(model.classifier)
    arrays = {
        "header": np.asarray(json.dumps(header, allow_nan=False)),
        **{f"template_{name}": np.asarray(getattr(model.template, name)) for name in _TEMPLATE},
        **{f"classifier_{i}": np.asarray(leaf, np.float32) for i, leaf in enumerate(leaves)},
        **{name: np.asarray(getattr(model.durations, name), np.float32) for name in _CHAIN},
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, arrays)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def read_stream_model(path: Path) -> StreamModel:
    """A model as it was written.

    Raises:
        InputError: an unreadable or foreign file, another version, or arrays that do not fit each other.
    """
    arrays = read_npz(path, _WANTED_MODEL)
    header = read_header(arrays, path, _WANTED_MODEL, FORMAT, VERSION)
    names = header.get("names")
    needed = [*(f"template_{name}" for name in _TEMPLATE), *(f"classifier_{i}" for i in range(_NUM_LEAVES)), *_CHAIN]
    if missing := [name for name in needed if name not in arrays]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED_MODEL}.")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: names must be of one gesture or more.")
    template = _template(arrays, path)
    _check_classifier(arrays, num_features(template), len(names) + 1, path)
    _check_durations(arrays, len(names) + 1, path)
    leaves = [jnp.asarray(arrays[f"classifier_{i}"], float) for i in range(_NUM_LEAVES)]
    middle = leaves[2:-2]
    layers = tuple(zip(middle[::2], middle[1::2], strict=True))
    classifier = FrameClassifier(leaves[0], leaves[1], layers, (leaves[-2], leaves[-1]))
    log_initial, log_transition, log_end, log_stay = (jnp.asarray(arrays[name], float) for name in _CHAIN)
    durations = SemiMarkovModel(log_initial, log_transition, log_end, log_stay)
    return StreamModel(tuple(names), template, classifier, durations)


def _template(arrays: dict[str, np.ndarray], path: Path) -> PoseTemplate:
    shape = arrays["template_shape"].shape
    if len(shape) != 2 or not shape[0] or shape[1] not in (2, 3):
        raise InputError(f"{path}: template_shape must be numbers (J, 2 or 3), J points; got {shape}.")
    _check(arrays, "template_shape", shape, path)
    weights = _check(arrays, "template_weights", shape[:1], path)
    if np.any(weights < 0) or abs(weights.sum() - 1) > _ROUNDING:
        raise InputError(f"{path}: template_weights must not be negative and sum to 1; got {shown(weights.tolist())}.")
    moving = arrays["template_moving"]
    is_whole = moving.ndim == 1 and moving.size > 0 and moving.dtype.kind in "iu"
    if not is_whole or moving.min() < 0 or moving.max() >= shape[0]:
        raise InputError(
            f"{path}: template_moving must be (m,) integers from 0 to {shape[0] - 1}, places of points; "
            f"got {shown(moving.tolist())}."
        )
    scale = {name: float(_check(arrays, f"template_{name}", (), path)) for name in _TEMPLATE[3:]}
    if wrong := [name for name, value in scale.items() if value <= 0]:
        raise InputError(f"{path}: template_{wrong[0]} must be above 0; got {scale[wrong[0]]}.")
    return PoseTemplate(arrays["template_shape"], weights, moving.astype(int), **scale)


def _check_classifier(arrays: dict[str, np.ndarray], num_inputs: int, num_classes: int, path: Path) -> None:
    """That the layers follow each other, from the features of the template to the classes."""
    width = (arrays["classifier_2"].shape or (0,))[-1]
    layers = [((KERNEL, num_inputs if i == 0 else width, width), (width,)) for i in range(len(DILATIONS))]
    shapes = [(num_inputs,), (num_inputs,), *(shape for layer in layers for shape in layer)]
    for i, shape in enumerate([*shapes, (width, num_classes), (num_classes,)]):
        _check(arrays, f"classifier_{i}", shape, path)
    if np.any(arrays["classifier_1"] <= 0):
        raise InputError(
            f"{path}: classifier_1 must be standard deviations above 0; got {arrays['classifier_1'].min()}."
        )


def _check_durations(arrays: dict[str, np.ndarray], num_classes: int, path: Path) -> None:
    ages = (num_classes, *arrays["log_end"].shape[1:2])
    if len(ages) < 2 or not ages[1]:
        raise InputError(f"{path}: log_end must be ({num_classes}, D), of D frames; got {arrays['log_end'].shape}.")
    for name, shape in zip(_CHAIN, ((num_classes,), (num_classes,) * 2, ages, ages), strict=True):
        _check(arrays, name, shape, path, logs=True)
    sums = {name: np.exp(arrays[name]).sum(axis=-1) for name in ("log_initial", "log_transition")}
    sums["log_end, log_stay"] = np.exp(arrays["log_end"]) + np.exp(arrays["log_stay"])
    for name, found in sums.items():
        if np.any(abs(found - 1) > _ROUNDING):
            off = float(np.ravel(found)[np.argmax(abs(np.ravel(found) - 1))])
            raise InputError(
                f"{path}: {name} must be logarithms of probabilities that sum to 1; got a sum of {off:.4g}."
            )


def _check(
    arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], path: Path, *, logs: bool = False
) -> np.ndarray:
    """An array of this shape whose numbers are finite, or logarithms of probabilities.

    Raises:
        InputError: it is not, with the name of the array.
    """
    values = arrays[name]
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise InputError(f"{path}: {name} must be numbers {shape}; got {values.shape} {values.dtype}.")
    # The logarithm of what is impossible is -inf.
    usable = (~np.isnan(values) & ~too_large(values)) | (np.isneginf(values) if logs else np.zeros(shape, bool))
    if not np.all(usable) or (logs and np.any(values > _ROUNDING)):
        wrong = values[~usable] if not np.all(usable) else values[values > _ROUNDING]
        what = "logarithms of probabilities" if logs else "finite"
        raise InputError(f"{path}: {name} must be {what}; got {wrong.ravel()[0]}.")
    return values
