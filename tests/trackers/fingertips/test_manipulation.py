"""When a pinch, a move, a turn and a stretch are over, at any frame rate."""

import numpy as np
import pytest

from jaxfilters.trackers.fingertips.events import MOVE, PINCH, HandFrame
from jaxfilters.trackers.fingertips.manipulation import IDLE, HandlingConfig, handled, scaled
from jaxfilters.trackers.fingertips.state import MANIPULATION, SYMBOLIC

CLOSED = np.array([[300.0, 200.0], [310.0, 190.0]])
"""Thumb and forefinger, pixels."""


def frame(i, tips, mode):
    """A frame with some tips, the first of them the thumb where there are two."""
    n, nowhere = len(tips), np.zeros(2)
    names = np.arange(2 - n, 2)
    return HandFrame(i, 0.0, names, np.asarray(tips), names == 0, np.array([300.0, 300.0]), nowhere, mode, nowhere, 17)


def ends(fps, frames):
    """Seconds at which each event is over."""
    config, state, found = scaled(HandlingConfig(), height=480.0, fps=fps), IDLE, {}
    for i, (tips, mode) in enumerate(frames):
        state, events = handled(config, 0, state, frame(i, tips, mode))
        found |= {event.name: i / fps for event in events if event.phase == "end"}
    return found


@pytest.mark.parametrize("fps", [10.0, 30.0, 60.0])
def test_a_pinch_whose_thumb_is_hidden_is_over_after_two_seconds_and_a_move_after_half_a_second_of_rest(fps):
    second, forefinger = round(fps), CLOSED[1:]
    hidden = ends(fps, [(CLOSED, MANIPULATION)] * second + [(forefinger, SYMBOLIC)] * (3 * second))
    assert hidden[PINCH] == pytest.approx(3.0, abs=1.1 / fps)
    places = [forefinger + np.array([x, 0.0]) for x in [*np.linspace(0, 90, second), *[90.0] * second]]
    moved = ends(fps, [(place, MANIPULATION) for place in places])
    assert moved[MOVE] == pytest.approx(1.5, abs=2.1 / fps)
