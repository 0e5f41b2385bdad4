"""What the tracker is told and remembers: constants that are checked, and the state before anybody has come."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.people.state import APPEARANCE, FREE, STATE, PeopleConfig, chosen, nobody


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"height_m": 0.0}, "height_m must be positive; got 0.0"),
        ({"memory_s": float("inf")}, "memory_s must be positive; got inf"),
        ({"width_sd_m": -0.1}, "width_sd_m must be positive; got -0.1"),
        ({"capacity": 0}, "capacity and grid must be positive integers; got 0"),
        ({"grid": (32, 0)}, r"capacity and grid must be positive integers; got 32, \(32, 0\)"),
        ({"spread_px": -0.1}, "spread_px must be 0 or more; got -0.1"),
        ({"calibration_error": -0.1}, "calibration_error must be 0 or more; got -0.1"),
        ({"dropped": 0.0}, "dropped must be negative log odds; got 0.0"),
    ],
)
def test_wrong_constants_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PeopleConfig(**options)


def test_no_spread_is_allowed():
    assert PeopleConfig(spread_px=0.0).spread_px == 0


def test_before_anybody_has_come_all_slots_are_free():
    people = nobody(PeopleConfig(capacity=3))
    assert np.all(people.mode == FREE)
    assert np.all(people.identity == -1)
    assert people.belief.covariance.shape == (3, STATE, STATE)
    # Six histograms that are blank, and each a distribution.
    np.testing.assert_allclose(people.appearance.reshape(3, 2, -1).sum(axis=-1), 1.0, rtol=1e-6)
    assert people.appearance.shape[1] == APPEARANCE
    assert not people.meetings.is_open.any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(people))


def test_slots_are_chosen_leaf_by_leaf():
    yes, no = (jnp.ones(3), jnp.ones((3, 2, 2))), (jnp.zeros(3), jnp.zeros((3, 2, 2)))
    flat, deep = chosen(jnp.array([True, False, True]), yes, no)
    assert flat.tolist() == [1, 0, 1]
    assert deep.sum(axis=(1, 2)).tolist() == [4, 0, 4]
