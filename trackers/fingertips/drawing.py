"""Symbols drawn with the thumb folded: where a stroke begins and ends in the stream, and what its event says.

A stroke ends with the mode, with the fingertips, or with a rest (section 1.1, step 8). Frames that are still are cut
off both ends (section 8.2).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.gesture.codes import STILL
from jaxfilters.trackers.fingertips.events import SYMBOL, Event, HandFrame, Recogniser, Stroke
from jaxfilters.trackers.fingertips.state import SYMBOLIC, rescaled


@dataclass(frozen=True)
class DrawingConfig:
    """Constants; pixels are those of a 640x480 image, frames last 1/30 s. `scaled` converts both.

    All numbers of frames are durations: how long a hand moves or rests does not depend on the camera.
    """

    resting_frames: int = 12
    """A rest that ends a stroke; shorter ones are corners."""
    least_frames: int = 8
    """In which a stroke moves; what is shorter is none."""
    least_size: float = 30.0
    """Longer side of the box around a stroke, pixels; what is smaller is none."""
    folding_frames: int = 8
    """Within which a finger comes out or folds; such a movement at either end is no part of a stroke, if it rests
    between the two for half as long."""
    most_frames: int = 600
    """After which a stroke is ended, so that none goes on for ever."""


def scaled(config: DrawingConfig, *, height: float, fps: float) -> DrawingConfig:
    """The same for images of another height in pixels, and another number of frames a second."""
    durations = ("resting_frames", "least_frames", "folding_frames", "most_frames")
    return rescaled(config, pixels=("least_size",), durations=durations, height=height, fps=fps)


class Drawing(NamedTuple):
    """The stroke that one hand is at."""

    points: tuple[np.ndarray, ...] = ()
    codes: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()
    times_s: tuple[float, ...] = ()
    first_frame: int = 0
    rests: int = 0
    """Frames since it moved."""


NOTHING_DRAWN = Drawing()


def drawn(config: DrawingConfig, state: Drawing, now: HandFrame) -> tuple[Drawing, Stroke | None]:
    """The stroke so far, and the one that ended with this frame, if one did."""
    is_drawing = now.mode == SYMBOLIC and len(now.position) > 0
    if not is_drawing:
        return NOTHING_DRAWN, finished(config, state)
    if not state.points:
        if now.code == STILL:
            return NOTHING_DRAWN, None
        state = state._replace(first_frame=now.frame)
        point = now.position.mean(axis=0)
    else:
        # The mean of the places would jump when a fingertip comes or goes.
        point = state.points[-1] + now.displacement
    state = Drawing(
        (*state.points, point),
        (*state.codes, now.code),
        (*state.counts, len(now.position)),
        (*state.times_s, now.time_s),
        state.first_frame,
        state.rests + 1 if now.code == STILL else 0,
    )
    if state.rests >= config.resting_frames or len(state.points) >= config.most_frames:
        return NOTHING_DRAWN, finished(config, state)
    return state, None


def finished(config: DrawingConfig, state: Drawing) -> Stroke | None:
    """The stroke without the rests at its ends; None where it is too short or too small to be one."""
    moving = np.flatnonzero(np.asarray(state.codes, int) != STILL)
    moving = _unfolded(config, moving)
    moving = moving[-1] - _unfolded(config, (moving[-1] - moving)[::-1])[::-1] if len(moving) else moving
    if len(moving) < config.least_frames:
        return None
    span = slice(int(moving[0]), int(moving[-1]) + 1)
    points = np.stack(state.points)[span]
    if np.ptp(points, axis=0).max() < config.least_size:
        return None
    return Stroke(
        points,
        np.asarray(state.codes, np.int32)[span],
        np.asarray(state.counts, np.int32)[span],
        np.asarray(state.times_s)[span],
        state.first_frame + span.start,
    )


def _unfolded(config: DrawingConfig, moving: np.ndarray) -> np.ndarray:
    """The frames that move, without a short movement at their beginning after which the finger rests."""
    # Neighbouring frames are no pause, however long a frame is.
    pauses = np.flatnonzero(np.diff(moving) > max(config.folding_frames // 2, 1))
    if not len(pauses) or moving[pauses[0]] - moving[0] >= config.folding_frames:
        return moving
    return moving[pauses[0] + 1 :]


def symbol_event(hand: int, now: HandFrame, stroke: Stroke, recogniser: Recogniser | None) -> Event:
    """What a stroke is, where it lies, and where it begins and ends; its label is None where nothing knows it."""
    low, high = stroke.points.min(axis=0), stroke.points.max(axis=0)
    quantities: dict[str, Any] = {
        "label": None,
        "confidence": None,
        "fingers": int(np.median(stroke.counts)),
        "first_frame": stroke.first_frame,
        "last_frame": stroke.first_frame + len(stroke.points) - 1,
        "box_px": [round(float(value), 1) for value in (*low, *high)],
        "first_px": [round(float(value), 1) for value in stroke.points[0]],
        "last_px": [round(float(value), 1) for value in stroke.points[-1]],
    }
    if recogniser is not None:
        found = recogniser(stroke)
        quantities |= {"label": found.label, "confidence": round(found.confidence, 4)}
    return Event(now.frame, now.time_s, hand, SYMBOL, "end", quantities)
