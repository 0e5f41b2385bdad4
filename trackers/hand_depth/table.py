"""What `track.csv` and `track.npz` hold of a hand in depth images."""

from typing import NamedTuple

import numpy as np

from jaxfilters.trackers.app.results import TrackTable

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
    ess: np.ndarray
    log_evidence: np.ndarray
    status: np.ndarray


def _numbers(track: TimedHandTrack, i: int) -> np.ndarray:
    return np.concatenate([track.pose[i], track.pose_std[i], [track.ess[i], track.log_evidence[i]]])


def _empty(frames: int) -> TimedHandTrack:
    pose, pose_std, joints, ess, log_evidence = (
        np.zeros((frames, *shape), np.float32) for shape in ((22,), (21,), (21, 3), (), ())
    )
    return TimedHandTrack(np.zeros(frames), pose, pose_std, joints, ess, log_evidence, np.zeros(frames, np.int32))


HAND_TABLE = TrackTable((*POSE_COLUMNS, *STD_COLUMNS, "ess", "log_evidence"), _numbers, _empty)
