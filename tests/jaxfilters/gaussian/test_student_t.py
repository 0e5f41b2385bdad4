"""Student-t noise against quadrature with the density of SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

KEY = jax.random.key(0)
M, P, Q, R = 0.4, 0.5, 0.2, 0.3


def line():
    one = jnp.eye(1)
    return jf.kalman(jf.Gaussian(jnp.array([M]), P * one), one, Q * one, one, R * one)


def moments(x, log_density):
    """Mean, variance and log integral of a density on an even grid."""
    w = np.exp(log_density) * (x[1] - x[0])
    mean = w @ x / w.sum()
    return mean, w @ (x - mean) ** 2 / w.sum(), np.log(w.sum())


GRID = np.linspace(-60, 60, 48001)
AHEAD = stats.norm.logpdf(GRID, M, np.sqrt(P + Q))


def log_prediction(dof):
    """Log density of the state ahead: the prior convolved with t noise."""
    tau, w = np.polynomial.hermite_e.hermegauss(60)
    points = GRID[:, None] - (M + np.sqrt(P) * tau)
    return np.log(stats.t.pdf(points, dof, scale=np.sqrt(Q)) @ (w / w.sum()))


def one_step(filter, y):
    """Mean, variance and log evidence after one step."""
    state, info = jf.step(filter, KEY, jf.init(filter, KEY), jnp.array([y]))
    belief = state.belief if isinstance(state, jf.HeavyTailState) else state
    return np.array([belief.mean[0], belief.covariance[0, 0], info.log_evidence]), info


@pytest.mark.parametrize("dof", [1.0, 4.0, 30.0])
def test_observations_with_heavy_tails_agree_with_quadrature(x64, dof):
    """The trapezoidal rule has a relative error of 1e-3 in the density, from the centre to an outlier of 27 sigma."""
    filter = jf.student_t(line(), dof)
    for y in (0.7, 2.5, 15.0):
        found, info = one_step(filter, y)
        exact = moments(GRID, AHEAD + stats.t.logpdf(y - GRID, dof, scale=np.sqrt(R)))
        np.testing.assert_allclose(found, exact, rtol=3e-3, atol=3e-3)
    assert info.observation_weight < 0.1


@pytest.mark.parametrize("dof", [3.0, pytest.param(10.0, marks=pytest.mark.system)])
def test_a_process_with_heavy_tails_agrees_with_quadrature(x64, dof):
    filter = jf.student_t(line(), None, process_dof=dof)
    for y in (0.7, 3.0, 20.0):
        found, info = one_step(filter, y)
        exact = moments(GRID, log_prediction(dof) + stats.norm.logpdf(y - GRID, 0, np.sqrt(R)))
        np.testing.assert_allclose(found, exact, rtol=5e-3, atol=5e-3)
    assert info.process_weight < 0.1
    np.testing.assert_allclose(info.observation_weight, 1.0, rtol=1e-12)


@pytest.mark.system
def test_both_tails_together_and_a_frame_without_an_observation(x64):
    filter = jf.student_t(line(), 4.0, process_dof=5.0)
    found, _ = one_step(filter, 6.0)
    exact = moments(GRID, log_prediction(5.0) + stats.t.logpdf(6.0 - GRID, 4.0, scale=np.sqrt(R)))
    np.testing.assert_allclose(found, exact, rtol=1e-2, atol=1e-2)
    _, (states, infos) = jf.run(filter, KEY, jnp.ones((3, 1)), mask=jnp.array([True, False, True]))
    # Predicted alone, the state has the variance of the t distribution, whose far tail is cut.
    grown = states.belief.covariance[1] - states.belief.covariance[0]
    np.testing.assert_allclose(grown, [[Q * 5 / 3]], rtol=2e-2)
    assert infos.log_evidence[1] == 0


def test_a_certain_state_leaves_the_density_of_the_t_distribution(x64):
    """In three dimensions, with correlated components and one that is missing."""
    V = np.array([[0.5, 0.2, 0.0], [0.2, 0.4, 0.1], [0.0, 0.1, 0.3]])
    one = jnp.eye(1)
    prior = jf.Gaussian(jnp.zeros(1), 0 * one)
    inner = jf.kalman(prior, one, 0 * one, jnp.ones((3, 1)), jnp.asarray(V))
    for dof, y in ((3.0, [0.5, -0.4, 4.0]), (8.0, [5.0, 0.0, -6.0])):
        _, info = jf.step(jf.student_t(inner, dof), KEY, prior, jnp.array(y))
        np.testing.assert_allclose(info.log_evidence, stats.multivariate_t.logpdf(y, np.zeros(3), V, dof), atol=5e-3)
    _, info = jf.step(jf.student_t(inner, 3.0), KEY, prior, jnp.array([0.5, jnp.nan, 4.0]))
    kept = V[np.ix_([0, 2], [0, 2])]
    np.testing.assert_allclose(info.log_evidence, stats.multivariate_t.logpdf([0.5, 4.0], None, kept, 3.0), atol=5e-3)


def test_many_degrees_of_freedom_are_gaussian(x64):
    found, _ = one_step(jf.student_t(line(), 1e7), 1.3)
    wanted, _ = one_step(line(), 1.3)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_the_gradient_in_the_degrees_of_freedom_is_that_of_the_exact_evidence(x64):
    exact = lambda dof: moments(GRID, AHEAD + stats.t.logpdf(5.0 - GRID, dof, scale=np.sqrt(R)))[2]
    build = lambda dof: jf.log_evidence(jf.student_t(line(), dof), KEY, jnp.array([[5.0]]))
    np.testing.assert_allclose(jax.grad(build)(4.0), (exact(4.01) - exact(3.99)) / 0.02, rtol=2e-2)


def test_an_observation_that_is_not_finite_leaves_the_prediction():
    filter = jf.student_t(line(), 4.0)
    belief, info = jf.step(filter, KEY, jf.init(filter, KEY), jnp.array([jnp.nan]))
    np.testing.assert_allclose([belief.mean[0], belief.covariance[0, 0]], [M, P + Q], rtol=1e-6)
    np.testing.assert_allclose(info.log_evidence, 0.0, atol=1e-6)


def test_missing_rows_change_nothing_about_the_others(x64):
    """Beside 60 rows without a reading, a reading far out in the tail has the evidence that it has alone."""
    alone, _ = one_step(jf.student_t(line(), 4.0), 50.0)
    wide = jf.kalman(line().params.prior, jnp.eye(1), Q * jnp.eye(1), jnp.ones((61, 1)), R * jnp.eye(61))
    y = jnp.full(61, jnp.nan).at[0].set(50.0)
    for observation in (y, jf.Observation(jnp.nan_to_num(y), mask=jnp.isfinite(y))):
        filter = jf.student_t(wide, 4.0)
        belief, info = jf.step(filter, KEY, jf.init(filter, KEY), observation)
        np.testing.assert_allclose([belief.mean[0], belief.covariance[0, 0], info.log_evidence], alone, rtol=1e-6)
