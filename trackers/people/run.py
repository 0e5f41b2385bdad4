"""People in a run: images of all cameras in, rows and pictures out."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxfilters.trackers.app.video import side_by_side
from jaxfilters.trackers.io.video_input import FrameSet
from jaxfilters.trackers.people.drawing import drawn
from jaxfilters.trackers.people.session import PeopleEstimate, PeopleSession
from jaxfilters.trackers.people.state import TRACKED
from jaxfilters.trackers.people.table import TimedPeopleTrack, as_rows


class PeopleStream:
    """The session of people, as `jaxfilters.trackers.app.stream` runs it."""

    def __init__(self, session: PeopleSession):
        """Before its first images; the session need not keep its tracks."""
        self._session = session
        self._now: PeopleEstimate | None = None

    @property
    def status(self) -> str:
        """How many people there are."""
        inside = 0 if self._now is None else int(np.sum(self._now.people.mode == TRACKED))
        return f"{inside} {'person' if inside == 1 else 'people'}"

    def is_due(self, waiting: Sequence[FrameSet]) -> bool:
        """Every moment is processed when it comes."""
        return bool(waiting)

    def process(self, moments: Sequence[FrameSet]) -> TimedPeopleTrack:
        """A row for everybody and, for newly confirmed people, of the frames before."""
        (moment,) = moments
        self._now = self._session.process(moment.images, moment.time_s)
        return as_rows(self._now.added)

    def pictures(self, moments: Sequence[FrameSet], rows: TimedPeopleTrack) -> Iterable[np.ndarray]:  # noqa: ARG002
        """The images of all cameras with everybody's outline."""
        assert self._now is not None
        views = zip(self._session.last_images, self._session.last_outlines, strict=True)
        yield side_by_side([drawn(image, outline, self._now.people) for image, outline in views], self._now.time_s)

    def saved(self) -> Any:
        """As of the session."""
        return self._session.state()

    def restore(self, saved: Any, rows: TimedPeopleTrack) -> None:  # noqa: ARG002
        """As of the session; rows stay in the results of the run."""
        self._session.restore(saved)
