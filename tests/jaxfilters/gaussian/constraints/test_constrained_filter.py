"""Inequalities as a hook: what lasts is counted once, and the evidence is that of data and inequalities."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters
from jaxfilters import Gaussian, keep_all
from jaxfilters.gaussian.constraints import cut, linear_constraints
from jaxfilters.gaussian.constraints.constrained_filter import EPConstraints, TruncateEachStep, constrained
from jaxfilters.gaussian.extended import extended_kalman


def below_a_half():
    return linear_constraints(np.array([[1.0]]), np.array([-np.inf]), np.array([0.5]))


def unmoved(x, inputs):
    return x


def observed(x):
    return x


def one_variable(noise=1e8):
    """N(0, 1), constant, and observations that say next to nothing."""
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    return extended_kalman(prior, unmoved, jnp.zeros((1, 1)), observed, noise * jnp.eye(1))


def run(filter, frames, y=0.0):
    _, (states, infos) = jaxfilters.run(filter, jax.random.key(0), jnp.full((frames, 1), y), collect=keep_all)
    return states.belief.mean[:, 0], jnp.sqrt(states.belief.covariance[:, 0, 0]), infos


def test_a_lasting_inequality_is_counted_once_however_often_it_is_applied(x64):
    mean, deviation, _ = run(constrained(one_variable(), EPConstraints(below_a_half(), jnp.array([True]))), 55)
    exact = stats.truncnorm(-np.inf, 0.5)
    # Fifty-five readings of variance 1e8 move the moments by 1e-6.
    np.testing.assert_allclose(mean, exact.mean(), atol=1e-6)
    np.testing.assert_allclose(deviation, exact.std(), atol=1e-6)
    np.testing.assert_allclose([exact.mean(), exact.std()], [-0.51, 0.70], atol=5e-3)


@pytest.mark.parametrize("method", [cut.sequential_halfspaces, cut.sequential_intervals])
def test_applied_afresh_it_shrinks_the_belief_in_every_frame(x64, method):
    mean, deviation, _ = run(constrained(one_variable(), TruncateEachStep(below_a_half(), method)), 55)
    np.testing.assert_allclose([mean[0], deviation[0]], [-0.51, 0.70], atol=5e-3)
    np.testing.assert_allclose([mean[-1], deviation[-1]], [-0.80, 0.38], atol=5e-3)


def test_what_moves_is_cut_anew(x64):
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    walk = extended_kalman(prior, unmoved, 10.0 * jnp.eye(1), observed, 1e8 * jnp.eye(1))
    _, _, infos = run(constrained(walk, EPConstraints(below_a_half(), jnp.array([False]))), 5)
    # The walk leaves the bound behind in every frame: there is always something to cut.
    assert np.all(np.asarray(infos.truncation.log_mass) < -0.05)


def test_the_evidence_is_that_of_the_data_and_of_the_inequalities(x64):
    filter = constrained(one_variable(noise=0.5), EPConstraints(below_a_half(), jnp.array([True])))
    y = jnp.array([[0.3], [0.8]])
    _, infos = jaxfilters.run(filter, jax.random.key(0), y, collect=jaxfilters.keep_info)
    # log p(y_1, y_2, x <= 0.5), by the posterior that both readings leave.
    joint = stats.multivariate_normal.logpdf(y[:, 0], np.zeros(2), 0.5 * np.eye(2) + 1)
    variance = 1 / (1 + 2 / 0.5)
    inside = stats.norm.logcdf(0.5, variance * (0.3 + 0.8) / 0.5, np.sqrt(variance))
    # The second reading is weighed by the Gaussian that stands for the cut belief: close, not exact.
    np.testing.assert_allclose(infos.log_evidence.sum(), joint + inside, atol=0.02)
    np.testing.assert_allclose(infos.least_distance[0], (0.5 - 0.2) / np.sqrt(1 / 3), rtol=1e-9)


@pytest.mark.system
def test_gradients_pass_through(x64):
    @jax.jit
    @jax.value_and_grad
    def evidence(bound, y):
        rows = replace(below_a_half(), upper=bound[None])
        filter = constrained(one_variable(noise=0.5), EPConstraints(rows, jnp.array([True])))
        return jaxfilters.log_evidence(filter, jax.random.key(0), y)

    y = jnp.array([[0.3], [0.8], [0.1]])
    bound = jnp.asarray(0.5)
    up, down = (evidence(bound + step, y)[0] for step in (1e-5, -1e-5))
    np.testing.assert_allclose(evidence(bound, y)[1], (up - down) / 2e-5, rtol=1e-5)
