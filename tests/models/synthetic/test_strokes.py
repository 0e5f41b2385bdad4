"""Symbols that are drawn at random: what stays the same, what varies, and by how much."""

import numpy as np
import pytest

from jaxfilters.models.synthetic import strokes
from jaxfilters.models.synthetic.strokes import SHAPES, drawn, tracked


@pytest.fixture(scope="module")
def many():
    return drawn(0, 40, shapes=("L", "circle cw"))


def paths(drawings):
    """The first finger's tips where it is seen, one symbol after the other."""
    for i, length in enumerate(drawings.lengths):
        observed = drawings.present[:length, 0, i]
        yield drawings.labels[i], drawings.tips[:length, 0, :, i][observed]


def test_the_same_writer_draws_the_same_and_another_does_not(many):
    again, other = drawn(0, 40, shapes=("L", "circle cw")), drawn(1, 40, shapes=("L", "circle cw"))
    np.testing.assert_array_equal(again.tips, many.tips)
    assert not np.array_equal(other.lengths, many.lengths)


def test_every_shape_is_drawn_with_one_finger_and_with_two():
    found = drawn(3, 1)
    assert set(found.labels) == {f"{shape} {fingers}" for shape in SHAPES for fingers in (1, 2)}
    assert found.tips.shape == (found.lengths.max(), 2, 2, 24)
    frames = np.arange(len(found.tips))[:, None, None]
    assert not np.any(found.present & (frames >= found.lengths))
    assert not np.any(found.tips.transpose(0, 1, 3, 2)[~found.present])


def test_shapes_have_the_size_and_the_turn_that_was_specified(many):
    for label, points in paths(many):
        low, high = strokes.HALF_SIZE_PX
        # Turned by up to 30 degrees, stretched by up to four deviations, drawn with tremor.
        assert 0.7 * low < 0.5 * np.ptp(points, axis=0).max() < 1.7 * high, label
    turns = [np.arctan2(*(points[-1] - points[0])[::-1]) for label, points in paths(many) if label.startswith("L")]
    # An L goes down and right as far: its ends are at 45 degrees, but for what stretching adds, 3.5 degrees.
    expected = np.hypot(np.hypot(strokes.TURN_DEG, 3.5), 1.0)
    spread = np.degrees(np.std(turns))
    assert abs(spread - expected) < 4 * expected / np.sqrt(2 * len(turns))


def test_circles_run_clockwise_as_seen_and_end_where_they_began(many):
    for label, points in paths(many):
        if label.startswith("circle"):
            centred = points - points.mean(axis=0)
            angles = np.unwrap(np.arctan2(centred[:, 1], centred[:, 0]))
            assert 5 < angles[-1] - angles[0] < 7


def test_tips_are_missed_and_invented_as_often_as_specified():
    found = drawn(5, 15)
    frames = np.arange(len(found.tips))[:, None] < found.lengths
    two = np.char.endswith(found.labels, "2")
    observed = found.present.sum(axis=1)
    lost = (1 - strokes.LOST) if strokes.LOST else 1.0
    for wanted, chosen, count in (
        (strokes.DROPPED * lost, two, 1),
        (strokes.SPURIOUS * lost, ~two, 2),
        (strokes.LOST, two, 0),
        (strokes.LOST, ~two, 0),
    ):
        inside = frames[:, chosen]
        share = np.mean(observed[:, chosen][inside] == count)
        assert abs(share - wanted) < 4 * np.sqrt(wanted / inside.sum())


def test_a_hand_moves_as_fast_as_specified():
    speeds = []
    for seed in range(12):
        for _, points in paths(drawn(seed, 8, shapes=("Z",))):
            speeds.append(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())
    # Uniform from 4 to 9 pixels a frame, with a factor a person; noise adds a little, rounded corners take it off.
    assert 5.5 < np.mean(speeds) < 7.5
    assert 2 < np.quantile(speeds, 0.01) < np.quantile(speeds, 0.99) < 15


def test_a_tracker_sees_where_the_hand_went_and_how_many_fingers_it_has(many):
    found = tracked(many)
    assert found.labels == many.labels
    for i, ((codes, counts), (points, _), length) in enumerate(
        zip(found.codes, found.paths, many.lengths, strict=True)
    ):
        assert len(codes) == len(counts) == len(points) == length
        np.testing.assert_array_equal(counts, many.present[:length, :, i].sum(axis=1))
        if many.present[:length, 0, i].all() and many.labels[i].startswith("L 1"):
            tips = many.tips[:length, 0, :, i]
            np.testing.assert_allclose(points[-1], tips[-1] - tips[0], atol=1e-2 if counts.max() == 1 else 60)


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ValueError, match="num_trials"):
        drawn(0, 0)
    for shapes in (("heart",), ()):
        with pytest.raises(ValueError, match="shapes"):
            drawn(0, 1, shapes=shapes)
