"""Edges of depth images beside analytic surfaces, and fingertips beside the capsules that were rendered."""

import itertools
import math

import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.depth_edges import REACH, depth_edges, goes_behind, own_surfaces, reading_noise
from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.synthetic.desk_hand import BASE_DISTANCES, FINGER_ANGLES, FINGER_RADII, TIP_DISTANCES

SHAPE, RADIUS = (120, 160), 6.5
ANGLES = tuple(FINGER_ANGLES)
PARAMETERS = HandParameters(tip_radius=RADIUS, half_size=9)


def slope(noise_std=0.0):
    """A plane at 0.6 m that recedes by as much as it is wide, with a finger 7.5 mm and 6.5 pixels thick."""
    columns = np.arange(SHAPE[1]) * 0.0075 / RADIUS
    noise = noise_std * np.random.default_rng(0).normal(size=SHAPE)
    return (0.5 + columns[None] + noise).astype(np.float32)


def hand_depth(*, angles=ANGLES, lifts=(0, 0, 0, 0, 0), pointing=()):
    """Depth and mask of spheres along the bones of a hand, viewed from afar, and the pixels (5, 2) of its fingertips.

    `angles` are those of the fingers about the palm, `lifts` the heights of their tips in pixels; what is `pointing`
    to the camera bends up from its middle.
    """
    palm, shape = np.array([160.0, 130.0]), (240, 320)
    balls = [(palm[0], palm[1] + y, 0.0, 19.0) for y in np.arange(22.0, 120.0)] + [(*palm, -20.5, 27.0)]
    tips = []
    for i, (angle, lift) in enumerate(zip(angles, lifts, strict=True)):
        out = np.array([-math.sin(angle), -math.cos(angle)])
        corners = [[*palm + 10 * out, 0], [*palm + BASE_DISTANCES[i] * out, 0], [*palm + TIP_DISTANCES[i] * out, lift]]
        if i in pointing:
            corners[2] = [*palm + 0.85 * TIP_DISTANCES[i] * out, 0.0]
            corners.append([*palm + 0.9 * TIP_DISTANCES[i] * out, 35.0])
        for one, other in itertools.pairwise(np.array(corners, float)):
            balls += [(*one + t * (other - one), FINGER_RADII[i]) for t in np.linspace(0, 1, 60)]
        tips.append(balls[-1][:2])
    y, x = np.mgrid[: shape[0], : shape[1]]
    height = np.full(shape, -np.inf)
    for u, v, middle, radius in balls:
        inside = radius**2 - (x - u) ** 2 - (y - v) ** 2
        height = np.where(inside > 0, np.maximum(height, middle + np.sqrt(np.maximum(inside, 0))), height)
    mask = np.isfinite(height)
    noise = np.random.default_rng(0).normal(0, 0.001, shape)
    depth = np.where(mask, 0.6 - 0.0075 / RADIUS * np.where(mask, height, 0.0) + noise, np.nan).astype(np.float32)
    return depth, mask, np.array(tips)


def test_edges_lie_on_what_is_behind_within_reach_of_what_is_in_front():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    front = np.hypot(x - 80, y - 60) < 20
    depth = np.where(front, 0.5, 0.53).astype(np.float32)
    depth[58:62, 40:42] = 0.0  # a hole is no edge
    beside = np.zeros(SHAPE, bool)
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            beside |= np.roll(front, (dy, dx), (0, 1))
    inside = np.ones(SHAPE, np.uint8)
    assert np.array_equal(depth_edges(depth, inside, RADIUS).is_behind, beside & ~front)
    inside[:, :80] = 0
    assert not depth_edges(depth, inside, RADIUS).is_behind[:, :80].any()


@pytest.mark.parametrize("noise_std", [0.0, 0.002, 0.006])
def test_a_slope_has_no_edges_and_its_noise_is_measured(noise_std):
    depth, inside = slope(noise_std), np.ones(SHAPE, np.uint8)
    # 18,960 second differences with correlated neighbours: the median's standard deviation is below 2 %.
    assert reading_noise(depth, inside > 0) == pytest.approx(noise_std, rel=0.06, abs=1e-6)
    # Of five readings in a row and column two differ by 5 standard deviations in 0.8 % of all windows.
    assert depth_edges(depth, inside, RADIUS).is_behind.mean() < 0.01


def test_a_window_holds_what_is_connected_without_crossing_an_edge():
    image = np.full(SHAPE, 255, np.uint8)
    image[:, 80:82] = 0
    points = np.array([[78.3, 60.2], [84.0, 3.0], [80.0, 60.0]])
    windows = own_surfaces(image, points, 4.0)
    assert windows.points - np.rint(windows.points) == pytest.approx(points - np.rint(points))
    y, x = np.mgrid[: windows.image.shape[0], : windows.image.shape[1]]
    left, right = (np.arange(SHAPE[1]) < 80), (np.arange(SHAPE[1]) >= 82)
    for (u, v), (column, row), side in zip(points, windows.points, (left, right, left), strict=True):
        own_x, own_y = x - round(column) + round(u), y - round(row) + round(v)
        near = np.maximum(abs(own_x - round(u)), abs(own_y - round(v)))
        expected = (near <= 12) & (own_y >= 0) & np.take(side, own_x, mode="clip")
        # The next window begins a margin farther down.
        assert np.array_equal((windows.image > 0)[near <= 14], expected[near <= 14])


@pytest.mark.parametrize(("front", "behind"), [(1, 2), (2, 1), (3, 2)])
def test_fingers_that_touch_have_tips_by_depth_alone(front, behind):
    """Side by side, with one tip 22 mm before the other."""
    angles, lifts = list(ANGLES), np.zeros(5)
    angles[front] = angles[behind] + math.copysign(0.18, behind - front)
    lifts[front] = 19
    depth, mask, tips = hand_depth(angles=angles, lifts=lifts)
    by_contour, by_edges = detect_hand(mask, PARAMETERS), detect_hand(mask, PARAMETERS, depth)
    assert by_contour.is_tip.sum() == 4
    assert by_edges.is_tip.all()
    apart = np.linalg.norm(by_edges.tips[:, None] - tips, axis=-1)
    assert sorted(apart.argmin(axis=1)) == [0, 1, 2, 3, 4]
    assert apart.min(axis=1).max() < RADIUS


def test_a_finger_does_not_end_behind_its_own_tip():
    depth, mask, tips = hand_depth(pointing=(2,))
    hand = detect_hand(mask, PARAMETERS, depth)
    apart = np.linalg.norm(hand.tips[hand.is_tip][:, None] - tips, axis=-1)
    assert apart.min(axis=1).max() < RADIUS
    edges = depth_edges(np.nan_to_num(depth), mask.view(np.uint8), RADIUS)
    up = np.array([[0.0, -3.0]])
    assert goes_behind(edges, tips[[2]] + [0, 2 * RADIUS], up, RADIUS)
    assert not goes_behind(edges, tips[[2]], up, RADIUS)


def with_plate(depth, mask, middle, size):
    """With a plate of that many columns and rows about a pixel, 40 mm before the hand, in depth and mask."""
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    plate = (np.abs(x - middle[0]) < size[0] / 2) & (np.abs(y - middle[1]) < size[1] / 2)
    return np.where(plate, np.float32(0.54), depth), mask | plate


@pytest.mark.parametrize("finger", [1, 2, 3])
def test_a_finger_whose_end_is_covered_has_no_tip_where_it_goes_behind(finger):
    depth, mask, tips = hand_depth()
    depth, mask = with_plate(depth, mask, tips[finger], (40, 12))
    hand = detect_hand(mask, PARAMETERS, depth)
    assert hand.is_tip.sum() == 4
    apart = np.linalg.norm(hand.tips[hand.is_tip][:, None] - np.delete(tips, finger, axis=0), axis=-1)
    assert apart.min(axis=1).max() < RADIUS


@pytest.mark.parametrize("finger", [2, 3])
def test_what_lies_before_a_finger_has_no_tips_as_it_does_not_lead_to_the_palm(finger):
    depth, mask, tips = hand_depth()
    middle = [160, 130] + 0.75 * (tips[finger] - [160, 130])
    depth, mask = with_plate(depth, mask, middle, (40, 20))
    hand = detect_hand(mask, PARAMETERS, depth)
    apart = np.linalg.norm(hand.tips[hand.is_tip][:, None] - tips, axis=-1)
    assert hand.is_tip.sum() >= 4
    assert apart.min(axis=1).max() < RADIUS


def test_a_hand_without_edges_is_as_without_depths():
    _, mask, _ = hand_depth()
    flat = np.full(mask.shape, 0.6) + np.random.default_rng(0).normal(0, 0.0005, mask.shape)
    flat[~mask] = np.nan
    one, other = detect_hand(mask, PARAMETERS), detect_hand(mask, PARAMETERS, flat)
    jax.tree.map(np.testing.assert_array_equal, one, other)
    assert one.is_tip.all()


def test_depths_of_another_shape_type_or_unit_are_refused():
    depth, mask, _ = hand_depth()
    with pytest.raises(
        ValueError, match=r"depth must have the shape of mask, \(240, 320\), and its pixels; got \(240, 319"
    ):
        detect_hand(mask, PARAMETERS, depth[:, 1:])
    with pytest.raises(ValueError, match=r"depth must be an array \(rows, cols\) of floats; got uint16"):
        detect_hand(mask, PARAMETERS, np.full(mask.shape, 600, np.uint16))
    with pytest.raises(ValueError, match=r"depth must be in metres; got a median of 5\d\d"):
        detect_hand(mask, PARAMETERS, 1000 * depth)
