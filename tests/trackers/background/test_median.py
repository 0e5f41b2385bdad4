"""A background whose room changes for good."""

import numpy as np

from jaxfilters.trackers.background.median import LOST_AFTER, SAMPLES, MedianBackground

AT = np.random.default_rng(0)
ROOM = AT.integers(60, 190, (60, 80, 3)).astype(np.uint8)


def test_samples_in_another_light_make_no_noise_and_no_other_room():
    """Half of the samples are a third darker: a person of 60 levels is as visible as with samples of one light."""
    dim = np.round(0.67 * ROOM).astype(np.uint8)
    person = ROOM.copy()
    person[20:40, 30:40] -= 55
    probabilities = []
    for samples in ([ROOM] * 20, [ROOM] * 10 + [dim] * 10):
        background = MedianBackground(shadow_probability=1.0)
        background.prime(samples)
        probabilities.append(background.apply(person))
    np.testing.assert_allclose(probabilities[1], probabilities[0], atol=0.02)
    assert probabilities[1][22:38, 32:38].min() > 0.9


def test_a_room_that_has_become_another_one_is_estimated_anew():
    """The left three quarters change by what no gain explains; five samples later nothing is foreground."""
    background, other = MedianBackground(), ROOM.copy()
    other[:, :60] = AT.integers(60, 190, (60, 60, 3))
    background.prime([ROOM] * 5)
    assert np.mean(background.apply(other) > 0.5) > 0.6
    for _ in range(LOST_AFTER - 2):
        background.apply(other)
    assert background.restarts == 0
    background.apply(other)
    assert background.restarts == 1
    for _ in range(5 * SAMPLES):
        probability = background.apply(other)
    assert probability.max() < 0.1
    person = other.copy()
    person[20:40, 30:40] = 255 - person[20:40, 30:40] // 4
    assert background.apply(person)[22:38, 32:38].mean() > 0.8
    assert background.restarts == 1


def test_a_person_who_fills_a_third_of_the_image_is_no_other_room():
    background, close = MedianBackground(), ROOM.copy()
    close[:, :28] = 20
    background.prime([ROOM] * 5)
    for _ in range(3 * LOST_AFTER):
        background.apply(close)
    assert background.restarts == 0


def test_a_background_that_was_saved_while_it_settled_goes_on_as_if_it_had_not_been():
    """Noise of two levels makes every image another sample."""
    whole, first, at = MedianBackground(), MedianBackground(), np.random.default_rng(1)
    images = [np.clip(ROOM + at.integers(-2, 3, ROOM.shape), 0, 255).astype(np.uint8) for _ in range(6 * SAMPLES)]
    for image in images[: 2 * SAMPLES]:
        whole.apply(image)
        first.apply(image)
    second = MedianBackground()
    second.restore(first.state())
    for image in images[2 * SAMPLES :]:
        np.testing.assert_array_equal(second.apply(image), whole.apply(image))
