"""Fingertips in a run: images in, rows, events and pictures out."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.trackers.fingertips.events import Event
from jaxfilters.trackers.fingertips.files import EventFile
from jaxfilters.trackers.fingertips.images import User
from jaxfilters.trackers.fingertips.input import DemoHand, shown
from jaxfilters.trackers.fingertips.pictures import FingertipPictures
from jaxfilters.trackers.fingertips.session import FingertipSession
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.fingertips.table import TimedTips, tip_rows
from jaxfilters.trackers.fingertips.tally import Tally
from jaxfilters.trackers.io.video_input import FrameSet


class Begun(NamedTuple):
    """What a run has once images of the recording have shown the user."""

    user: User
    observe: Callable[[Any], HandObservation]
    """What hands there are in an image."""
    session: FingertipSession
    """What follows them."""


class FingertipStream:
    """The session of hands, as `jaxfilters.trackers.app.stream` runs it."""

    def __init__(self, source: Any, begin: Callable[[], Begun], events: EventFile):
        """Before any image is read.

        Args:
            source: Of the images.
            begin: Reads images of the source to know the user.
            events: Where lines for events go.
        """
        self.tally = Tally()
        self._source, self._begin, self._file = source, begin, events
        self._begun: Begun | None = None
        self._pictures, self._reported = FingertipPictures(), 0
        self._report: HandReport | None = None
        self._events: list[Event] = []

    @property
    def begun(self) -> Begun:
        """The user and the session; not before `prime` or `restore`."""
        assert self._begun is not None
        return self._begun

    def prime(self) -> None:
        """Know the user."""
        self._begun = self._begin()

    @property
    def status(self) -> str:
        """How many fingertips there are."""
        return f"{0 if self._report is None else int(self._report.num_tips.sum())} fingertips"

    def is_due(self, waiting: Sequence[FrameSet]) -> bool:
        """Every image is processed when it comes."""
        return bool(waiting)

    def process(self, moments: Sequence[FrameSet]) -> TimedTips:
        """A row for every fingertip."""
        ((time_s, (image,)),) = moments
        found = self.begun.session.process(self.begun.observe(image), np.array([time_s]))
        self._report = HandReport(*(field[0] for field in found))
        rows = tip_rows(self.tally.frames, time_s, self._report)
        self._write_events()
        truth = self._source.truth if isinstance(self._source, DemoHand) else None
        self.tally = self.tally.add(time_s, self._report, truth)
        return rows

    def pictures(self, moments: Sequence[FrameSet], rows: TimedTips) -> Iterable[np.ndarray]:  # noqa: ARG002
        """The image with fingertips and events."""
        ((time_s, (image,)),) = moments
        assert self._report is not None
        picture: Any = shown(image)  # type: ignore[arg-type]
        yield self._pictures.drawn(picture, self.tally.frames - 1, time_s, self._report, self._events)

    def finish(self) -> None:
        """End what is under way: nothing more comes."""
        self.begun.session.finish()
        self._write_events()

    def saved(self) -> Any:
        """What the next image needs."""
        return {"session": self.begun.session.saved(), "tally": self.tally, "event_bytes": self._file.size()}

    def restore(self, saved: Any, rows: TimedTips) -> None:  # noqa: ARG002
        """Go on from what `saved` gave; the user, who is not in it, is known from the recording once more."""
        self.prime()
        self.tally = saved["tally"]
        self.begun.session.restore(saved["session"], self._file.cut(saved["event_bytes"]))
        self._reported = len(self.begun.session.events)

    def _write_events(self) -> None:
        events = self.begun.session.events
        self._events, self._reported = events[self._reported :], len(events)
        self._file.append(self._events)
