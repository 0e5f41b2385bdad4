"""What `track.csv` and `track.npz` hold of a head before one camera."""

from functools import partial
from typing import NamedTuple

import numpy as np

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.trackers.app.results import TrackTable
from jaxfilters.trackers.head.common.table import AXES, STATUS_WORDS, in_degrees


class TimedMonoTrack(NamedTuple):
    """`MonoTrack` on the host, with the times of its frames; all fields frames first, NaN where nothing is tracked."""

    times_s: np.ndarray
    """(frames,) float64 seconds from the first."""
    pose: np.ndarray
    """(frames, 6) x, y, z in millimetres, roll, yaw, pitch in radians."""
    pose_std: np.ndarray
    """(frames, 6) standard deviations."""
    deformation: np.ndarray
    """(frames, A) expression in standard deviations of the training set's."""
    shape: np.ndarray
    """(frames, 10, 3) millimetres in the model frame."""
    image_points: np.ndarray
    """(frames, 1, 10, 2) pixels without lens distortion."""
    score: np.ndarray
    """(frames,) mean correlation."""
    effective_sample_size: np.ndarray
    """(frames,)."""
    identity: np.ndarray
    """(frames, S) in standard deviations of the training set's."""
    offset: np.ndarray
    """(frames, 10, 3) what the model lacks of this face, millimetres."""
    who: np.ndarray
    """(frames,) place among those who are known, -1 for a stranger."""
    is_adjusted: np.ndarray
    """(frames,) 1 where the face was adjusted."""
    status: np.ndarray
    """(frames,) int32: places in `STATUS_WORDS`."""


def mono_table(face: MultilinearFace) -> TrackTable:
    """How the track of a head with a model of faces becomes rows."""
    expressions = (f"a{i}_sd" for i in range(1, face.num_expressions + 1))
    identities = (f"s{i}_sd" for i in range(1, face.num_identities + 1))
    columns = (*AXES, *(f"sd_{axis}" for axis in AXES), *expressions, *identities, "who", "is_adjusted", "score")
    return TrackTable(columns, _numbers, partial(_empty, face.num_expressions, face.num_identities), STATUS_WORDS)


def _numbers(track: TimedMonoTrack, i: int) -> np.ndarray:
    pose, std = in_degrees(track.pose[i]), in_degrees(track.pose_std[i])
    last = [track.who[i], track.is_adjusted[i], track.score[i]]
    return np.concatenate([pose, std, track.deformation[i], track.identity[i], last])


def _empty(num_expressions: int, num_identities: int, frames: int) -> TimedMonoTrack:
    zeros = lambda *shape: np.zeros((frames, *shape), np.float32)
    return TimedMonoTrack(
        times_s=np.zeros(frames),
        pose=zeros(6),
        pose_std=zeros(6),
        deformation=zeros(num_expressions),
        shape=zeros(NUM_LANDMARKS, 3),
        image_points=zeros(1, NUM_LANDMARKS, 2),
        score=zeros(),
        effective_sample_size=zeros(),
        identity=zeros(num_identities),
        offset=zeros(NUM_LANDMARKS, 3),
        who=zeros() - 1,
        is_adjusted=zeros(),
        status=np.zeros(frames, np.int32),
    )
