"""What a run of the head tracker amounts to: shares, events, and errors where the truth is known."""

from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.face.pose import within_half_turn
from jaxfilters.trackers.head.common.table import (
    AXES,
    SKIPPED,
    TABLE_STATUS,
    TRACKED,
    HeadRows,
    is_deformable,
    longest_stretch,
)

_SIGMAS = 2.0
"""Within which errors should be."""


class HeadTruth(NamedTuple):
    """Of a synthetic face, frames first."""

    poses: np.ndarray
    """(frames, 6) metres and radians."""
    uv: np.ndarray
    """(frames, cameras, 10, 2) pixels of the landmarks."""


def shares(track: HeadRows) -> dict[str, Any]:
    """Frames by status, how much of the run is tracked, and the longest stretch without loss."""
    counts = np.bincount(track.status, minlength=len(TABLE_STATUS))
    observed = int(len(track.status) - counts[SKIPPED])
    longest = longest_stretch(track.status)
    tracked = np.isin(track.status, TRACKED)
    ends = track.times_s[[longest.start, longest.stop - 1]] if longest.stop else np.zeros(2)
    return {
        "frames": len(track.status),
        "status": {word: int(counts[np.equal(TABLE_STATUS, word)].sum()) for word in dict.fromkeys(TABLE_STATUS)},
        "frames_deformable": int(is_deformable(track).sum()),
        "share_tracked": round(float(tracked.sum() / observed), 4) if observed else None,
        "longest_stretch_frames": int(tracked[longest].sum()),
        "longest_stretch_s": round(float(ends[1] - ends[0]), 3),
        "mean_score": _rounded(np.mean(track.score[tracked])) if tracked.any() else None,
    }


def errors(track: HeadRows, truth: HeadTruth | None) -> dict[str, Any]:
    """Root mean square errors of the tracked frames, and the share of them that is within 2 standard deviations."""
    tracked = np.flatnonzero(np.isin(track.status, TRACKED))
    if truth is None or not len(tracked):
        return {}
    offsets = track.pose[tracked].astype(float) - truth.poses[tracked]
    offsets[:, 3:] = within_half_turn(offsets[:, 3:])
    inside = np.abs(offsets) <= _SIGMAS * track.pose_std[tracked]
    pixels = track.image_points[tracked].astype(float) - truth.uv[tracked]
    rmse = np.sqrt(np.mean(offsets**2, axis=0))
    return {
        "rmse": {axis: round(float(value), 6) for axis, value in zip(AXES, rmse, strict=True)},
        "within_2_sigma": {axis: _rounded(value) for axis, value in zip(AXES, inside.mean(axis=0), strict=True)},
        "landmark_rms_px": _rounded(np.sqrt(np.nanmean(np.sum(pixels**2, axis=-1)))),
    }


def _rounded(value: Any) -> float:
    return round(float(value), 4)
