"""Hands in 21 keypoints: which fingers are extended, where palm and bases are, and on which side the thumb is."""

import numpy as np
import pytest

from jaxfilters.models.fingertip.first_image import base_angles
from jaxfilters.models.fingertip.keypoints import FINGERS, KEYPOINT_POSTURE, observe_keypoints, thumb_side

ANGLES_DEG = (50.0, 20.0, 5.0, -8.0, -22.0)
"""Of the fingers of a right hand whose arm comes from below, from upwards; the thumb is to the left."""


def skeleton(extended=(True,) * 5, *, place=(300.0, 300.0), size=100.0):
    """Keypoints of a hand with the wrist at `place`; folded fingers return to their knuckle. y points down."""
    points = np.zeros((21, 2))
    roots = [(-0.25, 0.2), (-0.35, 0.95), (-0.1, 1.0), (0.12, 0.97), (0.32, 0.9)]
    for chain, root, angle, out in zip(FINGERS, roots, np.radians(ANGLES_DEG), extended, strict=True):
        ahead = np.array([-np.sin(angle), np.cos(angle)])
        along = np.array([0.0, 0.35, 0.6, 0.85]) if out else np.array([0.0, 0.3, 0.15, 0.02])
        points[list(chain)] = np.array(root) + along[:, None] * ahead
    return np.array(place) + size * points * [1, -1]


def test_extended_fingers_are_tips_in_any_place_size_and_direction():
    rng = np.random.default_rng(0)
    for _ in range(20):
        extended = rng.random(5) < 0.5
        turn = rng.uniform(0, 2 * np.pi)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points = skeleton(extended, place=(0, 0), size=rng.uniform(30, 300)) @ R.T + 400
        hand = observe_keypoints(points, np.ones(21))
        np.testing.assert_array_equal(hand.is_tip, extended)
        np.testing.assert_allclose(hand.tips[extended], points[[4, 8, 12, 16, 20]][extended], rtol=1e-5)
        np.testing.assert_allclose(hand.axis, R @ [0, -1], atol=0.1)
        assert thumb_side(points) == 1
        assert thumb_side(points * [-1, 1]) == -1


def test_angles_of_an_open_hand_are_those_of_the_posture():
    """The skeleton was drawn by eye: within three standard deviations of a person."""
    thumb, index = base_angles(observe_keypoints(skeleton(), np.ones(21)))[:2]
    assert abs(thumb - KEYPOINT_POSTURE.open_thumb) < 3 * KEYPOINT_POSTURE.person_sd
    assert abs(index - KEYPOINT_POSTURE.open_forefinger) < 3 * KEYPOINT_POSTURE.person_sd


def test_keypoints_that_were_not_found_are_no_tips():
    confidence = np.ones(21)
    confidence[[8, 18]] = 0.1
    points = skeleton()
    points[12] = np.nan
    hand = observe_keypoints(points, confidence)
    np.testing.assert_array_equal(hand.is_tip, [True, False, False, True, False])
    assert np.isfinite(hand.tips).all()
    confidence[0] = 0
    assert not observe_keypoints(points, confidence).is_hand
    assert not observe_keypoints(np.zeros((21, 2)), np.ones(21)).is_hand
    with pytest.raises(ValueError, match=r"points and confidence must be \(21, 2\) and \(21,\); got \(20, 2\)"):
        observe_keypoints(points[:20], confidence)
