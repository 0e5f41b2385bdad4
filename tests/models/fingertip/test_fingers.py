"""Ends and bases of fingers on rendered capsules, whose discs are known."""

import math

import cv2
import numpy as np
import pytest

from jaxfilters.models.fingertip.fingers import find_bases, measured_ends


def capsule(start, end, radius, shape=(120, 120)):
    """Share of each pixel in a capsule, by many points in it: 0 to 255."""
    fine = (np.arange(8) - 3.5) / 8
    y, x = [(np.arange(n)[:, None] + fine).ravel() for n in shape]
    x, y = x[None] - start[0], y[:, None] - start[1]
    along = np.subtract(end, start)
    share = np.clip((x * along[0] + y * along[1]) / (along @ along), 0, 1)
    inside = np.hypot(x - share * along[0], y - share * along[1]) <= radius
    return np.rint(255 * inside.reshape(shape[0], 8, shape[1], 8).mean(axis=(1, 3))).astype(np.uint8)


def direction(angle):
    return np.array([math.cos(angle), math.sin(angle)])


@pytest.mark.parametrize("angle", np.linspace(0, 2 * math.pi, 7)[:-1])
@pytest.mark.parametrize("radius", [5.0, 6.5, 8.0])
def test_an_end_is_found_to_a_tenth_of_a_pixel(angle, radius):
    """From a start 2.5 px away, with a direction 6 degrees off."""
    end = np.array([60.3, 59.6])
    image = capsule(end - 50 * direction(angle), end, radius)
    towards = direction(angle + math.radians(6))[None]
    found = measured_ends(image, end[None] + [[1.5, -2.0]], towards, 6.5)
    # Turned about a place half a radius behind the end.
    assert np.linalg.norm(found.points[0] - end) < 0.1 + 6.5 * math.radians(6)
    exact = measured_ends(image, end[None] + [[1.5, -2.0]], direction(angle)[None], 6.5)
    assert np.linalg.norm(exact.points[0] - end) < 0.12
    assert exact.radii[0] == pytest.approx(radius, abs=0.15)
    assert exact.scores[0] > 0.98
    assert exact.is_end[0]


def test_the_middle_of_a_finger_is_no_end():
    found = measured_ends(capsule((60, 110), (60, 20), 6.5), np.array([[60.0, 60.0]]), np.array([[0.0, -1.0]]), 6.5)
    assert not found.is_end[0]


@pytest.mark.parametrize("beside_x", [41, 79])
def test_a_finger_beside_changes_neither_thickness_nor_place(beside_x):
    one = capsule((60, 110), (60, 40), 6.5)
    two = np.maximum(one, capsule((beside_x, 110), (beside_x, 30), 6.5))
    tip, up = np.array([[60.5, 41.0]]), np.array([[0.0, -1.0]])
    alone, beside = measured_ends(one, tip, up, 6.5), measured_ends(two, tip, up, 6.5)
    np.testing.assert_allclose(beside.points, alone.points, atol=0.05)
    np.testing.assert_allclose(beside.radii, alone.radii, atol=0.05)


def test_something_wide_scores_less_than_a_finger():
    knuckle = measured_ends(capsule((60, 160), (60, 60), 25), np.array([[60.0, 41.5]]), np.array([[0.0, -1.0]]), 6.5)
    assert knuckle.scores[0] < 0.9
    assert knuckle.radii[0] > 1.7 * 6.5


def test_a_base_is_where_the_finger_meets_the_palm():
    """The palm, of radius 27, ends 34 px below the tip; a bent finger is followed around its joint."""
    image = np.maximum(capsule((60, 80), (60.1, 80), 27), capsule((60, 80), (52, 40), 6.5))
    image = np.maximum(image, capsule((52, 40), (56, 18), 6.5))
    depth = cv2.distanceTransform(cv2.compare(image, 127, cv2.CMP_GT), cv2.DIST_L2, 5)
    bases = find_bases(depth, np.array([[56.0, 18.0]]), np.array([60.0, 80.0]), 6.5)
    assert bases.is_found[0]
    np.testing.assert_allclose(bases.points[0], (54.8, 54.0), atol=4.0)


def test_a_finger_without_a_palm_has_no_base():
    depth = cv2.distanceTransform(cv2.compare(capsule((60, 60), (60, 20), 6.5), 127, cv2.CMP_GT), cv2.DIST_L2, 5)
    assert not find_bases(depth, np.array([[60.0, 20.0]]), np.array([60.0, 100.0]), 6.5).is_found[0]


def test_no_tips_are_no_error():
    none = np.zeros((0, 2))
    assert measured_ends(np.zeros((9, 9), np.uint8), none, none, 6.5).points.shape == (0, 2)
    assert find_bases(np.zeros((9, 9), np.float32), none, np.zeros(2), 6.5).points.shape == (0, 2)
