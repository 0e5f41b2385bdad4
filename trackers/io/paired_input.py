"""Images that several cameras took at the same moments, for trackers that need all of them at once."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxfilters.trackers.io.input_files import check_rate
from jaxfilters.trackers.io.video_input import FrameSet, VideoSource, on_one_clock


class PairedInput:
    """The moments of several sources: all images of a moment lie within half a frame of each other.

    A moment to which not all sources have an image comes with None for those that have none. Ends with the source that
    ends first, and when a live camera has stopped; `trouble` says so afterwards.
    """

    def __init__(self, sources: Sequence[VideoSource]):
        self._sources = list(sources)
        self._half_s = 0.5 / max(check_rate(source.fps, f"{source.name}: fps") for source in sources)
        self._first_gap: tuple[float, str] | None = None
        self._ended: list[str] = []
        self.moments = self.incomplete = 0

    def __iter__(self) -> Iterator[FrameSet]:
        streams = on_one_clock(self._sources)
        waiting = [self._next(i, stream) for i, stream in enumerate(streams)]
        began = min((item[0] for item in waiting if item is not None), default=0.0)
        while not self._is_over(waiting):
            items = [item for item in waiting if item is not None]
            until = min(time_s for time_s, _ in items) + self._half_s
            images = tuple(image if time_s <= until else None for time_s, image in items)
            now = until - self._half_s - began
            self._count(now, images)
            yield FrameSet(now, images)
            for i, image in enumerate(images):
                if image is not None:
                    waiting[i] = self._next(i, streams[i])

    def trouble(self) -> list[str]:
        """What went wrong, for a person."""
        said = [trouble for source in self._sources if (trouble := source.trouble())]
        going = [source.name for source in self._sources if source.name not in self._ended]
        if self._ended and going:
            said.append(f"{', '.join(self._ended)}: over after {self.moments} moments, before {', '.join(going)}")
        if self._first_gap is not None:
            time_s, name = self._first_gap
            said.append(
                f"{self.incomplete} of {self.moments} moments skipped, where cameras have no images within half a "
                f"frame ({1000 * self._half_s:.0f} ms) of each other; the first at {time_s:.2f} s, without {name}: "
                "frames were dropped, or the cameras are not synchronised"
            )
        return said

    def _next(self, index: int, stream: Iterator[tuple[float, np.ndarray | None]]) -> tuple[float, np.ndarray] | None:
        """The next image of a source, waited for as long as a live camera is not known to have stopped."""
        for time_s, image in stream:
            if image is not None:
                return time_s, image
            if self._sources[index].trouble() is not None:
                return None
        return None

    def _is_over(self, waiting: list[tuple[float, np.ndarray] | None]) -> bool:
        self._ended = [source.name for source, item in zip(self._sources, waiting, strict=True) if item is None]
        return bool(self._ended)

    def _count(self, time_s: float, images: tuple[np.ndarray | None, ...]) -> None:
        self.moments += 1
        without = [source.name for source, image in zip(self._sources, images, strict=True) if image is None]
        if without:
            self.incomplete += 1
            self._first_gap = self._first_gap or (time_s, ", ".join(without))
