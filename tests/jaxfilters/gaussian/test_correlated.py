"""Observation noise that lasts: against the joint Gaussian of a whole sequence, and one filter against the other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import jaxfilters as jf

KEY = jax.random.key(0)
F = jnp.array([[1.0, 0.3], [0.0, 0.95]])
Q = jnp.array([[0.02, 0.01], [0.01, 0.05]])
H = jnp.array([[1.0, 0.0], [1.0, 0.5], [0.2, 1.0]])
P0 = jnp.diag(jnp.array([2.0, 1.0]))
MEAN = jnp.array([0.5, -0.2])
B, TAU = jnp.array([1.0, 0.5, 2.0]), jnp.array([3.0, 8.0, 1.5])
FULL_B = jnp.array([[1.0, 0.4, 0.0], [0.4, 0.5, 0.2], [0.0, 0.2, 2.0]])
MATRIX_TAU = jnp.array([[3.0, 0.5, 0.0], [0.0, 4.0, 0.3], [0.2, 0.0, 2.5]])
STEPS = jnp.array([0.5, 1.0, 0.25, 2.0, 1.0, 0.0625])
IDENTITY = np.eye(3)
RNG = np.random.default_rng(3)
YS = RNG.normal(size=(6, 3))
MISSING = np.where(np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 1], [0, 0, 1], [0, 0, 0]], bool), np.nan, YS)


def brute_force(ys, B, T, R, steps, G=IDENTITY):
    """Mean and covariance of the last state, and log density of all readings, from the joint Gaussian in NumPy."""
    B, T = np.asarray(B, float), np.asarray(T, float)
    B = np.diag(B) if B.ndim == 1 else B
    rate = np.linalg.inv(T) if T.ndim == 2 else np.diag(np.broadcast_to(1 / T, len(B)))
    n, k, joint = 2, len(B), None
    A = np.asarray(F, float)
    mean, cov = np.concatenate([MEAN, np.zeros(k)]), block_diag(P0, B)
    means, blocks = [], {}
    for t, dt in enumerate(np.asarray(steps, float)):
        phi = expm(-dt * rate)
        step, noise = block_diag(A, phi), block_diag(Q, B - phi @ B @ phi.T)
        for s in range(t):
            blocks[t, s] = step @ blocks[t - 1, s]
        mean, cov = step @ mean, step @ cov @ step.T + noise
        blocks[t, t] = cov
        means.append(mean)
    count = len(steps)
    joint = np.block([[blocks[t, s] if t >= s else blocks[s, t].T for s in range(count)] for t in range(count)])
    whole = np.hstack([np.asarray(H, float), G])
    C = np.kron(np.eye(count), whole)
    S = C @ joint @ C.T + np.kron(np.eye(count), np.asarray(R, float))
    read = np.isfinite(ys).ravel()
    S, cross = S[np.ix_(read, read)], (joint @ C.T)[-(n + k) : len(joint) - k][:, read]
    e = (ys.ravel() - C @ np.concatenate(means))[read]
    _, log_det = np.linalg.slogdet(S)
    log_density = -0.5 * (e @ np.linalg.solve(S, e) + log_det + len(e) * np.log(2 * np.pi))
    P = blocks[count - 1, count - 1][:n, :n] - cross @ np.linalg.solve(S, cross.T)
    return means[-1][:n] + cross @ np.linalg.solve(S, e), P, log_density


def of(builder, R=0.2, **options):
    prior = jf.Gaussian(MEAN, P0)
    return builder(prior, R * jnp.eye(3), **options)


def linear(prior, R):
    return jf.kalman(prior, F, Q, H, R)


def rooted(prior, R):
    del prior
    root = lambda A: jnp.linalg.cholesky(A)
    return jf.kalman(jf.GaussianRoot(MEAN, root(P0)), F, root(Q), H, root(R), arithmetic=jf.arithmetic.square_root)


def unscented(prior, R):
    return jf.unscented_kalman(prior, lambda x: F @ x, Q, lambda x: H @ x, R)


def one_pass(filter, ys, steps):
    return jf.run(filter, KEY, jnp.asarray(ys, jnp.float32), steps)


def found(filter, ys=MISSING):
    last, (_, infos) = jax.jit(one_pass)(filter, ys, STEPS)
    return last, float(infos.log_evidence.sum())


def identity(inputs):
    return inputs


PROCESSES = {
    "rows": (B, TAU),
    "one time constant": (FULL_B, jnp.array(2.0)),
    "matrix": (FULL_B, MATRIX_TAU),
}


@pytest.mark.parametrize(
    "inner", [linear, rooted, pytest.param(unscented, marks=pytest.mark.system)], ids=["linear", "rooted", "unscented"]
)
@pytest.mark.parametrize("process", PROCESSES)
def test_augmentation_is_the_conditional_of_the_joint_gaussian(process, inner):
    """Steps of unequal length, rows and a frame missing. Float32: eighteen terms of order one."""
    covariance, tau = PROCESSES[process]
    filter = jf.correlated_noise(of(inner), jf.GaussMarkov(tau, covariance), dt=identity)
    last, evidence = found(filter)
    mean, P, expected = brute_force(MISSING, covariance, tau, 0.2 * np.eye(3), STEPS)
    own = last.marginal([0, 1])
    np.testing.assert_allclose(own.mean, mean, atol=3e-5)
    got = own.covariance if isinstance(own, jf.Gaussian) else jnp.matmul(own.root, own.root.T, precision="highest")
    np.testing.assert_allclose(got, P, atol=3e-5)
    np.testing.assert_allclose(evidence, expected, atol=2e-4)


def test_errors_shared_by_rows_have_a_loading():
    G = np.array([[1.0], [1.0], [-0.5]])
    noise = jf.GaussMarkov(jnp.array(jnp.inf), jnp.array([0.7]))
    last, evidence = found(jf.correlated_noise(of(linear), noise, dt=identity, loading=jnp.asarray(G, jnp.float32)))
    mean, P, expected = brute_force(MISSING, np.array([0.7]), 1e12, 0.2 * np.eye(3), STEPS, G)
    np.testing.assert_allclose(last.mean[:2], mean, atol=3e-5)
    np.testing.assert_allclose(last.covariance[:2, :2], P, atol=3e-5)
    np.testing.assert_allclose(evidence, expected, atol=2e-4)


WHOLE_FRAMES = np.where(np.array([0, 0, 1, 0, 0, 0], bool)[:, None], np.nan, YS)


def test_differencing_is_the_conditional_without_white_noise():
    """To rounding: the joint Gaussian in float64, and augmentation with a white noise of zero."""
    noise = jf.GaussMarkov(TAU, B)
    filter = jf.measurement_differencing(of(linear, 0.0), noise, dt=identity)
    last, evidence = found(filter, WHOLE_FRAMES)
    mean, P, expected = brute_force(WHOLE_FRAMES, B, TAU, np.zeros((3, 3)), STEPS)
    np.testing.assert_allclose(last.belief.mean, mean, atol=3e-5)
    np.testing.assert_allclose(last.belief.covariance, P, atol=3e-5)
    np.testing.assert_allclose(evidence, expected, atol=3e-4)
    augmented, evidence = found(jf.correlated_noise(of(linear, 0.0), noise, dt=identity), WHOLE_FRAMES)
    np.testing.assert_allclose(last.belief.mean, augmented.mean[:2], atol=3e-5)
    np.testing.assert_allclose(evidence, expected, atol=3e-4)


@pytest.mark.system
@pytest.mark.parametrize(
    ("tau", "variances"),
    [([np.inf, 8.0, 1.5], [1.0, 0.5, 2.0]), ([1e7, 8.0, 1.5], [1.0, 0.5, 2.0]), ([3.0, 8.0, 1.5], [1.0, 0.0, 2.0])],
    ids=["constant", "almost constant", "without noise"],
)
def test_differencing_uses_rows_whose_difference_has_no_noise(tau, variances):
    """In float32, where the differences of the second case have a thousandth of the spread of the others."""
    noise = jf.GaussMarkov(jnp.array(tau), jnp.array(variances))
    filter = jf.measurement_differencing(of(linear, 0.0), noise, dt=identity)
    last, (_, infos) = jax.jit(one_pass)(filter, WHOLE_FRAMES, STEPS)
    mean, P, expected = brute_force(WHOLE_FRAMES, variances, tau, np.zeros((3, 3)), STEPS)
    np.testing.assert_allclose(last.belief.mean, mean, atol=3e-5)
    np.testing.assert_allclose(last.belief.covariance, P, atol=3e-5)
    np.testing.assert_allclose(infos.log_evidence.sum(), expected, atol=3e-4)
    assert infos.rank.tolist() == [3, 3, 0, 3, 3, 3]


@pytest.mark.system
def test_derivatives_are_finite_where_a_difference_has_no_noise():
    evidence = partial(evidence_of, build=jf.measurement_differencing, R=0.0)
    slopes = jax.jit(jax.grad(evidence))((jnp.array([jnp.inf, 8.0, 1.5]), jnp.array([1.0, 0.0, 2.0])))
    assert np.isfinite(np.concatenate(slopes)).all()


def test_a_row_that_returns_adds_nothing_once_and_never_certainty():
    """Against the exact conditional: what is left out may widen the belief, never narrow it."""
    noise = jf.GaussMarkov(TAU, B)
    last, _ = found(jf.measurement_differencing(of(linear, 0.0), noise, dt=identity), MISSING)
    _, P, _ = brute_force(MISSING, B, TAU, np.zeros((3, 3)), STEPS)
    assert np.linalg.eigvalsh(np.asarray(last.belief.covariance, float) - P).min() > -1e-5
    assert np.trace(last.belief.covariance) < 3 * np.trace(P)


def evidence_of(parameters, build, R):
    tau, variances = parameters
    filter = build(of(linear, R), jf.GaussMarkov(tau, variances), dt=identity)
    return jf.log_evidence(filter, KEY, jnp.asarray(WHOLE_FRAMES, jnp.float32), STEPS)


def test_errors_that_never_end_leave_the_covariance_symmetric_and_positive_for_hundreds_of_steps():
    """A vehicle among beacons of unknown places and biased ranges, against one extended filter of all that is unknown.

    Blocks of a covariance that rounding has made unsymmetric must not be propagated apart: the difference would grow
    until the covariance is indefinite, in float64 as well.
    """
    beacons = jnp.array([[-3.0, -2.0], [4.0, -3.0], [7.0, 3.0], [3.0, 9.0]])
    n, k = 10, 4
    turn = 0.0628 * jnp.arange(300)
    moves = 0.25 * jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=1)
    truth = jnp.cumsum(moves, axis=0)
    noise = 0.1 * jax.random.normal(KEY, (300, k)) + 0.5 * jax.random.normal(jax.random.key(1), (k,))
    ys = jnp.linalg.norm(truth[:, None] - beacons, axis=2) + noise
    move = lambda x, u: x.at[:2].add(u)
    ranges = lambda x: jnp.linalg.norm(x[2:n].reshape(k, 2) - x[:2], axis=1)
    mean = jnp.concatenate([jnp.zeros(2), beacons.ravel() + jax.random.normal(jax.random.key(2), (2 * k,))])
    P = jnp.diag(jnp.concatenate([jnp.full(2, 1e-6), jnp.ones(2 * k)]))
    Q = jnp.zeros((n, n)).at[[0, 1], [0, 1]].set(1e-3)
    bias = jf.GaussMarkov(jnp.array(jnp.inf), jnp.full(k, 0.25))
    inner = jf.extended_kalman(jf.Gaussian(mean, P), move, Q, ranges, 0.01 * jnp.eye(k))
    whole = jf.extended_kalman(
        jf.Gaussian(
            jnp.pad(mean, (0, k)), jnp.zeros((n + k, n + k)).at[:n, :n].set(P).at[n:, n:].set(0.25 * jnp.eye(k))
        ),
        move,
        jnp.pad(Q, ((0, k), (0, k))),
        lambda x: ranges(x) + x[n:],
        0.01 * jnp.eye(k),
    )
    _, (found, _) = jf.run(jf.correlated_noise(inner, bias), KEY, ys, moves)
    _, (expected, _) = jf.run(whole, KEY, ys, moves)
    covariance = np.asarray(found.covariance)
    np.testing.assert_allclose(covariance, covariance.swapaxes(1, 2), atol=1e-5)
    assert np.linalg.eigvalsh(covariance).min() > 0
    # Float32 over 300 steps; the standard deviations are 0.1 to 1.
    np.testing.assert_allclose(found.mean[-1], expected.mean[-1], atol=5e-3)
    np.testing.assert_allclose(found.covariance[-1], expected.covariance[-1], atol=2e-3)


@pytest.mark.system
@pytest.mark.parametrize(("build", "R"), [(jf.correlated_noise, 0.2), (jf.measurement_differencing, 0.0)])
def test_evidence_has_the_derivatives_of_the_joint_gaussian(build, R):
    """By time constants and variances; central differences of the joint density in float64."""
    slopes = np.concatenate(jax.jit(jax.grad(partial(evidence_of, build=build, R=R)))((TAU, B)))
    at, step = np.concatenate([TAU, B]).astype(float), 1e-4

    def density(values):
        return brute_force(WHOLE_FRAMES, values[3:], values[:3], R * np.eye(3), STEPS)[2]

    differences = [(density(at + shift) - density(at - shift)) / (2 * step) for shift in step * np.eye(6)]
    np.testing.assert_allclose(slopes, differences, atol=2e-3)


@pytest.mark.system
def test_states_on_manifolds_have_lasting_errors():
    """A turn about one axis is an angle: the filter of quaternions agrees with that of the angle."""

    def arrow(angle):
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def by_quaternion(q):
        return arrow(2 * jnp.arctan2(q[3], q[0]))

    rotation = jf.manifold.product(jf.manifold.rotation)
    spread = jnp.diag(jnp.array([1e-6, 1e-6, 0.3]))
    upright = jf.Gaussian(jnp.array([1.0, 0.0, 0.0, 0.0]), spread)
    R = 0.01 * jnp.eye(2)
    about = jf.extended_kalman(upright, lambda q: q, 0.1 * spread, by_quaternion, R, manifold=rotation)
    flat = jf.Gaussian(jnp.zeros(1), 0.3 * jnp.eye(1))
    plane = jf.extended_kalman(flat, lambda x: x, 0.03 * jnp.eye(1), lambda x: arrow(x[0]), R)
    noise = jf.GaussMarkov(jnp.array(5.0), jnp.array([0.02, 0.03]))
    ys = np.stack([np.cos(0.1 * np.arange(8)), np.sin(0.1 * np.arange(8))], 1) + 0.1 * RNG.normal(size=(8, 2))
    lasts, evidences = [], []
    for inner in (about, plane):
        last, (_, infos) = jf.run(jf.correlated_noise(inner, noise), KEY, jnp.asarray(ys, jnp.float32))
        lasts.append(last)
        evidences.append(float(infos.log_evidence.sum()))
    np.testing.assert_allclose(lasts[0].covariance[2:, 2:], lasts[1].covariance, atol=1e-4)
    np.testing.assert_allclose(2 * np.arctan2(lasts[0].mean[3], lasts[0].mean[0]), lasts[1].mean[0], atol=1e-3)
    np.testing.assert_allclose(*evidences, atol=1e-2)


def test_smoothing_takes_the_errors_with_the_state():
    """The smoothed belief of the last frame is the filtered one, and earlier ones are narrower than filtered."""
    filter = jf.correlated_noise(of(linear), jf.GaussMarkov(TAU, B), dt=identity)
    _, (beliefs, _) = one_pass(filter, MISSING, STEPS)
    smoothed = jf.smoothing.rts(filter, beliefs, STEPS)
    np.testing.assert_allclose(smoothed.mean[-1], beliefs.mean[-1], atol=1e-6)
    narrower = np.asarray(beliefs.covariance - smoothed.covariance, float)
    assert np.linalg.eigvalsh(narrower).min() > -1e-4


@pytest.mark.system
def test_particles_integrate_the_errors_out():
    """Linear model: the particle filter estimates the evidence of the Gaussian one; four standard errors of 16 keys.

    A false alarm has a probability of 6e-5; the bias of the log evidence, half its variance, is added.
    """
    process, R = jf.GaussMarkov(TAU, B), 0.2 * jnp.ones(3)
    pf = jf.correlated_bootstrap(
        lambda key: MEAN + jnp.sqrt(jnp.diagonal(P0)) * jax.random.normal(key, (2,)),
        lambda z, x: F @ x + jnp.linalg.cholesky(Q) @ z,
        lambda x: H @ x,
        R,
        process,
        num_particles=1000,
        noise=jf.StandardNormal(2),
        dt=identity,
    )
    ys = jnp.asarray(MISSING, jnp.float32)
    keys = jax.random.split(KEY, 16)
    values = np.asarray(jax.vmap(lambda key: jf.log_evidence(pf, key, ys, STEPS))(keys), float)
    _, _, expected = brute_force(MISSING, B, TAU, 0.2 * np.eye(3), STEPS)
    assert abs(values.mean() + 0.5 * values.var(ddof=1) - expected) < 4 * values.std(ddof=1) / 4 + 0.01


@pytest.mark.system
@pytest.mark.parametrize("builder", [jf.rao_blackwell, jf.rao_blackwell_shared])
def test_particles_integrate_out_the_errors_that_rows_share(builder):
    """Two correlated errors that three rows share, as the linear part: the evidence is that of the Gaussian filters.

    The difference is within four standard errors of 16 keys, a false alarm of 6e-5; the bias of the log evidence, half
    its variance, is added.
    """
    G = jnp.array([[1.0, 0.0], [1.0, 0.5], [0.0, 1.0]])
    B, T = FULL_B[:2, :2], MATRIX_TAU[:2, :2]
    process, R = jf.GaussMarkov(T, B), 0.2 * jnp.eye(3)

    def dynamics(x, dt):
        decay, added = process.decay_matrix(dt), process.added_matrix(dt)
        return jf.MixedDynamics(F @ x, jnp.zeros((2, 2)), Q, jnp.zeros(2), decay, added)

    pf = builder(
        lambda key: MEAN + jnp.sqrt(jnp.diagonal(P0)) * jax.random.normal(key, (2,)),
        process.prior(),
        dynamics,
        observe=lambda x, dt: jf.LinearObservation(H @ x, G, R),
        num_particles=1000,
        noise_dim=2,
    )
    ys = jnp.asarray(YS, jnp.float32)
    keys = jax.random.split(KEY, 16)
    values = np.asarray(jax.vmap(lambda key: jf.log_evidence(pf, key, ys, STEPS))(keys), float)
    kalman = jf.correlated_noise(of(linear), process, dt=identity, loading=G)
    _, _, expected = brute_force(YS, B, T, 0.2 * np.eye(3), STEPS, np.asarray(G))
    np.testing.assert_allclose(jf.log_evidence(kalman, KEY, ys, STEPS), expected, atol=1e-3)
    assert abs(values.mean() + 0.5 * values.var(ddof=1) - expected) < 4 * values.std(ddof=1) / 4 + 0.01
