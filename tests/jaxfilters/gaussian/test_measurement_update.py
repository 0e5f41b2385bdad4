"""The iterated update: its two targets, against the posterior on a grid and costs in numpy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, condition
from jaxfilters.gaussian.linearize import second_order

MEAN, STD, NOISE = np.array([10.0, 120.0]), np.array([30.0, 40.0]), 0.05


def wrap(y, y_hat):
    return (y - y_hat + math.pi) % (2 * math.pi) - math.pi


def bearing(x):
    return jnp.arctan2(x[1:], x[:1])


def posterior_mean(y):
    """By quadrature on a grid of 8 standard deviations each way; its error is far below the differences tested."""
    x, z = np.meshgrid(*(m + s * np.linspace(-8, 8, 4001) for m, s in zip(MEAN, STD, strict=True)), indexing="ij")
    log_density = -0.5 * (((x - MEAN[0]) / STD[0]) ** 2 + ((z - MEAN[1]) / STD[1]) ** 2)
    log_density -= 0.5 * (wrap(y, np.arctan2(z, x)) / NOISE) ** 2
    weights = np.exp(log_density - log_density.max())
    return np.array([np.sum(weights * x), np.sum(weights * z)]) / weights.sum()


def updated(y, form=Gaussian, **options):
    root = form is GaussianRoot
    power = 1 if root else 2
    belief = form(jnp.asarray(MEAN), jnp.diag(jnp.asarray(STD**power)))
    arithmetic = arithmetics.square_root if root else arithmetics.joseph
    R = NOISE**power * jnp.eye(1)
    return jax.jit(lambda y: condition(belief, y, bearing, R, residual=wrap, arithmetic=arithmetic, **options))(y)


@pytest.mark.system
@pytest.mark.parametrize("degrees", [55, 70, 105])
def test_the_mean_is_that_of_the_posterior_to_a_higher_order(x64, degrees):
    y = np.deg2rad([degrees])
    expected = posterior_mean(y)
    error = {
        target: np.linalg.norm(updated(jnp.asarray(y), iterations=10, iterate_to=target)[0].mean - expected)
        for target in ("mean", "mode")
    }
    # Laplace's expansion has one more order: the skewness of the posterior no longer counts.
    assert error["mean"] < 0.25 * error["mode"]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("target", ["mean", "mode"])
def test_no_end_is_worse_than_the_plain_update(x64, target, seed):
    rng = np.random.default_rng(seed)
    y = rng.uniform(-math.pi, math.pi, 1)

    def cost(x):
        x = np.asarray(x)
        J = 0.5 * np.sum(((x - MEAN) / STD) ** 2) + 0.5 * (wrap(y, np.arctan2(x[1], x[0]))[0] / NOISE) ** 2
        H = np.array([-x[1], x[0]]) / (x @ x)
        return J + (0.5 * np.log(np.sum((H * STD) ** 2) + NOISE**2) if target == "mean" else 0.0)

    plain = cost(updated(jnp.asarray(y))[0].mean)
    for iterations in (2, 4):
        assert cost(updated(jnp.asarray(y), iterations=iterations, iterate_to=target)[0].mean) <= plain + 1e-9


def test_roots_and_covariances_iterate_alike(x64):
    y = jnp.array([1.2])
    one, other = (updated(y, form, iterations=4) for form in (Gaussian, GaussianRoot))
    np.testing.assert_allclose(one[0].mean, other[0].mean, rtol=1e-8)
    np.testing.assert_allclose(one[0].covariance, other[0].root @ other[0].root.T, rtol=1e-8)


def test_the_covariance_and_the_evidence_are_those_at_the_end(x64):
    y = jnp.array([1.2])
    found, info = updated(y, iterations=4, iterate_to="mode")
    again, info_again = updated(y, at=found.mean)
    np.testing.assert_allclose(found.covariance, again.covariance, rtol=1e-9)
    np.testing.assert_allclose(info.log_evidence, info_again.log_evidence, rtol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize("n", [3, 12])
def test_an_iterated_linear_update_with_masks_is_the_plain_one(x64, n):
    rng = np.random.default_rng(n)
    H, root, y = rng.normal(size=(4, n)), rng.normal(size=(n, n)), rng.normal(size=4)
    belief, R = Gaussian(jnp.asarray(rng.normal(size=n)), jnp.asarray(root @ root.T)), 0.1 * jnp.eye(4)
    observation = Observation(jnp.asarray(y).at[1].set(jnp.nan), jnp.array([True, False, True, True]))
    # The masked component has no derivative: nothing of it may reach the others.
    observe = lambda x: (H @ x).at[1].set(jnp.sqrt(-1.0 - x[0] ** 2))
    results = [
        jax.jit(lambda b, o=options: condition(b, observation, observe, R, **o))(belief)
        for options in (dict(), dict(iterations=3), dict(iterations=3, linearize=second_order))
    ]
    for found, info in results[1:]:
        np.testing.assert_allclose(found.mean, results[0][0].mean, atol=1e-9)
        np.testing.assert_allclose(found.covariance, results[0][0].covariance, atol=1e-9)
        np.testing.assert_allclose(info.log_evidence, results[0][1].log_evidence, atol=1e-9)


EXACT = {
    "row": np.diag([0.1, 0.0, 0.2]),
    "difference of rows": np.array([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.2]]),
    "all": np.zeros((3, 3)),
}


@pytest.mark.system
@pytest.mark.parametrize("form", [Gaussian, GaussianRoot])
@pytest.mark.parametrize("target", ["mean", "mode"])
@pytest.mark.parametrize("noise", EXACT)
def test_linear_iterations_keep_what_is_exact(x64, noise, target, form):
    """Against the conditional of the joint Gaussian, and where the prediction satisfies what is exact, too."""
    rng = np.random.default_rng(5)
    H, root, mean, y = rng.normal(size=(3, 4)), rng.normal(size=(4, 4)), rng.normal(size=4), rng.normal(size=3)
    R, P = EXACT[noise], root @ root.T
    is_root = form is GaussianRoot
    belief = form(jnp.asarray(mean), jnp.asarray(root if is_root else P))
    spread = jnp.asarray(np.linalg.svd(R)[0] * np.sqrt(np.linalg.svd(R)[1]) if is_root else R)
    arithmetic = arithmetics.square_root if is_root else arithmetics.joseph
    options = dict(arithmetic=arithmetic, iterations=8, iterate_to=target)
    update = jax.jit(lambda y: condition(belief, y, lambda x: H @ x, spread, **options))
    for reading in (y, np.array([y[0], y[0] + (H[1] - H[0]) @ mean, y[2]]), H @ mean + np.array([0.0, 1.0, 0.0])):
        found, info = update(jnp.asarray(reading))
        S = H @ P @ H.T + R
        expected = mean + P @ H.T @ np.linalg.solve(S, reading - H @ mean)
        np.testing.assert_allclose(found.mean, expected, atol=1e-8)
        np.testing.assert_allclose(info.log_evidence, log_density(reading - H @ mean, S), atol=1e-8)


def log_density(e, S):
    return -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1])


@pytest.mark.system
@pytest.mark.parametrize("reading", [1.5, 5.0, 12.0])
def test_an_exact_distance_is_met_and_the_mode_lies_on_the_circle(x64, reading):
    """Against Brent's minimisation along the circle; the first whole step leaves the circle by a part of the radius."""
    mean, std, other = np.array([3.0, 4.0]), np.array([1.0, 2.0]), 0.5
    belief = Gaussian(jnp.asarray(mean), jnp.diag(jnp.asarray(std**2)))
    observe = lambda x: jnp.stack([jnp.sqrt(x @ x), x[0]])
    y, R = jnp.array([reading, 1.0]), jnp.diag(jnp.array([0.0, other**2]))
    found, _ = jax.jit(lambda y: condition(belief, y, observe, R, iterations=40, iterate_to="mode"))(y)

    def cost(angle):
        x = reading * np.array([np.cos(angle), np.sin(angle)])
        return 0.5 * np.sum(((x - mean) / std) ** 2) + 0.5 * ((1.0 - x[0]) / other) ** 2

    angle = minimize_scalar(cost, bounds=(0.0, np.pi), method="bounded", options=dict(xatol=1e-12)).x
    np.testing.assert_allclose(np.linalg.norm(found.mean), reading, atol=1e-8)
    # Gauss-Newton steps ignore the curvature of the circle: along the smallest one they converge slowly.
    np.testing.assert_allclose(found.mean, reading * np.array([np.cos(angle), np.sin(angle)]), atol=1e-4)


@pytest.mark.system
def test_derivatives_of_exact_iterations_are_those_of_the_plain_update(x64):
    belief, R = Gaussian(jnp.asarray([1.0, 0.5]), jnp.diag(jnp.array([4.0, 1.0]))), jnp.diag(jnp.array([0.1, 0.0]))

    def moved(y, iterations):
        return condition(belief, y, lambda x: jnp.stack([x[0] + x[1], x[1]]), R, iterations=iterations)[0].mean

    plain, iterated = (jax.jit(jax.jacrev(lambda y, k=k: moved(y, k)))(jnp.array([1.0, -1.0])) for k in (1, 4))
    np.testing.assert_allclose(iterated, plain, atol=1e-9)
