"""Skin that is learnt from one image, on desks with coloured things, uneven light and shadows."""

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.fingertip.first_image import fit_hand_to_mask
from jaxfilters.models.fingertip.skin import fit_skin_model, skin_mask, skin_probability
from jaxfilters.models.synthetic.desk import colour_desk
from jaxfilters.models.synthetic.desk_hand import random_frame


@pytest.mark.system
@pytest.mark.parametrize("seed", range(4))
def test_fingers_are_counted_on_the_desk_where_skin_was_learnt(seed):
    desk = colour_desk(np.random.default_rng(seed))
    first = random_frame(jax.random.key(seed), 5, desk=desk)
    skin = fit_skin_model(first.image)
    parameters = fit_hand_to_mask(skin_mask(first.image, skin))
    right, errors = [], []
    for i in range(12):
        truth = random_frame(jax.random.key(100 * seed + i), i % 6, desk=desk)
        hand = detect_hand(skin_mask(truth.image, skin), parameters)
        right.append(hand.is_tip.sum() == i % 6)
        if i % 6 and hand.is_tip.any():
            tips = truth.tips[truth.extended]
            errors.extend(np.linalg.norm(tips[:, None] - hand.tips[hand.is_tip], axis=-1).min(axis=1))
    assert all(right)
    assert np.mean(errors) < 1.0


def test_the_mask_is_the_hand_without_its_shadow():
    desk = colour_desk(np.random.default_rng(5))
    truth = random_frame(jax.random.key(5), 5, desk=desk)
    mask, hand = skin_mask(truth.image, fit_skin_model(truth.image)), truth.coverage > 0.5
    assert np.sum(mask & hand) / np.sum(mask | hand) > 0.93


def test_the_mask_is_where_skin_is_more_likely_than_not():
    truth = random_frame(jax.random.key(5), 5, desk=colour_desk(np.random.default_rng(5)))
    skin = fit_skin_model(truth.image)
    mask = skin_mask(truth.image, skin)
    np.testing.assert_array_equal(mask, skin_probability(truth.image, skin) > 127)
    assert mask.view(np.uint8).max() == 1


def test_something_larger_in_the_colours_of_other_skin_is_not_learnt_away_from_the_border():
    truth = random_frame(jax.random.key(5), 5, desk=colour_desk(np.random.default_rng(5)))
    image = cv2.copyMakeBorder(truth.image, 250, 0, 0, 0, cv2.BORDER_CONSTANT, value=(128, 128, 128))
    cv2.circle(image, (160, 120), 100, (90, 165, 190), -1)  # yellowish
    hand = np.pad(truth.coverage > 0.5, ((250, 0), (0, 0)))
    mask = skin_mask(image, fit_skin_model(image))
    assert mask[hand].mean() > 0.93
    assert mask[30:210, 70:250].mean() < 0.1


def test_an_image_without_skin_is_refused():
    grey = np.full((240, 320, 3), 128, np.uint8)
    with pytest.raises(ValueError, match="image must show a hand"):
        fit_skin_model(grey)
    with pytest.raises(ValueError, match="image must show a hand"):
        fit_skin_model(grey - np.array([50, 20, 0], np.uint8) + np.array([0, 0, 80], np.uint8))


@pytest.mark.parametrize("image", [np.zeros((4, 5), np.uint8), np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5, 3))])
def test_other_images_are_refused(image):
    with pytest.raises(ValueError, match="image must be a uint8 array"):
        fit_skin_model(image)
