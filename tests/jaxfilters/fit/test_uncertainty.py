import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import fit
from jaxfilters.fit.uncertainty import ErrorStatus, no_errors, observed_information

INFORMATION = np.array([[4e6, 600.0], [600.0, 1.0]])


def quadratic(theta):
    return -0.5 * theta @ jnp.asarray(INFORMATION) @ theta + jnp.sin(theta).sum()


def test_the_covariance_is_the_inverse_information_whatever_the_units():
    loss = lambda z: 0.5 * jnp.einsum("i,ij,j", z, jnp.asarray(INFORMATION, jnp.float32), z, precision="highest")
    # The two units differ by 2000, the correlation is 0.3: float32 keeps five digits.
    scaled = lambda factors: observed_information(lambda z: factors[0] * loss(factors[1:] * z), jnp.zeros(2))
    (right, downhill, flat), status = jax.jit(jax.vmap(scaled))(jnp.array([[1.0, 1, 1], [-1, 1, 1], [1, 1, 0]]))
    none, negative, level = ErrorStatus.DETERMINED, ErrorStatus.NEGATIVE_CURVATURE, ErrorStatus.FLAT
    np.testing.assert_array_equal(status, [[none, none], [negative, negative], [none, level]])
    np.testing.assert_allclose(right, np.linalg.inv(INFORMATION), rtol=1e-5)
    assert np.isnan(downhill).all()
    # What is not determined takes no certainty from the rest.
    assert np.isnan(flat[1]).all()
    np.testing.assert_allclose(flat[0, 0], 1 / 4e6, rtol=1e-5)
    assert np.isnan(no_errors(loss, jnp.zeros(2)).covariance).all()


def steep(x):
    return -(jnp.abs(x) ** 1.5)


@pytest.mark.system
def test_the_report_says_why_a_standard_error_is_missing():
    def log_density(theta):
        saddle = theta["saddle"][0] ** 2 - theta["saddle"][1] ** 2
        return -((theta["a"] - 1) ** 2) - 0 * theta["flat"] + saddle + steep(theta["steep"]) - theta["bound"] ** 2

    start = {"a": 0.0, "bound": 0.5, "flat": 1.0, "fixed": 2, "saddle": jnp.zeros(2), "steep": 0.0}
    constraints = {name: fit.free for name in start} | {"fixed": fit.fixed, "bound": fit.interval(0.2, 1)}
    found = fit.maximize(log_density, start, constraints, method=fit.lbfgsb())
    expected = {"a": 0, "bound": 1, "flat": 2, "fixed": 6, "saddle": [3, 0], "steep": 4}
    jax.tree.map(np.testing.assert_array_equal, found.standard_error_status, jax.tree.map(np.asarray, expected))
    assert list(found.missing_errors) == ["['flat']", "['saddle'][0]", "['steep']"]
    shown = str(found)
    for reason in ("at its bound", "flat direction", "fixed", "noisy information", "second derivatives", "for 3 of 7"):
        assert reason in shown
    without = fit.maximize(log_density, start, constraints, method=fit.lbfgsb(), errors=fit.no_errors)
    assert without.missing_errors["['a']"] == "not computed"


def rough(key, theta):
    """A log density whose curvature at any step is mostly noise."""
    return -0.5 * jnp.sum(theta["x"] ** 2) + 100 * jax.random.normal(key) * jnp.sum(theta["x"] ** 2)


def test_noisy_information_of_a_search_with_fresh_keys_is_announced():
    fits = [
        fit.maximize(fit.fresh_keys(jax.random.key(i), rough), {"x": jnp.zeros(1)}, method=fit.adam(patience=2))
        for i in range(16)
    ]
    missing = [found for found in fits if np.isnan(found.standard_errors["x"]).any()]
    assert missing
    for found in missing:
        assert "converged" in str(found)
        assert found.missing_errors["['x'][0]"].startswith("noisy information")
        assert "noisy information" in str(found)
        assert "one random draw" in str(found)


def test_a_right_gradient_agrees_with_differences():
    check = fit.check_gradient(quadratic, jnp.array([1e-3, 0.5]))
    expected = -INFORMATION @ [1e-3, 0.5] + np.cos([1e-3, 0.5])
    np.testing.assert_allclose(check.gradient, expected, rtol=1e-4)
    assert check.error < 1e-8
    assert "[" not in str(check).splitlines()[0]


@jax.custom_jvp
def square(x):
    return -(x**2)


def wrong_slope(primals, tangents):
    return square(*primals), -3 * primals[0] * tangents[0]


square.defjvp(wrong_slope)


def test_a_wrong_gradient_is_noticed_and_shown():
    check = fit.check_gradient(lambda theta: square(theta["x"]) + theta["y"], {"x": 2.0, "y": 1.0})
    np.testing.assert_allclose(check.error, 1 / 3, rtol=1e-6)
    assert "['x']" in str(check)
    found = fit.maximize(lambda theta: -(theta["x"] ** 2) - theta["y"] ** 2, {"x": 2.0, "y": 1.0})
    assert "agree to 0.3" in fit.report(found, check)


def test_intervals_end_at_the_bounds_of_a_search_within_bounds():
    found = fit.maximize(lambda x: -0.5 * (x - 1.9) ** 2, 1.0, fit.interval(0, 2), method=fit.lbfgsb())
    np.testing.assert_allclose([found.theta, found.standard_errors], [1.9, 1.0], rtol=1e-3)
    # 1.9 minus and plus 1.96 are outside.
    assert (found.lower, found.upper) == (0, 2)


def test_with_all_parameters_fixed_there_is_nothing_to_find():
    found = fit.maximize(lambda theta: -0.5 * (theta["a"] - theta["b"]) ** 2, {"a": 1.0, "b": 2}, fit.fixed)
    assert (found.theta["a"], found.theta["b"], found.log_density) == (1, 2, -0.5)
    assert found.covariance.shape == (0, 0)
    assert str(found).count("fixed") == 2
