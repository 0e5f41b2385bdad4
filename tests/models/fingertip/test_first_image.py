"""Parameters of hands that were rendered with known thickness and angles; images that show no open hand."""

import math

import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.first_image import fit_hand_parameters, fit_hand_to_mask
from jaxfilters.models.synthetic.desk_hand import FINGER_ANGLES, HandPose, hand_coverage, random_frame


def mask(*, lengths=(1, 1, 1, 1, 1), handedness=1, rows=240):
    pose = HandPose(np.array([160.0, 110.0]), -math.pi / 2 + 0.1, np.array(lengths, float), handedness)
    return hand_coverage(pose, (rows, rows * 4 // 3)) > 0.5


@pytest.mark.parametrize("shape", [(240, 320), (480, 640)])
@pytest.mark.parametrize("blur", [1.0, 2.2])
def test_an_open_hand_gives_the_threshold_thickness_and_angles(shape, blur):
    for i in range(6):
        fitted = fit_hand_parameters(random_frame(jax.random.key(50 + i), 5, shape=shape, blur=blur).image)
        assert fitted.threshold == pytest.approx(131, abs=6)
        assert fitted.tip_radius == pytest.approx(6.5 * shape[0] / 240, rel=0.15)
        assert fitted.phi_thumb == pytest.approx(FINGER_ANGLES[0], abs=math.radians(3))
        assert fitted.phi_index == pytest.approx(FINGER_ANGLES[1], abs=math.radians(4))


@pytest.mark.parametrize("handedness", [1, -1])
def test_the_side_of_the_thumb_is_found(handedness):
    assert fit_hand_to_mask(mask(handedness=handedness)).handedness == handedness


@pytest.mark.parametrize("lengths", [(0, 1, 1, 1, 1), (0, 1, 0, 0, 0), (0, 0, 0, 0, 0)])
def test_a_hand_that_is_not_open_is_refused(lengths):
    count = sum(lengths)
    with pytest.raises(ValueError, match=f"5 fingers spread; found {count}"):
        fit_hand_to_mask(mask(lengths=lengths))


def test_a_hand_away_from_the_border_is_refused():
    away = np.zeros((440, 320), bool)
    away[100:340] = mask()
    with pytest.raises(ValueError, match="border"):
        fit_hand_to_mask(away)


def test_masks_of_the_wrong_size_are_refused():
    for full in (np.zeros((240, 320), bool), np.ones((240, 320), bool)):
        with pytest.raises(ValueError, match="to 40% of the image"):
            fit_hand_to_mask(full)


def test_images_without_contrast_are_refused():
    noise = np.random.default_rng(0).normal(100, 8, (240, 320))
    for image in (noise.astype(np.uint8), np.full((240, 320), 90, np.uint8)):
        with pytest.raises(ValueError, match="brighter than the desk"):
            fit_hand_parameters(image)


def test_other_arrays_are_refused():
    with pytest.raises(ValueError, match="image must be a uint8 array"):
        fit_hand_parameters(np.zeros((240, 320)))
    with pytest.raises(ValueError, match="mask must be a bool array"):
        fit_hand_to_mask(np.zeros((240, 320), np.uint8))
