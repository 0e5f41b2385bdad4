"""Detection on rendered hands with known truth (section 4.2, image level), and on masks that are no hands."""

import math

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.detection import detect_hand, detect_hands, no_hand
from jaxfilters.models.fingertip.first_image import base_angles
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import MAX_TIPS
from jaxfilters.models.fingertip.segmentation import bright_mask
from jaxfilters.models.synthetic.desk_hand import FINGER_ANGLES, TIP_DISTANCES, HandPose, hand_coverage, random_frame

SMALL, LARGE = (240, 320), (480, 640)


def parameters(shape=SMALL):
    scale = shape[0] / 240
    return HandParameters(threshold=132.0, tip_radius=6.5 * scale, half_size=round(9 * scale))


def open_hand(*, palm=(160.0, 110.0), lean=0.0, lengths=(1, 1, 1, 1, 1), shape=SMALL, handedness=1):
    pose = HandPose(np.array(palm), -math.pi / 2 + lean, np.array(lengths, float), handedness)
    return hand_coverage(pose, shape) > 0.5


def accuracy(num_fingers, shape, blur, num_frames):
    """Share of right counts, tip and palm errors over random frames; errors are in pixels of the image."""
    right, tip_errors, palm_errors = [], [], []
    for i in range(num_frames):
        key = jax.random.fold_in(jax.random.key(7 * num_fingers), i)
        truth = random_frame(key, num_fingers, shape=shape, blur=blur)
        hand = detect_hand(bright_mask(truth.image, 132.0), parameters(shape))
        found, tips = hand.tips[hand.is_tip], truth.tips[truth.extended]
        right.append(len(found) == num_fingers)
        palm_errors.append(np.linalg.norm(hand.palm - truth.palm))
        if len(found) and len(tips):
            tip_errors.extend(np.linalg.norm(tips[:, None] - found, axis=-1).min(axis=1))
    return np.mean(right), np.array(tip_errors), np.array(palm_errors)


def check_accuracy(num_fingers, shape, blur, num_frames):
    """Section 4.2, with tighter limits for the palm (3 px, and 8 px with five fingers, in the specification)."""
    count, tips, palm = accuracy(num_fingers, shape, blur, num_frames)
    assert count >= 0.98
    assert palm.max() <= 3.0
    if num_fingers:
        assert tips.mean() <= 0.85
        assert np.percentile(tips, 95) <= 1.7


@pytest.mark.system
@pytest.mark.parametrize("num_fingers", range(6))
@pytest.mark.parametrize("blur", [1.0, 2.2])
@pytest.mark.parametrize("shape", [SMALL, LARGE])
def test_counts_and_places_are_right_in_50_frames(num_fingers, shape, blur):
    check_accuracy(num_fingers, shape, blur, 50)


@pytest.mark.parametrize("shape", [SMALL, LARGE])
def test_tips_are_found_to_a_small_part_of_a_pixel_without_noise(shape):
    """On sharp silhouettes; the mean of all directions tells an offset of the smaller image in which they are found."""
    scale, errors = shape[0] / 240, []
    for lean in (-0.4, 0.0, 0.4):
        pose = HandPose(np.array([160.3, 130.7]), -math.pi / 2 + lean, np.ones(5))
        hand = detect_hand(hand_coverage(pose, shape) > 0.5, parameters(shape))
        angles = pose.angle - FINGER_ANGLES
        tips = pose.palm + TIP_DISTANCES[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        tips = scale * (tips + 0.5) - 0.5
        nearest = np.linalg.norm(tips[:, None] - hand.tips, axis=-1).argmin(axis=1)
        errors.append(hand.tips[nearest] - tips)
    errors = np.concatenate(errors)
    assert np.linalg.norm(errors, axis=-1).max() < 0.4 * scale
    assert np.abs(errors.mean(axis=0)).max() < 0.25


def test_what_sticks_out_of_the_forearm_is_no_finger():
    mask = open_hand(lengths=(0, 1, 0, 0, 0)).view(np.uint8).copy()
    cv2.line(mask, (160, 190), (225, 165), 1, 13)
    hand = detect_hand(mask.view(bool), parameters())
    assert hand.is_tip.sum() == 1
    assert hand.tips[0, 1] < 60


@pytest.mark.parametrize("handedness", [1, -1])
def test_bases_are_in_the_directions_of_the_fingers(handedness):
    hand = detect_hand(open_hand(lean=0.3, handedness=handedness), parameters())
    assert hand.has_base.all()
    angles = handedness * base_angles(hand)
    np.testing.assert_allclose(np.sort(angles), np.sort(FINGER_ANGLES), atol=np.deg2rad(4.0))


def test_the_axis_is_that_of_the_forearm_whatever_the_fingers_do():
    for lengths in ((1, 0, 0, 0, 0), (0, 0, 0, 0, 1), (1, 1, 1, 1, 1), (0, 0, 0, 0, 0)):
        hand = detect_hand(open_hand(lean=0.4, lengths=lengths), parameters())
        angle = math.atan2(hand.axis[1], hand.axis[0])
        assert hand.has_axis
        assert angle == pytest.approx(-math.pi / 2 + 0.4, abs=math.radians(1.5))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_scene_that_is_turned_gives_the_same_hand_turned(turns):
    mask = np.zeros((320, 320), bool)
    mask[80:] = open_hand(lean=0.2)
    straight, turned = detect_hand(mask, parameters()), detect_hand(np.rot90(mask, turns).copy(), parameters())
    assert turned.is_tip.sum() == straight.is_tip.sum() == 5
    for points in (turned.tips, turned.bases, turned.palm[None]):
        moved = points
        for _ in range(turns):
            moved = np.stack([319 - moved[:, 1], moved[:, 0]], axis=1)  # back, clockwise
        expected = {id(turned.tips): straight.tips, id(turned.bases): straight.bases}.get(
            id(points), straight.palm[None]
        )
        distance = np.linalg.norm(expected[:, None] - moved, axis=-1).min(axis=1)
        assert distance.max() < 2.5


def test_an_empty_mask_and_specks_are_no_hand():
    rng = np.random.default_rng(0)
    bar = np.zeros(SMALL, bool)
    bar[100:112] = True
    for mask in (np.zeros(SMALL, bool), rng.uniform(size=LARGE) < 0.02, bar):
        hand = detect_hand(mask, parameters())
        assert not hand.is_hand
        assert not hand.is_tip.any()
        assert all(np.isfinite(part).all() for part in hand)


def test_masks_without_sense_give_finite_numbers():
    rng = np.random.default_rng(1)
    noise = rng.uniform(size=LARGE)
    masks = [np.ones(SMALL, bool), noise < 0.5, cv2.GaussianBlur(noise, (0, 0), 12) > 0.5, np.ones((3, 4), bool)]
    for mask in masks:
        for hand in detect_hands(mask, parameters()):
            assert all(np.isfinite(part).all() for part in hand)


def test_more_components_than_sixteen_bits_can_number_are_no_error():
    mask = np.zeros((600, 800), bool)
    mask[::2, ::2] = True
    assert not detect_hand(mask, parameters()).is_hand


def test_two_hands_are_given_from_left_to_right():
    """The left one is smaller, and shows two fingers."""
    mask = np.zeros((240, 640), bool)
    mask[:, :320] = open_hand(palm=(150.0, 130.0), lengths=(0, 1, 1, 0, 0))
    mask[:, 320:] = open_hand(palm=(170.0, 100.0))
    left, right, nobody = detect_hands(mask, parameters(), capacity=3)
    assert (int(left.is_tip.sum()), int(right.is_tip.sum())) == (2, 5)
    np.testing.assert_allclose([left.palm, right.palm], [(150, 130), (490, 100)], atol=2.0)
    assert not nobody.is_hand


def test_hands_that_touch_are_one():
    mask = np.zeros((240, 640), bool)
    mask[:, :320] = open_hand(palm=(200.0, 110.0))
    mask[:, 320:] = open_hand(palm=(110.0, 110.0))
    mask[105:115, 200:430] = True
    hands = detect_hands(mask, parameters())
    assert hands[0].is_hand
    assert not hands[1].is_hand
    assert hands[0].is_tip.sum() <= MAX_TIPS


def test_of_two_equally_thick_parts_the_one_away_from_the_border_is_the_palm():
    """A fist at the end of a wide sleeve, which is a little thicker."""
    mask = np.zeros(SMALL, np.uint8)
    cv2.line(mask, (160, 239), (160, 190), 1, 60)
    cv2.line(mask, (160, 190), (160, 80), 1, 36)
    cv2.circle(mask, (160, 80), 28, 1, -1)
    hand = detect_hand(mask.view(bool), parameters())
    np.testing.assert_allclose(hand.palm, (160, 80), atol=3)


def test_without_contact_with_the_border_the_axis_is_not_to_be_trusted():
    mask = np.zeros((400, 320), bool)
    mask[40:280] = open_hand()
    hand = detect_hand(mask, parameters())
    assert hand.is_hand
    assert not hand.has_axis
    assert hand.axis[1] < -0.95


def test_the_observation_has_room_for_every_tip_and_says_what_is_not_there():
    hand = detect_hand(open_hand(lengths=(0, 1, 0, 0, 0)), parameters())
    assert hand.tips.shape == hand.bases.shape == (MAX_TIPS, 2)
    assert {str(part.dtype) for part in hand} == {"float32", "bool"}
    assert hand.is_tip.tolist() == [True, False, False, False, False]
    assert not hand.tips[1:].any()
    assert [part.shape for part in hand] == [part.shape for part in no_hand()]


@pytest.mark.parametrize("mask", [np.zeros(SMALL, np.uint8), np.zeros((240, 320, 3), bool), np.zeros((0, 3), bool)])
def test_other_masks_are_refused_by_name(mask):
    with pytest.raises(ValueError, match="mask must be a bool array"):
        detect_hand(mask, parameters())


def test_a_capacity_of_none_is_refused():
    with pytest.raises(ValueError, match="capacity"):
        detect_hands(np.zeros(SMALL, bool), parameters(), capacity=0)


def test_a_finger_that_the_border_cuts_has_no_tip_there():
    mask = open_hand(lengths=(0, 1, 1, 0, 0))
    whole = detect_hand(mask, parameters())
    tips = whole.tips[whole.is_tip]
    assert len(tips) == 2
    longest = tips[:, 1].argmin()
    cut = detect_hand(np.ascontiguousarray(mask[int(tips[longest, 1]) + 4 :]), parameters())
    left = cut.tips[cut.is_tip] + [0, int(tips[longest, 1]) + 4]
    np.testing.assert_allclose(left, tips[[1 - longest]], atol=0.5)


def test_the_grid_says_where_the_hand_is():
    hand = detect_hand(open_hand(), parameters())
    column, row = ((hand.palm + 0.5) / hand.cell).astype(int)
    assert hand.coverage[row, column] == 1
    assert hand.coverage[0, 0] == 0
    assert math.isclose(hand.coverage.mean(), open_hand().mean(), rel_tol=0.01)
