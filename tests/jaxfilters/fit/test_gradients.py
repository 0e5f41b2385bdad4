"""Gradients of the log evidence of every Gaussian filter: exact where the model is linear, else beside differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import fit
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.linearize import taylor, unscented

RNG = np.random.default_rng(9)
T = 3
F, H = RNG.normal(size=(2, 2)), RNG.normal(size=(1, 2))
ROOT_P, ROOT_Q = np.tril(RNG.normal(size=(2, 2))), np.tril(RNG.normal(size=(2, 2)))
YS = RNG.normal(size=(T, 1))
THETA = {"rate": 0.7, "drift": 0.9, "noise": 0.6, "bend": 0.3}
KEY = jax.random.key(0)


def move(rate, x, inputs):
    del inputs
    return rate * F @ x


def see(bend, x):
    return H @ x + bend * jnp.sin(x[:1] * x[1:])


def filter_of(theta, bend=0.0, arithmetic=arithmetics.joseph, **options):
    root = arithmetic is arithmetics.square_root
    form = GaussianRoot if root else Gaussian
    P, Q = (ROOT_P, ROOT_Q) if root else (ROOT_P @ ROOT_P.T, ROOT_Q @ ROOT_Q.T)
    power = 1 if root else 2
    return extended_kalman(
        form(jnp.ones(2), jnp.asarray(P)),
        jax.tree_util.Partial(move, theta["rate"]),
        theta["drift"] ** power * jnp.asarray(Q),
        jax.tree_util.Partial(see, bend * theta["bend"]),
        theta["noise"] ** power * jnp.eye(1),
        arithmetic=arithmetic,
        **options,
    )


def exact(theta):
    """Log density of all readings at once, from their joint covariance."""
    A, Q = theta["rate"] * F, theta["drift"] ** 2 * ROOT_Q @ ROOT_Q.T
    mean, P = jnp.ones(2), jnp.asarray(ROOT_P @ ROOT_P.T)
    means, covariance = [], jnp.zeros((T, T))
    for t in range(T):
        mean, P = A @ mean, A @ P @ A.T + Q
        means.append((H @ mean)[0])
        across = P
        for s in range(t, T):
            value = (H @ across @ H.T)[0, 0]
            covariance = covariance.at[t, s].set(value).at[s, t].set(value)
            across = across @ A.T
    covariance = covariance + theta["noise"] ** 2 * jnp.eye(T)
    return jax.scipy.stats.multivariate_normal.logpdf(YS[:, 0], jnp.stack(means), covariance)


LINEAR = {
    "square_root": dict(arithmetic=arithmetics.square_root),
    "unscented": dict(linearize=unscented(), arithmetic=arithmetics.square_root),
}


@pytest.fixture(scope="module")
def expected():
    with jax.enable_x64(True):
        return jax.jit(jax.value_and_grad(exact))(THETA)


@pytest.mark.system
@pytest.mark.parametrize("options", LINEAR.values(), ids=LINEAR)
def test_the_gradient_is_that_of_the_joint_gaussian(x64, expected, options):
    density = fit.log_evidence(KEY, lambda theta: filter_of(theta, **options), jnp.asarray(YS))
    value, slope = jax.jit(jax.value_and_grad(density))(THETA)
    np.testing.assert_allclose(value, expected[0], rtol=1e-10)
    for name in ("rate", "drift", "noise"):
        np.testing.assert_allclose(slope[name], expected[1][name], rtol=1e-6)


CURVED = {
    "taylor": dict(linearize=taylor, arithmetic=arithmetics.fast),
    "iterated": dict(linearize=taylor, iterations=3),
    "unscented": dict(linearize=unscented(), arithmetic=arithmetics.square_root),
}


@pytest.mark.system
@pytest.mark.parametrize("options", CURVED.values(), ids=CURVED)
def test_the_gradient_of_a_curved_model_agrees_with_differences(options):
    density = fit.log_evidence(KEY, lambda theta: filter_of(theta, bend=1.0, **options), jnp.asarray(YS))
    check = fit.check_gradient(density, THETA, {**dict.fromkeys(THETA, fit.positive), "bend": fit.free})
    assert check.error < 1e-6
    assert abs(check.gradient).min() > 1e-4
