from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.scipy.stats import norm
from scipy.spatial.transform import Rotation

from jaxfilters import fit
from jaxfilters.math.lie import quaternion_to_matrix

RNG = np.random.default_rng(5)
YS = 2.0 + 0.7 * RNG.normal(size=60)
MEAN, STD = YS.mean(), YS.std()
START, LIMITS = {"mean": 0.5, "std": 2.0}, {"mean": fit.interval(-5, 5), "std": fit.positive}


def normal(ys, theta):
    return jnp.sum(norm.logpdf(ys, theta["mean"], theta["std"]))


def density(ys=YS):
    return jax.tree_util.Partial(normal, jnp.asarray(ys))


METHODS = {
    "bfgs": fit.bfgs(tolerance=1e-12),
    "lbfgsb": fit.lbfgsb(tolerance=1e-8),
    "adam": fit.adam(0.05, tolerance=1e-9, max_steps=2000),
}


@pytest.mark.system
@pytest.mark.parametrize("name", METHODS)
def test_every_method_finds_the_closed_form_and_its_errors(x64, name):
    found = fit.maximize(density(), START, LIMITS, method=METHODS[name])
    assert found.converged
    np.testing.assert_allclose([found.theta["mean"], found.theta["std"]], [MEAN, STD], rtol=1e-5)
    expected = [STD / np.sqrt(len(YS)), STD / np.sqrt(2 * len(YS))]
    np.testing.assert_allclose([found.standard_errors["mean"], found.standard_errors["std"]], expected, rtol=1e-4)
    # The logarithm of the standard deviation has the error 1 / sqrt(2 n).
    half = np.exp(1.959964 / np.sqrt(2 * len(YS)))
    np.testing.assert_allclose([found.lower["std"], found.upper["std"]], [STD / half, STD * half], rtol=1e-4)
    np.testing.assert_allclose(found.log_density, norm.logpdf(YS, MEAN, STD).sum(), rtol=1e-8)
    assert found.loss_history[-1] < found.loss_history[0]
    assert len(found.loss_history) == found.num_steps


def errors_of(ys, theta):
    return {"off": (ys - theta["mean"]) / 0.7, "prior": theta["mean"] / 3.0}


def test_least_squares_is_the_conjugate_posterior(x64):
    residuals = fit.residuals(jax.tree_util.Partial(errors_of, jnp.asarray(YS)))
    precision = len(YS) / 0.49 + 1 / 9
    found = fit.maximize(residuals, {"mean": 0.0}, method=fit.least_squares())
    np.testing.assert_allclose(found.theta["mean"], YS.sum() / 0.49 / precision, rtol=1e-8)
    np.testing.assert_allclose(found.standard_errors["mean"], precision**-0.5, rtol=1e-8)
    with pytest.raises(ValueError, match=r"made by fit\.residuals"):
        fit.maximize(density(), START, LIMITS, method=fit.least_squares())


@pytest.mark.parametrize("method", [fit.lbfgsb(tolerance=1e-6), fit.least_squares()], ids=["lbfgsb", "least_squares"])
def test_bounds_may_hold_a_parameter(x64, method):
    residuals = fit.residuals(jax.tree_util.Partial(errors_of, jnp.asarray(YS)))
    found = fit.maximize(residuals, {"mean": 0.3}, fit.interval(-1, 1), method=method)
    assert found.theta["mean"] == 1
    assert found.standard_errors["mean"] == 0
    assert "at its bound" in str(found)


def log_prior(theta):
    return norm.logpdf(theta["mean"], 0.0, 0.1)


def test_a_prior_is_added(x64):
    posterior = fit.with_prior(density(), log_prior)
    found = fit.maximize(posterior, {"mean": 0.5, "std": 0.7}, {"mean": fit.free, "std": fit.fixed})
    precision = len(YS) / 0.49 + 100
    np.testing.assert_allclose(found.theta["mean"], YS.sum() / 0.49 / precision, rtol=1e-4)
    assert found.standard_errors["std"] == 0
    assert found.theta["std"] == 0.7
    assert "fixed" in str(found)


def structured(data, theta):
    """Turned directions, a covariance and frequencies, each with a maximum in closed form."""
    directions, observed, deviations, counts = data
    off = observed - directions @ quaternion_to_matrix(theta["turn"]).T
    root = jnp.linalg.cholesky(theta["covariance"])
    whitened = jax.scipy.linalg.solve_triangular(root, deviations.T, lower=True)
    gaussian = -0.5 * jnp.sum(whitened**2) - deviations.shape[0] * jnp.sum(jnp.log(jnp.diagonal(root)))
    return -50 * jnp.sum(off**2) + gaussian + jnp.sum(counts * jnp.log(theta["shares"]))


@pytest.mark.system
def test_rotations_covariances_and_shares_have_their_closed_forms(x64):
    directions = RNG.normal(size=(8, 3))
    observed = Rotation.from_rotvec([0.5, 1.8, -0.6]).apply(directions) + 0.1 * RNG.normal(size=(8, 3))
    deviations, counts = RNG.normal(size=(30, 2)) @ np.array([[1.0, 0.0], [0.7, 0.3]]), np.array([10.0, 30.0, 60.0])
    data = tuple(map(jnp.asarray, (directions, observed, deviations, counts)))
    start = {"turn": np.array([1.0, 0, 0, 0]), "covariance": np.eye(2), "shares": np.full(3, 1 / 3)}
    limits = {"turn": fit.rotation, "covariance": fit.spd, "shares": fit.simplex}
    method = fit.bfgs(tolerance=1e-10)
    found = fit.maximize(jax.tree_util.Partial(structured, data), start, limits, method=method)
    best = Rotation.align_vectors(observed, directions)[0]
    assert (Rotation.from_quat(found.theta["turn"], scalar_first=True) * best.inv()).magnitude() < 1e-4
    covariance = deviations.T @ deviations / 30
    np.testing.assert_allclose(found.theta["covariance"], covariance, rtol=1e-3)
    np.testing.assert_allclose(found.theta["shares"], counts / 100, rtol=1e-4)
    # Of a multinomial share: sqrt(p (1 - p) / n); of a variance: sqrt(2 / n) of itself.
    np.testing.assert_allclose(found.standard_errors["shares"], np.sqrt([0.09, 0.21, 0.24]) / 10, rtol=1e-3)
    variances = np.diagonal(found.standard_errors["covariance"])
    np.testing.assert_allclose(variances, np.sqrt(2 / 30) * np.diagonal(covariance), rtol=1e-2)


SLOW_STEPS = optax.adam(0.1)


@pytest.mark.system
def test_a_search_continues_where_it_ended():
    def at_most(steps):
        return fit.first_order(SLOW_STEPS, max_steps=steps, patience=1000)

    whole = fit.maximize(density(), START, LIMITS, method=at_most(20), errors=fit.no_errors)
    half = fit.maximize(density(), START, LIMITS, method=at_most(10), errors=fit.no_errors)
    again = fit.maximize(density(), half, method=at_most(10), errors=fit.no_errors)
    np.testing.assert_allclose(again.theta["std"], whole.theta["std"], rtol=1e-6)
    np.testing.assert_allclose([*half.loss_history, *again.loss_history], whole.loss_history, rtol=1e-6)
    assert again.num_steps == 20
    assert again.termination == "stopped after 20 steps"
    other = fit.maximize(density(), half, method=METHODS["bfgs"], errors=fit.no_errors)
    np.testing.assert_allclose(other.theta["mean"], MEAN, rtol=1e-3)
    assert np.isnan(other.standard_errors["mean"])


def test_any_optax_transformation_serves():
    ours = fit.maximize(density(), START, LIMITS, errors=fit.no_errors)
    method = fit.first_order(optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(0.01)), max_steps=400)
    theirs = fit.maximize(density(), START, LIMITS, method=method, errors=fit.no_errors)
    np.testing.assert_allclose(theirs.log_density, ours.log_density, atol=0.5)


def cliff(theta):
    """Rises towards x = 1, beyond which the derivative with respect to y is NaN."""
    return theta["x"] + 0.0 * jnp.sqrt(jnp.where(theta["x"] > 1, 0.0, 1.0) * theta["y"][1]) - 0.1 * theta["y"][0] ** 2


@pytest.mark.parametrize("method", [fit.adam(0.25), fit.bfgs()], ids=["adam", "bfgs"])
def test_what_is_not_finite_ends_the_search_at_the_last_good_value(method):
    found = fit.maximize(cliff, {"x": 0.1, "y": jnp.ones(2)}, method=method)
    assert not found.converged
    assert 0.1 <= found.theta["x"] <= 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found.theta))
    if isinstance(method, type(fit.adam())):
        assert found.termination == "gradient of ['y'] not finite in step 4; kept the last finite value"
        np.testing.assert_allclose(found.theta["x"], 0.85, rtol=1e-4)


def kinked(theta):
    """The gradient is NaN where the value is not."""
    return -jnp.sum(theta["x"] ** 2) + jnp.where(theta["x"] > 0, 0.0, jnp.sqrt(theta["x"] * 0.0)).sum()


def test_a_gradient_that_is_not_finite_at_the_start_is_announced():
    found = fit.maximize(kinked, {"x": jnp.array([1.0, -2.0])})
    assert found.termination == "gradient of ['x'] not finite in step 0; kept the last finite value"
    np.testing.assert_array_equal(found.theta["x"], [1.0, -2.0])


def noisy(data, key, theta):
    return normal(data, theta) + 60 * jax.random.normal(key) * theta["mean"]


def test_fresh_keys_average_out_and_common_random_numbers_do_not():
    # The noise has mean zero: with fresh keys the maximum is that of the data, with one key it is elsewhere.
    random = jax.tree_util.Partial(noisy, jnp.asarray(YS))
    key = jax.random.key(7)
    fresh = fit.maximize(fit.fresh_keys(key, random), START, LIMITS, method=NOISY, errors=fit.no_errors)
    common = fit.maximize(fit.common_random_numbers(key, random), START, LIMITS, errors=fit.no_errors)
    draw = float(jax.random.normal(key))
    shifted = MEAN + 60 * draw * float(common.theta["std"]) ** 2 / len(YS)
    np.testing.assert_allclose(common.theta["mean"], shifted, rtol=1e-3)
    # About the maximum, Adam's coordinate has the variance rate x noise / (2 curvature): the mean wanders by 0.033.
    assert abs(fresh.theta["mean"] - MEAN) < 4 * 0.033
    assert abs(shifted - MEAN) > 0.2
    with pytest.raises(ValueError, match="method must be of first order"):
        fit.maximize(fit.with_prior(fit.fresh_keys(key, random), log_prior), START, LIMITS)


NOISY = fit.adam(0.002, max_steps=1500, patience=2000)


def test_fits_map_over_data(x64):
    data = RNG.normal(size=(5, 40)) + 1.0
    method = METHODS["bfgs"]
    found = jax.vmap(lambda ys: fit.maximize(density(ys), START, LIMITS, method=method))(jnp.asarray(data))
    np.testing.assert_allclose(found.theta["mean"], data.mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors["mean"], data.std(axis=1) / np.sqrt(40), rtol=1e-4)
    assert found.converged.all()


TRACES = []


def counted(ys, theta):
    TRACES.append(1)
    return normal(ys, theta)


def test_other_data_compile_nothing():
    for ys in (YS, YS + 1):
        count = len(TRACES)
        found = fit.maximize(jax.tree_util.Partial(counted, jnp.asarray(ys)), START, LIMITS, errors=fit.no_errors)
        np.testing.assert_allclose(found.theta["mean"], ys.mean(), rtol=1e-3)
    assert len(TRACES) == count > 0


def test_a_start_outside_its_constraint_is_rejected():
    with pytest.raises(ValueError, match=r"start\['std'\] must be positive; got -2"):
        fit.maximize(density(), {"mean": 0.0, "std": -2.0}, LIMITS)


WALLS = {
    # From a steep wall into a flat valley: the first curvature is that of the wall.
    "wall": (lambda z: -(1e6 * jnp.maximum(1 - z, 0.0) ** 2 + 0.01 * (z - 100.0) ** 2), 0.0, 100.0),
    "logarithm": (lambda z: jnp.log(z) - z, 0.01, 1.0),
}


@pytest.mark.parametrize("name", WALLS)
def test_quasi_newton_does_not_end_at_the_foot_of_a_wall(name):
    log_density, start, maximum = WALLS[name]
    found = fit.maximize(log_density, start, errors=fit.no_errors)
    assert found.converged
    assert found.num_steps < 20
    assert log_density(jnp.asarray(maximum)) - found.log_density < 1e-5
    np.testing.assert_allclose(found.theta, maximum, rtol=3e-3)


def test_a_slope_that_promises_nothing_ends_the_search():
    # Without curvature, a gain of 5e-15 nats by a step of the length of the gradient.
    found = fit.maximize(lambda z: -1e-7 * z, 0.0, errors=fit.no_errors)
    assert found.converged
    assert abs(found.theta) < 1e-5


def test_where_there_is_no_maximum_errors_are_unknown():
    found = fit.maximize(partial(jnp.sum), {"x": jnp.ones(2)}["x"], method=fit.bfgs(max_steps=3))
    assert np.isnan(found.standard_errors).all()
    assert found.termination == "stopped after 3 steps"


def test_what_is_not_determined_leaves_the_others_their_errors():
    found = fit.maximize(lambda theta: -((theta["a"] - 1) ** 2) - 0 * theta["b"], {"a": 0.0, "b": 1.0})
    np.testing.assert_allclose(found.standard_errors["a"], 0.5**0.5, rtol=1e-5)
    np.testing.assert_allclose(found.upper["a"], 1 + 1.959964 * 0.5**0.5, rtol=1e-4)
    assert np.isnan(found.standard_errors["b"])


def around(centre, x):
    return -0.5 * (x - centre) ** 2


@pytest.mark.system
def test_a_fit_within_bounds_keeps_them_with_another_method():
    high, within = jax.tree_util.Partial(around, 3.0), jax.tree_util.Partial(around, 1.9)
    options = {"constraints": fit.interval(0, 2), "method": fit.lbfgsb(), "errors": fit.no_errors}
    at_bound, inside = (fit.maximize(log_density, 1.0, **options) for log_density in (high, within))
    assert at_bound.theta == 2
    assert fit.maximize(high, at_bound, errors=fit.no_errors).theta == 2
    assert 1.99 < fit.maximize(high, inside, method=fit.bfgs(), errors=fit.no_errors).theta <= 2
    # Logits have no value there.
    with pytest.raises(ValueError, match="start must be between 0 and 2"):
        fit.maximize(high, at_bound, method=fit.bfgs(), errors=fit.no_errors)


def test_a_fit_that_continues_with_another_log_density_finds_its_maximum():
    first = fit.maximize(density(), START, LIMITS, errors=fit.no_errors)
    found = fit.maximize(density(YS + 1), first, errors=fit.no_errors)
    assert found.converged
    np.testing.assert_allclose([found.theta["mean"], found.theta["std"]], [MEAN + 1, STD], rtol=1e-2)
