"""Line charts drawn with OpenCV, so that a bare installation has its pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

Color = tuple[int, int, int]
"""Blue, green, red."""
_INK, _GRID, _PAPER = (60, 60, 60), (228, 228, 228), (255, 255, 255)
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 26, 24
_OVERSAMPLE = 2
"""Drawn larger and shrunk: the stroke font of OpenCV is coarse at reading size."""


@dataclass(frozen=True)
class Curve:
    """One line of a chart."""

    label: str
    values: np.ndarray
    """(points,); gaps where not finite."""
    color: Color
    half_width: np.ndarray | None = None
    """(points,) half the height of the band around the line."""


@dataclass(frozen=True)
class Shade:
    """A stretch of the horizontal axis on paper of another colour."""

    start: float
    end: float
    color: Color


def draw_chart(
    size: tuple[int, int],
    title: str,
    x: np.ndarray,
    curves: list[Curve],
    x_label: str = "",
    *,
    from_zero: bool = False,
    shades: Sequence[Shade] = (),
) -> np.ndarray:
    """(rows, cols, 3) uint8 image of `size` (rows, cols): the curves over `x` (points,), with axes and a legend.

    `from_zero` puts the bottom of the axis at zero. Bands may be cut; lines never are. `shades` lie under everything.
    """
    axes = _Axes(size, (float(x[0]), float(x[-1])), _span(curves, from_zero))
    for shade in shades:
        axes.shade(shade)
    axes.frame(title, x_label)
    for curve in curves:
        axes.band(x, curve)
    for curve in curves:
        axes.line(x, curve)
    axes.legend(curves)
    return axes.image()


def ticks(low: float, high: float, most: int = 5) -> np.ndarray:
    """At most `most` + 1 round numbers (1, 2 or 5 times a power of ten apart) within [low, high]."""
    raw = (high - low) / most
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    numbers = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return numbers * step + 0.0  # no negative zero


def _span(curves: list[Curve], from_zero: bool) -> tuple[float, float]:
    lines = np.concatenate([np.zeros(0), *(curve.values for curve in curves)])
    lines = lines[np.isfinite(lines)]
    if not lines.size:
        return 0.0, 1.0
    low, high = float(lines.min()), float(lines.max())
    if from_zero:
        low = min(low, 0.0)
    # Bands count by their usual width only: where nothing is known they are as wide as the prior.
    bands = [np.nanmedian(c.half_width) for c in curves if c.half_width is not None and np.isfinite(c.half_width).any()]
    margin = max([0.06 * (high - low), *map(float, bands), 1e-6 * max(abs(low), abs(high)), 1e-12])
    return (low if from_zero else low - margin), high + margin


class _Axes:
    """A sheet of paper with two scales."""

    def __init__(self, size: tuple[int, int], x_span: tuple[float, float], y_span: tuple[float, float]):
        rows, cols = (_OVERSAMPLE * length for length in size)
        self._size = size
        self._sheet: np.ndarray = np.full((rows, cols, 3), _PAPER, np.uint8)
        self._x_span = x_span if x_span[1] > x_span[0] else (x_span[0] - 0.5, x_span[0] + 0.5)
        self._y_span = y_span
        self._box = np.asarray((_LEFT, _TOP, size[1] - _RIGHT, size[0] - _BOTTOM)) * _OVERSAMPLE

    def shade(self, shade: Shade) -> None:
        ends = np.clip(np.asarray([shade.start, shade.end]), *self._x_span)
        (u0, _), (u1, _) = self._points(ends, np.zeros(2)).tolist()
        top, bottom = int(self._box[1]), int(self._box[3])
        cv2.rectangle(self._sheet, (u0, top), (u1, bottom), shade.color, cv2.FILLED)

    def frame(self, title: str, x_label: str) -> None:
        left, top, right, bottom = (int(edge) for edge in self._box)
        for value in ticks(*self._y_span):
            y = int(self._points(np.asarray(self._x_span[:1]), np.asarray([value]))[0, 1])
            cv2.line(self._sheet, (left, y), (right, y), _GRID, 1)
            self._text(f"{value:.4g}", (left - 6 * _OVERSAMPLE, y + 4 * _OVERSAMPLE), align_right=True)
        for value in ticks(*self._x_span, most=10):
            x = int(self._points(np.asarray([value]), np.asarray(self._y_span[:1]))[0, 0])
            cv2.line(self._sheet, (x, bottom), (x, bottom + 4 * _OVERSAMPLE), _INK, 1)
            self._text(f"{value:.4g}", (x - 8 * _OVERSAMPLE, bottom + 16 * _OVERSAMPLE))
        self._text(x_label, (right, bottom - 6 * _OVERSAMPLE), align_right=True)
        self._text(title, (left, top - 9 * _OVERSAMPLE), size=0.5)
        cv2.rectangle(self._sheet, (left, top), (right, bottom), _INK, 1)

    def band(self, x: np.ndarray, curve: Curve) -> None:
        if curve.half_width is None:
            return
        shaded = self._sheet.copy()
        for run in _finite_runs(curve.values + curve.half_width):
            upper = self._points(x[run], curve.values[run] + curve.half_width[run])
            lower = self._points(x[run], curve.values[run] - curve.half_width[run])
            cv2.fillPoly(shaded, [np.concatenate([upper, lower[::-1]])], curve.color, cv2.LINE_AA)
        self._sheet = cv2.addWeighted(shaded, 0.25, self._sheet, 0.75, 0)

    def line(self, x: np.ndarray, curve: Curve) -> None:
        for run in _finite_runs(curve.values):
            points = self._points(x[run], curve.values[run])
            cv2.polylines(self._sheet, [points], False, curve.color, 2 * _OVERSAMPLE - 1, cv2.LINE_AA)

    def legend(self, curves: list[Curve]) -> None:
        x, y = int(self._box[2]), int(self._box[1]) - 9 * _OVERSAMPLE
        for curve in reversed([curve for curve in curves if curve.label]):
            x -= self._text(curve.label, (x, y), align_right=True) + 6 * _OVERSAMPLE
            middle = y - 4 * _OVERSAMPLE
            cv2.line(self._sheet, (x - 16 * _OVERSAMPLE, middle), (x, middle), curve.color, 3 * _OVERSAMPLE)
            x -= 30 * _OVERSAMPLE

    def image(self) -> np.ndarray:
        return cv2.resize(self._sheet, self._size[::-1], interpolation=cv2.INTER_AREA)

    def _points(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        left, top, right, bottom = self._box
        (x0, x1), (y0, y1) = self._x_span, self._y_span
        u = left + (x - x0) / (x1 - x0) * (right - left)
        v = np.clip(bottom - (y - y0) / (y1 - y0) * (bottom - top), top, bottom)
        return np.stack([u, v], axis=-1).round().astype(np.int32)

    def _text(self, text: str, place: tuple[int, int], size: float = 0.4, *, align_right: bool = False) -> int:
        style = (cv2.FONT_HERSHEY_SIMPLEX, size * _OVERSAMPLE)
        (width, _), _ = cv2.getTextSize(text, *style, _OVERSAMPLE)
        x, y = place
        cv2.putText(self._sheet, text, (x - width * align_right, y), *style, _INK, _OVERSAMPLE, cv2.LINE_AA)
        return width


def _finite_runs(values: np.ndarray) -> list[slice]:
    """Slices of `values` without a gap in them."""
    edges = np.diff(np.concatenate([[False], np.isfinite(values), [False]]).astype(np.int8))
    return [slice(a, b) for a, b in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)]
