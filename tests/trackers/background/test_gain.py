"""The light of an image: exact where it is scaled, whoever stands in it, and nothing changes in steady light."""

import numpy as np
import pytest

from jaxfilters.trackers.background.gain import gain_of, without_gain
from jaxfilters.trackers.background.median import MedianBackground

RNG = np.random.default_rng(0)
ROOM = RNG.integers(40, 180, (90, 120, 3), dtype=np.uint8)


def lit(image, gain):
    return np.clip(np.round(image * np.asarray(gain)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("gain", [(1.25, 1.25, 1.25), (0.6, 0.7, 0.8), (1.0, 1.0, 1.3)])
def test_the_gain_is_that_of_the_light_with_people_in_a_third_of_the_image(gain):
    """Ratios of whole levels from 40 on are right to 1.3 percent, their median to far less."""
    image = lit(ROOM, gain)
    image[:, :40] = RNG.integers(0, 256, (90, 40, 3))
    np.testing.assert_allclose(gain_of(image, ROOM), gain, rtol=0.01)
    restored = without_gain(image, ROOM)[:, 40:].astype(int)
    assert np.abs(restored - ROOM[:, 40:]).max() <= 4


def test_a_grey_image_has_one_gain_and_a_dark_one_none():
    grey = ROOM[..., 0].copy()
    np.testing.assert_allclose(gain_of(lit(grey, 1.2), grey), [1.2], rtol=0.01)
    assert np.abs(without_gain(lit(grey, 1.2), grey).astype(int) - grey).max() <= 3
    np.testing.assert_array_equal(gain_of(np.zeros_like(ROOM), ROOM), [1, 1, 1])


def test_steady_light_passes_as_it_is():
    image = lit(ROOM, 1.004)
    assert without_gain(image, ROOM) is image


@pytest.mark.parametrize("gain", [1.25, 0.7])
def test_a_lamp_that_is_switched_makes_nobody(gain):
    """A person is found after a step of light as before it, and nothing else is."""
    model = MedianBackground()
    model.prime([ROOM] * 5)
    person = ROOM.copy()
    person[30:70, 50:62] = (10, 240, 20)
    before, after = (model.apply(image) > 0.5 for image in (person, lit(person, gain)))
    inside = np.zeros(before.shape, bool)
    inside[30:70, 50:62] = True
    for found in (before, after):
        assert found[inside].mean() > 0.95
        assert found[~inside].mean() < 0.01
