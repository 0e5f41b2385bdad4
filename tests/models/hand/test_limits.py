import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.limits import FAN, SOFT_LIMITS, limit_excess, limit_log_likelihood, unusualness
from jaxfilters.models.hand.skeleton import ANGLE_LIMITS, hand_geometry

pytestmark = pytest.mark.usefixtures("x64")
LOW, HIGH = SOFT_LIMITS.T


@pytest.mark.system
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_inside_and_on_the_limits_nothing_is_lost(share):
    assert limit_log_likelihood(jnp.asarray((1 - share) * LOW + share * HIGH)) == 0


@pytest.mark.parametrize("angle", range(15))
@pytest.mark.parametrize(("degrees", "expected"), [(3, -0.5), (6, -2.0)])
def test_three_degrees_beyond_are_one_deviation(angle, degrees, expected):
    for angles in (HIGH + np.deg2rad(degrees) * np.eye(15)[angle], LOW - np.deg2rad(degrees) * np.eye(15)[angle]):
        assert limit_log_likelihood(jnp.asarray(angles)) == pytest.approx(expected, rel=1e-12)


def test_excesses_of_several_angles_add_up():
    rng = np.random.default_rng(0)
    angles = rng.uniform(-3, 3, 15)
    clipped = np.clip(angles, LOW, HIGH)
    np.testing.assert_allclose(limit_excess(jnp.asarray(angles)), angles - clipped, atol=1e-15)
    expected = -0.5 * np.sum((np.rad2deg(angles - clipped) / 3) ** 2)
    assert limit_log_likelihood(jnp.asarray(angles)) == pytest.approx(expected, rel=1e-12)
    softer = limit_log_likelihood(jnp.asarray(angles), np.deg2rad(6.0))
    assert softer == pytest.approx(expected / 4, rel=1e-12)


@pytest.mark.system
def test_gradient_leads_back_inside_and_is_finite_at_the_limit():
    slope = jax.grad(limit_log_likelihood)
    np.testing.assert_array_equal(slope(jnp.asarray(HIGH)), 0)
    assert np.all(slope(jnp.asarray(HIGH + 0.1)) < 0)
    assert np.all(slope(jnp.asarray(LOW - 0.1)) > 0)


def test_fingers_spread_by_25_degrees_about_their_metacarpals_and_all_else_is_as_published():
    hand = hand_geometry()
    across, along, _ = np.asarray(hand.bases[1:] - hand.metacarpal_starts).T
    fan = np.rad2deg(np.arctan2(across, -along))
    spread = np.rad2deg(SOFT_LIMITS[4::3])
    np.testing.assert_allclose(spread, np.stack([np.minimum(-20, fan - 25), np.maximum(20, fan + 25)], 1), atol=1e-9)
    others = np.setdiff1d(np.arange(15), np.arange(4, 15, 3))
    np.testing.assert_array_equal(SOFT_LIMITS[others], ANGLE_LIMITS[others])


def test_usual_hands_are_those_of_a_broad_normal_distribution():
    # Written out: of each flexion a part of its own and one that the fingers share; thumb and spread by themselves.
    rng, n = np.random.default_rng(0), 20_000
    own, shared = rng.normal(size=(n, 15)), rng.normal(size=(n, 2, 1))
    angles = np.array([5.0, 0, 0] + 4 * [20, 0, 30]) + own * np.array([25.0, 20, 30] + 4 * [25, 12, 30])
    angles[:, 3::3] += 35 * shared[:, 0]
    angles[:, 5::3] += 40 * shared[:, 1]
    angles = np.deg2rad(angles)
    angles[:, 4::3] += FAN
    values = unusualness(angles)  # chi-squared of 15 degrees of freedom, by 15: mean 1, variance 2 / 15
    assert values.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / 15 / n))
    assert values.var() == pytest.approx(2 / 15, rel=0.1)


def test_fingers_that_bend_together_are_less_unusual_than_one_alone():
    together, alone = hands = np.zeros((2, 15))
    together[3::3] = alone[9] = np.deg2rad(80)
    assert np.diff(unusualness(hands)) > 0
