"""What `track.csv` and `track.npz` hold of a head before one camera."""

from operator import attrgetter
from typing import NamedTuple

import numpy as np

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.head.common.table import AXES, STD_AXES, TABLE_STATUS, is_deformable, pose_in_metres
from jaxfilters.trackers.head.mono.state import MonoTrack


class TimedMonoTrack(NamedTuple):
    """`MonoTrack` on the host, with the times of its frames; all fields frames first, NaN where nothing is tracked."""

    times_s: np.ndarray
    """(frames,) float64 seconds from the first."""
    pose: np.ndarray
    """(frames, 6) x, y, z in metres, roll, yaw, pitch in radians."""
    pose_std: np.ndarray
    """(frames, 6) standard deviations."""
    deformation: np.ndarray
    """(frames, A) expression in standard deviations of the training set's."""
    shape: np.ndarray
    """(frames, 10, 3) metres in the model frame."""
    image_points: np.ndarray
    """(frames, 1, 10, 2) pixels without lens distortion."""
    score: np.ndarray
    """(frames,) mean correlation."""
    effective_sample_size: np.ndarray
    """(frames,)."""
    innovations: np.ndarray
    """(frames, 2) how many coordinates of the pose the frame has corrected, and how many of these by less than 1.96 of
    the standard deviations that the filter claims for a correction."""
    identity: np.ndarray
    """(frames, S) in standard deviations of the training set's."""
    offset: np.ndarray
    """(frames, 10, 3) what the model lacks of this face, metres."""
    person_index: np.ndarray
    """(frames,) index of the recognised person, -1 for an unknown one."""
    is_adjusted: np.ndarray
    """(frames,) 1 where the face was adjusted."""
    status: np.ndarray
    """(frames,) int32: places in `TABLE_STATUS`."""


def mono_table(face: MultilinearFace) -> TrackTable:
    """How the track of a head with a model of faces becomes rows."""
    expressions = tuple(f"expression_{i}" for i in range(1, face.num_expressions + 1))
    identities = tuple(f"identity_{i}" for i in range(1, face.num_identities + 1))
    columns = (
        Columns(AXES, attrgetter("pose")),
        Columns(STD_AXES, attrgetter("pose_std")),
        Columns(expressions, attrgetter("deformation")),
        Columns(identities, attrgetter("identity")),
        Columns(("is_deformable",), is_deformable),
        *(Columns((name,), attrgetter(name)) for name in ("person_index", "is_adjusted", "score")),
    )
    return TrackTable(TimedMonoTrack, columns, TABLE_STATUS)


def mono_in_metres(track: MonoTrack) -> MonoTrack:
    """A track with all lengths in metres."""
    return track._replace(
        pose=pose_in_metres(track.pose),
        pose_std=pose_in_metres(track.pose_std),
        shape=1e-3 * np.asarray(track.shape),
        offset=1e-3 * np.asarray(track.offset),
    )


def empty_mono_rows(face: MultilinearFace, frames: int) -> TimedMonoTrack:
    """Rows of the right shapes and types."""
    zeros = lambda *shape: np.zeros((frames, *shape), np.float32)
    return TimedMonoTrack(
        times_s=np.zeros(frames),
        pose=zeros(6),
        pose_std=zeros(6),
        deformation=zeros(face.num_expressions),
        shape=zeros(NUM_LANDMARKS, 3),
        image_points=zeros(1, NUM_LANDMARKS, 2),
        score=zeros(),
        effective_sample_size=zeros(),
        innovations=zeros(2),
        identity=zeros(face.num_identities),
        offset=zeros(NUM_LANDMARKS, 3),
        person_index=zeros() - 1,
        is_adjusted=zeros(),
        status=np.zeros(frames, np.int32),
    )
