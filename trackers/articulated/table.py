"""What `track.csv` and `track.npz` hold of an articulated hand in features."""

from operator import attrgetter
from typing import NamedTuple

import numpy as np

from jaxfilters.models.articulated.layout import Layout
from jaxfilters.trackers.app.results import Columns, TrackTable

_DIAGNOSTICS = ("weight", "num_hypotheses", "is_new_view", "nis_per_row", "least_distance", "log_evidence")


class TimedArticulatedTrack(NamedTuple):
    """`ArticulatedTrack` on the host, with the times of its frames; all fields frames first."""

    times_s: np.ndarray
    """(frames,) float64 seconds, as in the recording."""
    mean: np.ndarray
    std: np.ndarray
    points: np.ndarray
    points_std: np.ndarray
    points_from_wrist_std: np.ndarray
    image_points: np.ndarray
    scale: np.ndarray
    weight: np.ndarray
    num_hypotheses: np.ndarray
    is_new_view: np.ndarray
    nis_per_row: np.ndarray
    innovations: np.ndarray
    least_distance: np.ndarray
    log_evidence: np.ndarray
    length_observed: np.ndarray
    status: np.ndarray


def articulated_table(layout: Layout) -> TrackTable:
    """The columns of a hand with these fingers: its state, standard deviations and what the filter says of itself."""
    unit = "_px" if layout.position_size == 2 else "_m"
    means = tuple(_column(name, "", unit) for name in layout.names)
    stds = tuple(_column(name, "_std", unit) for name in layout.names)
    diagnostics = (Columns((name,), attrgetter(name)) for name in _DIAGNOSTICS)
    lengths = tuple(f"{name}_observed" for name in layout.names[layout.lengths])
    observed = Columns(lengths, attrgetter("length_observed"))
    parts = (Columns(means, attrgetter("mean")), Columns(stds, attrgetter("std")), *diagnostics, observed)
    return TrackTable(TimedArticulatedTrack, parts)


def _column(name: str, suffix: str, length: str) -> str:
    """`r_11_px` or `r_11_m`, `theta_13_rate_std_rad_per_frame`; the parts of the quaternion have no unit."""
    unit = "_rad" if name.startswith("theta") else "" if name.startswith("q_") else length
    return f"{name}{suffix}{unit}" + ("_per_frame" if name.endswith("_rate") else "")
