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
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.hmm import Segment, SemiMarkovModel
from jaxfilters.models.gesture.frame_classifier import DILATIONS, FrameClassifier
from jaxfilters.models.gesture.poses import RATE_HZ, PoseTemplate
from jaxfilters.models.gesture.streams import Stream, StreamModel
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters gestures in streams", 1
_WANTED = "expected an .npz with points (F, J, 2 or 3) of F frames, and length, the frames of each stream"
_WANTED_MODEL = "expected an .npz of `jaxfilters fit gestures --stream`"
_ARRAYS = ("points", "delta_1e5", "length", "annotations", "seq_id", "gesture", "fps", "names")
_UNIT = 1e-5
_CHAIN = ("log_initial", "log_transition", "log_end", "log_stay")
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
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
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
    if lengths.dtype.kind not in "iu" or lengths.ndim != 1 or np.any(lengths < 1) or lengths.sum() != len(points):
        raise InputError(f"{path}: length must be frames of streams, {len(points)} together; got {lengths.sum()}.")
    firsts = np.cumsum(lengths) - lengths
    pieces = [points[first : first + length] for first, length in zip(firsts, lengths, strict=True)]
    if "points" not in arrays:
        pieces = [_UNIT * np.cumsum(piece, axis=0) for piece in pieces]
    rate = float(np.asarray(arrays.get("fps", RATE_HZ)).reshape(-1)[0])
    if not 0 < rate < 1e4:
        raise InputError(f"{path}: fps must be frames a second, above 0; got {rate}.")
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
    return points.astype(float)


def _annotations(arrays: dict[str, np.ndarray], lengths: np.ndarray, path: Path) -> list[tuple[int, int, int, int]]:
    """Rows of stream (from 0), gesture, first and last frame."""
    if "annotations" in arrays:
        table = arrays["annotations"]
        numbers = arrays.get("seq_id", np.arange(len(lengths)))
        if table.ndim != 2 or table.shape[1] != 4 or table.dtype.kind not in "iu" or numbers.shape != lengths.shape:
            raise InputError(
                f"{path}: annotations must be integers (m, 4), rows of stream, gesture, first and last frame; "
                f"got {table.shape} {table.dtype}, of {len(lengths)} streams and seq_id {numbers.shape}."
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
    num_leaves = 2 + 2 * len(DILATIONS) + 2
    needed = [f"template_{name}" for name in _TEMPLATE] + [f"classifier_{i}" for i in range(num_leaves)] + [*_CHAIN]
    if missing := [name for name in needed if name not in arrays]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED_MODEL}.")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: names must be of one gesture or more.")
    leaves = [jnp.asarray(arrays[f"classifier_{i}"], float) for i in range(num_leaves)]
    middle = leaves[2:-2]
    layers = tuple(zip(middle[::2], middle[1::2], strict=True))
    classifier = FrameClassifier(leaves[0], leaves[1], layers, (leaves[-2], leaves[-1]))
    log_initial, log_transition, log_end, log_stay = (jnp.asarray(arrays[name], float) for name in _CHAIN)
    durations = SemiMarkovModel(log_initial, log_transition, log_end, log_stay)
    model = StreamModel(tuple(names), _template(arrays), classifier, durations)
    _check_model(model, path)
    return model


def _template(arrays: dict[str, np.ndarray]) -> PoseTemplate:
    shape, weights, moving = (np.asarray(arrays[f"template_{name}"]) for name in _TEMPLATE[:3])
    size, speed, bending = (float(np.asarray(arrays[f"template_{name}"]).reshape(-1)[0]) for name in _TEMPLATE[3:])
    return PoseTemplate(shape, weights, moving.astype(int), size, speed, bending)


def _check_model(model: StreamModel, path: Path) -> None:
    num_classes, shape = len(model.names) + 1, model.template.shape.shape
    num_features = model.classifier.mean.shape
    expected: Sequence[tuple[Any, Any]] = [
        (model.classifier.sd.shape, num_features),
        (model.classifier.layers[0][0].shape[1:2], num_features),
        (model.classifier.readout[0].shape[1:], (num_classes,)),
        (model.classifier.readout[1].shape, (num_classes,)),
        (model.durations.log_initial.shape, (num_classes,)),
        (model.durations.log_transition.shape, (num_classes, num_classes)),
        (model.durations.log_stay.shape, model.durations.log_end.shape),
        (model.durations.log_end.shape[:1], (num_classes,)),
        (model.template.weights.shape, shape[:1]),
        (len(shape), 2),
    ]
    if wrong := [pair for pair in expected if pair[0] != pair[1]]:
        raise InputError(f"{path}: arrays do not fit each other: {wrong[0][0]} for {wrong[0][1]}; {_WANTED_MODEL}.")
    numbers = [*jax.tree.leaves(model.classifier), model.template.shape, model.template.weights]
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in numbers):
        raise InputError(f"{path}: the parameters of the network must be finite.")
