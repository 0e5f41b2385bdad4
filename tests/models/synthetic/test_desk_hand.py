"""The rendered hand: its truth against its own pixels, its motion, and what is refused."""

import math

import jax
import numpy as np
import pytest

from jaxfilters.models.synthetic.desk import colour_desk, infrared_desk
from jaxfilters.models.synthetic.desk_hand import (
    FINGER_RADII,
    HandPose,
    desk_video,
    hand_coverage,
    random_frame,
)


def test_capsules_cover_what_geometry_says():
    """Forearm, palm and one finger far enough apart in parts to be counted: the finger's strip beyond the palm."""
    lengths = np.array([0, 0, 1.0, 0, 0])
    with_finger, without = (
        hand_coverage(HandPose(np.array([160.0, 120.0]), -math.pi / 2, share), (240, 320))
        for share in (lengths, 0 * lengths)
    )
    # From the palm's edge, 27 px, to the disc at 74 px: a strip, half a disc, less the circle's bulge into the strip.
    reach = 74 - np.mean(np.sqrt(27**2 - np.linspace(-6.5, 6.5, 200) ** 2))
    assert np.sum(with_finger - without) == pytest.approx(13 * reach + math.pi * 6.5**2 / 2, rel=0.01)
    assert without[120, 160] == 1
    assert without[:90].max() == 0


@pytest.mark.parametrize("num_fingers", range(6))
def test_the_truth_is_that_of_the_pixels(num_fingers):
    for i in range(5):
        truth = random_frame(jax.random.key(i), num_fingers)
        assert truth.extended.sum() == num_fingers
        assert np.linalg.norm(truth.axis) == pytest.approx(1.0)
        for tip, base, radius in zip(
            truth.tips[truth.extended], truth.bases[truth.extended], FINGER_RADII[truth.extended], strict=True
        ):
            ahead = (tip - base) / np.linalg.norm(tip - base)
            for share, expected in ((0.8, 1.0), (1.2, 0.0)):
                x, y = np.rint(tip + share * (radius + 0.5) * ahead).astype(int)
                if 0 <= x < 320 and 0 <= y < 240:
                    assert truth.coverage[y, x] == pytest.approx(expected, abs=0.35)
        greys = truth.image[truth.coverage == 1].mean(), truth.image[truth.coverage == 0].mean()
        np.testing.assert_allclose(greys, (195, 73), atol=8)


def test_the_thumb_is_on_the_side_of_the_hand():
    for i in range(8):
        truth = random_frame(jax.random.key(i), 5)
        sides = [
            (tip - truth.palm)[0] * truth.axis[1] - (tip - truth.palm)[1] * truth.axis[0] for tip in truth.tips[[0, 4]]
        ]
        assert sides[0] * sides[1] < 0


def test_a_larger_image_shows_the_same_scene():
    small, large = (random_frame(jax.random.key(3), 4, shape=shape) for shape in ((240, 320), (480, 640)))
    np.testing.assert_allclose(large.tips, 2 * small.tips + 0.5)
    halved = large.coverage.reshape(240, 2, 320, 2).mean(axis=(1, 3))
    assert np.abs(halved - small.coverage).mean() < 0.002


def test_the_same_key_gives_the_same_frame_and_another_another():
    first, again, other = (random_frame(jax.random.key(seed), 3) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.image, again.image)
    assert not np.array_equal(first.image, other.image)


@pytest.mark.system
def test_a_video_moves_smoothly_and_shows_the_fingers_of_its_schedule():
    fingers = np.repeat(np.array([[0, 1, 0, 0, 0], [0, 1, 1, 0, 0], [1, 1, 1, 1, 1]], bool), 30, axis=0)
    frames = list(desk_video(jax.random.key(0), fingers))
    palms = np.array([frame.palm for frame in frames])
    steps = np.linalg.norm(np.diff(palms, axis=0), axis=1)
    assert 1.0 < steps.max() < 9.0
    assert np.linalg.norm(np.diff(palms, n=2, axis=0), axis=1).max() < 2.0
    settled = np.arange(90) % 30 >= 5
    shown = np.stack([frame.extended for frame in frames])
    np.testing.assert_array_equal(shown[settled][:-5], fingers[settled][:-5])


def test_fast_motion_blurs_the_edges():
    """Share of pixels that the hand covers in part while the shutter is open, at rest and at four times the speed."""

    def partly(speed):
        frames = desk_video(jax.random.key(2), np.ones((25, 5), bool), speed=speed)
        return np.mean([np.mean((frame.coverage > 0.02) & (frame.coverage < 0.98)) for frame in frames])

    assert partly(4.0) > 1.4 * partly(0.0)


def test_desks_of_both_kinds_have_the_type_of_their_cameras():
    rng = np.random.default_rng(0)
    nobody = np.zeros((240, 320))
    grey = infrared_desk(rng).image(rng, nobody, 1.0, 0.0)
    colour = colour_desk(rng).image(rng, nobody, 1.0, 0.0)
    assert (grey.shape, grey.dtype) == ((240, 320), np.uint8)
    assert (colour.shape, colour.dtype) == ((240, 320, 3), np.uint8)
    assert 60 < grey.mean() < 85


def test_a_hand_casts_a_shadow_in_colour_and_clutter_drifts():
    desk = colour_desk(np.random.default_rng(4))
    pose = HandPose(np.array([160.0, 120.0]), -math.pi / 2, np.ones(5))
    coverage = hand_coverage(pose, (240, 320))
    empty, hand = (desk.image(np.random.default_rng(0), c, 1.0, 0.0).astype(float) for c in (0 * coverage, coverage))
    beside = (coverage == 0) & (np.roll(coverage, (12, 8), (0, 1)) == 1)
    assert hand[beside].mean() < 0.85 * empty[beside].mean()
    later = desk.image(np.random.default_rng(0), 0 * coverage, 1.0, 60.0).astype(float)
    assert np.abs(later - empty).mean() > 1.0


def test_what_cannot_be_rendered_is_refused():
    with pytest.raises(ValueError, match="num_fingers"):
        random_frame(jax.random.key(0), 6)
    with pytest.raises(ValueError, match="shape"):
        random_frame(jax.random.key(0), 1, shape=(240, 240))
    with pytest.raises(ValueError, match="shape"):
        next(desk_video(jax.random.key(0), np.ones((3, 5), bool), shape=(100, 100)))
