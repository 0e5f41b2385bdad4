"""The motion of people against the integral of its stochastic differential equation."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.tracker import HEIGHT_DRIFT, WIDTH_DRIFT, motion


@pytest.mark.system
def test_motion_is_the_discretised_white_acceleration_with_decaying_biases(x64):
    """Van Loan's block exponential (1978) gives F and Q of any linear stochastic differential equation."""
    A = np.zeros((STATE, STATE))
    A[0, 2] = A[1, 3] = 1
    A[range(6, 9), range(6, 9)] = -1 / 4.0
    density = np.diag([0, 0, 0.49, 0.49, HEIGHT_DRIFT**2, WIDTH_DRIFT**2, *[2 / 4.0] * 3])
    dt = 0.3
    block = expm(dt * np.block([[-A, density], [np.zeros_like(A), A.T]]))
    F = block[STATE:, STATE:].T
    found_F, found_Q = motion(PeopleConfig(acceleration_sd=0.7, silhouette_bias_s=4.0), jnp.asarray(dt))
    np.testing.assert_allclose(found_F, F, atol=1e-12)
    np.testing.assert_allclose(found_Q, F @ block[:STATE, STATE:], atol=1e-12)
