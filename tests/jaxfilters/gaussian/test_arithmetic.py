from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.stats import multivariate_normal

from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot

VERBS = ("predict", "update", "rts", "noise_root")
ARITHMETICS = {
    module.__name__.rpartition(".")[2]: SimpleNamespace(**{verb: jax.jit(getattr(module, verb)) for verb in VERBS})
    for module in (arithmetics.joseph, arithmetics.square_root, arithmetics.fast)
}


@pytest.fixture(params=ARITHMETICS, ids=str)
def name(request):
    return request.param


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def belief_in(name, mean, root):
    mean, root = jnp.asarray(mean), jnp.asarray(root)
    return GaussianRoot(mean, root) if name == "square_root" else Gaussian(mean, root @ root.T)


def noise_in(name, root):
    return jnp.asarray(root if name == "square_root" else root @ root.T)


def covariance_of(belief):
    if isinstance(belief, Gaussian):
        return belief.covariance
    return jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest")


def textbook_update(mean, P, y, H, R):
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    log_evidence = multivariate_normal(H @ mean, S).logpdf(y)
    nis = (y - H @ mean) @ np.linalg.inv(S) @ (y - H @ mean)
    return mean + K @ (y - H @ mean), P - K @ H @ P, log_evidence, nis


@pytest.mark.system
@pytest.mark.parametrize(("n", "m", "width"), [(2, 4, 6), (10, 9, 7)])
def test_prediction_and_update_agree_with_textbook(x64, rng, name, n, m, width):
    arithmetic = ARITHMETICS[name]
    mean, root = rng.normal(size=n), rng.normal(size=(n, width))
    F, b, root_Q = rng.normal(size=(n, n)), rng.normal(size=n), rng.normal(size=(n, 2))
    H, root_R, y = rng.normal(size=(m, n)), rng.normal(size=(m, m + 1)), rng.normal(size=m)

    predicted = arithmetic.predict(belief_in(name, mean, root), jnp.asarray(F), noise_in(name, root_Q), jnp.asarray(b))
    P = F @ root @ root.T @ F.T + root_Q @ root_Q.T
    np.testing.assert_allclose(predicted.mean, F @ mean + b, atol=1e-12)
    np.testing.assert_allclose(covariance_of(predicted), P, atol=1e-10)

    posterior, info = arithmetic.update(predicted, jnp.asarray(y), jnp.asarray(H), noise_in(name, root_R))
    expected = textbook_update(F @ mean + b, P, y, H, root_R @ root_R.T)
    np.testing.assert_allclose(posterior.mean, expected[0], atol=1e-9)
    np.testing.assert_allclose(covariance_of(posterior), expected[1], atol=1e-9)
    np.testing.assert_allclose(info.log_evidence, expected[2], rtol=1e-10)
    np.testing.assert_allclose(info.nis, expected[3], rtol=1e-9)
    S = H @ P @ H.T + root_R @ root_R.T
    np.testing.assert_allclose(info.innovation_root @ info.innovation_root.T, S, atol=1e-9)
    assert (info.rank, info.deficiency, info.num_invalid) == (m, 0, 0)

    # A nonlinear observation gives its own prediction; shifting it shifts the innovation.
    shifted, _ = arithmetic.update(
        predicted,
        jnp.asarray(y + 1),
        jnp.asarray(H),
        noise_in(name, root_R),
        jnp.asarray(H @ (F @ mean + b) + 1),
    )
    np.testing.assert_allclose(shifted.mean, expected[0], atol=1e-9)


@pytest.mark.system
def test_masked_components_are_as_if_they_were_not_there(x64, rng, name):
    arithmetic = ARITHMETICS[name]
    belief = belief_in(name, rng.normal(size=3), rng.normal(size=(3, 3)))
    H, root_R, y = rng.normal(size=(4, 3)), np.tril(rng.normal(size=(4, 4))), rng.normal(size=4)
    observed = np.array([0, 2])
    mask = jnp.isin(jnp.arange(4), observed)
    expected = arithmetic.update(
        belief, jnp.asarray(y[observed]), jnp.asarray(H[observed]), noise_in(name, root_R[observed])
    )
    bad_y, bad_H = y.copy(), H.copy()
    bad_y[1], bad_y[3], bad_H[3] = np.nan, 1e9, np.inf
    R = np.array(noise_in(name, root_R))
    R[3] = np.nan
    if name != "square_root":
        R[:, 3] = np.nan
    posterior, info = arithmetic.update(belief, *map(jnp.asarray, (bad_y, bad_H, R)), mask=mask)
    np.testing.assert_allclose(posterior.mean, expected[0].mean, atol=1e-12)
    np.testing.assert_allclose(covariance_of(posterior), covariance_of(expected[0]), atol=1e-12)
    np.testing.assert_allclose(info.log_evidence, expected[1].log_evidence, rtol=1e-12)
    np.testing.assert_allclose(info.nis, expected[1].nis, rtol=1e-12)
    np.testing.assert_array_equal(info.innovation[jnp.array([1, 3])], 0)
    assert (info.rank, info.deficiency, info.num_invalid) == (2, 0, 0)

    def evidence(y, H, R):
        posterior, info = arithmetic.update(belief, y, H, R, y_hat=H @ belief.mean, mask=mask)
        return info.log_evidence + jnp.sum(posterior.mean)

    gradients = jax.grad(evidence, (0, 1, 2))(*map(jnp.asarray, (bad_y, H, R)))
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        np.testing.assert_array_equal(gradient[3], 0)

    nothing, info = arithmetic.update(belief, *map(jnp.asarray, (bad_y, bad_H, R)), mask=jnp.zeros(4, bool))
    np.testing.assert_array_equal(nothing.mean, belief.mean)
    np.testing.assert_allclose(covariance_of(nothing), covariance_of(belief), atol=1e-12)
    assert info.log_evidence == 0
    assert info.nis == 0


@pytest.mark.system
def test_what_is_certain_stays_so_without_nan(x64, rng, name):
    arithmetic = ARITHMETICS[name]
    root = np.tril(rng.normal(size=(3, 3)))
    root[1] = 0
    mean = rng.normal(size=3)
    # The certain component itself is observed without noise, beside a combination with noise.
    H = np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    root_R = np.diag([0.0, 0.5])
    y = np.array([mean[1], 0.3])
    expected = textbook_update(mean, root @ root.T, y[1:], H[1:], (root_R @ root_R.T)[1:, 1:])

    def run(root):
        return arithmetic.update(belief_in(name, mean, root), jnp.asarray(y), jnp.asarray(H), noise_in(name, root_R))

    posterior, info = run(root)
    np.testing.assert_allclose(posterior.mean, expected[0], atol=1e-12)
    np.testing.assert_allclose(covariance_of(posterior), expected[1], atol=1e-12)
    np.testing.assert_allclose(info.log_evidence, expected[2], rtol=1e-12)
    assert covariance_of(posterior)[1, 1] == 0
    assert (info.rank, info.deficiency) == (1, 1)
    assert np.isfinite(jax.grad(lambda root: run(root)[1].log_evidence)(jnp.asarray(root))).all()


@pytest.mark.system
def test_gradient_of_the_evidence_agrees_with_differences(x64, rng, name):
    arithmetic = ARITHMETICS[name]
    belief = belief_in(name, rng.normal(size=2), np.tril(rng.normal(size=(2, 2))))
    ys = jnp.asarray(rng.normal(size=(5, 1)))

    def log_likelihood(scale):
        F = jnp.array([[1.0, 0.1], [0.0, 1.0]]) * scale[0]
        H = jnp.array([[1.0, 0.0]])
        root_R = scale[1].reshape(1, 1)
        # One noise drives two states: the triangularised matrix is rank deficient on the way.
        root_Q = scale[2] * jnp.array([[0.05], [0.1]])

        def step(belief, y):
            Q, R = (root_Q, root_R) if name == "square_root" else (root_Q @ root_Q.T, root_R @ root_R.T)
            return arithmetic.update(arithmetic.predict(belief, F, Q), y, H, R)

        _, infos = jax.lax.scan(step, belief, ys)
        return jnp.sum(infos.log_evidence)

    scale = jnp.array([0.9, 0.7, 1.3])
    gradient = jax.grad(log_likelihood)(scale)
    compiled = jax.jit(log_likelihood)
    for i in range(3):
        step = 1e-5 * jnp.eye(3)[i]
        np.testing.assert_allclose(gradient[i], (compiled(scale + step) - compiled(scale - step)) / 2e-5, rtol=1e-6)


def constant_velocity(name, dtype, ys):
    """Log likelihood of a track whose prior is 10^12 times as uncertain as a measurement."""
    dt = 0.01
    F = jnp.array([[1, dt], [0, 1]], dtype)
    root_Q = jnp.array([[1e-6, 0], [1e-5, 1e-5]], dtype)
    root_R = jnp.array([[1e-3]], dtype)
    H = jnp.array([[1, 0]], dtype)
    root_P = jnp.diag(jnp.array([1e3, 1e3], dtype))
    mean = jnp.zeros(2, dtype)
    if name != "square_root":
        belief, Q, R = Gaussian(mean, root_P @ root_P.T), root_Q @ root_Q.T, root_R @ root_R.T
    else:
        belief, Q, R = GaussianRoot(mean, root_P), root_Q, root_R
    arithmetic = ARITHMETICS[name]

    def step(belief, y):
        belief, info = arithmetic.update(belief, y, H, R)
        return arithmetic.predict(belief, F, Q), (belief.mean, info.log_evidence)

    _, (means, log_evidence) = jax.lax.scan(step, belief, jnp.asarray(ys, dtype))
    return np.asarray(means), np.asarray(log_evidence)


@pytest.mark.system
def test_float32_survives_a_condition_number_of_1e12(x64, rng, name):
    velocity = 0.3 + np.cumsum(1e-5 * rng.normal(size=2000))
    ys = np.float32(0.01 * np.cumsum(velocity) + 1e-3 * rng.normal(size=2000))[:, None]
    exact_means, exact = constant_velocity("square_root", jnp.float64, ys)
    np.testing.assert_allclose(constant_velocity("joseph", jnp.float64, ys)[1].sum(), exact.sum(), rtol=1e-6)
    means, log_evidence = constant_velocity(name, jnp.float32, ys)
    assert np.isfinite(means).all()
    # What `fast` cannot do it says, and stays finite.
    assert np.isfinite(log_evidence).all() == (name != "fast")
    assert not np.isnan(log_evidence).any()
    if name == "square_root":
        assert abs(log_evidence.astype(np.float64).sum() - exact.sum()) <= 0.1
        np.testing.assert_allclose(means[10:], exact_means[10:], atol=2e-4)


@pytest.mark.system
def test_beliefs_map_over_the_last_axis(rng, name):
    arithmetic = ARITHMETICS[name]
    means, roots = rng.normal(size=(3, 5)).astype(np.float32), rng.normal(size=(3, 3, 5)).astype(np.float32)
    H, R, y = jnp.ones((1, 3)), jnp.ones((1, 1)), jnp.ones(1)
    means, roots = jnp.asarray(means), jnp.asarray(roots)
    beliefs = jax.vmap(lambda mean, root: belief_in(name, mean, root), -1, -1)(means, roots)
    mapped, infos = jax.vmap(lambda belief: arithmetic.update(belief, y, H, R), -1, -1)(beliefs)
    for i in range(5):
        single, info = arithmetic.update(belief_in(name, means[:, i], roots[..., i]), y, H, R)
        np.testing.assert_allclose(mapped.mean[:, i], single.mean, atol=1e-4)
        np.testing.assert_allclose(infos.log_evidence[i], info.log_evidence, atol=1e-4)


@pytest.mark.system
@pytest.mark.parametrize("size", [2, 10])
def test_a_component_that_repeats_others_is_left_out_and_counted(x64, rng, name, size):
    arithmetic = ARITHMETICS[name]
    belief = belief_in(name, rng.normal(size=size), rng.normal(size=(size, size)))
    H = np.vstack([rng.normal(size=(size, size)), np.zeros((1, size))])
    root_R = np.vstack([rng.normal(size=(size, size)), np.zeros((1, size))])
    y = rng.normal(size=size + 1)
    H[-1], root_R[-1], y[-1] = H[0] + H[1], root_R[0] + root_R[1], y[0] + y[1]
    expected = arithmetic.update(belief, jnp.asarray(y[:-1]), jnp.asarray(H[:-1]), noise_in(name, root_R[:-1]))

    def run(H):
        return arithmetic.update(belief, jnp.asarray(y), H, noise_in(name, root_R))

    posterior, info = run(jnp.asarray(H))
    assert (info.rank, info.deficiency, info.num_invalid) == (size, 1, 0)
    np.testing.assert_allclose(posterior.mean, expected[0].mean, atol=1e-7)
    np.testing.assert_allclose(covariance_of(posterior), covariance_of(expected[0]), atol=1e-7)
    np.testing.assert_allclose(info.log_evidence, expected[1].log_evidence, atol=1e-7)
    assert info.innovation[-1] == 0
    assert np.isfinite(jax.grad(lambda H: run(H)[1].log_evidence)(jnp.asarray(H))).all()


@pytest.mark.system
@pytest.mark.parametrize("size", [3, 10])
def test_nothing_that_is_not_finite_leaves_unannounced(rng, name, size):
    arithmetic = ARITHMETICS[name]
    root = np.float32(rng.normal(size=(size, size)))
    belief = belief_in(name, np.float32(rng.normal(size=size)), root)
    y, H = jnp.asarray(rng.normal(size=size), jnp.float32), jnp.asarray(rng.normal(size=(size, size)), jnp.float32)
    R = noise_in(name, np.eye(size, dtype=np.float32))
    without = arithmetic.update(belief, y, H, R, mask=jnp.arange(size) != 1)

    def run(y, H=H, R=R, belief=belief):
        return arithmetic.update(belief, y, H, R)

    unread, info = run(y.at[1].set(jnp.nan))
    np.testing.assert_allclose(unread.mean, without[0].mean, rtol=1e-5)
    np.testing.assert_allclose(info.log_evidence, without[1].log_evidence, rtol=1e-5)
    assert (info.rank, info.deficiency, info.num_invalid) == (size - 1, 0, 1)
    assert np.isfinite(jax.grad(lambda y: run(y)[1].log_evidence)(y.at[1].set(jnp.nan))).all()

    for bad in (dict(H=H.at[1, 0].set(jnp.inf)), dict(R=R.at[1, 1].set(jnp.nan))):
        posterior, info = run(y, **bad)
        np.testing.assert_allclose(posterior.mean, without[0].mean, rtol=1e-5)
        assert info.num_invalid == 1
        assert info.log_evidence == -jnp.inf

    lost = belief_in(name, np.full(size, np.nan, np.float32), root)
    _, info = run(y, belief=lost)
    assert info.log_evidence == -jnp.inf
    assert info.num_invalid == size
    _, info = run(y, belief=belief_in(name, np.zeros(size, np.float32), root * np.float32(np.nan)))
    assert info.log_evidence == -jnp.inf or info.num_invalid == size


@pytest.mark.parametrize("size", [3, 10])
@pytest.mark.parametrize("name", ["joseph", "fast"])
def test_an_indefinite_covariance_is_left_as_it_is_and_announced(name, size):
    belief = Gaussian(jnp.zeros(size), jnp.diag(jnp.arange(size) - 1.0))
    posterior, info = ARITHMETICS[name].update(belief, jnp.ones(size), jnp.eye(size), 0.1 * jnp.eye(size))
    np.testing.assert_array_equal(posterior.covariance, belief.covariance)
    np.testing.assert_array_equal(posterior.mean, 0)
    assert info.log_evidence == -jnp.inf
    assert (info.rank, info.deficiency) == (0, size)


def test_more_noise_counts_as_noise(x64, rng, name):
    arithmetic = ARITHMETICS[name]
    belief = belief_in(name, rng.normal(size=3), rng.normal(size=(3, 3)))
    F, H, y = (jnp.asarray(rng.normal(size=shape)) for shape in ((3, 3), (2, 3), 2))
    root_Q, root_R = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
    lost_x, lost_y = rng.normal(size=(3, 5)), rng.normal(size=(2, 7))
    both_Q, both_R = np.hstack([root_Q, lost_x]), np.hstack([root_R, lost_y])
    predicted = arithmetic.predict(belief, F, noise_in(name, root_Q), added_root=jnp.asarray(lost_x))
    expected = arithmetic.predict(belief, F, noise_in(name, both_Q))
    np.testing.assert_allclose(covariance_of(predicted), covariance_of(expected), atol=1e-12)
    posterior, info = arithmetic.update(belief, y, H, noise_in(name, root_R), added_root=jnp.asarray(lost_y))
    expected, expected_info = arithmetic.update(belief, y, H, noise_in(name, both_R))
    np.testing.assert_allclose(covariance_of(posterior), covariance_of(expected), atol=1e-12)
    np.testing.assert_allclose(info.log_evidence, expected_info.log_evidence, rtol=1e-12)
    root = arithmetic.noise_root(noise_in(name, root_R), jnp.array([True, False]), jnp.asarray(lost_y))
    np.testing.assert_allclose(root @ root.T, np.diag([1.0, 0.0]) * (both_R @ both_R.T), atol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize(("name", "size"), [("joseph", 3), ("fast", 9), ("square_root", 9)])
def test_derivatives_agree_with_differences(x64, rng, name, size):
    arithmetic = ARITHMETICS[name]
    mean, root, root_R, y = (rng.normal(size=shape) for shape in (size, (size, size), (size, size), size))
    F, H, mix = (rng.normal(size=(size, size)) for _ in range(3))

    def figures(root, F, H, root_R, y):
        belief = belief_in(name, mean, root)
        predicted = arithmetic.predict(belief, F, noise_in(name, root_R))
        posterior, info = arithmetic.update(predicted, y, H, noise_in(name, root_R))
        smoothed = arithmetic.rts(belief, posterior, F, noise_in(name, root_R))
        return (
            info.log_evidence,
            info.nis,
            posterior.mean,
            jnp.sum(mix * covariance_of(posterior)),
            jnp.sum(mix * info.innovation_root),
            smoothed.mean,
            jnp.sum(mix * covariance_of(smoothed)),
        )

    check_grads(jax.jit(figures), (root, F, H, root_R, y), order=1, atol=1e-5, rtol=1e-5)


@pytest.mark.system
def test_second_derivatives_agree_with_differences(x64, rng, name):
    H, root, y = (jnp.asarray(rng.normal(size=shape)) for shape in ((10, 9), (9, 9), 10))

    def log_evidence(scales):
        belief = belief_in(name, jnp.zeros(9), scales[0] * root)
        posterior, info = ARITHMETICS[name].update(belief, y, scales[2] * H, scales[1] * jnp.eye(10))
        return info.log_evidence + jnp.sum(covariance_of(posterior))

    scales = jnp.array([0.8, 1.1, 0.9])
    slope = jax.jit(jax.grad(log_evidence))
    numeric = [(slope(scales + step) - slope(scales - step)) / 2e-5 for step in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(jax.jit(jax.hessian(log_evidence))(scales), numeric, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("n", "width"), [(3, 3), (10, 12)])
def test_smoothing_agrees_with_the_joint_posterior(x64, rng, name, n, width):
    arithmetic = ARITHMETICS[name]
    mean, root, F, b = rng.normal(size=n), rng.normal(size=(n, width)), rng.normal(size=(n, n)), rng.normal(size=n)
    root_Q, next_mean = rng.normal(size=(n, 2 * n)), rng.normal(size=n)
    P, Q = root @ root.T, root_Q @ root_Q.T
    # Were the next state seen as y = x' + r, the future would be that; its belief is what such an update leaves.
    S = F @ P @ F.T + Q
    R = np.eye(n)
    y = rng.normal(size=n)
    gain = S @ np.linalg.inv(S + R)
    next_mean, next_P = F @ mean + b + gain @ (y - F @ mean - b), S - gain @ S
    joint = P @ F.T @ np.linalg.inv(S + R)
    expected_mean, expected_P = mean + joint @ (y - F @ mean - b), P - joint @ F @ P
    smoothed = arithmetic.rts(
        belief_in(name, mean, root),
        belief_in(name, next_mean, np.linalg.cholesky(next_P)),
        jnp.asarray(F),
        noise_in(name, root_Q),
        jnp.asarray(b),
    )
    np.testing.assert_allclose(smoothed.mean, expected_mean, atol=1e-9)
    np.testing.assert_allclose(covariance_of(smoothed), expected_P, atol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize("n", [4, 12])
def test_roots_of_any_rank(x64, rng, n):
    A = rng.normal(size=(n, 2))
    A[1] = 0
    full = A @ A.T
    L = factor.root(jnp.asarray(full))
    np.testing.assert_allclose(L @ L.T, full, atol=1e-7)
    assert np.sum(np.diagonal(L) > 0) == 2
    np.testing.assert_array_equal(L, np.tril(L))
    assert np.isfinite(jax.grad(lambda S: jnp.sum(jnp.sin(factor.root(S))))(jnp.asarray(full))).all()
    assert np.isnan(factor.root(jnp.diag(jnp.arange(n) - 1.0))).any()
    # Along a change that keeps the span of the rows.
    turn = rng.normal(size=(2, 2))
    moved = lambda t: jnp.asarray(A) @ (jnp.eye(2) + t * jnp.asarray(turn))
    square = lambda t: jnp.sum((lambda L: L @ L.T)(factor.root(moved(t) @ moved(t).T)) * jnp.asarray(full))
    slope = jax.grad(square)(0.0)
    np.testing.assert_allclose(slope, (square(1e-5) - square(-1e-5)) / 2e-5, rtol=1e-4)
