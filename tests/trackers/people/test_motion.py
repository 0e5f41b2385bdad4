"""The motion of people against the integral of its stochastic differential equation."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxfilters.trackers.people.motion import HEIGHT_DRIFT, WIDTH_DRIFT, motion
from jaxfilters.trackers.people.state import PeopleConfig


@pytest.mark.system
def test_motion_is_the_discretised_white_acceleration(x64):
    """Van Loan's block exponential (1978) gives F and Q of any linear stochastic differential equation."""
    A = np.zeros((6, 6))
    A[0, 2] = A[1, 3] = 1
    density = np.diag([0, 0, 0.49, 0.49, HEIGHT_DRIFT**2, WIDTH_DRIFT**2])
    dt = 0.3
    block = expm(dt * np.block([[-A, density], [np.zeros((6, 6)), A.T]]))
    F = block[6:, 6:].T
    found_F, found_Q = motion(PeopleConfig(acceleration_sd=0.7), jnp.asarray(dt))
    np.testing.assert_allclose(found_F, F, atol=1e-12)
    np.testing.assert_allclose(found_Q, F @ block[:6, 6:], atol=1e-12)
