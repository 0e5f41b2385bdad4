"""Moments of the cut standard normal: 400-digit references, scipy, identities of the derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import truncnorm

from jaxfilters.gaussian.constraints import moments

# (c, mean, variance, log mass) in 400 digits: q = erfc(-c / sqrt(2)) / 2, mean = -exp(-c^2 / 2) / sqrt(2 pi) / q,
# variance = 1 + c mean - mean^2, log mass = log(q).
ONE_SIDED = np.array(
    [
        (-10000.0, -10000.000099999998, 9.99999940000005e-9, -50000010.129278915),
        (-1000, -1000.000999998, 9.9999400004999948e-7, -500007.82669481218),
        (-100, -100.00999800099926, 9.994004994826345e-5, -5005.5242086942051),
        (-20, -20.049753068527851, 0.0024632616150521636, -203.91715537109726),
        (-8, -8.1213681122361127, 0.01432488344334091, -35.01343715991455),
        (-4, -4.2256071444894711, 0.046672838397422631, -10.360101486527291),
        (-3.0625, -3.3412494101772817, 0.068628697657892292, -6.8147364701480863),
        (-2.9375, -3.2250708492669056, 0.07256363693037547, -6.4043465769760307),
        (-1.0625, -1.5754168626060155, 0.19194212553551027, -1.9379115701325937),
        (-0.9375, -1.475310514214552, 0.20656249372413665, -1.7472601439521883),
        (-0.5, -1.1410777703680645, 0.26848040715587895, -1.1759117615936186),
        (0, -0.79788456080286536, 0.36338022763241866, -0.69314718055994531),
        (1, -0.28759997093917836, 0.6296862857766054, -0.17275377902344989),
        (3, -0.0044378390421256638, 0.98666678845825919, -0.0013508099647481938),
        (6, -6.0758828558176764e-9, 0.99999996354470283, -9.8658764552437573e-10),
        (12, -2.1463837356630603e-32, 1.0, -1.776482112077679e-33),
        (30, -1.4736461348785475e-196, 1.0, -4.9067139271481871e-198),
    ]
)
# (a, b, mean, variance, log mass) in 400 digits: phi(x) = exp(-x^2 / 2) / sqrt(2 pi),
# Z = (erfc(a / sqrt(2)) - erfc(b / sqrt(2))) / 2, mean = (phi(a) - phi(b)) / Z,
# variance = 1 + (a phi(a) - b phi(b)) / Z - mean^2, log mass = log(Z).
INTERVAL = np.array(
    [
        (-1, 1, 0.0, 0.29112509477279321, -0.38171514630212607),
        (-0.3, 2, 0.55009768665379284, 0.32371521218160421, -0.51892283413606392),
        (0.5, 0.6, 0.54954184251023176, 0.0008329296820635764, -3.3730642269427959),
        (30, 31, 30.033259667433622, 0.0011037715118352823, -454.32124395634325),
        (0.5, 0.500001, 0.50000049999995835, 8.3333333338122125e-14, -14.859449341140347),
        (40, 40.001, 40.000496666713999, 8.3326664145745602e-8, -807.84662731141355),
        (-1.0, 8.0, 0.28759997093917257, 0.62968628577656048, -0.17275377902345063),
        (-9, -3.5, -3.7513912648576971, 0.056933004951282903, -8.3660653083440934),
        (0, 1.5, 0.6219509777741192, 0.1647013970073684, -0.83657238742112241),
        (2, 3.5, 2.3589775530097368, 0.095046386533135625, -3.7934623668879905),
        (-20, 30, 5.5209483621597632e-88, 1.0, -2.7536241186062337e-89),
        (1000, 1000.0001, 1000.0000491668055, 8.3291683121576616e-10, -500010.17886227509),
        (-7, -6.5, -6.6311640766207388, 0.012756814712823394, -23.970536164777029),
        (0.75, 1.75, 1.1516438412101309, 0.075005471366855167, -1.6789584471480357),
    ]
)
one_sided, interval = jax.jit(moments.one_sided), jax.jit(moments.interval)
EXTREMES = [-jnp.inf, -1e300, -1e30, -1e8, -40.0, -1.0, -0.0, 0.0, 1e-30, 3.0, 40.0, 1e8, 1e30, 1e300, jnp.inf]


def total(moments):
    return sum(jnp.sum(field) for field in moments)


def test_one_sided_moments_agree_with_400_digits(x64):
    c, *expected = ONE_SIDED.T
    for got, exact in zip(one_sided(jnp.asarray(c)), expected, strict=True):
        np.testing.assert_allclose(got, exact, rtol=1e-12)


def test_one_sided_moments_agree_with_400_digits_in_float32():
    c, *expected = ONE_SIDED.T
    for got, exact in zip(one_sided(jnp.asarray(c, jnp.float32)), expected, strict=True):
        assert got.dtype == jnp.float32
        np.testing.assert_allclose(got, exact, rtol=1e-5, atol=1e-37)


@pytest.mark.parametrize(("dtype", "rtol"), [("float64", 1e-12), ("float32", 1e-5)])
def test_one_sided_moments_agree_with_scipy_between_the_reference_points(x64, dtype, rtol):
    c = np.linspace(-5, 5, 401).astype(dtype)
    expected = truncnorm(-np.inf, c.astype(float))
    got = one_sided(jnp.asarray(c))
    np.testing.assert_allclose(got.mean, expected.mean(), rtol=rtol)
    # What scipy subtracts costs it three digits.
    np.testing.assert_allclose(got.variance, expected.var(), rtol=max(rtol, 1e-10))


def test_interval_moments_agree_with_400_digits(x64):
    a, b, *expected = INTERVAL.T
    for got, exact in zip(interval(jnp.asarray(a), jnp.asarray(b)), expected, strict=True):
        np.testing.assert_allclose(got, exact, rtol=1e-10, atol=1e-15 * (exact[0] == 0))


def test_interval_moments_agree_with_400_digits_in_float32():
    exact_in_float32 = np.isin(np.arange(len(INTERVAL)), [2, 4, 5, 11], invert=True)
    a, b, *expected = INTERVAL[exact_in_float32].astype(float).T
    a, b = jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)
    for got, exact in zip(interval(a, b), expected, strict=True):
        np.testing.assert_allclose(got, exact, rtol=1e-5, atol=1e-7 if exact[0] == 0 else 1e-37)


@pytest.mark.parametrize("start", [-30.0, -0.7, 0.0, 2.0, 55.0])
def test_a_narrow_interval_has_the_variance_of_a_uniform_variable(x64, start):
    width = 2.0**-20
    mean, variance, log_mass = interval(start, start + width)
    np.testing.assert_allclose(variance, width**2 / 12, rtol=1e-8)
    np.testing.assert_allclose(mean, start + width / 2, rtol=1e-9)
    middle = start + width / 2
    np.testing.assert_allclose(log_mass, np.log(width) - middle**2 / 2 - np.log(2 * np.pi) / 2, rtol=1e-10)


@pytest.mark.system
def test_moments_are_continuous_where_the_method_changes(x64):
    # From narrow to wide, and along the tail, through every change of method: no step beyond rounding.
    width = jnp.linspace(0.2, 4, 2001)
    for near in (-0.5, 0.0, 1.0, 2.9, 6.0):
        mean, variance, _ = interval(jnp.full(2001, near), near + width)
        exact = truncnorm(near, near + np.asarray(width))
        np.testing.assert_allclose(mean, exact.mean(), rtol=1e-9)
        np.testing.assert_allclose(variance, exact.var(), rtol=1e-7)
        assert np.max(np.abs(np.diff(variance, 3))) < 1e-6


def test_an_interval_with_an_infinite_bound_is_one_sided(x64):
    c = jnp.linspace(-30, 30, 61)
    expected = one_sided(c)
    below = interval(-jnp.inf, c)
    above = interval(-c, jnp.inf)
    for sign, got in ((1, below), (-1, above)):
        np.testing.assert_allclose(sign * got.mean, expected.mean, rtol=1e-14)
        np.testing.assert_allclose(got.variance, expected.variance, rtol=1e-14)
        np.testing.assert_allclose(got.log_mass, expected.log_mass, rtol=1e-14)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_without_bounds_nothing_changes(x64, dtype):
    infinity = jnp.asarray(jnp.inf, dtype)
    assert interval(-infinity, infinity) == (0, 1, 0)
    assert one_sided(infinity) == (0, 1, 0)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_values_and_gradients_are_finite_everywhere(x64, dtype):
    with np.errstate(over="ignore"):
        extremes = np.array(EXTREMES).astype(dtype)
    a, b = (
        jnp.asarray(x) for x in np.broadcast_arrays(*np.sort([np.repeat(extremes, 15), np.tile(extremes, 15)], axis=0))
    )
    results = (
        one_sided(a),
        interval(a, b),
        jax.jit(jax.grad(lambda a: total(one_sided(a))))(a),
        jax.jit(jax.grad(lambda a, b: total(interval(a, b)), (0, 1)))(a, b),
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results))
    assert all((result.variance >= 0).all() for result in results[:2])


def test_derivatives_of_one_sided_moments(x64):
    c = jnp.concatenate([-jnp.logspace(-1, 3, 30), jnp.linspace(-3.3, 8, 40)])
    mean, variance, log_mass = (jax.jit(jax.vmap(jax.grad(lambda c, i=i: one_sided(c)[i])))(c) for i in range(3))
    value = one_sided(c)
    # The mean follows the bound by what the variance has lost, the log mass by the density over the mass.
    np.testing.assert_allclose(mean, 1 - value.variance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(log_mass, -value.mean, rtol=1e-12)
    step = 1e-4 * jnp.maximum(1, abs(c))
    # Fourth-order differences: error step^4, and 1e-12 of rounding over the step.
    shifted = lambda k: one_sided(c + k * step).variance
    slope = (8 * (shifted(1) - shifted(-1)) - (shifted(2) - shifted(-2))) / (12 * step)
    np.testing.assert_allclose(variance, slope, rtol=1e-6, atol=1e-11)


def test_derivatives_of_interval_moments(x64):
    a, b = (jnp.asarray(x) for x in INTERVAL[[0, 1, 2, 3, 7, 8, 9, 12, 13], :2].T)
    step = 1e-5
    for i in range(3):
        moment = lambda a, b, i=i: interval(a, b)[i]
        gradients = jax.jit(jax.vmap(jax.grad(moment, (0, 1))))(a, b)
        differences = (
            (moment(a + step, b) - moment(a - step, b)) / (2 * step),
            (moment(a, b + step) - moment(a, b - step)) / (2 * step),
        )
        np.testing.assert_allclose(gradients, differences, rtol=1e-6, atol=1e-7)


def test_float32_gradients_agree_with_float64(x64):
    c = np.concatenate([-np.logspace(-2, 3, 40), np.linspace(-1.3, 6, 30)]).astype(np.float32)
    gradient = jax.jit(jax.grad(lambda c: total(one_sided(c))))
    np.testing.assert_allclose(gradient(jnp.asarray(c)), gradient(jnp.asarray(c, jnp.float64)), rtol=1e-4)


def test_second_derivatives(x64):
    c = jnp.array([-30.0, -3.5, -2.0, 0.0, 1.5])
    for i in range(3):
        slope = jax.grad(lambda c, i=i: one_sided(c)[i])
        slopes, curvature = jax.jit(jax.vmap(slope)), jax.jit(jax.vmap(jax.grad(slope)))(c)
        np.testing.assert_allclose(curvature, (slopes(c + 1e-5) - slopes(c - 1e-5)) / 2e-5, rtol=1e-5, atol=1e-9)


def test_any_shape_goes_in_and_numbers_too():
    a, b = jnp.zeros((2, 3)), jnp.ones((2, 3))
    assert interval(a, b).mean.shape == (2, 3)
    assert interval(a, 1.0).mean.shape == (2, 3)
    assert one_sided(a).variance.shape == (2, 3)
    single = interval(0.0, 1.0)
    assert single.mean.shape == ()
    np.testing.assert_array_equal(jax.vmap(interval)(a, b).variance, jnp.full((2, 3), single.variance))
