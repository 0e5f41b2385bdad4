"""What a run leaves in its folder: `track.csv`, `track.npz`, `report.json`, and a checkpoint to continue from."""

import csv
import errno
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.shell import checkpoint
from jaxfilters.trackers.shell.checkpoint import CheckpointError
from jaxfilters.trackers.tracker import STATUS_NAMES, HandTrack

_POSITION = tuple(f"wrist_{axis}" for axis in "xyz")
_THUMB_ANGLES = ("thumb_cmc_x", "thumb_mcp_x", "thumb_mcp_z")
_FINGER_ANGLES = tuple(
    f"{finger}_{joint}" for finger in ("index", "middle", "ring", "little") for joint in ("mcp_x", "mcp_z", "pip_x")
)
_ANGLES = _THUMB_ANGLES + _FINGER_ANGLES
POSE_COLUMNS = (
    *(f"{name}_m" for name in _POSITION),
    *(f"wrist_quaternion_{part}" for part in "wxyz"),
    *(f"{name}_rad" for name in _ANGLES),
)
"""The 22 pose numbers, in the order of the pose vector."""
STD_COLUMNS = (
    *(f"{name}_std_m" for name in _POSITION),
    *(f"wrist_rotation_{axis}_std_rad" for axis in "xyz"),
    *(f"{name}_std_rad" for name in _ANGLES),
)
"""The 21 standard deviations, in the order of the tangent vector."""
COLUMNS = ("frame", "time_s", *POSE_COLUMNS, *STD_COLUMNS, "ess", "log_evidence", "status")


class OutputError(OSError):
    """Results cannot be written; the message says what is kept."""


class TimedTrack(NamedTuple):
    """`HandTrack` on the host, with the times of its frames; all fields frames first."""

    times_s: np.ndarray
    """(frames,) float64 seconds, as in the recording."""
    pose: np.ndarray
    pose_std: np.ndarray
    joints: np.ndarray
    ess: np.ndarray
    log_evidence: np.ndarray
    status: np.ndarray


class TrackWriter:
    """Appends rows to `track.csv` as frames are done, and saves everything so far at checkpoints.

    `begin` and `resume` make one.
    """

    def __init__(self, folder: Path, run: dict[str, Any], done: TimedTrack):
        self._folder, self._run = folder, run
        self._parts = [done]
        self.frames_saved = len(done.times_s)
        self._write_rows([COLUMNS, *_rows(0, done)], "w")

    @property
    def frames(self) -> int:
        """How many frames were appended so far."""
        return sum(len(part.times_s) for part in self._parts)

    @property
    def results(self) -> TimedTrack:
        """All frames so far."""
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *self._parts)

    def append(self, times_s: np.ndarray, track: HandTrack) -> None:
        """Add frames: one row each in `track.csv`, on disk when this returns."""
        arrays = TimedTrack(times_s, **track._asdict())
        part = jax.tree.map(lambda array, like: np.asarray(array, like.dtype), arrays, self._parts[0])
        self._write_rows(_rows(self.frames, part), "a")
        self._parts.append(part)

    def checkpoint(self, state: Any, *, complete: bool = False) -> None:
        """Save `state` with everything appended so far; `complete` marks the last one of a recording."""
        meta = {"run": self._run, "frames": self.frames, "complete": complete}
        with self._explained(_checkpoint_path(self._folder)):
            checkpoint.save(_checkpoint_path(self._folder), {"state": state, "done": self.results}, meta)
        self.frames_saved = self.frames

    def finish(self, report: dict[str, Any]) -> None:
        """Write `track.npz` and `report.json`."""
        with self._explained(self._folder / "track.npz"):
            checkpoint.write_npz(self._folder / "track.npz", self.results._asdict())
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

    def _write_rows(self, rows: Iterable[tuple[Any, ...]], mode: str) -> None:
        with self._explained(path := self._folder / "track.csv"), path.open(mode, newline="") as file:
            csv.writer(file).writerows(rows)

    @contextmanager
    def _explained(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {path}: {_cause(error)}; {self.kept()}.") from error


def begin(folder: Path, run: dict[str, Any], *, overwrite: bool = False) -> TrackWriter:
    """A writer for a new run in `folder`, which is made if need be.

    Args:
        folder: where the results go.
        run: what must be equal for a run to be continued (input, configuration, versions), JSON-able.
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
    return TrackWriter(folder, run, _empty(0))


def resume(folder: Path, run: dict[str, Any], state: Any) -> tuple[TrackWriter, Any]:
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
    saved, _ = checkpoint.load(path, {"state": state, "done": _empty(meta["frames"])})
    return TrackWriter(folder, run, saved["done"]), saved["state"]


def can_resume(folder: Path) -> bool:
    """Whether `folder` holds a checkpoint."""
    return _checkpoint_path(folder).exists()


def _checkpoint_path(folder: Path) -> Path:
    return folder / "checkpoint.npz"


def _cause(error: OSError) -> str:
    return "no space left on the device" if error.errno == errno.ENOSPC else error.strerror or str(error)


def _rows(first: int, part: TimedTrack) -> Iterator[tuple[Any, ...]]:
    for i, time_s in enumerate(part.times_s):
        numbers = np.concatenate([part.pose[i], part.pose_std[i], [part.ess[i], part.log_evidence[i]]])
        yield (first + i, f"{time_s:.6f}", *(f"{x:.9g}" for x in numbers), STATUS_NAMES[int(part.status[i])])


def _empty(frames: int) -> TimedTrack:
    pose, pose_std, joints, ess, log_evidence = (
        np.zeros((frames, *shape), np.float32) for shape in ((22,), (21,), (21, 3), (), ())
    )
    return TimedTrack(np.zeros(frames), pose, pose_std, joints, ess, log_evidence, np.zeros(frames, np.int32))
