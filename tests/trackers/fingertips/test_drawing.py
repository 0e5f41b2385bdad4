import numpy as np
import pytest

from jaxfilters.models.gesture.codes import STILL
from jaxfilters.trackers.fingertips.drawing import Drawing, DrawingConfig, drawn, finished, scaled
from jaxfilters.trackers.fingertips.events import HandFrame
from jaxfilters.trackers.fingertips.state import SYMBOLIC


def drawing(*parts):
    """A drawing of stretches of frames: (frames, code, pixels a frame to the right)."""
    codes = [code for frames, code, _ in parts for _ in range(frames)]
    steps = [step for frames, _, step in parts for _ in range(frames)]
    points = np.stack([np.cumsum(steps), np.zeros(len(steps))], axis=1)
    return Drawing(tuple(points), tuple(codes), (1,) * len(codes), tuple(np.arange(len(codes)) / 30), 100)


REST, STROKE, OUT = (8, STILL, 0.0), (20, 1, 6.0), (5, 5, 9.0)


@pytest.mark.parametrize("before", [(), (REST,), (OUT, REST), (REST, OUT, REST)])
@pytest.mark.parametrize("after", [(), (REST,), (REST, OUT)])
def test_a_finger_that_comes_out_or_folds_is_no_part_of_the_stroke(before, after):
    stroke = finished(DrawingConfig(), drawing(*before, STROKE, *after))
    assert stroke is not None
    assert len(stroke.points) == 20
    assert stroke.first_frame == 100 + sum(part[0] for part in before)
    assert np.all(stroke.codes == 1)


def test_corners_and_short_sides_stay():
    """A rest as short as a corner's, or after a side longer than a finger takes to come out."""
    for first in (((5, 1, 9.0), (3, STILL, 0.0)), ((9, 1, 9.0), REST)):
        stroke = finished(DrawingConfig(), drawing(*first, STROKE))
        assert stroke is not None
        assert len(stroke.points) == sum(part[0] for part in first) + 20


@pytest.mark.parametrize("fps", [4.0, 10.0, 30.0, 60.0, 120.0])
def test_strokes_begin_and_end_at_the_same_times_at_any_frame_rate(fps):
    """An L with a corner of 0.25 s is one stroke, one with a rest of a second is two; 0.1 s of movement is none."""
    config = scaled(DrawingConfig(), height=480.0, fps=fps)
    side, corner, rest = (round(seconds * fps) for seconds in (1.0, 0.25, 1.0))
    speed = 100 / side
    for pause, expected in ((corner, [2 * side + corner]), (rest, [side, side])):
        parts = ((side, 1, speed), (pause, STILL, 0.0), (side, 13, speed), (rest, STILL, 0.0))
        assert [len(stroke.points) for stroke in strokes(config, drawing(*parts))] == expected
    assert not strokes(config, drawing((round(0.1 * fps), 1, 60.0), (rest, STILL, 0.0)))


def strokes(config, whole):
    """The strokes of a stream in which a finger draws all the time."""
    state, found = Drawing(), []
    steps = np.diff(np.stack(whole.points), axis=0, prepend=0)
    for i, (code, step) in enumerate(zip(whole.codes, steps, strict=True)):
        one, nowhere = np.zeros((1, 2)), np.zeros(2)
        now = HandFrame(i, 0.0, np.zeros(1, int), one, np.zeros(1, bool), nowhere, nowhere, SYMBOLIC, step, code)
        state, stroke = drawn(config, state, now)
        found += [] if stroke is None else [stroke]
    return found


def test_what_is_too_short_or_too_small_is_no_stroke():
    assert finished(DrawingConfig(), Drawing()) is None
    assert finished(DrawingConfig(), drawing((7, 1, 9.0))) is None
    assert finished(DrawingConfig(), drawing((20, 1, 1.0))) is None
