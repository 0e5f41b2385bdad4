import numpy as np
import pytest

from jaxfilters.models.gesture.codes import STILL
from jaxfilters.trackers.fingertips.drawing import Drawing, DrawingConfig, finished


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


def test_what_is_too_short_or_too_small_is_no_stroke():
    assert finished(DrawingConfig(), Drawing()) is None
    assert finished(DrawingConfig(), drawing((7, 1, 9.0))) is None
    assert finished(DrawingConfig(), drawing((20, 1, 1.0))) is None
