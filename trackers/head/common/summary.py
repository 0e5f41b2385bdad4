"""One picture of a whole run of a head: pose, deformation and score over time, and the face model."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.app.canvas import INK, write
from jaxfilters.trackers.app.chart import Color, Curve, Shade, draw_chart
from jaxfilters.trackers.head.common.drawing import HEAD_STATUS_COLORS, draw_points
from jaxfilters.trackers.head.common.state import NUM_MODES
from jaxfilters.trackers.head.common.table import DISPLAYED, SHOWN_STATUS, HeadRows, displayed
from jaxfilters.trackers.io.errors import OutputError

DEVIATIONS = 2.0
"""How far from the mean the drawn faces of a mode are."""
_WIDTH, _ROWS = 1200, 190
"""Pixels: of the picture, and the height of a chart."""
_LEGEND_ROWS, _MODE_ROWS = 34, 250
_MODE_TITLES, _MODE_CAPTION = 66, 34
"""Rows of a drawn mode above and below its faces."""
_LEFT, _OVERSAMPLE = 62, 2
_SCALE = 1.35
"""Pixels a millimetre of the drawn faces, at most."""
_COLORS: tuple[Color, ...] = ((70, 70, 215), (60, 150, 60), (205, 110, 40), (160, 60, 160), (40, 140, 190))
_TRUTH, _MEAN = (150, 150, 150), (165, 165, 165)
_PLUS, _MINUS = (70, 70, 215), (205, 110, 40)
_TINT = 0.22
"""Share of a status's colour in the paper behind a chart."""


class Labels(NamedTuple):
    """What the numbers of a face's changes are called."""

    coefficients: str = "deformation, mm"
    scale: float = 1e3
    """Of the coefficients in this picture."""
    curve: str = "a"
    mode: str = "a"
    modes: str = "deformation estimated"


DEFORMATION = Labels()


def draw_summary(
    track: HeadRows, model: FaceModel | None, truth: np.ndarray | None, labels: Labels = DEFORMATION
) -> np.ndarray:
    """(rows, cols, 3) uint8: charts with 2-sigma bands over paper in the colours of the statuses, and the modes.

    `truth` are poses (frames, 6) in metres and radians, drawn in grey; None where they are not known.
    """
    times_s = track.times_s
    shades = status_shades(times_s, track.status)
    pose, std = displayed(track.pose), displayed(track.pose_std)
    known = None if truth is None else displayed(truth[: len(times_s)])

    def chart(title: str, curves: list[Curve], x_label: str = "") -> np.ndarray:
        return draw_chart((_ROWS, _WIDTH // 2), title, times_s, curves, x_label, shades=shades)

    charts = []
    for axis, name in enumerate(DISPLAYED):
        curve = Curve("", pose[:, axis].astype(float), _COLORS[axis % 3], DEVIATIONS * std[:, axis].astype(float))
        under = [] if known is None else [Curve("truth", known[:, axis].astype(float), _TRUTH)]
        charts.append(chart(f"{name}, with 2 sigma", [*under, curve]))
    modes = [
        Curve(f"{labels.curve}{mode + 1}", labels.scale * track.deformation[:, mode].astype(float), _COLORS[mode])
        for mode in range(min(NUM_MODES, 0 if model is None else track.deformation.shape[1]))
        if np.any(np.nan_to_num(track.deformation[:, mode]))
    ]
    charts.append(chart(labels.coefficients, modes, "time (s)"))
    charts.append(chart("score: mean correlation", [Curve("", track.score.astype(float), INK)], "time (s)"))
    # Translations on the left, rotations on the right.
    order = [0, 3, 1, 4, 2, 5, 6, 7]
    rows = [np.concatenate([charts[a], charts[b]], axis=1) for a, b in zip(order[::2], order[1::2], strict=True)]
    return np.concatenate([_legend(track.status), *rows, draw_modes(model, labels)])


def write_summary(
    path: Path, track: HeadRows, model: FaceModel | None, truth: np.ndarray | None, labels: Labels = DEFORMATION
) -> None:
    """Write `draw_summary` as a PNG image.

    Raises:
        OutputError: the image cannot be written.
    """
    if not cv2.imwrite(str(path), draw_summary(track, model, truth, labels)):
        raise OutputError(f"cannot write {path} (is the disk full?).")


def status_shades(times_s: np.ndarray, status: np.ndarray) -> list[Shade]:
    """Paper for a chart: each frame's status holds from halfway to its neighbours."""
    middles = 0.5 * (times_s[1:] + times_s[:-1])
    changes = np.flatnonzero(np.diff(status)) + 1
    edges = [float(times_s[0]), *middles[changes - 1].tolist(), float(times_s[-1])]
    states = status[np.concatenate([[0], changes])]
    return [Shade(a, b, _tint(int(s))) for a, b, s in zip(edges[:-1], edges[1:], states, strict=True)]


def draw_modes(model: FaceModel | None, labels: Labels = DEFORMATION) -> np.ndarray:
    """(rows, cols, 3) uint8: for each mode estimated the mean face and those beside it, from the front and the side."""
    sheet = np.full((_MODE_ROWS, _WIDTH, 3), 255, np.uint8)
    deviation = np.zeros(0) if model is None else np.asarray(model.deviation, float)
    learned = np.flatnonzero(deviation > 0)[:NUM_MODES]
    if model is None or not learned.size:
        what = "no face was registered" if model is None else "a rigid face: no deformation was estimated"
        write(sheet, what, (_LEFT, 24))
        return sheet
    width = _WIDTH // NUM_MODES
    for cell, mode in enumerate(learned):
        offset = DEVIATIONS * deviation[mode] * np.asarray(model.basis, float)[:, mode].reshape(-1, 3)
        picture = _draw_mode((_MODE_ROWS, width), np.asarray(model.mean, float), offset)
        write(picture, f"{labels.mode}{mode + 1}, sd {deviation[mode]:.1f} mm", (26, 52))
        sheet[:, cell * width : (cell + 1) * width] = picture
    legend = f"{labels.modes}: mean in grey, {DEVIATIONS:g} sd more in red, {DEVIATIONS:g} sd less in blue"
    write(sheet, legend, (_LEFT, 24))
    return sheet


def _draw_mode(size: tuple[int, int], mean: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The faces (10, 3) `mean` and `offset` to both sides of it."""
    rows, cols = (_OVERSAMPLE * length for length in size)
    sheet = np.full((rows, cols, 3), 255, np.uint8)
    shapes = np.stack([mean - offset, mean + offset, mean])
    low, high = shapes[..., 1].min(), shapes[..., 1].max()
    room = rows - _OVERSAMPLE * (_MODE_TITLES + _MODE_CAPTION)
    scale = min(_OVERSAMPLE * _SCALE, room / max(high - low, 1.0))
    # From the front x goes to the right; from the side z does, the nose to the left.
    for axes, middle in (((0, 1), 0.33), ((2, 1), 0.8)):
        center = np.array([middle * cols, _OVERSAMPLE * _MODE_TITLES + 0.5 * (room - scale * (low + high))])
        for shape, color in zip(shapes, (_MINUS, _PLUS, _MEAN), strict=True):
            draw_points(sheet, center + scale * shape[:, axes], color, color, 2.0 * _OVERSAMPLE)
    picture = cv2.resize(sheet, size[::-1], interpolation=cv2.INTER_AREA)
    for view, middle in (("front", 0.33), ("side", 0.8)):
        write(picture, view, (int(middle * size[1]) - 16, size[0] - 12), _MEAN)
    return picture


def _legend(status: np.ndarray) -> np.ndarray:
    """The colours of the statuses, and the share of frames in each."""
    sheet = np.full((_LEGEND_ROWS, _WIDTH, 3), 255, np.uint8)
    left = _LEFT
    for code, word in enumerate(SHOWN_STATUS):
        share = float(np.mean(status == code))
        if not share:
            continue
        cv2.rectangle(sheet, (left, 10), (left + 26, 26), _tint(code), cv2.FILLED)
        cv2.rectangle(sheet, (left, 10), (left + 26, 26), INK, 1)
        left += 36 + write(sheet, f"{word} {100 * share:.1f} %", (left + 34, 23)) + 24
    return sheet


def _tint(code: int) -> Color:
    blue, green, red = (round(255 - _TINT * (255 - part)) for part in HEAD_STATUS_COLORS[code])
    return blue, green, red
