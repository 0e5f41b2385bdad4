"""What `track.csv` and `track.npz` hold of an articulated hand in features."""

from functools import partial
from typing import NamedTuple

import numpy as np

from jaxfilters.models.articulated.layout import LINKS, Layout
from jaxfilters.trackers.app.results import TrackTable

_DIAGNOSTICS = ("weight", "num_hypotheses", "is_new_view", "nis_per_row", "least_distance", "log_evidence")


class TimedArticulatedTrack(NamedTuple):
    """`ArticulatedTrack` on the host, with the times of its frames; all fields frames first."""

    times_s: np.ndarray
    """(frames,) float64 seconds, as in the recording."""
    mean: np.ndarray
    std: np.ndarray
    points: np.ndarray
    image_points: np.ndarray
    scale: np.ndarray
    weight: np.ndarray
    num_hypotheses: np.ndarray
    is_new_view: np.ndarray
    nis_per_row: np.ndarray
    least_distance: np.ndarray
    log_evidence: np.ndarray
    status: np.ndarray


def articulated_table(layout: Layout) -> TrackTable:
    """The columns of a hand with these fingers: its state, standard deviations and what the filter says of itself."""
    means = [_column(name, "") for name in layout.names]
    stds = [_column(name, "_std") for name in layout.names]
    return TrackTable((*means, *stds, *_DIAGNOSTICS), _numbers, partial(_empty, layout))


def _column(name: str, suffix: str) -> str:
    """`r_11_px`, `theta_13_rate_std_rad_per_frame`; the parts of the quaternion have no unit."""
    unit = "_rad" if name.startswith("theta") else "" if name.startswith("q_") else "_px"
    return f"{name}{suffix}{unit}" + ("_per_frame" if name.endswith("_rate") else "")


def _numbers(track: TimedArticulatedTrack, i: int) -> np.ndarray:
    diagnostics = [float(getattr(track, name)[i]) for name in _DIAGNOSTICS]
    return np.concatenate([track.mean[i], track.std[i], diagnostics])


def _empty(layout: Layout, frames: int) -> TimedArticulatedTrack:
    joints, n = (frames, layout.num_fingers, LINKS + 1), layout.size
    one = np.zeros(frames, np.float32)
    return TimedArticulatedTrack(
        times_s=np.zeros(frames),
        mean=np.zeros((frames, n), np.float32),
        std=np.zeros((frames, n), np.float32),
        points=np.zeros((*joints, 3), np.float32),
        image_points=np.zeros((*joints, 2), np.float32),
        scale=one,
        weight=one,
        num_hypotheses=np.zeros(frames, np.int32),
        is_new_view=np.zeros(frames, bool),
        nis_per_row=one,
        least_distance=one,
        log_evidence=one,
        status=np.zeros(frames, np.int32),
    )
