import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters import fit
from jaxfilters.fit.uncertainty import no_errors, observed_information

INFORMATION = np.array([[4e6, 600.0], [600.0, 1.0]])


def quadratic(theta):
    return -0.5 * theta @ jnp.asarray(INFORMATION) @ theta + jnp.sin(theta).sum()


def test_the_covariance_is_the_inverse_information_whatever_the_units():
    loss = lambda z: 0.5 * z @ jnp.asarray(INFORMATION, jnp.float32) @ z
    # The two units differ by 2000, the correlation is 0.3: float32 keeps five digits.
    scaled = lambda factors: observed_information(lambda z: factors[0] * loss(factors[1:] * z), jnp.zeros(2))
    right, downhill, flat = jax.jit(jax.vmap(scaled))(jnp.array([[1.0, 1, 1], [-1, 1, 1], [1, 1, 0]]))
    np.testing.assert_allclose(right, np.linalg.inv(INFORMATION), rtol=1e-5)
    assert np.isnan(downhill).all()
    # What is not determined takes no certainty from the rest.
    assert np.isnan(flat[1]).all()
    np.testing.assert_allclose(flat[0, 0], 1 / 4e6, rtol=1e-5)
    assert np.isnan(no_errors(loss, jnp.zeros(2))).all()


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
