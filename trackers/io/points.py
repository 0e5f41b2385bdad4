"""Points over time from files: CSV with a row a point and frame, or `.npz` with all of them."""

from pathlib import Path

import numpy as np

from jaxfilters.trackers.io.errors import InputError, shortened
from jaxfilters.trackers.io.input_files import check_rate, too_large
from jaxfilters.trackers.io.npz import read_npz
from jaxfilters.trackers.io.recording import check_times
from jaxfilters.trackers.io.tables import Columns, read_table

_WANTED = "expected .npz with points (frames, points, coordinates), or CSV with id, frame or time_s, and coordinates"
_AXES = (("x", "y", "z"), ("x_m", "y_m", "z_m"), ("x_mm", "y_mm", "z_mm"), ("x_px", "y_px"), ("u", "v"))
_MOST_NUMBERS = 2**26
"""Of a table with a place for every point in every frame."""


def read_points(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Points `(frames, points, coordinates)`, NaN where not observed, and times `(frames,)` in seconds.

    The columns of a CSV are `id`, `frame` or `time_s`, and `x, y` and perhaps `z`, or the same with `_m`, `_mm` or
    `_px`, or `u, v`: `track.csv` of `track people` and of `track fingertips` are such files. An `.npz` holds `points`
    and perhaps `t_s`.

    Args:
        path: The file.
        fps: Frames a second, for files without times.

    Raises:
        InputError: A file that cannot be read, or is no such file; infinite coordinates; times that are not finite or
            do not increase; or more points in more frames than fit into memory.
    """
    check_rate(fps)
    points, times = _from_arrays(path, fps) if path.suffix == ".npz" else _from_table(path, fps)
    check_times(times, str(path))
    if (wrong := too_large(points)).any():
        frame, point, _ = np.argwhere(wrong)[0]
        raise InputError(f"{path}: coordinates must be finite or NaN; point {point} in frame {frame} is not.")
    return points, times


def _from_arrays(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    arrays = read_npz(path, _WANTED, ("points", "t_s"))
    points = arrays.get("points", np.zeros(0))
    times = arrays.get("t_s", np.arange(points.shape[0] if points.ndim else 0) / fps)
    if points.ndim != 3 or times.shape != points.shape[:1] or not {points.dtype.kind, times.dtype.kind} <= set("fiu"):
        raise InputError(f"{path}: {_WANTED}; points have shape {points.shape}, t_s {times.shape}.")
    return points.astype(float), times.astype(float)


def _from_table(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    def choose(names: list[str]) -> Columns:
        axes = next((tuple(name for name in axes if name in names) for axes in _AXES if axes[0] in names), ())
        clock = "time_s" if "time_s" in names else "frame"
        if not axes or clock not in names or "id" not in names:
            raise InputError(f"{path}: {_WANTED}; the columns are {shortened(', '.join(names))}.")
        return Columns((clock, *axes), ("id",), frozenset(axes))

    numbers, words, lines = read_table(path, _WANTED, choose)
    clock, *axes = numbers
    if not len(lines):
        raise InputError(f"{path}: no rows in it; {_WANTED}.")
    times, frame = np.unique(numbers[clock], return_inverse=True)
    _, point = np.unique(words["id"], return_inverse=True)
    shape = (len(times), int(point.max()) + 1, len(axes))
    if np.prod(np.array(shape, float)) > _MOST_NUMBERS:
        raise InputError(
            f"{path}: {shape[1]} points in {shape[0]} frames, of which {len(lines)} are there; at most "
            f"{_MOST_NUMBERS >> 20} million coordinates can be used. Take fewer points or frames at once."
        )
    _, cell = np.unique(frame * shape[1] + point, return_index=True)
    if len(cell) < len(lines):
        again = int(np.setdiff1d(np.arange(len(lines)), cell)[0])
        raise InputError(
            f"{path}: line {lines[again]}: point {shortened(words['id'][again])} is there twice in one frame."
        )
    points = np.full(shape, np.nan)
    points[frame, point] = np.stack([numbers[axis] for axis in axes], axis=-1)
    return points, times if clock == "time_s" else times / fps
