"""Features of strokes: what they ignore, what they keep, and strokes that hardly are any."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.gesture.stroke import features, resampled, shape_features, stacked, to_judge, turned


def spiral(num_samples=120, warp=1.0):
    angle = 9 * np.linspace(0, 1, num_samples) ** warp
    return np.stack([(1 + angle) * np.cos(angle), (1 + angle) * np.sin(angle)], axis=1)


def test_points_are_evenly_spaced_and_keep_the_ends():
    found = resampled(spiral(2000), 200)
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.01)
    np.testing.assert_allclose(found[[0, -1]], spiral(2000)[[0, -1]], atol=1e-12)


def shape_of(points):
    return np.asarray(features([points]))[:, :-2]


def test_place_size_and_speed_do_not_matter():
    expected = features([spiral()])
    np.testing.assert_allclose(features([40 * spiral() + np.array([300.0, -20.0])]), expected, atol=1e-4)
    np.testing.assert_allclose(features([spiral(400, warp=1.4)]), features([spiral(400)]), atol=0.1)


def test_a_turn_of_the_stroke_turns_its_features():
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    expected = shape_of(spiral()).reshape(-1, 3, 2) @ turn.T
    np.testing.assert_allclose(shape_of(spiral() @ turn.T), expected.reshape(-1, 6), atol=1e-4)


def test_features_are_turned_as_the_stroke_is():
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    both = jnp.stack([features([spiral()], 2.0), features([spiral() * [1, 3]])])
    expected = np.stack([features([spiral() @ turn.T], 2.0), features([spiral() * [1, 3] @ turn.T])])
    np.testing.assert_allclose(turned(both, angle), expected, atol=1e-4)


def test_directions_have_length_one_and_circles_turn_evenly():
    angle = np.linspace(0, 2 * np.pi, 200)
    found = shape_of(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    np.testing.assert_allclose(np.linalg.norm(found[1:-1, 2:4], axis=1), 1, rtol=1e-5)
    turning = np.linalg.norm(found[3:-3, 4:], axis=1)
    # A twelfth of a circle, halved.
    np.testing.assert_allclose(turning, np.pi / 12, rtol=0.1)


@pytest.mark.parametrize("stroke", [np.zeros((1, 3)), np.ones((7, 3)), np.array([[0.0, 0, 0], [0, 0, 1e-9]])])
def test_a_stroke_that_hardly_is_one_has_finite_features(stroke):
    found = features([stroke])
    assert found.shape == (40, 11)
    assert np.all(np.isfinite(found))


def test_what_is_no_stroke_is_refused():
    for pieces, word in (([np.zeros((0, 2))], "at least one sample"), ([np.array([[0.0, np.nan]])], "finite")):
        with pytest.raises(ValueError, match=word):
            features(pieces)
    with pytest.raises(ValueError, match="at least one"):
        stacked([])


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="num_points"):
        resampled(spiral(), 1)


def test_pieces_are_joined_and_their_gaps_are_no_ink():
    pieces = [np.array([[0.0, 0], [1, 0]]), np.zeros((0, 2)), np.array([[1.0, 1], [0, 1]])]
    found = np.asarray(features(pieces, 2.0, num_points=31))
    np.testing.assert_array_equal(found[:, -2], np.repeat([1, 0, 1], [11, 10, 10]))
    np.testing.assert_array_equal(found[:, -1], 2)
    whole = np.asarray(features([np.concatenate(pieces)], num_points=31))
    np.testing.assert_array_equal(found[:, :-2], whole[:, :-2])
    assert np.all(whole[:, -2:] == 1)
    assert np.all(np.isfinite(shape_features(jnp.zeros((5, 2)))))


def test_strokes_that_are_none_have_no_features_and_the_others_keep_theirs():
    none = [[], [np.zeros((0, 2))], [np.ones((1, 2))], [np.ones((9, 2))], [np.array([[0.0, 0], [np.inf, 0]])]]
    found = to_judge([(pieces, 1.0) for pieces in none] + [([spiral()], 2.0)], 2)
    assert np.all(np.isnan(found[..., :-1]))
    np.testing.assert_allclose(found[..., -1], features([spiral()], 2.0), atol=1e-6)
    with pytest.raises(ValueError, match="number 1"):
        to_judge([([], 1.0), ([np.zeros((4, 3))], 1.0)], 2)
