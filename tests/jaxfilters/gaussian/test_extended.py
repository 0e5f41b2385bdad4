import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import keep_all, keep_info, log_evidence, run
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, condition, extended_kalman
from jaxfilters.gaussian.linearize import cubature, second_order_covariance_only, taylor, unscented
from jaxfilters.gaussian.manifold import Manifold, add, displacement, product, rotation, vector
from jaxfilters.math import lie

KEY = jax.random.key(1)
RNG = np.random.default_rng(4)
N, M, T = 4, 3, 5
F, H = RNG.normal(size=(N, N)), RNG.normal(size=(M, N))
ROOT_P, ROOT_Q, ROOT_R = (np.tril(RNG.normal(size=(size, size))) for size in (N, N, M))
MEAN, YS = RNG.normal(size=N), RNG.normal(size=(T, M))
DTS = np.array([0.1, 0.3, 0.05, 0.2, 0.4])
CURVED = Manifold(add, displacement)


@pytree_dataclass
class Linear:
    F: jax.Array
    H: jax.Array
    unit_noise: jax.Array

    def transition(self, x, dt):
        return x + dt * self.F @ x

    def process_noise(self, dt):
        return dt * self.unit_noise

    def observe(self, x):
        return self.H @ x


def linear_filter(arithmetic=arithmetics.joseph, F=F, **options):
    root = arithmetic is arithmetics.square_root
    model = Linear(jnp.asarray(F), jnp.asarray(H), jnp.asarray(ROOT_Q if root else ROOT_Q @ ROOT_Q.T))
    prior = (GaussianRoot if root else Gaussian)(jnp.asarray(MEAN), jnp.asarray(ROOT_P if root else ROOT_P @ ROOT_P.T))
    R = jnp.asarray(ROOT_R if root else ROOT_R @ ROOT_R.T)
    return extended_kalman(
        prior, model.transition, model.process_noise, model.observe, R, arithmetic=arithmetic, **options
    )


def covariance_of(belief):
    if isinstance(belief, Gaussian):
        return belief.covariance
    return jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest")


def textbook(observed, root_noise=False):
    """Means, covariances and log evidences of the dense Kalman filter."""
    mean, P, found = MEAN, ROOT_P @ ROOT_P.T, []
    for y, dt, rows in zip(YS, DTS, observed, strict=True):
        A = np.eye(N) + dt * F
        mean, P = A @ mean, A @ P @ A.T + dt ** (2 if root_noise else 1) * ROOT_Q @ ROOT_Q.T
        C, R = H[rows], (ROOT_R @ ROOT_R.T)[np.ix_(rows, rows)]
        S = C @ P @ C.T + R
        log_evidence = multivariate_normal(C @ mean, S).logpdf(y[rows]) if rows.any() else 0.0
        gain = P @ C.T @ np.linalg.inv(S)
        mean, P = mean + gain @ (y[rows] - C @ mean), P - gain @ C @ P
        found.append((mean, P, log_evidence))
    return [np.array(column) for column in zip(*found, strict=True)]


LINEAR = {
    "ekf": dict(),
    "iekf": dict(iterations=4),
    "ukf": dict(linearize=unscented(), arithmetic=arithmetics.fast),
    "ckf": dict(linearize=cubature, manifold=CURVED),
    "square_root_ukf": dict(arithmetic=arithmetics.square_root, linearize=unscented()),
    "square_root_second_order": dict(
        arithmetic=arithmetics.square_root, linearize=second_order_covariance_only, iterations=3
    ),
}


@pytest.mark.system
@pytest.mark.parametrize("options", LINEAR.values(), ids=LINEAR)
def test_all_are_the_kalman_filter_where_the_model_is_linear(x64, options):
    observed = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 1], [1, 1, 1]], bool)
    ys = Observation(jnp.where(observed, YS, jnp.nan), jnp.asarray(observed))
    filter = linear_filter(**options)
    _, (beliefs, infos) = run(filter, KEY, ys, jnp.asarray(DTS))
    means, covariances, log_evidences = textbook(observed, options.get("arithmetic") is arithmetics.square_root)
    np.testing.assert_allclose(beliefs.mean, means, atol=1e-9)
    np.testing.assert_allclose(covariance_of(beliefs), covariances, atol=1e-9)
    np.testing.assert_allclose(infos.log_evidence, log_evidences, atol=1e-9)
    np.testing.assert_array_equal(infos.rank, observed.sum(axis=1))
    np.testing.assert_array_equal(infos.num_invalid, 0)


@pytest.mark.system
@pytest.mark.parametrize("arithmetic", [arithmetics.joseph, arithmetics.square_root])
def test_what_was_not_read_is_left_out_counted_and_differentiated(x64, arithmetic):
    observed = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 1], [1, 1, 1]], bool)
    ys = jnp.where(observed, YS, jnp.nan)
    log_evidences = textbook(observed, arithmetic is arithmetics.square_root)[2]

    def evidence(filter, ys):
        _, infos = run(filter, KEY, ys, jnp.asarray(DTS), collect=keep_info)
        return infos.log_evidence.sum(), infos.num_invalid

    evaluate = jax.jit(jax.value_and_grad(evidence, (0, 1), has_aux=True))
    (value, num_invalid), slopes = evaluate(linear_filter(arithmetic), ys)
    np.testing.assert_allclose(value, log_evidences.sum(), rtol=1e-10)
    np.testing.assert_array_equal(num_invalid, (~observed).sum(axis=1))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize(
    "options",
    [dict(), dict(linearize=second_order_covariance_only, manifold=CURVED), dict(iterations=3)],
    ids=["taylor", "second_order", "iterated"],
)
def test_any_point_of_linearisation_serves_a_linear_observation(x64, options):
    belief = Gaussian(jnp.asarray(MEAN), jnp.asarray(ROOT_P @ ROOT_P.T))
    R, y = jnp.asarray(ROOT_R @ ROOT_R.T), jnp.asarray(YS[0])
    at = jnp.asarray(RNG.normal(size=N))
    found, info = jax.jit(lambda at: condition(belief, y, lambda x: H @ x, R, at=at, **options))(at)
    expected, expected_info = arithmetics.joseph.update(belief, y, jnp.asarray(H), R)
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-10)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-10)
    np.testing.assert_allclose(info.log_evidence, expected_info.log_evidence, atol=1e-10)


def distances(x):
    return jnp.sqrt(jnp.sum((jnp.array([[4.0, 0.0], [0.0, 3.0], [-2.0, 1.0]]) - x[:2]) ** 2, axis=1))


NONLINEAR = {
    "taylor": taylor,
    "second_order_covariance_only": second_order_covariance_only,
    "cubature": cubature,
    "unscented": unscented(0.8, 2.0, 0.5),
}


@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "iterations"), [("taylor", 1), ("second_order_covariance_only", 3), ("cubature", 1), ("unscented", 3)]
)
def test_masked_components_are_as_if_they_were_not_there(x64, name, iterations):
    belief = Gaussian(jnp.asarray(MEAN), jnp.asarray(0.3 * ROOT_P @ ROOT_P.T))
    R, y = ROOT_R @ ROOT_R.T, jnp.array([3.0, jnp.nan, 2.0])
    options = dict(linearize=NONLINEAR[name], iterations=iterations)
    mask = jnp.array([True, False, True])

    @jax.jit
    def both(belief):
        return (
            condition(belief, y[::2], lambda x: distances(x)[::2], jnp.asarray(R[::2, ::2]), **options),
            condition(belief, Observation(jnp.asarray(y), mask), distances, jnp.asarray(R), **options),
        )

    (expected, expected_info), (found, info) = both(belief)
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-10)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-10)
    np.testing.assert_allclose(info.log_evidence, expected_info.log_evidence, atol=1e-10)


@pytest.mark.system
def test_iterations_reach_the_most_probable_state(x64):
    # A whole Gauss-Newton step overshoots: seen from the mean, the angle hardly changes with x.
    P, R = np.array([[9.0, 1.0], [1.0, 4.0]]), 0.01 * np.eye(2)
    mean = np.array([4.0, -3.0])
    observe = lambda x: jnp.array([jnp.arctan(x[0]), x[0] * x[1]])
    y = np.array([0.1, 0.4])

    def cost(x):
        missed = y - np.array([np.arctan(x[0]), x[0] * x[1]])
        return 0.5 * (x - mean) @ np.linalg.solve(P, x - mean) + 0.5 * missed @ np.linalg.solve(R, missed)

    @partial(jax.jit, static_argnums=0)
    def iterated(iterations):
        belief = Gaussian(jnp.asarray(mean), jnp.asarray(P))
        return condition(belief, jnp.asarray(y), observe, jnp.asarray(R), iterations=iterations, iterate_to="mode")[0]

    costs = [cost(np.asarray(iterated(count).mean)) for count in (2, 5, 12)]
    assert cost(np.asarray(iterated(1).mean)) > cost(mean) > costs[0]
    assert (np.diff(costs) <= 1e-9).all()
    found = iterated(40)
    best = minimize(cost, np.asarray(found.mean), method="Nelder-Mead", options=dict(xatol=1e-10, fatol=1e-12)).x
    np.testing.assert_allclose(found.mean, best, atol=1e-6)
    J = jax.jacfwd(observe)(jnp.asarray(best))
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(np.linalg.inv(P) + J.T @ np.linalg.inv(R) @ J), rtol=1e-4
    )


@pytest.mark.system
def test_angles_may_wrap(x64):
    # The same two bearings, once where the angle jumps, once turned by half a turn to where it does not.
    def wrap(y, y_hat):
        return (y - y_hat + math.pi) % (2 * math.pi) - math.pi

    def bearings(x):
        return jnp.arctan2(jnp.array([0.1, -0.2]) - x[1], -5.0 - x[0])

    def turned(x):
        return jnp.arctan2(x[1] - jnp.array([0.1, -0.2]), x[0] + 5.0)

    belief, R = Gaussian(jnp.array([0.0, 0.01]), jnp.diag(jnp.array([0.5, 0.6]))), 0.01 * jnp.eye(2)
    y = jnp.array([0.05, -0.08])
    far = (y + 2 * math.pi) % (2 * math.pi) - math.pi
    for options in (dict(linearize=cubature), dict(linearize=second_order_covariance_only, iterations=3)):
        expected, _ = jax.jit(lambda b, o=options: condition(b, y, turned, R, **o))(belief)
        found, info = jax.jit(lambda b, o=options: condition(b, far, bearings, R, residual=wrap, **o))(belief)
        np.testing.assert_allclose(found.mean, expected.mean, atol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-9)
        assert (abs(info.innovation) < 1).all()


@pytest.mark.system
def test_a_prediction_that_is_not_finite_is_left_out_and_announced():
    belief, R = Gaussian(jnp.array([-1.0, 2.0]), jnp.eye(2)), 0.1 * jnp.eye(2)
    observe = lambda x: jnp.array([jnp.log(x[0]), x[1]])
    for options in (dict(), dict(manifold=CURVED), dict(residual=lambda y, y_hat: y - y_hat)):
        found, info = condition(belief, jnp.ones(2), observe, R, **options)
        assert np.isfinite(found.mean).all()
        assert np.isfinite(found.covariance).all()
        assert (info.rank, info.num_invalid) == (1, 1)
        assert info.log_evidence == -jnp.inf
    lost = Gaussian(jnp.array([jnp.nan, 2.0]), jnp.eye(2))
    for manifold in (CURVED, Manifold(add, displacement, flat=True)):
        assert condition(lost, jnp.ones(1), lambda x: x[1:], R[:1, :1], manifold=manifold)[1].log_evidence == -jnp.inf


UP, NORTH = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.2])
ATTITUDE = product(rotation)


def turn(q, dt):
    return lie.so3_retract(q, dt * jnp.array([0.4, -0.7, 0.5]))


def two_vectors(q):
    back = lie.quaternion_to_matrix(q).T
    return jnp.concatenate([back @ UP, back @ NORTH])


@pytest.mark.system
@pytest.mark.parametrize(
    ("arithmetic", "linearize"),
    [(arithmetics.square_root, cubature)],
)
def test_attitude_from_two_vectors_is_as_certain_as_it_says(arithmetic, linearize):
    runs, steps, dt, noise, drift, spread = 200, 12, 0.1, 0.05, 0.03, 0.5
    rng = np.random.default_rng(12)
    # Drawn as the model says: around the prior's mean, and moved by noise in the tangent space.
    true = Rotation.from_rotvec(spread * rng.normal(size=(runs, 3)))
    ys = np.zeros((runs, steps, 6))
    for t in range(steps):
        true = true * Rotation.from_rotvec(dt * np.array([0.4, -0.7, 0.5]))
        true = true * Rotation.from_rotvec(drift * rng.normal(size=(runs, 3)))
        ys[:, t] = np.hstack([true.inv().apply(UP), true.inv().apply(NORTH)]) + noise * rng.normal(size=(runs, 6))
    ends = true.as_quat(scalar_first=True)
    root = arithmetic is arithmetics.square_root
    power = 1 if root else 2
    prior = (GaussianRoot if root else Gaussian)(jnp.array([1.0, 0, 0, 0]), spread**power * jnp.eye(3))
    noises = (drift**power * jnp.eye(3), noise**power * jnp.eye(6))
    filter = extended_kalman(
        prior, turn, noises[0], two_vectors, noises[1], linearize=linearize, arithmetic=arithmetic, manifold=ATTITUDE
    )

    @jax.jit
    @jax.vmap
    def follow(y, end):
        last, (_, infos) = run(filter, KEY, y, jnp.full(steps, dt), collect=keep_all)
        return last, infos, ATTITUDE.local(last.mean, end)

    last, infos, errors = follow(jnp.asarray(ys, jnp.float32), jnp.asarray(ends, jnp.float32))
    nees = np.einsum("ri,rij,rj->r", errors, np.linalg.inv(covariance_of(last)), errors)
    # Means over the runs of chi-squared numbers with 3 and 6 degrees of freedom, at four standard errors.
    assert abs(nees.mean() - 3) < 4 * math.sqrt(2 * 3 / runs)
    assert abs(infos.nis[:, -1].mean() - 6) < 4 * math.sqrt(2 * 6 / runs)
    np.testing.assert_allclose(np.linalg.norm(last.mean, axis=1), 1, atol=1e-6)


@pytest.mark.system
def test_the_gradient_is_that_of_the_exact_evidence(x64):
    def exact(F):
        # Everything that is random, one below the other: the first state, and the noise of each step.
        P, size = jnp.asarray(ROOT_P @ ROOT_P.T), N * (T + 1)
        scales = jnp.asarray(np.append(1.0, DTS))
        covariances = jnp.where(jnp.arange(T + 1)[:, None, None] == 0, P, ROOT_Q @ ROOT_Q.T) * scales[:, None, None]
        random = jax.scipy.linalg.block_diag(*covariances)

        def ahead(carry, inputs):
            mean, weights = carry
            dt, own_noise = inputs
            A = jnp.eye(N) + dt * F
            mean, weights = A @ mean, A @ weights + own_noise
            return (mean, weights), (H @ mean, H @ weights)

        enters = jnp.eye(size).reshape(T + 1, N, size)
        _, (means, weights) = jax.lax.scan(ahead, (jnp.asarray(MEAN), enters[0]), (jnp.asarray(DTS), enters[1:]))
        weights = weights.reshape(T * M, size)
        covariance = weights @ random @ weights.T + jnp.kron(jnp.eye(T), ROOT_R @ ROOT_R.T)
        return jax.scipy.stats.multivariate_normal.logpdf(YS.ravel(), means.ravel(), covariance)

    def evidence(F, arithmetic):
        return log_evidence(linear_filter(arithmetic, F), KEY, jnp.asarray(YS), jnp.asarray(DTS))

    value, slope = jax.jit(jax.value_and_grad(exact))(jnp.asarray(F))
    for arithmetic in (arithmetics.joseph, arithmetics.fast):
        found, found_slope = jax.jit(jax.value_and_grad(evidence), static_argnums=1)(jnp.asarray(F), arithmetic)
        np.testing.assert_allclose(found, value, rtol=1e-10)
        np.testing.assert_allclose(found_slope, slope, rtol=1e-6, atol=1e-9)


def wander(scale, x, dt):
    del dt
    return x + 0.1 * jnp.sin(scale * x)


@pytest.mark.system
@pytest.mark.parametrize(
    ("linearize", "arithmetic", "iterations"),
    [(cubature, arithmetics.square_root, 3)],
)
def test_the_gradient_of_nonlinear_filters_agrees_with_differences(x64, linearize, arithmetic, iterations):
    ys = jnp.asarray(RNG.normal(size=(4, 3)) + 3)
    form = GaussianRoot if arithmetic is arithmetics.square_root else Gaussian

    @jax.jit
    @jax.value_and_grad
    def evidence(scale):
        prior = form(jnp.array([1.0, -0.5]), scale[0] * jnp.eye(2))
        filter = extended_kalman(
            prior,
            jax.tree_util.Partial(wander, scale[1]),
            0.1 * jnp.eye(2),
            distances,
            scale[2] * jnp.eye(3),
            linearize=linearize,
            arithmetic=arithmetic,
            iterations=iterations,
        )
        return log_evidence(filter, KEY, ys)

    scale, steps = jnp.array([0.9, 1.2, 0.7]), 1e-6 * np.eye(3)
    numeric = [(evidence(scale + step)[0] - evidence(scale - step)[0]) / 2e-6 for step in steps]
    np.testing.assert_allclose(evidence(scale)[1], numeric, rtol=1e-6)


TRACES = []


def counted(x):
    TRACES.append(1)
    return x[:2]


def stay(x, inputs):
    del inputs
    return x


def test_a_filter_built_again_compiles_nothing():
    first, _ = follow(1.0)
    TRACES.clear()
    second, (_, infos) = follow(2.0)
    assert not TRACES
    assert not np.allclose(first.covariance, second.covariance)
    assert second.mean.dtype == infos.log_evidence.dtype == jnp.float32


def follow(scale):
    prior = Gaussian(jnp.zeros(3), scale * jnp.eye(3))
    manifold = product(vector(2), vector(1))
    filter = extended_kalman(
        prior, stay, 0.1 * jnp.eye(3), counted, jnp.eye(2), linearize=unscented(0.9), manifold=manifold
    )
    return run(filter, KEY, jnp.ones((3, 2)))


@pytest.mark.system
def test_filters_map_over_sequences_and_priors():
    filter = linear_filter_32()
    ys = jnp.asarray(RNG.normal(size=(T, M, 4)), jnp.float32)
    together = jax.vmap(lambda y: log_evidence(filter, KEY, y, jnp.asarray(DTS, jnp.float32)), in_axes=-1)(ys)
    alone = [log_evidence(filter, KEY, ys[..., i], jnp.asarray(DTS, jnp.float32)) for i in range(4)]
    np.testing.assert_allclose(together, alone, rtol=1e-4)


def linear_filter_32():
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), linear_filter())


def test_an_observation_may_bring_its_own_noise(x64):
    belief, y = Gaussian(jnp.asarray(MEAN), jnp.asarray(ROOT_P @ ROOT_P.T)), jnp.asarray(YS[0])
    R = jnp.asarray(ROOT_R @ ROOT_R.T)
    expected, _ = condition(belief, y, lambda x: H @ x, R)
    found, _ = condition(belief, Observation(y, noise=R), lambda x: H @ x, jnp.eye(M))
    np.testing.assert_array_equal(found.mean, expected.mean)


def test_a_wide_root_is_a_prior(x64):
    wide = ROOT_P @ np.linalg.qr(RNG.normal(size=(N + 2, N + 2)))[0][:N]
    filter = linear_filter(arithmetics.square_root)
    prior = GaussianRoot(jnp.asarray(MEAN), jnp.asarray(wide))
    model = filter.params
    other = extended_kalman(
        prior,
        model.transition,
        model.process_noise,
        model.observe,
        model.observation_noise,
        arithmetic=arithmetics.square_root,
    )
    one, two = (log_evidence(f, KEY, jnp.asarray(YS), jnp.asarray(DTS)) for f in (filter, other))
    np.testing.assert_allclose(one, two, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (dict(arithmetic=arithmetics.square_root), "prior must be a GaussianRoot"),
        (dict(prior=GaussianRoot(jnp.zeros(2), jnp.eye(2))), "prior must be a Gaussian"),
        (dict(prior=Gaussian(jnp.zeros((3, 2)), jnp.zeros((3, 2, 2)))), "prior must be one belief"),
        (dict(process_noise=jnp.eye(3)), r"process_noise must be a covariance, \(2, 2\)"),
        (dict(observation_noise=jnp.ones((2, 3))), r"observation_noise must be a covariance, \(m, m\)"),
        (dict(iterations=0), "iterations"),
    ],
)
def test_models_that_do_not_fit_are_rejected(changes, named):
    arguments = dict(
        prior=Gaussian(jnp.zeros(2), jnp.eye(2)),
        transition=stay,
        process_noise=jnp.eye(2),
        observe=counted,
        observation_noise=jnp.eye(2),
    )
    with pytest.raises(ValueError, match=named):
        extended_kalman(**{**arguments, **changes})
