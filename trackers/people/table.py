"""What `track.csv` and `track.npz` hold of people."""

from collections.abc import Sequence
from functools import partial
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.people.recorded import Sighting, as_arrays, from_arrays, spreads
from jaxfilters.trackers.people.state import HEIGHT, PeopleScene

_NAMES = {"times_s": "time_s", "identity": "key", "status": "mode"}
"""Of the arrays that hold sightings, by the fields of the table."""
STATUS = ("tentative", "tracking", "predicted", "doubtful")
"""Words of the table for `recorded.MODES`, in their order."""


class TimedPeopleTrack(NamedTuple):
    """A row a person and frame, in the order in which they became known; sightings, column by column."""

    frame: np.ndarray
    """(rows,) number of the frame."""
    times_s: np.ndarray
    """(rows,) float64 seconds from the first."""
    identity: np.ndarray
    """(rows,)."""
    mean: np.ndarray
    """(rows, 9): X, Y, velocity along X and Y, height, width, metres and metres per second; biases of the
    silhouette."""
    covariance: np.ndarray
    """(rows, 9, 9)."""
    score: np.ndarray
    """(rows,)."""
    slot: np.ndarray
    """(rows,) where the tracker kept this person."""
    image: np.ndarray
    """(rows,) number of the image of the first camera, from 0; -1 in frames in which it has none."""
    innovations: np.ndarray
    """(rows, 2) how many coordinates were compared with their prediction, and how many of these lie within its 95 %
    band."""
    status: np.ndarray
    """(rows,) int64: places in `STATUS`."""


def people_table(scene: PeopleScene) -> TrackTable:
    """How tracks of people become rows; the cameras of the scene say what is along a line of sight."""
    centers = np.asarray(scene.centers())
    columns = (
        Columns(("id",), attrgetter("identity")),
        Columns(("x_m", "y_m", "vx_m_per_s", "vy_m_per_s"), lambda track: track.mean[:, :4]),
        Columns(("height_m",), lambda track: track.mean[:, HEIGHT]),
        Columns(("x_std_m", "y_std_m", "vx_std_m_per_s", "vy_std_m_per_s"), lambda track: _std(track)[:, :4]),
        Columns(("height_std_m",), lambda track: _std(track)[:, HEIGHT]),
        Columns(("radial_std_m", "lateral_std_m"), partial(_spreads, centers)),
        Columns(("score",), attrgetter("score")),
    )
    return TrackTable(TimedPeopleTrack, columns, STATUS)


def as_rows(sightings: Sequence[tuple[int, Sighting]]) -> TimedPeopleTrack:
    """Sightings with their identities as rows, in their order."""
    arrays = as_arrays(sightings)
    return TimedPeopleTrack(**{field: arrays[_NAMES.get(field, field)] for field in TimedPeopleTrack._fields})


def from_rows(rows: TimedPeopleTrack) -> list[tuple[int, Sighting]]:
    """Sightings as `as_rows` was given them."""
    return from_arrays({_NAMES.get(field, field): column for field, column in rows._asdict().items()})


def _std(track: TimedPeopleTrack) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("rii->ri", track.covariance), 0.0))


def _spreads(centers: np.ndarray, track: TimedPeopleTrack) -> np.ndarray:
    return np.asarray([spreads(centers, sighting) for _, sighting in from_rows(track)]).reshape(len(track.frame), 2)
