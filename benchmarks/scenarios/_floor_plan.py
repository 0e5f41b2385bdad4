"""A picture of tracks over a floor, beside the true ones."""

from pathlib import Path

import cv2
import numpy as np

from jaxfilters.benchmarks.multi_object import FloorTracks

PIXELS_PER_M = 45
MARGIN_M = 1.0
GRID_M = 2.0
TRUTH_COLOR, GRID_COLOR, AREA_COLOR = (150, 150, 150), (235, 235, 235), (120, 120, 120)
"""Blue, green, red."""
LONGEST_GAP = 7
"""Frames across which a line is drawn."""


def draw_floor_plan(path: Path, truth: FloorTracks, estimate: FloorTracks, area: np.ndarray) -> None:
    """Write a plan with Y upwards: true tracks thick and grey, estimated ones thin, a colour each, with their numbers.

    Args:
        path: Of the picture.
        truth: What is right.
        estimate: What was found.
        area: (2, 2) metres: least and greatest X, Y of what is compared.
    """
    low, high = area[0] - MARGIN_M, area[1] + MARGIN_M
    cols, rows = np.ceil((high - low) * PIXELS_PER_M).astype(int)
    picture = np.full((rows, cols, 3), 255, np.uint8)

    def at(xy):
        scaled = (np.asarray(xy, float) - low) * PIXELS_PER_M
        return np.stack([scaled[..., 0], rows - 1 - scaled[..., 1]], axis=-1).round().astype(np.int32)

    for x in np.arange(np.ceil(low[0] / GRID_M), high[0] / GRID_M) * GRID_M:
        _line(picture, at([(x, low[1]), (x, high[1])]))
    for y in np.arange(np.ceil(low[1] / GRID_M), high[1] / GRID_M) * GRID_M:
        _line(picture, at([(low[0], y), (high[0], y)]))
    corner, opposite = at(area).tolist()
    cv2.rectangle(picture, corner, opposite, AREA_COLOR)
    for rows_of_one in _by_identity(truth):
        cv2.polylines(picture, [at(piece) for piece in _pieces(rows_of_one)], False, TRUTH_COLOR, 5, cv2.LINE_AA)
    for rows_of_one in _by_identity(estimate):
        identity = int(rows_of_one.identity[0])
        color = _color(identity)
        cv2.polylines(picture, [at(piece) for piece in _pieces(rows_of_one)], False, color, 2, cv2.LINE_AA)
        cv2.putText(picture, str(identity), at(rows_of_one.xy_m[0]).tolist(), cv2.FONT_HERSHEY_SIMPLEX, 0.6, color, 2)
    caption = f"grey: truth; colours: tracks; squares of {GRID_M:g} m"
    cv2.putText(picture, caption, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"cannot write {path}")


def _line(picture: np.ndarray, ends: np.ndarray) -> None:
    start, end = ends.tolist()
    cv2.line(picture, start, end, GRID_COLOR)


def _by_identity(tracks: FloorTracks) -> list[FloorTracks]:
    return [
        FloorTracks(*(rows[tracks.identity == identity] for rows in tracks)) for identity in np.unique(tracks.identity)
    ]


def _pieces(one: FloorTracks) -> list[np.ndarray]:
    return np.split(one.xy_m, np.flatnonzero(np.diff(one.frame) > LONGEST_GAP) + 1)


def _color(number: int) -> tuple[int, int, int]:
    hue = np.array([[[number * 67 % 180, 220, 190]]], np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red
