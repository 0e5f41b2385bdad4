"""What is estimated of a user and a desk from the first images."""

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.synthetic.desk import colour_desk
from jaxfilters.models.synthetic.desk_hand import random_frame
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
