"""Direction codes: sectors, rotations, what is still; and their blur."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters.models.gesture.codes import STILL, blurred, direction_code, displacements, observed


def turned(degrees, length=5.0):
    """Displacements in the image, counter-clockwise as seen from +x."""
    angle = np.radians(degrees)
    return jnp.asarray(length * np.stack([np.cos(angle), -np.sin(angle)], axis=-1), dtype=float)


@pytest.mark.system
def test_the_centres_of_the_sectors_are_one_to_sixteen():
    np.testing.assert_array_equal(direction_code(turned(22.5 * np.arange(16))), np.arange(1, 17))
    np.testing.assert_array_equal(direction_code(turned(np.array([11.2, 11.3, -11.2, -11.3]))), [1, 2, 1, 16])


def test_a_turn_by_one_sector_is_the_next_code_and_a_right_angle_four():
    angles = np.random.default_rng(0).uniform(0, 360, 200)
    codes = np.asarray(direction_code(turned(angles)))
    np.testing.assert_array_equal(direction_code(turned(angles + 22.5)), codes % 16 + 1)
    np.testing.assert_array_equal(direction_code(turned(angles + 90)), (codes + 3) % 16 + 1)


@pytest.mark.system
def test_what_hardly_moves_is_still():
    np.testing.assert_array_equal(direction_code(turned(np.arange(0, 360, 30), 1.49)), STILL)
    np.testing.assert_array_equal(direction_code(jnp.array([[0.0, 0.0], [jnp.nan, 1.0]])), STILL)
    assert direction_code(turned(90.0, 1.0), still=0.5) == 5


@pytest.mark.system
def test_blur_spreads_directions_around_the_circle_and_leaves_still_alone():
    probability = np.zeros((2, 17))
    probability[0, [0, 16]] = 0.6, 0.4
    probability[1, 16] = 1.0
    with np.errstate(divide="ignore"):
        codes = hmm.Codes(jnp.asarray(np.log(probability), dtype=float))
    found = np.exp(blurred(codes, 1.0).log_probability)
    kernel = np.exp(-0.5 * np.minimum(np.arange(16), 16 - np.arange(16)) ** 2)
    np.testing.assert_allclose(found[0], np.append(0.6 * kernel / kernel.sum(), 0.4), rtol=1e-5)
    np.testing.assert_array_equal(found[1], probability[1])
    with pytest.raises(ValueError, match="17 symbols"):
        blurred(hmm.Codes(jnp.zeros((2, 16))))


@pytest.mark.system
def test_a_hand_moves_as_the_mean_of_the_tips_that_were_seen_twice():
    tips = np.array([[(0, 0), (9, 9)], [(4, 0), (9, 1)], [(7, 7), (9, -9)], [(np.nan, 0), (9, -9)], [(5, 5), (0, 0)]])
    present = np.array([[1, 0], [1, 1], [1, 1], [0, 1], [1, 0]], bool)
    found = displacements(jnp.asarray(tips), jnp.asarray(present))
    np.testing.assert_allclose(found, [(0, 0), (4, 0), (1.5, -1.5), (0, 0), (0, 0)], atol=1e-6)
    codes, counts = observed(jnp.asarray(tips), jnp.asarray(present))
    np.testing.assert_array_equal(codes, [STILL, 1, 3, STILL, STILL])
    np.testing.assert_array_equal(counts, [1, 2, 2, 1, 1])
