"""The long sequence of the scenario `gaussian`: of a linear model, so that the linear filter has the same evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.benchmarks.scenarios import _gaussian_unscented as unscented


@pytest.mark.system
def test_the_unscented_filters_have_the_evidence_of_the_linear_one():
    """To the rounding of float32 in 100 terms of about two."""
    problem = unscented.walk(seed=0, num_steps=100)
    F, Q, readings = (jnp.asarray(each, jnp.float32) for each in problem)
    prior = jf.Gaussian(jnp.zeros(4), 0.2 * jnp.eye(4))
    filter = jf.kalman(prior, F, Q, jnp.eye(4)[::2], unscented.READING_STD**2 * jnp.eye(2))
    expected = float(jf.log_evidence(filter, jax.random.key(0), readings))
    np.testing.assert_allclose(float(unscented.ours(problem)()), expected, atol=0.02)
    pytest.importorskip("filterpy")
    np.testing.assert_allclose(unscented.filterpy(problem, with_evidence=True)(), expected, atol=0.02)
