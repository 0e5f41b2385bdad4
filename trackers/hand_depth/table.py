"""What `track.csv` and `track.npz` hold of a hand in depth images."""

from operator import attrgetter
from typing import NamedTuple

import numpy as np

from jaxfilters.trackers.app.results import Columns, TrackTable

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


class TimedHandTrack(NamedTuple):
    """`HandTrack` on the host, with the times of its frames; all fields frames first."""

    times_s: np.ndarray
    """(frames,) float64 seconds, as in the recording."""
    pose: np.ndarray
    pose_std: np.ndarray
    joints: np.ndarray
    innovations: np.ndarray
    effective_sample_size: np.ndarray
    log_evidence: np.ndarray
    status: np.ndarray


HAND_TABLE = TrackTable(
    TimedHandTrack,
    (
        Columns(POSE_COLUMNS, attrgetter("pose")),
        Columns(STD_COLUMNS, attrgetter("pose_std")),
        Columns(("effective_sample_size",), attrgetter("effective_sample_size")),
        Columns(("log_evidence",), attrgetter("log_evidence")),
    ),
)
