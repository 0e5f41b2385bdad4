"""Pictures of people on a floor: outlines over the images, and the floor plan with the path of each person."""

import itertools
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.models.person.ellipsoid import VISIBLE, Outline
from jaxfilters.trackers.app.canvas import color_of, write, write_outlined
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.people.recorded import Sighting, pieces
from jaxfilters.trackers.people.state import DORMANT, FREE, TENTATIVE, People, PeopleScene

_PLAN_PX = 900
_MARGIN_PX = 50
_PAPER, _INK, _FLOOR = (255, 255, 255), (70, 70, 70), (236, 240, 242)
_NOT_MEASURED = {"hidden", "no_depth"}
"""Modes of sightings whose distance from the camera is not measured."""
_UNSURE = (170, 170, 170)


def drawn(image: np.ndarray, outlines: Outline, people: People) -> np.ndarray:
    """A copy of an image with everybody's outline, foot and number; NumPy leaves."""
    image = image.copy()
    for slot in np.flatnonzero((people.mode != FREE) & (people.mode != DORMANT) & (outlines.code == VISIBLE)):
        color = _UNSURE if people.mode[slot] == TENTATIVE else color_of(int(people.identity[slot]))
        _draw_one(image, outlines.center[slot], outlines.shape[slot], color, int(people.identity[slot]))
    return image


def _draw_one(image, center, shape, color, identity):
    values, vectors = np.linalg.eigh(shape)
    axes = tuple(round(float(axis)) for axis in np.sqrt(np.maximum(values, 0.0)))
    if max(axes) > 4 * max(image.shape[:2]):
        return
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    place = (round(float(center[0])), round(float(center[1])))
    cv2.ellipse(image, place, axes, angle, 0, 360, color, 2, cv2.LINE_AA)
    if identity >= 0:
        top = (place[0] - 8, max(12, place[1] - int(np.sqrt(shape[1, 1])) - 6))
        write_outlined(image, str(identity), top, color, thickness=2)


def write_plan(path: Path, scene: PeopleScene, tracks: dict[int, list[Sighting]]) -> None:
    """The floor from above, X to the right and Y up, with cameras and paths; a dot where a person was last.

    Where a person is hidden or the distance from the camera is not measured, the path is thin and faint, in a band of
    two standard deviations. A path is interrupted where a person was lost and found again.

    Raises:
        OutputError: it cannot be written.
    """
    floor = np.asarray(scene.floor, float)
    centers = np.asarray(scene.centers())
    everything = np.concatenate([floor, centers])
    low, high = everything.min(axis=0) - 0.3, everything.max(axis=0) + 0.3
    scale = (_PLAN_PX - 2 * _MARGIN_PX) / max(high - low)
    size = np.ceil((high - low) * scale).astype(int) + 2 * _MARGIN_PX

    def pixels(xy):
        flipped = (np.atleast_2d(xy) - low) * scale
        return np.round(np.stack([_MARGIN_PX + flipped[:, 0], size[1] - _MARGIN_PX - flipped[:, 1]], -1)).astype(int)

    plan = np.full((size[1], size[0], 3), _PAPER, np.uint8)
    cv2.fillPoly(plan, [pixels(floor)], _FLOOR, cv2.LINE_AA)
    cv2.polylines(plan, [pixels(floor)], True, _INK, 1, cv2.LINE_AA)
    _draw_grid(plan, low, high, pixels)
    for number, center in enumerate(centers):
        at = tuple(int(v) for v in pixels(center)[0])
        cv2.drawMarker(plan, at, _INK, cv2.MARKER_TRIANGLE_UP, 16, 2, cv2.LINE_AA)
        write(plan, f"camera {number}", (at[0] + 10, at[1] - 8), _INK)
    parts = {identity: pieces(track, scene.config.hidden_s) for identity, track in tracks.items()}
    for identity, some in parts.items():
        for one in some:
            _draw_band(plan, one, color_of(identity), pixels)
    for identity, some in parts.items():
        for one in some:
            _draw_way(plan, one, color_of(identity), pixels)
        end = tuple(int(v) for v in pixels(some[-1][-1].mean[:2])[0])
        cv2.circle(plan, end, 5, color_of(identity), -1, cv2.LINE_AA)
        write(plan, str(identity), (end[0] + 7, end[1] - 5), _INK, 0.5)
    if not cv2.imwrite(str(path), plan):
        raise OutputError(f"cannot write {path}.")


def _draw_way(plan, piece, color, pixels):
    faint = tuple((np.array(color) + np.array(_FLOOR)) // 2)
    for before, now in itertools.pairwise(piece):
        ends = pixels(np.stack([before.mean[:2], now.mean[:2]]))
        measured = not {before.mode, now.mode} & _NOT_MEASURED
        shade, width = (color, 2) if measured else (tuple(map(int, faint)), 1)
        cv2.line(plan, *(tuple(map(int, end)) for end in ends), shade, width, cv2.LINE_AA)


def _draw_band(plan, piece, color, pixels):
    """Two standard deviations around the places that are not measured, blended into the plan."""
    band = np.zeros(plan.shape[:2], np.uint8)
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = 2 * np.stack([np.cos(turns), np.sin(turns)])
    for before, now in itertools.pairwise(piece):
        if {before.mode, now.mode} & _NOT_MEASURED:
            edges = [
                sighting.mean[:2] + (np.linalg.cholesky(sighting.covariance[:2, :2] + 1e-9 * np.eye(2)) @ circle).T
                for sighting in (before, now)
            ]
            hull = cv2.convexHull(pixels(np.concatenate(edges)).astype(np.int32))
            cv2.fillConvexPoly(band, hull, 255)
    tinted = (plan.astype(int) * 5 + np.array(color)) // 6
    plan[band > 0] = tinted[band > 0]


def _draw_grid(plan, low, high, pixels):
    step = 1.0 if max(high - low) < 12 else 5.0
    for axis in (0, 1):
        for value in np.arange(np.ceil(low[axis] / step) * step, high[axis], step):
            ends = np.array([low, high])
            ends[:, axis] = value
            a, b = (tuple(int(v) for v in end) for end in pixels(ends))
            cv2.line(plan, a, b, (222, 222, 222), 1, cv2.LINE_AA)
            place = (a[0] - 8, len(plan) - 28) if axis == 0 else (8, a[1] + 4)
            write(plan, f"{value:g}", place, _INK, 0.4)
    write(plan, "metres", (8, len(plan) - 8), _INK, 0.42)
