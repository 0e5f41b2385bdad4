"""What `track.csv` and `track.npz` hold of a head."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.trackers.app.results import TrackTable
from jaxfilters.trackers.head.common.state import DEFORMABLE, HEAD_STATUS, NUM_MODES, RIGID

STATUS_WORDS = (*HEAD_STATUS, "skipped")
"""Words for the integers in `TimedHeadTrack.status`; skipped: without an image of each camera."""
SKIPPED = len(HEAD_STATUS)
TRACKED = (RIGID, DEFORMABLE)
"""Statuses in which there is a pose."""
AXES = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
"""Of a pose in the table and in reports; the tracker's own order has yaw before pitch."""
AXIS_ORDER = [0, 1, 2, 3, 5, 4]
"""Where they are in a pose of the tracker."""
_COLUMNS = (*AXES, *(f"sd_{axis}" for axis in AXES), *(f"a{i}_mm" for i in range(1, NUM_MODES + 1)), "score")


@runtime_checkable
class HeadRows(Protocol):
    """What the tracks of all head trackers have on the host; arrays are frames first, as in `TimedHeadTrack`."""

    @property
    def times_s(self) -> np.ndarray: ...
    @property
    def pose(self) -> np.ndarray: ...
    @property
    def pose_std(self) -> np.ndarray: ...
    @property
    def deformation(self) -> np.ndarray: ...
    @property
    def image_points(self) -> np.ndarray: ...
    @property
    def score(self) -> np.ndarray: ...
    @property
    def status(self) -> np.ndarray: ...


class TimedHeadTrack(NamedTuple):
    """`HeadTrack` on the host, with the times of its frames; all fields frames first, NaN where nothing is tracked."""

    times_s: np.ndarray
    """(frames,) float64 seconds from the first."""
    pose: np.ndarray
    """(frames, 6) x, y, z in millimetres, roll, yaw, pitch in radians."""
    pose_std: np.ndarray
    """(frames, 6) standard deviations."""
    deformation: np.ndarray
    """(frames, 5) millimetres."""
    shape: np.ndarray
    """(frames, 10, 3) millimetres in the model frame."""
    image_points: np.ndarray
    """(frames, cameras, 10, 2) pixels without lens distortion."""
    score: np.ndarray
    """(frames,) mean correlation of the best particle."""
    effective_sample_size: np.ndarray
    """(frames,)."""
    status: np.ndarray
    """(frames,) int32: places in `STATUS_WORDS`."""


def head_table(num_cameras: int) -> TrackTable:
    """How the track of a head before `num_cameras` becomes rows."""
    return TrackTable(_COLUMNS, _numbers, partial(_empty, num_cameras), STATUS_WORDS)


def in_degrees(pose: np.ndarray) -> np.ndarray:
    """(..., 6) in the units and the order of `AXES`, of poses or of their standard deviations."""
    return np.concatenate([pose[..., :3], np.rad2deg(pose[..., 3:])], axis=-1)[..., AXIS_ORDER]


def with_gaps(track: Any, times_s: np.ndarray, whole: Sequence[bool], table: TrackTable) -> Any:
    """The rows of all moments, in order: those of `track` where a moment is whole, else nothing and `SKIPPED`.

    `track` has the fields of the table's rows but for the times, or is None where no moment is whole.

    Rows whose status says that nothing is tracked lose their numbers, so that none of them passes for a pose.
    """
    none = table.empty(len(whole))
    rows = {name: np.full_like(field, np.nan) for name, field in none._asdict().items() if name != "status"}
    status = np.full(len(whole), SKIPPED, np.int32)
    places = np.flatnonzero(whole)
    if track is not None and len(places):
        status[places] = np.asarray(track.status)
        tracked = np.isin(track.status, TRACKED)
        for name in none._fields[1:-1]:
            values = np.asarray(getattr(track, name), np.float32)
            values = _as_wide(values, rows[name]) if name == "deformation" else values
            says_why = name in ("score", "effective_sample_size")
            rows[name][places] = values if says_why else np.where(_beside(tracked, values), values, np.nan)
    return type(none)(**rows | {"times_s": times_s, "status": status})


def longest_stretch(status: np.ndarray) -> slice:
    """The longest run of frames in which the head is tracked; skipped moments neither count nor end it."""
    best, start = slice(0, 0), 0
    frames = np.flatnonzero(status != SKIPPED)
    tracked = np.isin(status[frames], TRACKED)
    for i, is_tracked in enumerate(tracked):
        if not is_tracked:
            start = i + 1
        elif i + 1 - start > best.stop - best.start:
            best = slice(start, i + 1)
    return slice(int(frames[best.start]), int(frames[best.stop - 1]) + 1) if best.stop else best


def _numbers(track: TimedHeadTrack, i: int) -> np.ndarray:
    return np.concatenate(
        [in_degrees(track.pose[i]), in_degrees(track.pose_std[i]), track.deformation[i], track.score[i : i + 1]]
    )


def _as_wide(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """With as many columns as the table: zeros for modes that the face has not."""
    modes = rows.shape[1]
    return np.pad(values[:, :modes], ((0, 0), (0, max(0, modes - values.shape[1]))))


def _beside(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`rows` (b,) with as many axes as `values`."""
    return rows.reshape(-1, *[1] * (values.ndim - 1))


def _empty(num_cameras: int, frames: int) -> TimedHeadTrack:
    one = np.zeros(frames, np.float32)
    return TimedHeadTrack(
        times_s=np.zeros(frames),
        pose=np.zeros((frames, 6), np.float32),
        pose_std=np.zeros((frames, 6), np.float32),
        deformation=np.zeros((frames, NUM_MODES), np.float32),
        shape=np.zeros((frames, NUM_LANDMARKS, 3), np.float32),
        image_points=np.zeros((frames, num_cameras, NUM_LANDMARKS, 2), np.float32),
        score=one,
        effective_sample_size=one,
        status=np.zeros(frames, np.int32),
    )
