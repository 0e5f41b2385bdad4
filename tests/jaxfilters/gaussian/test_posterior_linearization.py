import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
MEAN, P, R = np.array([1.0, 1.0]), np.diag([0.3, 0.2]), np.array([[0.01]])
Y = np.array([1.6])


def distance(x, *, xp=jnp):
    return xp.sqrt(x[:1] ** 2 + x[1:] ** 2)


def build(kind, iterations, root=False):
    spread = [jnp.asarray(np.linalg.cholesky(C) if root else C) for C in (P, 1e-12 * np.eye(2), R)]
    prior = (jf.GaussianRoot if root else jf.Gaussian)(jnp.asarray(MEAN), spread[0])
    arithmetic = jf.arithmetic.square_root if root else jf.arithmetic.joseph
    inner = kind(prior, lambda x, u: x, spread[1], distance, spread[2], arithmetic=arithmetic)
    return jf.posterior_linearization(inner, iterations)


def regressed(mean, C):
    """Kalman update of the prior with the observation regressed on sigma points of a belief, in numpy."""
    offsets = np.sqrt(2) * np.linalg.cholesky(C).T
    points = np.concatenate([mean + offsets, mean - offsets])
    values = np.array([distance(x, xp=np) for x in points])
    y_hat = values.mean(axis=0)
    cross = (points - mean).T @ (values - y_hat) / len(points)
    H = cross.T @ np.linalg.inv(C)
    rest = (values - y_hat).T @ (values - y_hat) / len(points) - H @ C @ H.T
    S = H @ P @ H.T + rest + R
    K = P @ H.T @ np.linalg.inv(S)
    return MEAN + K @ (Y - y_hat - H @ (MEAN - mean)), P - K @ S @ K.T


@pytest.mark.system
@pytest.mark.parametrize("root", [False, True], ids=["covariance", "root"])
def test_the_belief_is_that_of_the_regression_over_itself(x64, root):
    found, _ = jf.update(
        build(jf.cubature_kalman, 60, root), KEY, jf.init(build(jf.cubature_kalman, 1, root), KEY), jnp.asarray(Y)
    )
    C = found.root @ found.root.T if root else found.covariance
    mean, covariance = regressed(np.asarray(found.mean), np.asarray(C))
    # The slope of the regression is not quite the derivative of its cost, on which steps of the mean are judged.
    np.testing.assert_allclose(found.mean, mean, atol=5e-4)
    np.testing.assert_allclose(C, covariance, atol=5e-4)


@pytest.mark.system
def test_with_derivatives_it_finds_the_mode_and_its_smoother_runs(x64):
    filter = build(jf.extended_kalman, 30)
    found, _ = jf.update(filter, KEY, jf.init(filter, KEY), jnp.asarray(Y))
    cost = lambda x: 0.5 * ((x - MEAN) ** 2 / np.diag(P)).sum() + 0.5 * ((Y - distance(x)) ** 2 / R[0]).sum()
    assert np.abs(jax.grad(cost)(found.mean)).max() < 1e-6
    beliefs, infos = jf.smoothing.filter_and_smooth(filter, KEY, jnp.asarray(Y)[None] + jnp.zeros((4, 1)))
    assert np.isfinite(infos.log_evidence).all()
    # The state stands still: smoothing carries the last belief back.
    np.testing.assert_allclose(beliefs.mean[0], beliefs.mean[-1], atol=1e-4)


@pytest.mark.system
@pytest.mark.parametrize("root", [False, True], ids=["covariance", "root"])
@pytest.mark.parametrize("kind", ["extended_kalman", "cubature_kalman"])
def test_exact_linear_observations_are_those_of_the_kalman_filter(x64, kind, root):
    """The regression over the last belief has no slope in the direction that was observed; the update needs it."""
    F, H, ys = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.2]]), np.array([[0.3], [1.1], [0.7]])
    Q = np.diag([0.0, 0.2])
    spread = [jnp.asarray(np.sqrt(C) if root else C) for C in (P, Q, np.zeros((1, 1)))]
    prior = (jf.GaussianRoot if root else jf.Gaussian)(jnp.asarray(MEAN), spread[0])
    arithmetic = jf.arithmetic.square_root if root else jf.arithmetic.joseph
    build = getattr(jf, kind)
    inner = build(prior, lambda x: F @ x, spread[1], lambda x: H @ x, spread[2], arithmetic=arithmetic)
    last, (_, infos) = jf.run(jf.posterior_linearization(inner, 4), KEY, jnp.asarray(ys))
    mean, C = MEAN, P
    for y, info in zip(ys, np.asarray(infos.log_evidence), strict=True):
        mean, C = F @ mean, F @ C @ F.T + Q
        e, S = y - H @ mean, H @ C @ H.T
        gain = C @ H.T / S
        np.testing.assert_allclose(info, (-0.5 * e**2 / S - 0.5 * np.log(2 * np.pi * S))[0, 0], atol=1e-7)
        mean, C = mean + gain @ e, C - gain @ H @ C
    np.testing.assert_allclose(last.mean, mean, atol=1e-7)
