"""Pictures of fingertips: names, trails, palms, and what the hands do."""

import math
from collections import deque
from typing import Any

import cv2
import numpy as np

from jaxfilters.trackers.app.canvas import color_of, write_outlined
from jaxfilters.trackers.app.video import caption
from jaxfilters.trackers.fingertips.events import SYMBOL, Event
from jaxfilters.trackers.fingertips.state import MODE_NAMES, HandReport
from jaxfilters.trackers.fingertips.table import name_of

TRAIL_FRAMES = 25
EVENT_FRAMES = 45
"""For which an event is shown."""
_PALM, _THUMB = (230, 230, 230), (60, 60, 255)


class FingertipPictures:
    """Frames with what was found in them; trails and events stay for a while."""

    def __init__(self) -> None:
        self._trails: dict[str, deque[tuple[int, int]]] = {}
        self._events: deque[tuple[int, str]] = deque(maxlen=4)

    def drawn(
        self, image: np.ndarray, frame: int, time_s: float, report: HandReport, events: list[Event]
    ) -> np.ndarray:
        """A copy of an image (rows, cols, 3) with the fingertips of all hands; of even size, for video coders."""
        picture = image[: len(image) // 2 * 2, : image.shape[1] // 2 * 2].copy()
        now = set()
        for hand in range(len(report.num_tips)):
            if report.has_palm[hand]:
                _draw_palm(picture, report, hand)
            for slot in np.flatnonzero(report.is_tip[hand]):
                now.add(self._draw_tip(picture, report, hand, int(slot)))
        self._trails = {name: trail for name, trail in self._trails.items() if name in now}
        modes = ", ".join(MODE_NAMES[int(mode)] for mode in report.mode)
        caption(picture, f"{time_s:.1f} s  {modes}", 0)
        self._events.extend((frame, in_words(event)) for event in events)
        for line, (_, text) in enumerate([event for event in self._events if frame - event[0] < EVENT_FRAMES], 1):
            caption(picture, text, line)
        return picture

    def _draw_tip(self, picture: np.ndarray, report: HandReport, hand: int, slot: int) -> str:
        identity = int(report.identity[hand, slot])
        name, color = name_of(hand, identity), color_of(5 * hand + identity)
        place = _pixel(report.position[hand, slot])
        trail = self._trails.setdefault(name, deque(maxlen=TRAIL_FRAMES))
        trail.append(place)
        cv2.polylines(picture, [np.asarray(trail, np.int32)], False, color, 1, cv2.LINE_AA)
        thickness = 2 if report.is_observed[hand, slot] else 1
        cv2.circle(picture, place, 9, color, thickness, cv2.LINE_AA)
        if report.is_thumb[hand, slot]:
            cv2.circle(picture, place, 13, _THUMB, 2, cv2.LINE_AA)
        at = (place[0] + 12, place[1] - 8)
        write_outlined(picture, name, at, color, 0.5)
        return name


def in_words(event: Event) -> str:
    """An event for people."""
    numbers = {name: value for name, value in event.quantities.items() if isinstance(value, float)}
    if event.name == SYMBOL:
        return f"symbol: {event.quantities['label'] or 'unknown'}"
    reported = ", ".join(_quantity(name, value) for name, value in numbers.items())
    return f"{event.name} {event.phase}s" + (f": {reported}" if reported else "")


def _quantity(name: str, value: float) -> str:
    """`dx 14 px`, or `angle 40 degrees` of radians."""
    stem, _, unit = name.rpartition("_")
    if unit == "rad":
        return f"{stem} {math.degrees(value):.4g} degrees"
    return f"{stem} {value:.4g} {unit}" if stem else f"{name} {value:.4g}"


def _draw_palm(picture: np.ndarray, report: HandReport, hand: int) -> None:
    palm = report.palm[hand]
    cv2.circle(picture, _pixel(palm), 4, _PALM, -1, cv2.LINE_AA)
    if report.has_axis[hand]:
        cv2.line(picture, _pixel(palm), _pixel(palm + 40 * report.axis[hand]), _PALM, 1, cv2.LINE_AA)


def _pixel(point: Any) -> tuple[int, int]:
    x, y = np.clip(np.rint(point), -10_000, 10_000).astype(int)
    return int(x), int(y)
