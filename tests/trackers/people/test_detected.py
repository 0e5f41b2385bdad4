"""Foreground from boxes: silhouettes that fill them, frame by frame, without lens distortion."""

import numpy as np

from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.detected import DetectedForeground

SHAPE = (120, 160)
IMAGE = np.zeros((*SHAPE, 3), np.uint8)
PLAIN = Undistortion(SHAPE)


def box_of(probability):
    v, u = np.nonzero(probability > 0.5)
    return np.array([u.min(), v.min(), u.max(), v.max()])


def test_a_silhouette_fills_its_box_and_frames_follow_one_another():
    """To a pixel but for the tips of soles and crown, 0.012 of the height."""
    box = np.array([50, 20, 78, 100, 1.0])
    found = DetectedForeground({1: box[None]}, PLAIN, spread_px=0.0)
    assert not found.apply(IMAGE).any()
    saved = found.state()
    shown = found.apply(IMAGE)
    np.testing.assert_allclose(box_of(shown), [50, 21, 78, 99], atol=1.1)
    assert not found.apply(IMAGE).any()
    again = DetectedForeground({1: box[None]}, PLAIN, spread_px=0.0)
    again.restore(saved)
    np.testing.assert_array_equal(again.apply(IMAGE), shown)
    wider = DetectedForeground({0: box[None]}, PLAIN, spread_px=4.0)
    np.testing.assert_allclose(box_of(wider.apply(IMAGE)) - box_of(shown), [-4, -4, 4, 4], atol=1)


def test_legs_reach_the_lower_edge_of_a_box():
    """But for their rounded tips, a part in 80 of the height: those of the model of bodies end 0.017 heights higher."""
    shape, bottom, height = (480, 240), 440.0, 400.0
    found = DetectedForeground({0: np.array([[60.0, bottom - height, 180.0, bottom, 1.0]])}, Undistortion(shape))
    _, _, _, v1 = box_of(found.apply(np.zeros((*shape, 3), np.uint8)))
    assert 0 <= bottom - v1 < height / 80


def test_scores_are_probabilities_and_boxes_add_up_also_at_the_border():
    """Two boxes of one place leave (1 - a)(1 - b) for nobody; one half outside the image is cut off."""
    boxes = np.array([(40.0, 20, 68, 100, 0.6), (40.0, 20, 68, 100, 0.5), (-10.0, 60, 18, 140, 1.0)])
    shown = DetectedForeground({0: boxes}, PLAIN).apply(IMAGE)
    np.testing.assert_allclose(shown[55, 54], 1 - 0.4 * 0.5, atol=1e-3)
    assert shown[90, 4] > 0.99
    assert shown.shape == SHAPE


def test_boxes_are_straightened_like_the_images():
    """A box drawn into a distorted image, then straightened by the map of the images, is where its silhouette is."""
    K = np.array([[120.0, 0, 80], [0, 120, 60], [0, 0, 1]])
    lens = Undistortion(SHAPE, K, np.array([-0.3, 0.1, 0, 0, 0]))
    left, top, right, bottom = 118, 12, 138, 66
    drawn = np.zeros(SHAPE, np.uint8)
    drawn[top : bottom + 1, (left + right) // 2] = 255
    straight = np.nonzero(lens.apply(drawn).max(axis=1) > 120)[0]
    shown = DetectedForeground({0: np.array([(left, top, right, bottom, 1.0)], float)}, lens, spread_px=0.0).apply(
        IMAGE
    )
    _, v0, _, v1 = box_of(shown)
    height = straight.max() - straight.min()
    np.testing.assert_allclose(v0, straight.min() + 0.012 * height, atol=1.6)
    np.testing.assert_allclose(v1, straight.max() - 0.012 * height, atol=1.6)


def test_distorted_pixels_come_back():
    """Corners and middle of the image, to a thousandth of a pixel."""
    K = np.array([[120.0, 0, 80], [0, 121, 60], [0, 0, 1]])
    lens = Undistortion(SHAPE, K, np.array([-0.2, 0.05, 0.001, -0.001, 0]))
    uv = np.array([[(10.0, 10.0), (150.0, 110.0)], [(80.0, 60.0), (30.0, 100.0)]])
    np.testing.assert_allclose(lens.straightened(lens.distorted(uv)), uv, atol=1e-3)
    assert np.abs(lens.distorted(uv) - uv).max() > 1
    np.testing.assert_array_equal(PLAIN.distorted(uv), uv)
