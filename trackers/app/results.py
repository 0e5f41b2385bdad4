"""What a run leaves in its folder: `track.csv`, `track.npz`, `report.json`, and a checkpoint to continue from."""

import csv
import errno
import json
import platform
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError, OutputError
from jaxfilters.trackers.tracker import STATUS_NAMES


class TrackTable(NamedTuple):
    """How the track of one kind of tracker becomes rows of `track.csv`."""

    columns: tuple[str, ...]
    """Names of the numbers of a row, between the time and the status."""
    numbers: Callable[[Any, int], np.ndarray]
    """`(track, i) -> (columns,)`."""
    empty: Callable[[int], Any]
    """`frames -> track`: a named tuple of arrays, frames first, that begins with `times_s` and ends with `status`,
    zeros of the right shapes and types. Between these two are the fields of what the tracker returns, in order."""
    status_names: tuple[str, ...] = STATUS_NAMES
    """Words for the integers in `status`."""


class TrackWriter:
    """Appends rows to `track.csv` as frames are done, and saves everything so far at checkpoints.

    `begin` and `resume` make one.
    """

    def __init__(self, folder: Path, run: dict[str, Any], table: TrackTable, done: Any):
        self._folder, self._run, self._table = folder, run, table
        self._parts = [done]
        self.frames_saved = len(done.times_s)
        self._write_rows([("frame", "time_s", *table.columns, "status"), *self._rows(0, done)], "w")

    @property
    def frames(self) -> int:
        """How many frames were appended so far."""
        return sum(len(part.times_s) for part in self._parts)

    @property
    def results(self) -> Any:
        """All frames so far."""
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *self._parts)

    def append(self, times_s: np.ndarray, track: Any) -> None:
        """Add frames: one row each in `track.csv`, on disk when this returns."""
        arrays = type(self._parts[0])(times_s, *track)
        part = jax.tree.map(lambda array, like: np.asarray(array, like.dtype), arrays, self._parts[0])
        self._write_rows(self._rows(self.frames, part), "a")
        self._parts.append(part)

    def checkpoint(self, state: Any, *, complete: bool = False) -> None:
        """Save `state` with everything appended so far; `complete` marks the last one of a recording."""
        meta = {"run": self._run, "frames": self.frames, "complete": complete}
        with self._explained(_checkpoint_path(self._folder)):
            checkpoint.save(_checkpoint_path(self._folder), {"state": state, "done": self.results}, meta)
        self.frames_saved = self.frames

    def finish(self, report: dict[str, Any], **learnt: np.ndarray) -> None:
        """Write `track.npz`, with what was `learnt` beside the track, and `report.json`."""
        with self._explained(self._folder / "track.npz"):
            checkpoint.write_npz(self._folder / "track.npz", self.results._asdict() | learnt)
        with self._explained(self._folder / "report.json"):
            (self._folder / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")

    def kept(self) -> str:
        """A sentence for people: what of this run is safe, and how to go on."""
        if self.frames_saved:
            path = _checkpoint_path(self._folder)
            return f"the first {self.frames_saved} frames are kept in {path}; continue with --resume"
        if self.frames:
            return f"the first {self.frames} frames are in {self._folder / 'track.csv'}"
        return "nothing was kept"

    def _rows(self, first: int, part: Any) -> Iterator[tuple[Any, ...]]:
        for i, time_s in enumerate(part.times_s):
            numbers = (f"{x:.9g}" for x in self._table.numbers(part, i))
            yield (first + i, f"{time_s:.6f}", *numbers, self._table.status_names[int(part.status[i])])

    def _write_rows(self, rows: Iterable[tuple[Any, ...]], mode: str) -> None:
        with self._explained(path := self._folder / "track.csv"), path.open(mode, newline="") as file:
            csv.writer(file).writerows(rows)

    @contextmanager
    def _explained(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {path}: {_cause(error)}; {self.kept()}.") from error


def begin(folder: Path, run: dict[str, Any], table: TrackTable, *, overwrite: bool = False) -> TrackWriter:
    """A writer for a new run in `folder`, which is made if need be.

    Args:
        folder: where the results go.
        run: what must be equal for a run to be continued (input, configuration, versions), JSON-able.
        table: how rows are written.
        overwrite: discard an unfinished run that lies there.

    Raises:
        CheckpointError: an unfinished run lies there, and `overwrite` is false.
        OutputError: the folder cannot be written.
    """
    path = _checkpoint_path(folder)
    if not overwrite and path.exists() and not (meta := checkpoint.load_meta(path))["complete"]:
        raise CheckpointError(
            f"{folder} holds an unfinished run of {meta['frames']} frames: continue it with --resume, "
            f"choose another --out, or delete {path}."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write into {folder}: {_cause(error)}.") from error
    return TrackWriter(folder, run, table, table.empty(0))


def resume(folder: Path, run: dict[str, Any], table: TrackTable, state: Any) -> tuple[TrackWriter, Any]:
    """`(writer, state)` where the last checkpoint in `folder` left off; `state` is a template of the state.

    Raises:
        CheckpointError: the checkpoint is damaged, or of another input, configuration or version.
    """
    path = _checkpoint_path(folder)
    meta = checkpoint.load_meta(path)
    was = meta["run"]
    if different := sorted(key for key in run | was if run.get(key) != was.get(key)):
        changes = ", ".join(f"{key} was {was.get(key)!r} and is {run.get(key)!r}" for key in different)
        raise CheckpointError(f"{folder} cannot be resumed: {changes}.")
    saved, _ = checkpoint.load(path, {"state": state, "done": table.empty(meta["frames"])})
    return TrackWriter(folder, run, table, saved["done"]), saved["state"]


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
    return _checkpoint_path(folder).exists()


def _checkpoint_path(folder: Path) -> Path:
    return folder / "checkpoint.npz"


def _cause(error: OSError) -> str:
    return "no space left on the device" if error.errno == errno.ENOSPC else error.strerror or str(error)
