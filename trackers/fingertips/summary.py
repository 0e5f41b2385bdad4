"""One picture of a whole run of fingertips: where they went and what they drew, and their coordinates over time."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.trackers.app.canvas import INK, color_of, write
from jaxfilters.trackers.app.chart import Curve, Shade, draw_chart
from jaxfilters.trackers.fingertips.events import SYMBOL, Event
from jaxfilters.trackers.fingertips.table import TimedTips, name_of
from jaxfilters.trackers.fingertips.tally import Tally
from jaxfilters.trackers.io.errors import OutputError

SIGMAS = 2.0
"""Half the height of the bands of charts, standard deviations."""
_WIDTH, _PLAN_ROWS, _CHART_ROWS, _LEGEND_ROWS = 1200, 560, 200, 30
_MARGIN, _LINE_ROWS = 16, 22
_PAPER, _FRAME = 255, (200, 200, 200)
_DRAWN, _HANDLED = (205, 240, 205), (225, 225, 250)
"""Paper of a chart while a symbol is drawn, and while something is handled."""


def draw_summary(
    track: TimedTips, frames: int, seconds: float, events: Sequence[Event], image_size: tuple[int, int]
) -> np.ndarray:
    """(rows, cols, 3) uint8: the paths in the image with the symbols, and charts over paper in colours of the events.

    Args:
        track: Rows of all fingertips.
        frames: Number of frames, with fingertips or without.
        seconds: From the first frame to the last.
        events: What began and ended.
        image_size: Columns and rows of the images, pixels.
    """
    times_s = np.linspace(0.0, max(seconds, 1e-3), max(frames, 1))
    fingers = sorted({(int(hand), int(finger)) for hand, finger in zip(track.hand, track.finger, strict=True)})
    shades = _shades(events, times_s)
    curves: list[list[Curve]] = [[], []]
    for hand, finger in fingers:
        rows = (track.hand == hand) & (track.finger == finger)
        values, width = np.full((2, 2, len(times_s)), np.nan)
        values[:, track.frame[rows]] = track.position[rows].T
        width[:, track.frame[rows]] = SIGMAS * track.position_std[rows].T
        for axis in (0, 1):
            curves[axis].append(Curve("", values[axis], _color(hand, finger), width[axis]))
    counts = np.bincount(track.frame, minlength=len(times_s)).astype(float)
    size = (_CHART_ROWS, _WIDTH)
    charts = [
        draw_chart(size, "x, px, with 2 sigma", times_s, curves[0], shades=shades),
        draw_chart(size, "y, px, with 2 sigma", times_s, curves[1], shades=shades),
        draw_chart(
            size,
            "fingertips; green paper: a symbol is drawn, red paper: something is handled",
            *(times_s, [Curve("", counts, INK)], "time (s)"),
            from_zero=True,
            shades=shades,
        ),
    ]
    return np.concatenate([_plan(track, fingers, events, image_size), _legend(fingers), *charts])


def write_summary(
    path: Path, track: TimedTips, tally: Tally, events: Sequence[Event], image_size: tuple[int, int]
) -> None:
    """Write `draw_summary` as a PNG image.

    Raises:
        OutputError: the image cannot be written.
    """
    if not cv2.imwrite(str(path), draw_summary(track, tally.frames, tally.last_s - tally.first_s, events, image_size)):
        raise OutputError(f"cannot write {path} (is the disk full?).")


def _color(hand: int, finger: int) -> tuple[int, int, int]:
    return color_of(5 * hand + finger)


def _plan(
    track: TimedTips, fingers: list[tuple[int, int]], events: Sequence[Event], image_size: tuple[int, int]
) -> np.ndarray:
    """The image plane with the path of every fingertip; thick where a symbol is drawn."""
    sheet = np.full((_PLAN_ROWS, _WIDTH, 3), _PAPER, np.uint8)
    scale = min((_PLAN_ROWS - 40) / image_size[1], (_WIDTH - 40) / image_size[0])
    corner = np.array([(_WIDTH - scale * image_size[0]) / 2, 20])

    def pixel(points: np.ndarray) -> np.ndarray:
        return np.rint(np.clip(corner + scale * np.asarray(points, float), -1e4, 1e4)).astype(np.int32)

    low, high = pixel(np.zeros(2)), pixel(np.asarray(image_size))
    cv2.rectangle(sheet, tuple(map(int, low)), tuple(map(int, high)), _FRAME, 1)
    symbols = [event for event in events if event.name == SYMBOL]
    for hand, finger in fingers:
        rows = (track.hand == hand) & (track.finger == finger)
        order = np.argsort(track.frame[rows])
        frames, points = track.frame[rows][order], pixel(track.position[rows][order])
        drawing = np.zeros(len(frames), bool)
        for event in symbols:
            span = (event.quantities["first_frame"] <= frames) & (frames <= event.quantities["last_frame"])
            drawing |= (event.hand == hand) & span
        for i in np.flatnonzero(np.diff(frames) == 1):
            ends = (tuple(map(int, points[i])), tuple(map(int, points[i + 1])))
            cv2.line(sheet, *ends, _color(hand, finger), 3 if drawing[i] else 1, cv2.LINE_AA)
    # In the margin and not where they were drawn, which is one place for all of them.
    for line, event in enumerate(symbols):
        label = event.quantities["label"] or "unknown"
        write(sheet, f"{event.time_s:.1f} s  {label}", (int(high[0]) + _MARGIN, 36 + _LINE_ROWS * line))
    return sheet


def _legend(fingers: list[tuple[int, int]]) -> np.ndarray:
    sheet = np.full((_LEGEND_ROWS, _WIDTH, 3), _PAPER, np.uint8)
    left = 62
    for hand, finger in fingers:
        cv2.line(sheet, (left, 15), (left + 20, 15), _color(hand, finger), 4, cv2.LINE_AA)
        left += 50 + write(sheet, name_of(hand, finger), (left + 26, 20))
    if not fingers:
        write(sheet, "no fingertips", (left, 20))
    return sheet


def _shades(events: Sequence[Event], times_s: np.ndarray) -> list[Shade]:
    """Paper for the times of symbols, and of what began and ended."""
    shades, began = [], dict[tuple[int, str], float]()
    for event in events:
        if event.name == SYMBOL:
            places = np.clip([event.quantities["first_frame"], event.quantities["last_frame"]], 0, len(times_s) - 1)
            shades.append(Shade(float(times_s[places[0]]), float(times_s[places[1]]), _DRAWN))
        elif event.phase == "begin":
            began[event.hand, event.name] = float(times_s[event.frame])
        elif (event.hand, event.name) in began:
            shades.append(Shade(began.pop((event.hand, event.name)), float(times_s[event.frame]), _HANDLED))
    return shades
