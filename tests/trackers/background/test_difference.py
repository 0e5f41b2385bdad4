import numpy as np
import pytest
from scipy.ndimage import median_filter

from jaxfilters.trackers.background.difference import NOISE_STEPS, Difference, is_shadow


def made(background, *, difference=25.0, spread=0.0, shadow_probability=1.0, noise=0):
    found = Difference(difference, spread, shadow_probability)
    found.set_background(background.copy(), np.full(background.shape[:2], noise, np.uint8))
    return found


def images(seed, shape=(40, 50, 3), change=60):
    rng = np.random.default_rng(seed)
    background = rng.integers(60, 200, shape, np.uint8)
    image = np.clip(background.astype(int) + rng.integers(-change, change + 1, shape), 0, 255).astype(np.uint8)
    return background, image


@pytest.mark.parametrize("shape", [(40, 50, 3), (40, 50)])
def test_one_half_lies_at_the_threshold_after_a_median_of_nine(shape):
    background, image = images(0, shape)
    probability = made(background).probability(image)
    absolute = np.abs(image.astype(int) - background)
    largest = median_filter(absolute if len(shape) == 2 else absolute.max(axis=-1), 3, mode="nearest")
    assert (probability.shape, probability.dtype) == (shape[:2], np.float32)
    np.testing.assert_array_equal(probability > 0.5, largest > 25)
    expected = 1 / (1 + np.exp(-6 * (np.minimum(np.rint(64 * largest / 25), 255) / 64 - 1)))
    np.testing.assert_allclose(probability, expected, atol=1e-6)


def test_pixels_that_flicker_need_a_larger_difference():
    background = np.full((20, 30, 3), 100, np.uint8)
    difference = made(background, spread=6.0)
    noise = np.zeros((20, 30), np.uint8)
    noise[:, 15:] = 10 * NOISE_STEPS
    difference.set_background(background, noise)
    probability = difference.probability(background + np.uint8(60))
    assert probability[:, :14].min() > 0.99
    # 6 standard deviations of 1.4826 * 10 levels are 89 levels.
    np.testing.assert_allclose(probability[:, 16:], 1 / (1 + np.exp(-6 * (60 / 89 - 1))), atol=0.02)


def test_shadows_are_darker_and_of_the_same_colour():
    empty = np.array([[100.0, 150, 200]] * 5)
    now = empty * [[0.7], [0.4], [0.97], [1.2], [0.7]]
    now[4] += [0, 0, 12]
    np.testing.assert_array_equal(is_shadow(now.T, empty.T), [True, False, False, False, False])
    assert not is_shadow(np.zeros((3, 1)), empty[:1].T).any()


@pytest.mark.parametrize("cols", [100, 1981], ids=["every pixel", "squares of 3 pixels"])
def test_shadows_are_weakened_and_nothing_else(cols):
    """The wide image is not a whole number of squares."""
    background = np.full((61, cols, 3), (100, 150, 200), np.uint8)
    image = background.copy()
    image[30:, 30:48] = (70, 105, 140)
    image[:, 66:84] = (70, 140, 70)
    image[30:, 90:] = (70, 105, 140)
    probability = made(background, shadow_probability=0.3).probability(image)
    for shadow in (probability[33:, 33:45], probability[33:, 93:]):
        np.testing.assert_allclose(shadow, 0.3, atol=1e-6)
    assert probability[:, 69:81].min() > 0.99
    assert max(probability[:27, :63].max(), probability[33:, 51:63].max()) < 0.01


def test_edges_of_dark_clothes_are_no_shadows():
    background = np.full((30, 60, 3), (100, 150, 200), np.uint8)
    image = background.copy()
    image[:, 20:24] = (70, 105, 140)
    probability = made(background, shadow_probability=0.3).probability(image)
    assert probability[5:-5, 20:24].min() > 0.9


def test_the_background_follows_by_one_level_where_it_may():
    background, image = images(1)
    difference = made(background)
    probability = difference.probability(image)
    keep = np.zeros((40, 50), bool)
    keep[10:20, 10:30] = True
    difference.follow(image, probability, keep)
    may_move = (probability < 0.5) & ~keep
    expected = background + np.sign(image.astype(int) - background) * may_move[..., None]
    np.testing.assert_array_equal(difference.background, expected)


def test_noise_becomes_the_median_deviation():
    rng = np.random.default_rng(3)
    background = np.full((8, 8), 120, np.uint8)
    difference = made(background, spread=6.0, difference=200.0)
    for _ in range(400):
        image = np.clip(rng.normal(120, 8, (8, 8)), 0, 255).round().astype(np.uint8)
        difference.probability(image)
        difference.follow(image, None, None)
    # What is compared is the median of nine deviations: 0.6745 * 8 again.
    np.testing.assert_allclose(difference.noise.mean() / NOISE_STEPS, 0.6745 * 8, atol=1.0)


def test_images_that_do_not_fit_are_named():
    background, image = images(0)
    with pytest.raises(ValueError, match=r"image must be uint8 \(40, 50, 3\) like the background; got uint8 \(39, 50"):
        made(background).probability(image[1:])
    with pytest.raises(ValueError, match="got float32"):
        made(background).probability(image.astype(np.float32))
    with pytest.raises(ValueError, match="background must be set"):
        Difference(25.0, 6.0, 1.0).probability(image)
