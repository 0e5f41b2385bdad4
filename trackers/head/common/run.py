"""A head's session in a run: images of all cameras in, rows and pictures out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any, NamedTuple, Protocol, runtime_checkable

import cv2
import jax
import numpy as np

from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.app.results import TrackTable
from jaxfilters.trackers.app.stream import StreamSpec
from jaxfilters.trackers.head.common.drawing import draw_frame
from jaxfilters.trackers.head.common.following import UNUSED_POINTS
from jaxfilters.trackers.head.common.input import Setup
from jaxfilters.trackers.head.common.table import SHOWN_STATUS, SKIPPED, HeadRows, with_gaps
from jaxfilters.trackers.io.content_hash import content_hash
from jaxfilters.trackers.io.paired_input import PairedInput
from jaxfilters.trackers.io.undistortion import straightened
from jaxfilters.trackers.io.video_input import FrameSet

MOST_WAITING = 32
"""Moments after which rows are written, however few of them are whole."""


@runtime_checkable
class HeadTracker(Protocol):
    """What follows a head."""

    @property
    def events(self) -> list[tuple[int, str]]:
        """(frame index, what happened), in order."""
        ...

    def process(self, images: np.ndarray, times: np.ndarray) -> Any:
        """Track of the next frames in metres and radians, a row each, with the fields of `HeadTrack`."""
        ...

    def saved(self) -> Any:
        """All that the next frame needs; None where a run cannot go on from here."""
        ...

    def restore(self, saved: Any) -> None:
        """Go on from what `saved` gave."""
        ...


class RowsOf(NamedTuple):
    """How what a session returns becomes rows of its table."""

    table: TrackTable
    nothing: Callable[[int], Any]
    """`frames -> rows` of the right shapes and types."""


class HeadStream:
    """The session of a head, as `jaxfilters.trackers.app.stream` runs it."""

    def __init__(self, place: Setup, session: HeadTracker, rows: RowsOf, chunk: int):
        """A session before its first image.

        Args:
            place: What is watched.
            session: What follows the head.
            rows: How its track becomes rows.
            chunk: Frames that are processed together.
        """
        self.place, self.session = place, session
        self.frame_of = list[int]()
        """Of every frame of the session, the number in the run, which counts skipped moments."""
        self.status = "no images of one moment"
        self._rows, self._chunk, self._frames = rows, chunk, 0

    def is_due(self, waiting: Sequence[FrameSet]) -> bool:
        """Whether enough moments are whole."""
        return sum(map(_is_whole, waiting)) == self._chunk or len(waiting) == MOST_WAITING

    def process(self, moments: Sequence[FrameSet]) -> HeadRows:
        """A row for every moment; skipped where it is not whole."""
        whole = [_is_whole(moment) for moment in moments]
        track = self._track([moment for moment, is_whole in zip(moments, whole, strict=True) if is_whole])
        self.frame_of += [self._frames + int(i) for i in np.flatnonzero(whole)]
        self._frames += len(moments)
        times_s = np.asarray([moment.time_s for moment in moments])
        return with_gaps(track, times_s, whole, self._rows.nothing)

    def pictures(self, moments: Sequence[FrameSet], rows: HeadRows) -> Any:
        """The images of all cameras with the head in them."""
        return (draw_frame(list(moment.images), self.place.rig, rows, i) for i, moment in enumerate(moments))

    def saved(self) -> Any:
        """As of the session."""
        return self.session.saved()

    def restore(self, saved: Any, rows: HeadRows) -> None:
        """As of the session."""
        self.session.restore(saved)
        self.frame_of, self._frames = np.flatnonzero(rows.status != SKIPPED).tolist(), len(rows.status)

    def _track(self, moments: Sequence[FrameSet]) -> Any:
        if not moments:
            return None
        grey = [
            [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in moment.images if image is not None]
            for moment in moments
        ]
        num_events = len(self.session.events)
        track = self.session.process(np.asarray(grey), np.asarray([moment.time_s for moment in moments]))
        for _, what in self.session.events[num_events:]:
            if what.startswith(UNUSED_POINTS):
                warn(f"{what}; a face is detected instead")
        self.status = SHOWN_STATUS[int(track.status[-1])]
        return track


def stream_spec(
    stream: HeadStream, rows: RowsOf, config: Any, files: Mapping[str, Any], contents: Mapping[str, Any] | None = None
) -> StreamSpec:
    """A run of a head.

    Args:
        stream: What is watched, and what follows the head.
        rows: How its track becomes rows.
        config: A dataclass of Python values: the options of the session.
        files: What else decides about the results, by the names of options; None where it was not given.
        contents: Trees of arrays that were read from files, beside the cameras and landmarks, by what they are.
    """
    sources = stream.place.sources
    paired = PairedInput(sources)
    total = min((getattr(source, "frames", 0) for source in sources), default=0) or None
    moments = straightened(iter(paired), stream.place.undistortions)
    identity = _identity(stream.place, config, files, contents or {})
    return StreamSpec(sources, moments, paired.trouble, stream, rows.table, identity, total)


def _identity(place: Setup, config: Any, files: Mapping[str, Any], contents: Mapping[str, Any]) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    lenses = [np.zeros(5) if one.is_identity else one.distortion for one in place.undistortions]
    read = {"cameras": [place.rig, lenses, place.focal_log_std], "landmarks": place.points, **contents}
    return {
        "input": [source.name for source in place.sources],
        "image_sizes": [list(source.image_size) for source in place.sources],
        "fps": [source.fps for source in place.sources],
        "version": version("jaxfilters"),
        **{f"contents of {name}": content_hash(*jax.tree.leaves(tree)) for name, tree in read.items()},
        **{f"--{name}": str(value) for name, value in files.items() if value is not None},
        **{f"config.{name}": value for name, value in asdict(config).items()},
    }


def _is_whole(moment: FrameSet) -> bool:
    return all(image is not None for image in moment.images)
