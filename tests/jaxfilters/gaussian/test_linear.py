from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxfilters as jf
from jaxfilters.gaussian.linear import Kalman

KEY = jax.random.key(0)
T = 12
SIZES = [(3, 2), (12, 10), (12, 3)]


def problem(n, m):
    rng = np.random.default_rng(n)
    roots = [np.tril(rng.normal(size=(size, size))) / np.sqrt(size) + 0.3 * np.eye(size) for size in (n, n, m)]
    F = 0.9 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    H, b, d, mean = (rng.normal(size=shape) for shape in ((m, n), n, m, n))
    ys = rng.normal(size=(T, m))
    return mean, roots, F, H, b, d, ys


def build(n, m, arithmetic=jf.arithmetic.joseph, offsets=True):
    mean, roots, F, H, b, d, _ = problem(n, m)
    P, Q, R = (jnp.asarray(root if arithmetic is jf.arithmetic.square_root else root @ root.T) for root in roots)
    kind = jf.GaussianRoot if arithmetic is jf.arithmetic.square_root else jf.Gaussian
    more = {"b": jnp.asarray(b), "d": jnp.asarray(d)} if offsets else {}
    return jf.kalman(kind(jnp.asarray(mean), P), jnp.asarray(F), Q, jnp.asarray(H), R, arithmetic=arithmetic, **more)


def textbook(n, m, observed):
    """Filtered means and covariances, log densities, and smoothed means, in numpy and float64."""
    mean, roots, F, H, b, d, ys = problem(n, m)
    P, Q, R = (root @ root.T for root in roots)
    means, covariances, log_densities, ahead = [], [], [], []
    for y, rows in zip(ys, observed, strict=True):
        mean, P = F @ mean + b, F @ P @ F.T + Q
        ahead.append((mean, P))
        C, innovation = H[rows], (y - H @ mean - d)[rows]
        S = C @ P @ C.T + R[np.ix_(rows, rows)]
        gain = P @ C.T @ np.linalg.inv(S)
        log_densities.append(multivariate_normal(np.zeros(len(S)), S).logpdf(innovation) if rows.any() else 0.0)
        mean, P = mean + gain @ innovation, P - gain @ S @ gain.T
        means.append(mean)
        covariances.append(P)
    smoothed, known = [(means[-1], covariances[-1])], (means[-1], covariances[-1])
    for t in reversed(range(T - 1)):
        G = covariances[t] @ F.T @ np.linalg.inv(ahead[t + 1][1])
        known = (
            means[t] + G @ (known[0] - ahead[t + 1][0]),
            covariances[t] + G @ (known[1] - ahead[t + 1][1]) @ G.T,
        )
        smoothed.insert(0, known)
    return np.array(means), np.array(covariances), np.array(log_densities), np.array([pair[0] for pair in smoothed])


def covariance_of(belief):
    if isinstance(belief, jf.Gaussian):
        return belief.covariance
    return jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest")


@pytest.mark.parametrize(("n", "m"), SIZES)
@pytest.mark.parametrize("name", ["joseph", "square_root", "fast"])
@pytest.mark.parametrize("wide", [False, True])
def test_filter_and_smoother_agree_with_textbook(n, m, name, wide):
    observed = np.random.default_rng(1).random((T, m)) > 0.2
    observed[3] = False
    means, covariances, log_densities, smoothed = textbook(n, m, observed)
    tolerance = 1e-9 if wide else 3e-4
    with jax.enable_x64(wide):
        filter = build(n, m, getattr(jf.arithmetic, name))
        ys = jnp.where(observed, problem(n, m)[-1], jnp.nan)
        _, (beliefs, infos) = jf.run(filter, KEY, ys)
        np.testing.assert_allclose(beliefs.mean, means, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(covariance_of(beliefs), covariances, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(infos.log_evidence, log_densities, rtol=tolerance, atol=10 * tolerance)
        found = jf.smoothing.rts(filter, beliefs)
        np.testing.assert_allclose(found.mean, smoothed, rtol=3 * tolerance, atol=3 * tolerance)
        np.testing.assert_array_equal(infos.num_invalid, np.sum(~observed, axis=1))


@pytest.mark.parametrize(("n", "m"), [(3, 2), (12, 10)])
@pytest.mark.parametrize("name", ["joseph", "square_root", "fast"])
def test_products_have_full_precision(products_at_default_precision, n, m, name):
    """Of small matrices, written out, and of those that the device multiplies."""
    filter, ys = build(n, m, getattr(jf.arithmetic, name)), jnp.asarray(problem(n, m)[-1], float)

    def smoothed(ys):
        beliefs, infos = jf.smoothing.filter_and_smooth(filter, KEY, ys)
        return beliefs.mean.sum() + infos.log_evidence.sum()

    assert not products_at_default_precision(jax.value_and_grad(smoothed), ys)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_masked_and_missing_components_are_the_same(n, m):
    ys = jnp.asarray(problem(n, m)[-1], float)
    observed = jnp.asarray(np.random.default_rng(1).random((T, m)) > 0.3)
    filter = build(n, m)
    missing = jf.run(filter, KEY, jnp.where(observed, ys, jnp.nan))[0]
    masked = jf.run(filter, KEY, jf.Observation(ys, observed, jnp.broadcast_to(filter.params.R, (T, m, m))))[0]
    np.testing.assert_allclose(masked.mean, missing.mean, rtol=1e-4, atol=1e-5)


def test_it_is_the_extended_filter_of_a_linear_model():
    n, m = 3, 2
    filter, (_, _, _, _, b, d, ys) = build(n, m), problem(n, m)
    model = filter.params
    dot = partial(jnp.matmul, precision="highest")
    extended = jf.extended_kalman(
        model.prior, lambda x, u: dot(model.F, x) + b, model.Q, lambda x: dot(model.H, x) + d, model.R
    )
    ours, theirs = (jf.log_evidence(one, KEY, jnp.asarray(ys)) for one in (filter, extended))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def test_vmap_over_sequences_is_one_by_one():
    filter = build(3, 2)
    ys = jax.random.normal(KEY, (5, T, 2))
    together = jax.vmap(lambda y: jf.log_evidence(filter, KEY, y))(ys)
    np.testing.assert_allclose(together, [jf.log_evidence(filter, KEY, y) for y in ys], rtol=1e-5)


@pytest.mark.parametrize(("n", "m"), [(3, 2), (12, 10)])
def test_gradient_agrees_with_finite_differences(x64, n, m):
    filter, ys = build(n, m), jnp.asarray(problem(n, m)[-1])

    @jax.jit
    def of(model):
        return jf.log_evidence(jf.Filter(model, filter.init, filter.predict, filter.update), KEY, ys)

    gradient = jax.grad(of)(filter.params)
    for name in ("F", "H", "b", "d"):
        direction = np.random.default_rng(2).normal(size=getattr(filter.params, name).shape)

        def moved(step, name=name, direction=direction):
            values = {field: getattr(filter.params, field) for field in Kalman.__dataclass_fields__}
            return of(Kalman(**{**values, name: values[name] + step * direction}))

        difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
        np.testing.assert_allclose(np.sum(getattr(gradient, name) * direction), difference, rtol=1e-6)


def test_wrappers_take_it():
    filter, ys = build(3, 2), jnp.asarray(problem(3, 2)[-1], float)
    lagged = jf.smoothing.fixed_lag_rts(filter, 2)
    _, (states, _) = jf.run(lagged, KEY, ys)
    _, (beliefs, _) = jf.run(filter, KEY, ys[:8])
    smoothed = jf.smoothing.rts(filter, beliefs)
    np.testing.assert_allclose(states.delayed.mean[7], smoothed.mean[5], rtol=1e-4, atol=1e-5)
    robust = jf.robust(filter, 1e-9, 10 * filter.params.R)
    np.testing.assert_allclose(jf.run(robust, KEY, ys)[0].mean, jf.run(filter, KEY, ys)[0].mean, rtol=1e-4, atol=1e-5)


def test_covariances_are_tested_where_they_are_known():
    prior = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
    indefinite = jnp.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(ValueError, match=r"Q must be positive semidefinite; .*-1"):
        jf.kalman(prior, jnp.eye(2), indefinite, jnp.eye(2), jnp.eye(2))
    # A singular covariance is one.
    jf.kalman(prior, jnp.eye(2), jnp.ones((2, 2)), jnp.eye(2), jnp.eye(2))
    # Traced values are not known.
    jax.jit(lambda Q: jf.kalman(prior, jnp.eye(2), Q, jnp.eye(2), jnp.eye(2)).params.Q)(indefinite)
