"""What `track.csv` and `track.npz` hold of a head."""

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.head.common.state import DEFORMABLE, DOUBTFUL, HEAD_STATUS, NUM_MODES, RIGID, HeadTrack

TABLE_STATUS = ("searching", "tracking", "tracking", "lost", "doubtful", "skipped")
"""Words for the integers in `TimedHeadTrack.status`, those of all trackers; `is_deformable` tells the two that are
tracked apart. Skipped: without an image of each camera."""
SHOWN_STATUS = ("searching", "tracking, rigid", "tracking", "lost", "doubtful", "skipped")
"""The same in pictures and while a run goes on."""
SKIPPED = len(HEAD_STATUS)
TRACKED = (RIGID, DEFORMABLE, DOUBTFUL)
"""Statuses in which there is a pose."""
AXES = ("x_m", "y_m", "z_m", "roll_rad", "yaw_rad", "pitch_rad")
"""Of a pose, in the table and in reports."""
STD_AXES = tuple(f"{axis}_std_{unit}" for axis, unit in (name.split("_") for name in AXES))
"""Of its standard deviations."""
DISPLAYED = ("x, mm", "y, mm", "z, mm", "roll, degrees", "pitch, degrees", "yaw, degrees")
"""What `displayed` gives, for pictures."""
_DISPLAY_ORDER = [0, 1, 2, 3, 5, 4]
_METRES = 1e-3
"""The trackers compute in millimetres, and their sessions return metres."""


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
    def innovations(self) -> np.ndarray: ...
    @property
    def status(self) -> np.ndarray: ...


class TimedHeadTrack(NamedTuple):
    """`HeadTrack` on the host, with the times of its frames; all fields frames first, NaN where nothing is tracked."""

    times_s: np.ndarray
    """(frames,) float64 seconds from the first."""
    pose: np.ndarray
    """(frames, 6) x, y, z in metres, roll, yaw, pitch in radians."""
    pose_std: np.ndarray
    """(frames, 6) standard deviations."""
    deformation: np.ndarray
    """(frames, 5) metres."""
    shape: np.ndarray
    """(frames, 10, 3) metres in the model frame."""
    image_points: np.ndarray
    """(frames, cameras, 10, 2) pixels without lens distortion."""
    score: np.ndarray
    """(frames,) mean correlation at the estimate, -1 to 1."""
    effective_sample_size: np.ndarray
    """(frames,)."""
    innovations: np.ndarray
    """(frames, 2) how many coordinates of the pose the frame has corrected, and how many of these by less than 1.96 of
    the standard deviations that the filter claims for a correction."""
    status: np.ndarray
    """(frames,) int32: places in `TABLE_STATUS`."""


def is_deformable(track: HeadRows) -> np.ndarray:
    """(frames,) 1 where the head is tracked with a deformation, otherwise 0."""
    return (track.status == DEFORMABLE).astype(int)


HEAD_TABLE = TrackTable(
    TimedHeadTrack,
    (
        Columns(AXES, attrgetter("pose")),
        Columns(STD_AXES, attrgetter("pose_std")),
        Columns(tuple(f"deformation_{i}_m" for i in range(1, NUM_MODES + 1)), attrgetter("deformation")),
        Columns(("is_deformable",), is_deformable),
        Columns(("score",), attrgetter("score")),
    ),
    TABLE_STATUS,
)
"""How the track of a head before the cameras of a rig becomes rows."""


def displayed(pose: np.ndarray) -> np.ndarray:
    """(..., 6) in the units and the order of `DISPLAYED`, of poses in metres and radians or of their deviations."""
    return np.concatenate([pose[..., :3] / _METRES, np.rad2deg(pose[..., 3:])], axis=-1)[..., _DISPLAY_ORDER]


def in_metres(track: HeadTrack) -> HeadTrack:
    """A track of the stereo tracker with all lengths in metres."""
    return track._replace(
        pose=pose_in_metres(track.pose),
        pose_std=pose_in_metres(track.pose_std),
        deformation=_METRES * np.asarray(track.deformation),
        shape=_METRES * np.asarray(track.shape),
    )


def with_gaps(track: Any, times_s: np.ndarray, whole: Sequence[bool], nothing: Callable[[int], Any]) -> Any:
    """The rows of all moments, in order: those of `track` where a moment is whole, else `nothing` and `SKIPPED`.

    `track` is None where no moment is whole. Rows whose status says that nothing is tracked lose their numbers, so that
    none of them passes for a pose.

    Args:
        track: Rows of the whole moments.
        times_s: (frames,) of all moments.
        whole: (frames,) which of them have an image of every camera.
        nothing: `frames -> rows` with the times first, of the right shapes and types.
    """
    none = nothing(len(whole))
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


def _as_wide(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """With as many columns as the table: zeros for modes that the face has not."""
    modes = rows.shape[1]
    return np.pad(values[:, :modes], ((0, 0), (0, max(0, modes - values.shape[1]))))


def _beside(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`rows` (b,) with as many axes as `values`."""
    return rows.reshape(-1, *[1] * (values.ndim - 1))


def empty_rows(num_cameras: int, frames: int) -> TimedHeadTrack:
    """Rows of the right shapes and types, before `num_cameras` cameras."""
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
        innovations=np.zeros((frames, 2), np.float32),
        status=np.zeros(frames, np.int32),
    )


def pose_in_metres(pose: Array | np.ndarray) -> np.ndarray:
    """(..., 6) in metres and radians, of millimetres and radians."""
    return np.asarray(pose) * np.repeat(np.asarray([_METRES, 1.0], np.asarray(pose).dtype), 3)
