"""What a run leaves in its folder: `track.csv`, `track.npz`, `report.json`, and `checkpoint/` to continue from."""

import argparse
import csv
import json
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


class Columns(NamedTuple):
    """Neighbouring columns of `track.csv`."""

    names: tuple[str, ...]
    """With their units: `x_m`, `yaw_std_rad`."""
    values: Callable[[Any], np.ndarray]
    """`track -> (frames,)` or `(frames, len(names))`."""


class TrackTable(NamedTuple):
    """How the track of one kind of tracker becomes rows of `track.csv` and arrays of `track.npz`."""

    track: Callable[..., Any]
    """A named tuple of arrays, frames first, that begins with `times_s` and ends with `status`. Between these two are
    the fields of what the tracker returns, in order."""
    parts: tuple[Columns, ...]
    """Of the numbers of a row, between the time and the status."""
    status_names: tuple[str, ...] = STATUS_NAMES
    """Words for the integers in `status`."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the numbers of a row."""
        return tuple(name for part in self.parts for name in part.names)

    def numbers(self, track: Any) -> np.ndarray:
        """(frames, columns) of a track."""
        return np.concatenate([part.values(track).reshape(len(track.times_s), -1) for part in self.parts], axis=1)


class TrackWriter:
    """Appends rows to `track.csv` as frames are done, and saves the state with them at checkpoints.

    The cost of a checkpoint does not depend on how many came before it: rows are saved once, in a file a checkpoint.
    `begin` and `resume` make one; `close` lets go of its folder.
    """

    def __init__(self, folder: OutputFolder, run: dict[str, Any], table: TrackTable, done: list[Any]):
        self._folder, self._path, self._run, self._table = folder, folder.path, run, table
        self._parts, self._saved = done, len(done)
        self.frames_saved = self.frames
        rows = [("frame", "time_s", *table.columns, "status")]
        self._write_rows(rows + [row for part in self._with_first_frames() for row in self._rows(*part)], "w")

    @property
    def frames(self) -> int:
        """How many frames were appended so far."""
        return sum(len(part.times_s) for part in self._parts)

    @property
    def results(self) -> Any:
        """All frames so far, at least one."""
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *self._parts)

    def append(self, times_s: np.ndarray, track: Any) -> None:
        """Add frames: one row each in `track.csv`, on disk when this returns."""
        part = jax.tree.map(np.asarray, self._table.track(np.asarray(times_s), *track))
        self._write_rows(self._rows(self.frames, part), "a")
        self._parts.append(part)

    def checkpoint(self, state: Any, *, complete: bool = False) -> None:
        """Save `state` with everything appended so far; `complete` marks the last one of a recording."""
        meta = {"run": self._run, "frames": self.frames, "complete": complete}
        with self._explained(folder := _checkpoint_folder(self._path)):
            folder.mkdir(exist_ok=True)
            for first, part in list(self._with_first_frames())[self._saved :]:
                checkpoint.write_npz(_part_path(self._path, first), part._asdict())
            # The state comes last: rows without it are written again.
            checkpoint.save(checkpoint.state_path(self._path), state, meta)
        self.frames_saved, self._saved = self.frames, len(self._parts)

    def finish(self, report: dict[str, Any], **arrays: np.ndarray) -> None:
        """Write `track.npz`, with other `arrays` beside the track, and `report.json`."""
        results = self.results
        with self._explained(self._path / "track.npz"):
            checkpoint.write_npz(self._path / "track.npz", results._asdict() | arrays)
        with self._explained(self._path / "report.json"):
            (self._path / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        if self.frames_saved == self.frames and len(self._parts) > 1:
            with self._explained(_checkpoint_folder(self._path)):
                checkpoint.write_npz(_part_path(self._path, 0), results._asdict())
                for first, _ in list(self._with_first_frames())[1:]:
                    _part_path(self._path, first).unlink(missing_ok=True)

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

    def _with_first_frames(self) -> Iterator[tuple[int, Any]]:
        first = 0
        for part in self._parts:
            yield first, part
            first += len(part.times_s)

    def _rows(self, first: int, part: Any) -> Iterator[tuple[Any, ...]]:
        numbers = self._table.numbers(part)
        for i, time_s in enumerate(part.times_s):
            texts = (f"{x:.9g}" for x in numbers[i])
            yield (first + i, f"{time_s:.6f}", *texts, self._table.status_names[int(part.status[i])])

    def _write_rows(self, rows: Iterable[tuple[Any, ...]], mode: str) -> None:
        with self._explained(path := self._path / "track.csv"), path.open(mode, newline="") as file:
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


def can_resume(folder: Path) -> bool:
    """Whether `folder` holds a checkpoint."""
    return checkpoint.state_path(folder).exists()


def _saved_parts(folder: Path, table: TrackTable, frames: int) -> list[Any]:
    """The rows of the first `frames` frames; files of later ones were written without a state, and are ignored."""
    parts: list[Any] = []
    done = 0
    while done < frames:
        arrays = checkpoint.read_arrays(path := _part_path(folder, done))
        try:
            part = table.track(**arrays)
        except TypeError:
            raise CheckpointError(f"{path}: arrays of another tracker, {sorted(arrays)}.") from None
        lengths = {len(array) for array in part}
        if len(lengths) != 1 or not 0 < min(lengths) <= frames - done:
            raise CheckpointError(f"{path}: expected at most {frames - done} frames in all arrays; got {lengths}.")
        parts.append(part)
        done += len(part.times_s)
    return parts


def _checkpoint_folder(folder: Path) -> Path:
    return folder / "checkpoint"


def _part_path(folder: Path, first: int) -> Path:
    return _checkpoint_folder(folder) / f"rows_{first:08d}.npz"
