"""Masks against the silhouettes that were rendered, desks against planes that are known."""

import math

import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip.segmentation import (
    bright_mask,
    depth_mask,
    fit_desk,
    otsu_threshold,
    smoothed,
)
from jaxfilters.models.synthetic.desk_hand import HandPose, hand_coverage, random_frame


def overlap(a, b):
    return np.sum(a & b) / np.sum(a | b)


def desk_depth(shape=(240, 320)):
    """Of a plane z = 0.8 + 0.15 x + 0.1 y (metres) before a camera with a focal length of 300 px."""
    v, u = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    x, y = (u - shape[1] / 2) / 300, (v - shape[0] / 2) / 300
    return (0.8 / (1 - 0.15 * x - 0.1 * y)).astype(np.float32)


def hand():
    return hand_coverage(HandPose(np.array([160.0, 110.0]), -math.pi / 2, np.ones(5)), (240, 320)) > 0.5


def test_the_threshold_is_midway_between_desk_and_skin():
    """The desk's mean is about 70 with clutter, the hand's 195."""
    thresholds = [otsu_threshold(random_frame(jax.random.key(i), 5).image) for i in range(5)]
    np.testing.assert_allclose(thresholds, 132.5, atol=6)


@pytest.mark.parametrize("blur", [1.0, 2.2])
def test_bright_masks_are_the_silhouette(blur):
    for i in range(5):
        truth = random_frame(jax.random.key(i), 5, blur=blur)
        assert overlap(bright_mask(truth.image, otsu_threshold(truth.image)), truth.coverage > 0.5) > 0.95


def test_a_mask_is_what_lies_above_the_threshold_of_the_smoothed_image():
    image = np.random.default_rng(0).integers(0, 256, (40, 50), dtype=np.uint8)
    np.testing.assert_array_equal(bright_mask(image, 127.5), smoothed(image) > 127)
    assert set(np.unique(bright_mask(image, 127.5).view(np.uint8))) == {0, 1}


def test_flat_images_have_a_threshold_and_no_hand():
    for level in (0, 128, 255):
        image = np.full((20, 30), level, np.uint8)
        assert not bright_mask(image, max(otsu_threshold(image), 128.0 if level < 200 else 255.0)).any()


def test_the_desk_is_found_below_a_hand_with_noise_and_without_readings():
    rng = np.random.default_rng(0)
    depth = desk_depth() - 0.03 * hand() + 0.002 * rng.standard_normal((240, 320))
    depth[rng.uniform(size=depth.shape) < 0.1] = 0.0
    depth[rng.uniform(size=depth.shape) < 0.05] = np.nan
    depth[:10] = np.inf
    np.testing.assert_allclose(fit_desk(depth), desk_depth(), atol=0.001)


def test_a_hand_is_what_stands_on_the_desk_and_not_far_above():
    rng = np.random.default_rng(1)
    depth = (desk_depth() - 0.03 * hand() + 0.002 * rng.standard_normal((240, 320))).astype(np.float32)
    depth[20:60, 20:60] = 0.2  # a lamp
    depth[rng.uniform(size=depth.shape) < 0.02] = np.nan
    assert overlap(depth_mask(depth, fit_desk(depth)), hand()) > 0.95


@pytest.mark.parametrize("image", [np.zeros((4, 5)), np.zeros((4, 5, 3), np.uint8), np.zeros((0, 5), np.uint8)])
def test_other_images_are_refused(image):
    for function in (otsu_threshold, lambda image: bright_mask(image, 100.0)):
        with pytest.raises(ValueError, match="image must be a uint8 array"):
            function(image)


def test_other_arguments_are_refused_by_name():
    depth = np.ones((20, 30), np.float32)
    with pytest.raises(ValueError, match="threshold"):
        bright_mask(np.zeros((4, 5), np.uint8), 300.0)
    with pytest.raises(ValueError, match="depth must be an array"):
        fit_desk(np.ones((20, 30), np.uint16))
    with pytest.raises(ValueError, match="depth must have at least"):
        fit_desk(np.full((20, 30), np.nan))
    with pytest.raises(ValueError, match="desk must have the shape"):
        depth_mask(depth, depth[1:])
    with pytest.raises(ValueError, match="desk must be an array"):
        depth_mask(depth, depth[0])
