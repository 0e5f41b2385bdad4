"""What is estimated of a user and a desk from the first images."""

import math

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.synthetic.desk import colour_desk
from jaxfilters.models.synthetic.desk_hand import HandPose, hand_coverage, random_frame
from jaxfilters.trackers.fingertips.images import estimate_user


@pytest.mark.system
def test_a_hand_is_found_on_a_desk_in_the_colour_of_skin_where_the_hand_has_another():
    """Wood has Cr 142 and Cb 113 here, as on photographs, and the hand is nearly grey: a seed of skin is the desk."""
    rng = np.random.default_rng(0)
    images, hands = [], []
    for i in range(3):
        truth = random_frame(jax.random.key(20 + i), 5, desk=colour_desk(rng))
        hand = cv2.GaussianBlur(truth.coverage.astype(np.float32), (0, 0), 1.0)[..., None]
        shading = 1 + 0.1 * np.sin(np.arange(hand.shape[1]) / 40)[None, :, None]
        image = (1 - hand) * [95, 110, 135] * shading + hand * [168, 172, 175]
        images.append(np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8))
        hands.append(truth.coverage > 0.5)
    user = estimate_user(images, "colour")
    for image, hand in zip(images, hands, strict=True):
        mask = user.segment(image)
        assert np.sum(mask & hand) / np.sum(mask | hand) > 0.9
        assert detect_hand(mask, user.parameters).is_tip.sum() == 5
    empty = np.clip(rng.normal([95, 110, 135], 4, (120, 160, 3)), 0, 255).astype(np.uint8)
    with pytest.raises(ValueError, match="no image in which a hand differs from the desk"):
        estimate_user([empty], "colour")


@pytest.mark.parametrize("handedness", [1, -1])
def test_the_side_of_the_thumb_is_known_by_the_other_fingers_and_in_depths_without_a_desk(handedness):
    pose = HandPose(np.array([160.0, 110.0]), -math.pi / 2 + 0.1, np.array([0.0, 1, 1, 1, 1]), handedness)
    hand = hand_coverage(pose, (240, 320)) > 0.5
    depth = np.where(hand, np.linspace(0.45, 0.55, 240)[:, None], 0.0).astype(np.float32)
    for image, mask in ((np.where(hand, 200, 60).astype(np.uint8), "infrared"), (depth, "depth")):
        user = estimate_user([image], mask)
        assert not user.has_open_hand
        assert user.parameters.handedness == handedness
        assert np.mean(user.segment(image) != hand) < 0.01
        assert detect_hand(user.segment(image), user.parameters).is_tip.sum() == 4
