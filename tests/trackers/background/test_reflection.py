"""Floors that mirror people, drawn: how much is found out, and what is mirrored is no foreground."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, maximum_filter1d

from jaxfilters.trackers.background.median import MedianBackground
from jaxfilters.trackers.background.reflection import REACH, enlarged, reflected_share, strongest_above

AT = np.random.default_rng(0)
ROOM = AT.integers(150, 190, (280, 200, 3)).astype(np.uint8)
FEET, HEIGHT = 180, 90


def observed(left, share):
    """Somebody in dark clothes at some column, whom the floor mirrors by a share."""
    image = ROOM.astype(float)
    body = AT.uniform(-140, -110, (HEIGHT, 24, 3))
    image[FEET - HEIGHT : FEET, left : left + 24] += body
    image[FEET : FEET + HEIGHT, left : left + 24] += share * body[::-1]
    return np.clip(image.round(), 0, 255).astype(np.uint8)


def primed(share):
    background = MedianBackground(shadow_probability=1.0)
    background.prime([observed(10 + 12 * i, share) for i in range(12)])
    return background


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_share_that_a_floor_mirrors_is_found(share):
    differences = [np.abs(observed(10 + 12 * i, share).astype(int) - ROOM).max(axis=-1) for i in range(8)]
    assert abs(reflected_share([one.astype(np.uint8) for one in differences], 30.0) - 0.9 * share) < 0.04
    assert reflected_share([differences[0].astype(np.uint8)], 30.0) == 0, "24 columns say nothing."


def test_a_reflection_is_no_foreground_and_its_body_is():
    background, image = primed(0.3), observed(60, 0.3)
    body, mirrored = np.s_[FEET - HEIGHT + 3 : FEET - 3, 62:82], np.s_[FEET + 3 : FEET + 30, 62:82]
    probability = background.apply(image)
    assert probability[body].min() > 0.9
    assert np.median(probability[mirrored]) < 0.1
    background.estimate_reflection([ROOM])
    assert np.median(background.apply(image)[mirrored]) > 0.5


def test_where_nothing_is_mirrored_nothing_changes():
    background, image = primed(0.0), observed(60, 0.0)
    found = background.apply(image)
    background.estimate_reflection([ROOM])
    np.testing.assert_array_equal(background.apply(image), found)


def test_the_share_is_saved():
    first, second = primed(0.3), MedianBackground(shadow_probability=1.0)
    second.restore(first.state())
    image = observed(60, 0.3)
    np.testing.assert_array_equal(first.apply(image), second.apply(image))


def test_the_strongest_above_is_that_of_the_columns_beside():
    differences = AT.integers(0, 255, (70, 40), np.uint8)
    up = round(70 * REACH)
    beside = maximum_filter1d(differences, 7, axis=1, mode="constant")
    for row in (0, 5, 30, 69):
        expected = beside[max(0, row - up) : row + 4].max(axis=0)
        np.testing.assert_array_equal(strongest_above(differences)[row], expected)


def test_the_strongest_above_in_squares_is_never_less_and_off_by_two_at_most():
    differences = AT.integers(0, 255, (70, 41), np.uint8)
    for every in (2, 3):
        found, exact = (strongest_above(differences, every=size) for size in (every, 1))
        assert np.all(found >= exact)
        assert np.all(found <= maximum_filter(exact, 4 * (every - 1) + 1, mode="constant"))


def test_an_enlarged_image_repeats_each_pixel():
    coarse = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(enlarged(coarse, 3, (8, 11)), np.kron(coarse, np.ones((3, 3), np.uint8))[:8, :11])
