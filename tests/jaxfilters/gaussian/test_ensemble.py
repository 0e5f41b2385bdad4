"""The ensemble Kalman filter against the exact one on a linear model, and on what was not seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.filter import init, log_evidence, run, update
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.ensemble import ensemble_kalman
from jaxfilters.gaussian.ensemble_analysis import Forecast, perturbed_observations
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.noise import StandardNormal
from jaxfilters.priors import gaussian_prior

KEY = jax.random.key(5)
RNG = np.random.default_rng(0)
F = 0.9 * np.linalg.qr(RNG.normal(size=(3, 3)))[0]
H = RNG.normal(size=(2, 3))
ROOT_Q = np.tril(0.4 * RNG.normal(size=(3, 3)))
R = jnp.array([[0.3, 0.1], [0.1, 0.2]])
PRIOR = Gaussian(jnp.array([1.0, 0.0, -1.0]), jnp.eye(3))
YS = RNG.normal(size=(6, 2))
YS[2, 1] = YS[4] = np.nan


def move(noise, x, inputs):
    return F @ x + inputs + ROOT_Q @ noise


def observe(x):
    return H @ x


def transition(x, inputs):
    return F @ x + inputs


def make(num_particles, **options):
    prior, noise = gaussian_prior(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), PRIOR)), StandardNormal(3)
    return ensemble_kalman(prior, move, observe, R, num_particles=num_particles, noise=noise, **options)


def moments(state, info):
    return jnp.mean(state.particles, axis=1), jnp.cov(state.particles), info.log_evidence


@pytest.mark.system
def test_mean_covariance_and_evidence_are_those_of_the_kalman_filter():
    """Within 4 standard errors over 40 ensembles, beside a bias of 1 / N, here a fiftieth of the standard errors."""
    ys, inputs = jnp.asarray(YS, jnp.float32), jnp.linspace(-1.0, 1.0, 6)
    exact = extended_kalman(PRIOR, transition, jnp.asarray(ROOT_Q @ ROOT_Q.T), observe, R)
    beliefs, infos = run(exact, jax.random.key(0), ys, inputs, mask=None)[1]
    follow = lambda key: run(make(2000), key, ys, inputs, collect=moments)[1]
    found = jax.lax.map(follow, jax.random.split(jax.random.key(1), 40))
    for values, expected in zip(found, (beliefs.mean, beliefs.covariance, infos.log_evidence), strict=True):
        values = np.asarray(values, np.float64)
        error = values.std(0, ddof=1) / np.sqrt(40)
        assert np.all(np.abs(values.mean(0) - np.asarray(expected)) < 4.5 * error + 1e-5)
        # Not merely because everything is noise.
        assert np.max(error) < 0.02


def test_inflation_widens_the_spread_by_its_factor_where_nothing_is_seen():
    filter, plain = make(50, inflation=1.1), make(50)
    state = init(plain, jax.random.key(2))
    unseen = jnp.full(2, jnp.nan)
    wide, info = update(filter, jax.random.key(3), state, unseen)
    same, _ = update(plain, jax.random.key(3), state, unseen)
    np.testing.assert_allclose(same.particles, state.particles, rtol=1e-5)
    np.testing.assert_allclose(jnp.std(wide.particles, axis=1), 1.1 * jnp.std(state.particles, axis=1), rtol=1e-5)
    np.testing.assert_allclose(jnp.mean(wide.particles, axis=1), jnp.mean(state.particles, axis=1), atol=1e-6)
    assert info.log_evidence == 0
    np.testing.assert_array_equal(info.innovation, 0)


def test_a_state_far_larger_than_the_ensemble_follows_its_few_readings_and_has_a_derivative():
    """Readings of ten of 500 numbers that move together: the others follow, and nothing is n x n."""
    shape = jnp.sin(jnp.arange(500) / 80.0)
    prior = gaussian_prior(Gaussian(jnp.zeros(1), jnp.eye(1)))
    start = lambda key: shape * prior(key)[0]

    def evidence(scale):
        filter = ensemble_kalman(
            start, lambda noise, x, u: scale * x, lambda x: x[::50], 0.01 * jnp.eye(10), num_particles=60
        )
        state, info = run(filter, jax.random.key(4), 2.0 * shape[None, ::50])
        return info[1].log_evidence.sum(), state

    (_, state), slope = jax.value_and_grad(evidence, has_aux=True)(1.0)
    np.testing.assert_allclose(jnp.mean(state.particles, axis=1), 2 * shape, atol=0.1)
    assert np.isfinite(slope)


def test_memory_grows_as_the_ensemble_not_as_its_square():
    """The arrays of the compiled update have 3 or 2 rows, so 1 kB a particle is plenty; N x N would be 160 kB."""
    count = 40_000
    shapes = jax.eval_shape(make(count).init, make(count).params, KEY)
    compiled = update.lower(make(count), KEY, shapes, jnp.zeros(2)).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 1000 * count


@pytest.mark.parametrize(("n", "m", "count"), [(30, 20, 10), (3, 2, 50), (7, 3, 6)])
def test_products_in_any_order_move_samples_by_the_gain(x64, n, m, count):
    """As each sample has noise of its own, only the mean is the textbook's: noise has the mean zero."""
    x, predicted, y = (np.random.default_rng(6).normal(size=shape) for shape in ((n, count), (m, count), m))
    x -= x.mean(1, keepdims=True)
    spread = predicted - predicted.mean(1, keepdims=True)
    S = spread @ spread.T / (count - 1) + np.eye(m)
    root = np.linalg.cholesky(S)
    arrays = [jnp.asarray(a) for a in (np.ones(n), x, predicted, y, np.isfinite(y), np.eye(m), np.eye(m), root)]
    moved = perturbed_observations(KEY, Forecast(*arrays, None))
    gain = x @ spread.T / (count - 1) @ np.linalg.inv(S)
    np.testing.assert_allclose(moved.mean(1), 1 + gain @ (y - predicted.mean(1)), rtol=1e-10, atol=1e-10)


def test_the_gradient_in_inflation_is_that_of_finite_differences(x64):
    """Central differences of step h = 1e-5 in float64 err by h^2 and by 1e-16 / h: 1e-6 of the slope is safe."""
    ys, inputs = jnp.asarray(YS), jnp.linspace(-1.0, 1.0, 6)

    @jax.jit
    def evidence(inflation):
        return log_evidence(make(40, inflation=inflation), KEY, ys, inputs)

    slope = jax.grad(evidence)(1.1)
    difference = (evidence(1.1 + 1e-5) - evidence(1.1 - 1e-5)) / 2e-5
    assert abs(slope) > 0.1
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "named"), [({"num_particles": 1}, "num_particles"), ({"inflation": 0.9}, "inflation")]
)
def test_what_cannot_be_is_refused(options, named):
    with pytest.raises(ValueError, match=f"{named} must be"):
        make(**({"num_particles": 5} | options))
