"""What a run leaves in its folder: `track.csv`, `track.npz`, `report.json`, and `checkpoint/` to continue from."""

import argparse
import csv
import json
import math
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.app.output_folder import OutputFolder, reason
from jaxfilters.trackers.app.progress import note
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError, OutputError
from jaxfilters.trackers.tracker import STATUS_NAMES

CHECKPOINT_EVERY_S = 2.0
"""Seconds between checkpoints of what has no chunks; what was tracked since the last is tracked again after a crash."""
_NUM_FRAMES = "num_frames"
"""Of the rows in a file of a checkpoint, beside the fields of the track."""


class Columns(NamedTuple):
    """Neighbouring columns of `track.csv`."""

    names: tuple[str, ...]
    """With their units: `x_m`, `yaw_std_rad`."""
    values: Callable[[Any], np.ndarray]
    """`track -> (rows,)` or `(rows, len(names))` numbers or words."""


class TrackTable(NamedTuple):
    """How the track of one kind of tracker becomes rows of `track.csv` and arrays of `track.npz`."""

    track: Callable[..., Any]
    """A named tuple of arrays, rows first, with `times_s`, and with `status` last. A tracker of one object has a row a
    frame. One of several has a row an object and frame, and the frame of each row in the field `frame`."""
    parts: tuple[Columns, ...]
    """Of a row, between the time and the status."""
    status_names: tuple[str, ...] = STATUS_NAMES
    """Words for the integers in `status`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns between the time and the status."""
        return tuple(name for part in self.parts for name in part.names)

    def rows(self, first: int, track: Any) -> Iterator[tuple[Any, ...]]:
        """Rows of `track.csv`; `first` is the number of the first frame."""
        frames = getattr(track, "frame", first + np.arange(len(track.times_s)))
        cells = [part.values(track).reshape(len(frames), len(part.names)) for part in self.parts]
        for i, (frame, time_s, status) in enumerate(zip(frames, track.times_s, track.status, strict=True)):
            texts = (_text(value) for part in cells for value in part[i])
            yield (int(frame), f"{time_s:.6f}", *texts, self.status_names[int(status)])


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.9g}"


class _Part(NamedTuple):
    """Rows of neighbouring frames."""

    first: int
    frames: int
    track: Any


class TrackWriter:
    """Appends rows to `track.csv` as frames are done, and saves the state with them at checkpoints.

    Neither the cost of a checkpoint nor the memory depends on how many came before it: rows are saved once, in a file a
    checkpoint, and are read again at the end. `begin` and `resume` make a writer; `close` lets go of its folder.
    """

    def __init__(self, folder: OutputFolder, run: dict[str, Any], table: TrackTable, done: list[_Part]):
        self._folder, self._path, self._run, self._table = folder, folder.path, run, table
        self._saved, self._unsaved = [part.first for part in done], list[_Part]()
        self.frames = self.frames_saved = sum(part.frames for part in done)
        """How many frames were appended so far, and how many of them are in a checkpoint."""
        rows = [("frame", "time_s", *table.columns, "status")]
        self._write_rows(rows + [row for part in done for row in _rows_of(self._path, part, table)], "w")

    @property
    def results(self) -> Any:
        """The rows of all frames so far, at least one frame.

        Raises:
            CheckpointError: a file of the checkpoint is gone or damaged.
        """
        parts = [_read_part(self._path, first, self._table).track for first in self._saved]
        return _joined([*parts, *(part.track for part in self._unsaved)])

    def append(self, times_s: np.ndarray, track: Any) -> Any:
        """Add frames of a tracker of one object: a row each in `track.csv`, on disk when this returns; the rows."""
        rows = jax.tree.map(np.asarray, self._table.track(np.asarray(times_s), *track))
        self.append_rows(len(times_s), rows)
        return rows

    def append_rows(self, frames: int, track: Any) -> None:
        """Add any number of rows, of so many further frames."""
        self._write_rows(self._table.rows(self.frames, track), "a")
        self._unsaved.append(_Part(self.frames, frames, track))
        self.frames += frames

    def checkpoint(self, state: Any, *, complete: bool = False) -> None:
        """Save `state` with everything appended so far; `complete` marks the last one of a recording."""
        meta = {"run": self._run, "frames": self.frames, "complete": complete}
        with self._explained(folder := _checkpoint_folder(self._path)):
            folder.mkdir(exist_ok=True)
            if self.frames > self.frames_saved:
                rows = _joined([part.track for part in self._unsaved])
                _write_part(self._path, _Part(self.frames_saved, self.frames - self.frames_saved, rows))
            # The state comes last: rows without it are written again.
            checkpoint.save(checkpoint.state_path(self._path), state, meta)
        if self.frames > self.frames_saved:
            self._saved.append(self.frames_saved)
        self.frames_saved, self._unsaved = self.frames, []

    def finish(self, report: dict[str, Any], track: Any = None, **arrays: np.ndarray) -> None:
        """Write `track.npz`, with other `arrays` beside the track, and `report.json`.

        Args:
            report: JSON-able.
            track: Rows that replace those in `track.csv`, all or nothing; None keeps them.
            arrays: By name.
        """
        results = self.results
        if track is not None:
            header = ("frame", "time_s", *self._table.columns, "status")
            partial = self._path / "track.csv.partial"
            self._write_rows([header, *self._table.rows(0, track)], "w", partial)
            with self._explained(self._path / "track.csv"):
                partial.replace(self._path / "track.csv")
        with self._explained(self._path / "track.npz"):
            checkpoint.write_npz(self._path / "track.npz", (results if track is None else track)._asdict() | arrays)
        with self._explained(self._path / "report.json"):
            (self._path / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        if self.frames_saved == self.frames and len(self._saved) > 1:
            with self._explained(_checkpoint_folder(self._path)):
                _write_part(self._path, _Part(0, self.frames, results))
                for first in self._saved[1:]:
                    _part_path(self._path, first).unlink(missing_ok=True)
                self._saved = [0]

    def kept(self) -> str:
        """A sentence for people: what of this run is safe, and how to go on."""
        if self.frames_saved:
            path = _checkpoint_folder(self._path)
            return f"the first {self.frames_saved} frames are kept in {path}; continue with --resume"
        if self.frames:
            return f"the first {self.frames} frames are in {self._path / 'track.csv'}"
        return "nothing was kept"

    def close(self) -> None:
        """Let other runs write into the folder."""
        self._folder.close()

    def _write_rows(self, rows: Iterable[tuple[Any, ...]], mode: str, path: Path | None = None) -> None:
        path = path or self._path / "track.csv"
        with self._explained(path), path.open(mode, newline="") as file:
            csv.writer(file).writerows(rows)

    @contextmanager
    def _explained(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {path}: {reason(error)}; {self.kept()}.") from error


def begin(folder: Path, run: dict[str, Any], table: TrackTable, *, overwrite: bool = False) -> TrackWriter:
    """A writer for a new run in `folder`, which is made if need be.

    Args:
        folder: where the results go.
        run: what must be equal for a run to be continued (input, configuration, versions), JSON-able.
        table: how rows are written.
        overwrite: discard an unfinished run that lies there.

    Raises:
        CheckpointError: an unfinished run lies there, and `overwrite` is false.
        OutputError: the folder cannot be written, or another run writes into it.
    """
    output = OutputFolder(folder)
    try:
        path = checkpoint.state_path(folder)
        if not overwrite and path.exists() and not (meta := checkpoint.load_meta(path))["complete"]:
            raise CheckpointError(
                f"{folder} holds an unfinished run of {meta['frames']} frames: continue it with --resume, "
                f"choose another --out, or delete {path.parent}."
            )
        shutil.rmtree(_checkpoint_folder(folder), ignore_errors=True)
        return TrackWriter(output, run, table, [])
    except BaseException:
        output.close()
        raise


def open_writer(options: argparse.Namespace, run: dict[str, Any], table: TrackTable) -> tuple[TrackWriter, Any | None]:
    """The writer of a command, and the state where `--resume` goes on from one; None where it begins anew.

    Raises:
        CheckpointError: `--resume` does not fit what lies in the folder, or is missing.
        OutputError: the folder cannot be written, or another run writes into it.
    """
    if options.resume and can_resume(options.out):
        writer, saved = resume(options.out, run, table)
        note(f"continuing after frame {writer.frames} of {options.out}")
        return writer, saved
    if options.resume:
        note(f"nothing to resume in {options.out}: starting with the first frame")
    return begin(options.out, run, table, overwrite=options.overwrite), None


def resume(folder: Path, run: dict[str, Any], table: TrackTable) -> tuple[TrackWriter, Any]:
    """A writer where the last checkpoint in `folder` left off, and the state of the tracker then.

    Args:
        folder: where the results are.
        run: must equal that of the run that is continued.
        table: how rows are written.

    Returns:
        The writer, and the state as `TrackWriter.checkpoint` was given it.

    Raises:
        CheckpointError: the checkpoint is damaged, or of another input, configuration or version.
        OutputError: the folder cannot be written, or another run writes into it.
    """
    output = OutputFolder(folder)
    try:
        checkpoint.check_same_run(folder, run)
        state, meta = checkpoint.load(checkpoint.state_path(folder))
        return TrackWriter(output, run, table, _saved_parts(folder, table, meta["frames"])), state
    except BaseException:
        output.close()
        raise


def versions() -> dict[str, str]:
    """What a run was made with, for its report."""
    return {
        "jaxfilters": version("jaxfilters"),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def finite(value: float) -> float | None:
    """A number for JSON; None for one that is not finite."""
    return round(value, 3) if math.isfinite(value) else None


def can_resume(folder: Path) -> bool:
    """Whether `folder` holds a checkpoint."""
    return checkpoint.state_path(folder).exists()


def _saved_parts(folder: Path, table: TrackTable, frames: int) -> list[_Part]:
    """The rows of the first `frames` frames; files of later ones were written without a state, and are ignored."""
    parts: list[_Part] = []
    done = 0
    while done < frames:
        parts.append(part := _read_part(folder, done, table))
        if not 0 < part.frames <= frames - done:
            path = _part_path(folder, done)
            raise CheckpointError(f"{path}: expected at most {frames - done} frames; got {part.frames}.")
        done += part.frames
    return parts


def _write_part(folder: Path, part: _Part) -> None:
    checkpoint.write_npz(_part_path(folder, part.first), part.track._asdict() | {_NUM_FRAMES: np.asarray(part.frames)})


def _read_part(folder: Path, first: int, table: TrackTable) -> _Part:
    arrays = checkpoint.read_arrays(path := _part_path(folder, first))
    frames = arrays.pop(_NUM_FRAMES, np.asarray(-1))
    try:
        track = table.track(**arrays)
    except TypeError:
        raise CheckpointError(f"{path}: arrays of another tracker, {sorted(arrays)}.") from None
    lengths = {len(array) if array.ndim else 0 for array in track}
    has_row_a_frame = "frame" not in arrays
    if len(lengths) != 1 or frames.ndim or (has_row_a_frame and lengths != {int(frames)}):
        raise CheckpointError(f"{path}: expected rows of {frames} frames in all arrays; got {lengths}.")
    return _Part(first, int(frames), track)


def _rows_of(folder: Path, part: _Part, table: TrackTable) -> list[tuple[Any, ...]]:
    """Rows of `track.csv` of what a file of the checkpoint holds.

    Raises:
        CheckpointError: shapes or types from which no rows of this table can be made.
    """
    try:
        return list(table.rows(part.first, part.track))
    except (IndexError, TypeError, ValueError):
        raise CheckpointError(f"{_part_path(folder, part.first)}: arrays of another tracker.") from None


def _joined(tracks: list[Any]) -> Any:
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *tracks)


def _checkpoint_folder(folder: Path) -> Path:
    return folder / "checkpoint"


def _part_path(folder: Path, first: int) -> Path:
    return _checkpoint_folder(folder) / f"rows_{first:08d}.npz"
