"""What `track.csv` and `track.npz` hold of fingertips."""

from operator import attrgetter
from typing import NamedTuple

import numpy as np

from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.fingertips.state import HandReport

STATUS = ("tracking", "predicted")
"""Detected in this frame, or not."""
_FRAMES_PER_SECOND = 30.0
"""The tracker counts velocities in pixels per 1/30 s."""


class TimedTips(NamedTuple):
    """A row a fingertip and frame."""

    frame: np.ndarray
    """(rows,) number of the frame."""
    times_s: np.ndarray
    """(rows,) float64 seconds from the first."""
    hand: np.ndarray
    """(rows,) from 0."""
    finger: np.ndarray
    """(rows,) 0, the thumb, to 4, the little finger."""
    position: np.ndarray
    """(rows, 2) pixels."""
    velocity: np.ndarray
    """(rows, 2) pixels per second."""
    position_std: np.ndarray
    """(rows, 2) pixels."""
    innovations: np.ndarray
    """(rows, 2) how many coordinates were compared with their prediction, and how many of these lie within its 95 %
    band."""
    is_thumb: np.ndarray
    """(rows,) 1 for what is taken for a thumb, otherwise 0."""
    thumb_probability: np.ndarray
    """(rows,)."""
    status: np.ndarray
    """(rows,) int64: places in `STATUS`."""


def name_of(hand: int, identity: int) -> str:
    """The id of a fingertip, which begins with that of its hand."""
    return f"{hand}-{identity}"


def _names(track: TimedTips) -> np.ndarray:
    return np.asarray([name_of(int(hand), int(one)) for hand, one in zip(track.hand, track.finger, strict=True)], str)


TIP_TABLE = TrackTable(
    TimedTips,
    (
        Columns(("hand",), attrgetter("hand")),
        Columns(("id",), _names),
        Columns(("x_px", "y_px"), attrgetter("position")),
        Columns(("vx_px_per_s", "vy_px_per_s"), attrgetter("velocity")),
        Columns(("x_std_px", "y_std_px"), attrgetter("position_std")),
        Columns(("is_thumb",), attrgetter("is_thumb")),
        Columns(("thumb_probability",), attrgetter("thumb_probability")),
    ),
    STATUS,
)
"""How fingertips become rows."""


def tip_rows(frame: int, time_s: float, report: HandReport) -> TimedTips:
    """A row for every fingertip of every hand in a frame."""
    at = np.nonzero(report.is_tip)
    rows = len(at[0])
    return TimedTips(
        frame=np.full(rows, frame, np.int64),
        times_s=np.full(rows, time_s, np.float64),
        hand=at[0].astype(np.int64),
        finger=np.asarray(report.identity)[at].astype(np.int64),
        position=np.asarray(report.position)[at].astype(np.float32),
        velocity=_FRAMES_PER_SECOND * np.asarray(report.velocity)[at].astype(np.float32),
        position_std=np.repeat(np.asarray(report.sd)[at].astype(np.float32)[:, None], 2, axis=1),
        innovations=np.asarray(report.innovations)[at].astype(np.int64),
        is_thumb=np.asarray(report.is_thumb)[at].astype(np.int64),
        thumb_probability=np.asarray(report.thumb_probability)[at].astype(np.float32),
        status=np.where(np.asarray(report.is_observed)[at], 0, 1).astype(np.int64),
    )
