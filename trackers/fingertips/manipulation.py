"""Direct manipulation with the thumb out: pinch, move, rotate, resize, each with its quantities (section 2.8).

Thumb and forefinger that close are a pinch. Their middle moves things, and the line from the one to the other rotates
and resizes them while it is open. Each begins when its quantity has left where it was by more than
a jitter, and ends when it rests or the fingers are gone.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.fingertips.events import MOVE, PINCH, RESIZE, ROTATE, Event, HandFrame
from jaxfilters.trackers.fingertips.state import ABSENT, MANIPULATION, rescaled


@dataclass(frozen=True)
class HandlingConfig:
    """Constants; pixels are those of a 640x480 image, frames last 1/30 s. `scaled` converts both."""

    closed: float = 38.0
    """Thumb and forefinger nearer than this are a pinch, pixels."""
    opened: float = 55.0
    """A pinch is over when they are farther apart."""
    moved: float = 12.0
    """Beyond jitter, pixels."""
    turned: float = math.radians(10)
    resized: float = math.log(1.2)
    """Logarithm of a ratio of lengths."""
    resting: float = 0.3
    """Share of these within which a quantity rests."""
    resting_frames: int = 15
    """For which a quantity rests that has ended."""
    unseen_frames: int = 60
    """A pinch hides the thumb for so long at most: closed fingers have one outline, and one tip or none."""


def scaled(config: HandlingConfig, *, height: float, fps: float) -> HandlingConfig:
    """The same for images of another height in pixels, and another number of frames a second."""
    pixels, durations = ("closed", "opened", "moved"), ("resting_frames", "unseen_frames")
    return rescaled(config, pixels=pixels, durations=durations, height=height, fps=fps)


class Activity(NamedTuple):
    """A quantity that is at rest or changes."""

    anchor: np.ndarray
    """Where it rested last."""
    recent: np.ndarray
    """Where it was when it last moved."""
    rests: int
    """Frames since then."""
    is_on: bool


class Handling(NamedTuple):
    """What one hand is about."""

    is_pinching: bool = False
    unseen: int = 0
    """Frames since thumb and forefinger were both observed."""
    partner: int = -1
    """Identity of the forefinger."""
    activities: dict[str, Activity] = {}  # noqa: RUF012 - never changed in place


IDLE = Handling()


def handled(config: HandlingConfig, hand: int, state: Handling, now: HandFrame) -> tuple[Handling, list[Event]]:
    """What the hand is about after a frame, and what began and ended in it."""
    grip = _grip(now)
    pinching, unseen = _pinching(config, state, now, grip)
    events = []
    if pinching != state.is_pinching:
        events.append(_event(now, hand, PINCH, "begin" if pinching else "end", _where(now, grip)))
    values: dict[str, np.ndarray] = {}
    if now.mode == MANIPULATION or (pinching and len(now.position)):
        values[MOVE] = now.position.mean(axis=0) if grip is None else grip.middle
    if grip is not None and now.mode == MANIPULATION and not pinching:
        values[ROTATE], values[RESIZE] = np.array([grip.angle]), np.array([math.log(max(grip.gap, 1e-3))])
    partner = -1 if grip is None else grip.partner
    limits = {MOVE: config.moved, ROTATE: config.turned, RESIZE: config.resized}
    activities = {}
    for name, limit in limits.items():
        before = state.activities.get(name)
        # Another finger, or another point of reference, is another quantity.
        if before is not None and name in values and (partner != state.partner or pinching != state.is_pinching):
            events += _ended(now, hand, name, before)
            before = None
        if name not in values:
            events += _ended(now, hand, name, before)
            continue
        activities[name], more = _advanced(config, now, hand, name, limit, before, values[name])
        events += more
    return Handling(pinching, unseen, partner, activities), events


class _Grip(NamedTuple):
    """Thumb and forefinger."""

    middle: np.ndarray
    gap: float
    angle: float
    """Of the line from the thumb to the forefinger, counter-clockwise in the image, radians."""
    partner: int


def _grip(now: HandFrame) -> _Grip | None:
    thumbs, others = np.flatnonzero(now.is_thumb), np.flatnonzero(~now.is_thumb)
    if not len(thumbs) or not len(others):
        return None
    thumb = now.position[thumbs[0]]
    direction = now.position - now.palm
    angle = np.arctan2(-direction[:, 1], direction[:, 0])
    apart = np.abs(np.angle(np.exp(1j * (angle[others] - angle[thumbs[0]]))))
    partner = others[np.argmin(apart)]
    line = now.position[partner] - thumb
    return _Grip(
        (thumb + now.position[partner]) / 2,
        float(np.hypot(*line)),
        math.atan2(-line[1], line[0]),
        int(now.identity[partner]),
    )


def _pinching(config: HandlingConfig, state: Handling, now: HandFrame, grip: _Grip | None) -> tuple[bool, int]:
    if grip is not None:
        return grip.gap < (config.opened if state.is_pinching else config.closed), 0
    unseen = state.unseen + 1
    return state.is_pinching and now.mode != ABSENT and unseen <= config.unseen_frames, unseen


def _advanced(
    config: HandlingConfig,
    now: HandFrame,
    hand: int,
    name: str,
    limit: float,
    before: Activity | None,
    value: np.ndarray,
) -> tuple[Activity, list[Event]]:
    if before is None:
        return Activity(value, value, 0, False), []
    if name == ROTATE:
        value = before.recent + np.angle(np.exp(1j * (value - before.recent)))
    moved = np.linalg.norm(value - before.recent) > config.resting * limit
    recent, rests = (value, 0) if moved else (before.recent, before.rests + 1)
    if rests >= config.resting_frames:
        return Activity(value, value, 0, False), _ended(now, hand, name, before._replace(recent=value))
    if not before.is_on and np.linalg.norm(value - before.anchor) > limit:
        return Activity(before.anchor, value, 0, True), [_event(now, hand, name, "begin", {})]
    return Activity(before.anchor, recent, rests, before.is_on), []


def _ended(now: HandFrame, hand: int, name: str, activity: Activity | None) -> list[Event]:
    if activity is None or not activity.is_on:
        return []
    change = activity.recent - activity.anchor
    quantities: dict[str, Any] = {
        MOVE: lambda: {"dx_px": float(change[0]), "dy_px": float(change[-1])},
        ROTATE: lambda: {"angle_rad": float(change[0])},
        RESIZE: lambda: {"ratio": math.exp(float(change[0]))},
    }[name]()
    return [_event(now, hand, name, "end", quantities)]


def _where(now: HandFrame, grip: _Grip | None) -> dict[str, Any]:
    place = now.position.mean(axis=0) if len(now.position) else now.palm
    found = {"x_px": float(place[0]), "y_px": float(place[1])}
    if grip is not None:
        found = {"x_px": float(grip.middle[0]), "y_px": float(grip.middle[1]), "gap_px": grip.gap}
    return found


def _event(now: HandFrame, hand: int, name: str, phase: str, quantities: dict[str, Any]) -> Event:
    rounded = {key: round(value, 3) for key, value in quantities.items()}
    return Event(now.frame, now.time_s, hand, name, phase, rounded)
