"""The regression of diffusion on speed against normal equations, pseudo-inverse and ridge regression in numpy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math import diffusion
from jaxfilters.math.diffusion import GAMMA

SCALE = np.array([30.0, 20.0, 50.0, 0.2, 0.1, 0.3])
"""Millimetres and radians per second."""


def steps(seed, count=300):
    """Velocities and changes that have nothing to do with each other, in their units."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2, count, 6)) * SCALE * np.array([2.0, 0.7])[:, None, None]


@jax.jit
def learn(fit, velocities, changes, forgetting=1.0):
    def one(fit, step):
        return diffusion.update(fit, *step, forgetting=forgetting), None

    return jax.lax.scan(one, fit, (velocities, changes))[0]


def regression(velocities, changes):
    """`Z` and `Y` of the specification, section 2.5, in numbers without units."""
    Z = np.column_stack([np.abs(velocities) / SCALE, np.ones(len(velocities))])
    return Z, np.sqrt(np.pi / 2) * np.abs(changes) / SCALE


def in_units(coefficients):
    """`A` and `b` of scaled coefficients."""
    return coefficients[:-1].T * SCALE[:, None] / SCALE, coefficients[-1] * SCALE


def test_accumulated_normal_equations_are_the_pseudo_inverse_and_weak_recursive_least_squares_reach_it(x64):
    velocities, changes = steps(0)
    Z, Y = regression(velocities, changes)
    by_pseudo_inverse = np.linalg.pinv(Z) @ Y
    S_zz, S_zy = sum(np.outer(z, z) for z in Z), sum(np.outer(z, y) for z, y in zip(Z, Y, strict=True))
    np.testing.assert_allclose(np.linalg.solve(S_zz, S_zy), by_pseudo_inverse, atol=1e-10)
    fit = learn(diffusion.start(jnp.asarray(SCALE), strength=1e-6), velocities, changes)
    np.testing.assert_allclose(fit.coefficients, by_pseudo_inverse, atol=1e-6)


@pytest.mark.parametrize("count", [1, 5, 300])
def test_the_fit_is_ridge_regression_towards_the_first_guess(x64, count):
    velocities, changes = steps(1, count)
    Z, Y = regression(velocities, changes)
    first = np.vstack([np.eye(6), np.ones(6)])
    ridge = np.linalg.solve(Z.T @ Z + 10 * np.eye(7), Z.T @ Y + 10 * first)
    fit = learn(diffusion.start(jnp.asarray(SCALE)), velocities, changes)
    np.testing.assert_allclose(fit.coefficients, ridge, atol=1e-10)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(Z.T @ Z + 10 * np.eye(7)), atol=1e-12)
    A, b = in_units(ridge)
    np.testing.assert_allclose(fit.slope, A, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(fit.offset, b, rtol=1e-9)
    np.testing.assert_allclose(
        diffusion.velocity_change_std(fit, jnp.asarray(velocities[0]), low=-np.inf), A @ np.abs(velocities[0]) + b
    )


def test_exact_dependence_is_recovered(x64):
    rng = np.random.default_rng(2)
    A, b = rng.uniform(0, 1, (6, 6)) * SCALE[:, None] / SCALE, rng.uniform(0.5, 2, 6) * SCALE
    velocities, _ = steps(2)
    changes = (np.abs(velocities) @ A.T + b) / GAMMA
    fit = learn(diffusion.start(jnp.asarray(SCALE), strength=1e-10), velocities, changes)
    np.testing.assert_allclose(fit.slope, A, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(fit.offset, b, rtol=1e-6)


def test_of_gaussian_changes_the_standard_deviation_is_learnt():
    # The mean of 20000 absolute values of unit normals, over their mean: relative error sqrt(pi/2 - 1) / sqrt(20000).
    changes = SCALE * np.random.default_rng(3).normal(size=(20000, 6))
    fit = learn(diffusion.start(jnp.asarray(SCALE)), np.zeros_like(changes), changes)
    np.testing.assert_allclose(diffusion.velocity_change_std(fit, jnp.zeros(6)), SCALE, rtol=4 * 0.756 / np.sqrt(20000))


def test_forgetting_weighs_old_steps_less(x64):
    velocities, changes = steps(4, 60)
    Z, Y = regression(velocities, changes)
    root = np.sqrt(0.98 ** np.arange(59, -1, -1))[:, None]
    fit = learn(diffusion.start(jnp.asarray(SCALE), strength=1e-8), velocities, changes, 0.98)
    np.testing.assert_allclose(fit.coefficients, np.linalg.pinv(root * Z) @ (root * Y), atol=1e-6)


def test_a_long_rest_neither_overflows_nor_forgets_the_first_guess_of_the_slope():
    still = np.zeros((20000, 6))
    fit = learn(diffusion.start(jnp.asarray(SCALE)), still, 0.1 * still + 0.01, forgetting=0.98)
    assert np.trace(fit.covariance) <= 0.7 * (1 + 1e-5)
    np.testing.assert_allclose(fit.slope, np.eye(6), atol=1e-5)
    np.testing.assert_allclose(fit.offset, GAMMA * 0.01, rtol=1e-3)


def test_single_precision_keeps_up_with_double():
    velocities, changes = steps(5, 5000)
    single = learn(diffusion.start(jnp.asarray(SCALE)), velocities, changes)
    with jax.enable_x64(True):
        double = learn(diffusion.start(jnp.asarray(SCALE)), velocities, changes)
    assert single.coefficients.dtype == jnp.float32
    np.testing.assert_allclose(single.coefficients, double.coefficients, atol=1e-4)
    np.testing.assert_array_equal(single.covariance, single.covariance.T)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_not_finite_is_not_learnt(wrong):
    velocities, changes = (jnp.asarray(numbers[0]) for numbers in steps(6, 1))
    fit = diffusion.update(diffusion.start(jnp.asarray(SCALE)), velocities, changes)
    for spoilt in [(velocities.at[2].set(wrong), changes), (velocities, changes.at[0].set(wrong))]:
        jax.tree.map(np.testing.assert_array_equal, diffusion.update(fit, *spoilt), fit)


def test_the_spread_stays_within_limits():
    fit = diffusion.start(jnp.asarray(SCALE))
    low, high = 1.5 * jnp.asarray(SCALE), 3 * jnp.asarray(SCALE)
    limited = functools.partial(diffusion.velocity_change_std, fit, low=low, high=high)
    np.testing.assert_allclose(limited(jnp.zeros(6)), low)
    np.testing.assert_allclose(limited(jnp.asarray(SCALE)), 2 * SCALE, rtol=1e-6)
    np.testing.assert_allclose(limited(-1e9 * jnp.asarray(SCALE)), high)
    falling = diffusion.start(jnp.asarray(SCALE), slope=-1.0)
    np.testing.assert_array_equal(diffusion.velocity_change_std(falling, 5 * jnp.asarray(SCALE)), 0)


def test_a_fixed_diffusion_does_not_depend_on_speed_and_is_not_learnt():
    scale = jnp.asarray(SCALE)
    fit = diffusion.start(scale, slope=0.0, offset=2.0)
    np.testing.assert_allclose(
        diffusion.velocity_change_std(diffusion.fixed(fit, scale, scale), 7 * scale), 2 * SCALE, rtol=1e-6
    )


@pytest.mark.system
def test_fits_learn_in_a_batch_and_are_differentiable():
    velocities, changes = (jnp.asarray(numbers) for numbers in steps(7, 4))
    fit = diffusion.start(jnp.asarray(SCALE))
    together = jax.vmap(diffusion.update, in_axes=(None, 0, 0))(fit, velocities, changes)
    alone = [diffusion.update(fit, *step).coefficients for step in zip(velocities, changes, strict=True)]
    np.testing.assert_allclose(together.coefficients, np.stack(alone), rtol=1e-5, atol=1e-6)
    slope = jax.grad(lambda change: diffusion.update(fit, velocities[0], change).offset.sum())(changes[0])
    assert np.all(slope * np.sign(changes[0]) > 0)


@pytest.mark.parametrize(
    ("options", "named"), [({"scale": jnp.asarray(SCALE) - 0.2}, "scale"), ({"strength": 0.0}, "strength")]
)
def test_scales_and_strengths_that_cannot_be_are_rejected(options, named):
    with pytest.raises(ValueError, match=f"{named} must be positive"):
        diffusion.start(**({"scale": jnp.asarray(SCALE)} | options))
