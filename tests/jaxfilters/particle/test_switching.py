"""The mixture Kalman filter against all sequences of modes, one by one."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

pytestmark = pytest.mark.system

KEY = jax.random.key(0)
RNG = np.random.default_rng(3)
F = [np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1.0, 0.5], [0.0, -0.4]])]
Q = [np.diag([0.01, 0.02]), np.array([[0.3, 0.1], [0.1, 0.5]])]
H, R = np.array([[1.0, 0.3]]), np.array([[0.2]])
MEANS = [np.array([0.0, 1.0]), np.array([0.2, -1.0])]
CHAIN, INITIAL = np.array([[0.8, 0.2], [0.35, 0.65]]), np.array([0.6, 0.4])
LENGTH = 6
YS = np.cumsum(RNG.normal(size=(LENGTH, 1)), axis=0)
RUNS = jax.random.split(jax.random.key(1), 2000)


def sequence_by_sequence():
    """Every sequence s_0 ... s_T: its modes, log p(s, y), and the mean and covariance of the last state given it."""
    found = []
    for modes in itertools.product(range(2), repeat=LENGTH + 1):
        m, P, joint = MEANS[modes[0]], np.eye(2), np.log(INITIAL[modes[0]])
        for before, mode, y in zip(modes, modes[1:], YS, strict=False):
            m, P = F[mode] @ m, F[mode] @ P @ F[mode].T + Q[mode]
            S, e = H @ P @ H.T + R, y - H @ m
            K = P @ H.T / S
            joint += np.log(CHAIN[before, mode]) - 0.5 * (np.log(2 * np.pi * S) + e**2 / S).item()
            m, P = m + K @ e, P - K @ S @ K.T
        found.append((modes, joint, m, P))
    return map(np.array, zip(*found, strict=True))


MODES, JOINTS, LAST_MEANS, LAST_COVARIANCES = sequence_by_sequence()
LOG_Z = np.logaddexp.reduce(JOINTS)
POSTERIOR = np.exp(JOINTS - LOG_Z)


def fresh(array):
    """A copy: JAX 0.10 keeps the precision in which a traced function has used a NumPy array."""
    return jnp.asarray(np.array(array))


def linear(i):
    belief = jf.Gaussian(fresh(MEANS[i]), jnp.eye(2))
    return jf.kalman(belief, fresh(F[i]), fresh(Q[i]), fresh(H), fresh(R))


def nonlinear(i):
    build = (jf.extended_kalman, jf.unscented_kalman)[i]
    belief = jf.Gaussian(jnp.asarray(MEANS[i]), jnp.eye(2))
    return build(belief, lambda x: F[i] @ x, jnp.asarray(Q[i]), lambda x: H @ x, jnp.asarray(R))


def rooted(i):
    belief = jf.GaussianRoot(jnp.asarray(MEANS[i]), jnp.eye(2))
    roots = [jnp.asarray(np.linalg.cholesky(noise)) for noise in (Q[i], R)]
    return jf.kalman(
        belief, jnp.asarray(F[i]), roots[0], jnp.asarray(H), roots[1], arithmetic=jf.arithmetic.square_root
    )


def switching(build=linear, num_particles=2**LENGTH, **options):
    return jf.switching([build(i) for i in range(2)], CHAIN, INITIAL, num_particles=num_particles, **options)


@pytest.mark.parametrize("build", [linear, rooted, nonlinear])
def test_it_is_exact_while_there_are_enough_particles(build):
    """As many particles as there are sequences before the last step, whose successors are all kept."""
    with jax.enable_x64(True):
        last, infos = jf.run(switching(build), KEY, jnp.asarray(YS), collect=jf.keep_info)
        np.testing.assert_allclose(infos.log_evidence.sum(), LOG_Z, rtol=1e-10)
        of_modes = [POSTERIOR[MODES[:, -1] == k].sum() for k in range(2)]
        np.testing.assert_allclose(last.probabilities, of_modes, rtol=1e-9)
        found = jf.mixture_moments(last.particles.belief, last.log_weights)
        mean = POSTERIOR @ LAST_MEANS
        apart = LAST_MEANS - mean
        spread = np.einsum("s,sij->ij", POSTERIOR, LAST_COVARIANCES + apart[:, :, None] * apart[:, None])
        np.testing.assert_allclose(found.mean, mean, rtol=1e-8)
        covariance = found.root @ found.root.T if build is rooted else found.covariance
        np.testing.assert_allclose(covariance, spread, rtol=1e-8)


def test_trajectories_are_the_sequences_of_modes():
    _, history = jf.run(switching(), KEY, jnp.asarray(YS, jnp.float32), collect=jf.smoothing.keep_history)
    paths = np.asarray(jf.smoothing.trajectories(history).mode)
    chances = np.exp(np.asarray(history.log_weights[-1], float))
    for t in range(LENGTH):
        expected = POSTERIOR[MODES[:, t + 1] == 1].sum()
        np.testing.assert_allclose(chances[paths[t] == 1].sum(), expected, atol=1e-5)


@pytest.mark.parametrize("scheme", [jf.resampling.optimal, jf.resampling.systematic, jf.resampling.multinomial])
def test_estimates_are_unbiased(scheme):
    """Evidence, and products of evidence and probabilities, by a z-test at 4 sigma: 6e-5 of a false alarm each."""
    filter = switching(num_particles=5, scheme=scheme)

    @jax.jit
    def estimates(key):
        last, log_evidence = jf.run(filter, key, jnp.asarray(YS, jnp.float32), collect=keep_log_evidence)
        mean = jf.mixture_moments(last.particles.belief, last.log_weights).mean
        ratio = jnp.exp(log_evidence.sum() - LOG_Z)
        return jnp.stack([ratio, ratio * last.probabilities[1], ratio * mean[0]])

    values = np.asarray(jax.vmap(estimates)(RUNS), float)
    expected = [1.0, POSTERIOR[MODES[:, -1] == 1].sum(), POSTERIOR @ LAST_MEANS[:, 0]]
    errors = values.std(0, ddof=1) / np.sqrt(len(RUNS))
    assert (errors > 1e-4).all()
    assert (np.abs(values.mean(0) - expected) < 4 * errors).all()


def keep_log_evidence(state, info):
    del state
    return info.log_evidence


def test_gradients_and_masks():
    """Exact sequences have the gradient of finite differences; a frame without an observation is a prediction."""
    mask = jnp.ones(LENGTH, bool).at[2].set(False)
    ys = np.where(np.asarray(mask)[:, None], YS, np.nan)

    def evidence(theta):
        scaled = [
            jf.kalman(jf.Gaussian(jnp.asarray(MEANS[i]), jnp.eye(2)), F[i], theta[0] * Q[i], H, theta[1] * R)
            for i in range(2)
        ]
        chain = jnp.stack([1 - theta[2:], theta[2:]], axis=1)
        filter = jf.switching(scaled, chain, [1.0, 0.0], num_particles=2**LENGTH)
        return jf.log_evidence(filter, KEY, jnp.asarray(ys), mask=mask)

    with jax.enable_x64(True):
        theta, step = jnp.array([1.1, 0.9, 0.2, 0.6]), 1e-5
        slope = jax.jit(jax.grad(evidence))(theta)
        value = jax.jit(jax.vmap(evidence))
        ahead, behind = (value(theta + sign * step * jnp.eye(4)) for sign in (1, -1))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6)


def test_inputs_reach_the_chain_and_the_models():
    places = jnp.asarray(RNG.normal(size=(LENGTH, 1)))
    observe = lambda x, inputs: H @ x + inputs[1]
    with jax.enable_x64(True):
        filters = [
            jf.extended_kalman(
                jf.Gaussian(jnp.asarray(MEANS[i]), jnp.eye(2)),
                lambda x, *, i=i: F[i] @ x,
                jnp.asarray(Q[i]),
                observe,
                jnp.asarray(R),
            )
            for i in range(2)
        ]
        filter = jf.switching(filters, lambda inputs: inputs[0], INITIAL, num_particles=2**LENGTH)
        inputs = (jnp.broadcast_to(jnp.asarray(CHAIN), (LENGTH, 2, 2)), jnp.asarray(np.asarray(places, float)))
        total = jf.log_evidence(filter, KEY, YS + inputs[1], inputs)
    np.testing.assert_allclose(total, LOG_Z, rtol=1e-9)


def test_what_no_sequence_explains_leaves_the_prediction():
    filter = switching()
    predicted = jf.predict(filter, KEY, jf.init(filter, KEY))
    impossible = jf.Observation(jnp.array([1.0]), noise=jnp.array([[jnp.nan]]))
    after, info = jf.update(filter, KEY, predicted, impossible)
    assert info.log_evidence == -jnp.inf
    np.testing.assert_allclose(after.probabilities, INITIAL @ CHAIN, rtol=1e-6)
    np.testing.assert_array_equal(after.particles.belief.mean, predicted.particles.belief.mean)
