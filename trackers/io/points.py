"""Points over time from files: CSV with a row a point and frame, or `.npz` with all of them."""

import csv
from pathlib import Path

import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.npz import read_npz

_WANTED = "expected .npz with points (frames, points, coordinates), or CSV with id, frame or time_s, and coordinates"
_AXES = (("x", "y", "z"), ("x_m", "y_m", "z_m"), ("x_mm", "y_mm", "z_mm"), ("u", "v"))


def read_points(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Points `(frames, points, coordinates)`, NaN where not seen, and times `(frames,)` in seconds.

    The columns of a CSV are `id`, `frame` or `time_s`, and `x, y` and perhaps `z`, or the same with `_m` or `_mm`, or
    `u, v`: `tips.csv` and `tracks.csv` of the trackers are such files. An `.npz` holds `points` and perhaps `t_s`.

    Args:
        path: The file.
        fps: Frames a second, for files without times.

    Raises:
        InputError: A file that cannot be read, or is no such file.
    """
    return _from_arrays(path, fps) if path.suffix == ".npz" else _from_table(path, fps)


def _from_arrays(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    arrays = read_npz(path, _WANTED, ("points", "t_s"))
    points = arrays.get("points", np.zeros(0))
    times = arrays.get("t_s", np.arange(len(points)) / fps)
    if points.ndim != 3 or times.shape != points.shape[:1] or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: {_WANTED}; points have shape {points.shape}, t_s {times.shape}.")
    return points, times


def _from_table(path: Path, fps: float) -> tuple[np.ndarray, np.ndarray]:
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_WANTED}.") from None
    names = set(rows[0]) if rows else set()
    axes = next(([name for name in axes if name in names] for axes in _AXES if axes[0] in names), [])
    clock = "time_s" if "time_s" in names else "frame"
    if not axes or clock not in names or "id" not in names:
        raise InputError(f"{path}: {_WANTED}; the columns are {sorted(map(str, names))}.")
    try:
        moments = np.array([float(row[clock]) for row in rows])
        places = np.array([[float(row[axis]) for axis in axes] for row in rows])
    except (TypeError, ValueError):
        raise InputError(f"{path}: {clock}, {', '.join(axes)} must be numbers in every row.") from None
    times, frame = np.unique(moments, return_inverse=True)
    _, point = np.unique([row["id"] for row in rows], return_inverse=True)
    points = np.full((len(times), point.max() + 1, len(axes)), np.nan)
    points[frame, point] = places
    return points, times if clock == "time_s" else times / fps
