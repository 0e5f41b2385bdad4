"""Fingertips in a run: images in, rows, events and pictures out."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.trackers.fingertips.events import Event
from jaxfilters.trackers.fingertips.files import EventFile
from jaxfilters.trackers.fingertips.input import DemoHand, shown
from jaxfilters.trackers.fingertips.pictures import FingertipPictures
from jaxfilters.trackers.fingertips.session import FingertipSession
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.fingertips.table import TimedTips, tip_rows
from jaxfilters.trackers.fingertips.tally import Tally
from jaxfilters.trackers.io.video_input import FrameSet


class FingertipStream:
    """The session of hands, as `jaxfilters.trackers.app.stream` runs it."""

    def __init__(
        self, source: Any, observe: Callable[[Any], HandObservation], session: FingertipSession, events: EventFile
    ):
        """Before the first image.

        Args:
            source: Of the images.
            observe: What hands there are in an image.
            session: What follows them.
            events: Where lines for events go.
        """
        self.tally = Tally()
        self._source, self._observe, self._session, self._file = source, observe, session, events
        self._pictures, self._reported = FingertipPictures(), 0
        self._report: HandReport | None = None
        self._events: list[Event] = []

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
        found = self._session.process(self._observe(image), np.array([time_s]))
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
        self._session.finish()
        self._write_events()

    def saved(self) -> Any:
        """What the next image needs."""
        return {"session": self._session.saved(), "tally": self.tally, "event_bytes": self._file.size()}

    def restore(self, saved: Any, rows: TimedTips) -> None:  # noqa: ARG002
        """Go on from what `saved` gave."""
        self.tally = saved["tally"]
        self._session.restore(saved["session"], self._file.cut(saved["event_bytes"]))
        self._reported = len(self._session.events)

    def _write_events(self) -> None:
        self._events, self._reported = self._session.events[self._reported :], len(self._session.events)
        self._file.append(self._events)
