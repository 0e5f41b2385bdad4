"""One picture of a whole run of an articulated hand: frames, and estimates over time beside the truth; its errors."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxfilters.models.articulated.layout import LINKS, PALM_NAMES, Layout
from jaxfilters.trackers.app.chart import Color, Curve, draw_chart
from jaxfilters.trackers.app.video import caption
from jaxfilters.trackers.articulated.drawing import Scene, draw_frame
from jaxfilters.trackers.articulated.recording import FeatureSequence
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack
from jaxfilters.trackers.io.errors import OutputError

LAST_FRAMES = 15
"""Over which errors of angles are averaged, as in the experiments of the paper."""
_TILES, _TILE = 4, 240
_WIDTH = _TILES * _TILE
_ROWS = 180
"""Pixels: height of a chart."""
_COLORS = ((70, 70, 215), (60, 150, 60), (205, 110, 40))
_INK, _TRUTH = (90, 90, 90), (165, 165, 165)


class Errors(NamedTuple):
    """Of the last frames that have an estimate and a truth."""

    angle_deg: float
    """Mean absolute error of all joint angles over the last `LAST_FRAMES` such frames."""
    length_px: float
    """Mean absolute error of the links' lengths in the last one."""
    within_2_sigma: float
    """Share of these lengths whose error is at most two of their standard deviations."""


def errors_of(sequence: FeatureSequence, layout: Layout, results: TimedArticulatedTrack) -> Errors | None:
    """Errors against the truth; None where none is known, or no frame has an estimate."""
    if sequence.truth is None:
        return None
    truth = sequence.truth[: len(results.times_s)]
    known = np.isfinite(truth).all(axis=1) & np.isfinite(results.mean).all(axis=1)
    frames = np.flatnonzero(known)[-LAST_FRAMES:]
    if not frames.size:
        return None
    offsets = results.mean[frames].astype(float) - truth[frames]
    angles = (offsets[:, layout.angles] + np.pi) % (2 * np.pi) - np.pi
    lengths = np.abs(offsets[-1, layout.lengths])
    inside = lengths <= 2 * results.std[frames[-1], layout.lengths]
    return Errors(float(np.rad2deg(np.abs(angles).mean())), float(lengths.mean()), float(inside.mean()))


def draw_summary(sequence: FeatureSequence, layout: Layout, scene: Scene, results: TimedArticulatedTrack) -> np.ndarray:
    """(rows, cols, 3) uint8: frames above, charts below, with 2-sigma bands and the truth in grey where it is known.

    The charts are scale (of a hand in space its distance), a part of the quaternion, an angle, the number of
    hypotheses, and the lengths of each finger and of the palm (figures 12 to 16 of the paper).
    """
    return np.concatenate([_montage(scene, results), *_charts(sequence, layout, results)])


def write_summary(
    path: Path, sequence: FeatureSequence, layout: Layout, scene: Scene, results: TimedArticulatedTrack
) -> None:
    """Write `draw_summary` as a PNG image.

    Raises:
        OutputError: the image cannot be written.
    """
    if not cv2.imwrite(str(path), draw_summary(sequence, layout, scene, results)):
        raise OutputError(f"cannot write {path} (is the disk full?).")


def _montage(scene: Scene, results: TimedArticulatedTrack) -> np.ndarray:
    indices = np.linspace(0, len(results.times_s) - 1, _TILES).round().astype(int)
    low, high = _boxes(scene)
    extents = (high - low)[np.isfinite(low).all(axis=-1)].max(axis=-1, initial=0.0)
    shape = scene.canvas.shape
    side = int(np.clip(1.3 * np.percentile(extents, 90) if extents.size else np.inf, 64, min(shape)))
    tiles = []
    for i in indices:
        center = 0.5 * (low[i] + high[i])
        center = center if np.isfinite(center).all() else 0.5 * np.asarray(shape[::-1])
        left, top = np.clip(center - side / 2, 0, np.asarray(shape[::-1]) - side).astype(int)
        square = draw_frame(scene, int(i))[top : top + side, left : left + side]
        tile = cv2.resize(square, (_TILE, _TILE), interpolation=cv2.INTER_AREA)
        caption(tile, f"{results.times_s[i] - results.times_s[0]:.2f} s", 0)
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)


def _boxes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Upper left and lower right corners (frames, 2) of the hand in the picture, NaN where there is none."""
    frames = len(scene.wrist)
    points = np.concatenate([scene.measured.points, scene.joints.reshape(frames, -1, 2)], axis=1)
    points = scene.canvas.place(points)
    observed = (np.abs(points) < 1e5).all(axis=-1)
    low = np.where(observed[..., None], points, np.inf).min(axis=1)
    high = np.where(observed[..., None], points, -np.inf).max(axis=1)
    nothing = ~observed.any(axis=1)[:, None]
    return np.where(nothing, np.nan, low), np.where(nothing, np.nan, high)


def _charts(sequence: FeatureSequence, layout: Layout, results: TimedArticulatedTrack) -> list[np.ndarray]:
    times_s = results.times_s - results.times_s[0]
    states = _Series(sequence, layout, results)

    def chart(title: str, curves: list[Curve], cells: int, x_label: str = "", *, from_zero: bool = False) -> np.ndarray:
        return draw_chart((_ROWS, _WIDTH // cells), title, times_s, curves, x_label, from_zero=from_zero)

    in_space = layout.position_size == 3
    halves = [
        chart("distance, m, with 2 sigma", states.curves("wrist_z", _COLORS[2]), 2)
        if in_space
        else chart("scale", states.scale(_COLORS[2]), 2),
        chart("q_x, with 2 sigma", states.curves("q_x", _COLORS[1]), 2),
        chart("theta_13, degrees, with 2 sigma", states.curves("theta_13", _COLORS[0], factor=180 / np.pi), 2),
        chart("hypotheses", [Curve("", results.num_hypotheses.astype(float), _INK)], 2, from_zero=True),
    ]
    thirds: list[np.ndarray] = []
    groups, unit = _lengths(layout), "m" if in_space else "px"
    for i, names in enumerate(groups):
        pairs = [states.curves(name, color, labelled=True) for name, color in zip(names, _COLORS, strict=True)]
        curves = [curve for pair in pairs for curve in pair]
        thirds.append(chart(unit, curves, 3, "time (s)" if i >= len(groups) - 3 else ""))
    return [*_rows(halves, 2), *_rows(thirds, 3)]


def _lengths(layout: Layout) -> list[list[str]]:
    """Names of the lengths of each finger, and of the palm."""
    fingers = range(1, layout.num_fingers + 1)
    return [*([f"r_{finger}{link}" for link in range(1, LINKS + 1)] for finger in fingers), list(PALM_NAMES)]


class _Series:
    """Numbers of the state over time: estimates, and under them the truth where it is known."""

    def __init__(self, sequence: FeatureSequence, layout: Layout, results: TimedArticulatedTrack):
        shape = results.mean.shape
        truth = np.full(shape, np.nan) if sequence.truth is None else sequence.truth[: shape[0]].astype(float)
        self._layout, self._results, q = layout, results, layout.quaternion
        # A quaternion and its negative are one rotation.
        opposite = np.sum(results.mean[:, q] * truth[:, q], axis=1) < 0
        truth[opposite, q] *= -1
        self._truth = truth

    def curves(self, name: str, color: Color, *, factor: float = 1.0, labelled: bool = False) -> list[Curve]:
        """One number times a factor, with a band of two standard deviations."""
        i = self._layout.names.index(name)
        mean, std = self._results.mean[:, i].astype(float), self._results.std[:, i].astype(float)
        estimate = Curve(name if labelled else "", factor * mean, color, 2 * factor * std)
        return [*self._known(factor * self._truth[:, i], "" if labelled else "truth"), estimate]

    def scale(self, color: Color) -> list[Curve]:
        """The squared length of the quaternion; its deviation would take correlations, which a track has not."""
        truth = np.sum(self._truth[:, self._layout.quaternion] ** 2, axis=1)
        return [*self._known(truth, "truth"), Curve("", self._results.scale.astype(float), color)]

    def _known(self, truth: np.ndarray, label: str) -> list[Curve]:
        return [Curve(label, truth, _TRUTH)] if np.isfinite(truth).any() else []


def _rows(charts: list[np.ndarray], cells: int) -> list[np.ndarray]:
    """Charts of equal size side by side, with empty paper at the end."""
    charts = charts + [np.full_like(charts[0], 255)] * (-len(charts) % cells)
    return [np.concatenate(charts[i : i + cells], axis=1) for i in range(0, len(charts), cells)]
