"""Rao-Blackwellized filter: the recursion against batch conditioning, the proposals against joint Kalman filters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters.filter import log_evidence, run
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.particle.differentiable_resampling import transport
from jaxfilters.particle.proposals import exact, plug_in, plug_in_corrected
from jaxfilters.particle.rao_blackwell import (
    LinearObservation,
    MixedDynamics,
    propagate,
    rao_blackwell,
    rao_blackwell_shared,
)

DT, Q_N, Q_L, R, PRIOR_X, PRIOR_V = 1 / 30, 0.3, 40.0, 0.02, 0.5, 4.0


def velocity_step(x, dt=DT, q_n=Q_N, q_l=Q_L):
    """One coordinate whose velocity is the linear state (specification 2.5)."""
    one = jnp.ones((1, 1))
    return MixedDynamics(x, dt * one, dt * q_n * one, jnp.zeros(1), one, dt * q_l * one)


def dynamics(x, inputs):
    del inputs
    return velocity_step(x)


def sample_prior(key):
    return jnp.sqrt(PRIOR_X) * jax.random.normal(key, (1,))


def log_likelihood(x, y):
    return norm.logpdf(y, x[0], jnp.sqrt(R))


def make_filter(
    proposal=exact, *, num_particles=5000, builder=rao_blackwell_shared, likelihood=log_likelihood, **options
):
    prior = Gaussian(jnp.zeros(1), PRIOR_V * jnp.eye(1))
    options = {"ess_threshold": 1.0} | options
    return builder(
        sample_prior,
        prior,
        dynamics,
        likelihood,
        num_particles=num_particles,
        noise_dim=1,
        proposal=proposal,
        **options,
    )


def simulate(length, seed=0):
    rng = np.random.default_rng(seed)
    x, v, ys = np.sqrt(PRIOR_X) * rng.normal(), np.sqrt(PRIOR_V) * rng.normal(), []
    for _ in range(length):
        x += DT * v + np.sqrt(DT * Q_N) * rng.normal()
        v += np.sqrt(DT * Q_L) * rng.normal()
        ys.append(x + np.sqrt(R) * rng.normal())
    return np.array(ys)


def kalman_oracle(ys, transition, noise, prior):
    """Textbook Kalman filter of the first component, observed with variance R: means, covariances, log evidence."""
    m, P, means, covariances, total = np.zeros(2), prior, [], [], 0.0
    for t, y in enumerate(ys):
        F, Q = transition(t), noise(t)
        m, P = F @ m, F @ P @ F.T + Q
        S = P[0, 0] + R
        total += -0.5 * ((y - m[0]) ** 2 / S + np.log(2 * np.pi * S))
        K = P[:, 0] / S
        m, P = m + K * (y - m[0]), P - np.outer(K, K) * S
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances), total


def joint_kalman(ys):
    F, Q = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * Q_L])
    return kalman_oracle(ys, lambda t: F, lambda t: Q, np.diag([PRIOR_X, PRIOR_V]))


def gains_and_variances(length):
    P, gains, variances = PRIOR_V, [], []
    for _ in range(length):
        gains.append(DT * P / (DT**2 * P + DT * Q_N))
        P = P * Q_N / (DT * P + Q_N) + DT * Q_L
        variances.append(P)
    return np.array(gains), np.array(variances)


def moments(state, info):
    """Mean of pose and velocity, and their variances, with the velocity's own variance added."""
    both = jnp.concatenate([state.particles, state.linear_mean])
    within = jnp.diag(jnp.array([0.0, 1.0])) * state.covariance[0, 0]
    return (
        weights.mean(both, state.log_weights),
        weights.covariance(both, state.log_weights) + within,
        info.log_evidence,
    )


@pytest.fixture(scope="module")
def table():
    """Eight runs of each proposal on one sequence of 150 frames: the set-up of the table in specification 2.6."""
    ys = simulate(150)
    keys = jax.random.split(jax.random.key(7), 8)
    runs = jax.vmap(lambda pf, key: run(pf, key, jnp.asarray(ys, dtype=float), collect=moments)[1], in_axes=(None, 0))
    results = {
        p.__name__: jax.tree.map(np.asarray, runs(make_filter(p), keys)) for p in (exact, plug_in, plug_in_corrected)
    }
    return ys, results


def rms(a, b):
    return np.sqrt(np.mean((a - b) ** 2, axis=(0, 1)))


def test_joint_kalman_filter_has_the_papers_spread():
    _, covariances, _ = joint_kalman(simulate(150))
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariances[-1])), [0.113, 2.27], rtol=0.004)


@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "pose", "velocity", "evidence"), [("exact", 0.005, 0.05, 0.4), ("plug_in_corrected", 0.007, 0.07, 0.5)]
)
def test_consistent_proposals_match_the_joint_kalman_filter(table, name, pose, velocity, evidence):
    # Bounds: about twice the Monte Carlo error that the specification measured at N = 5000.
    ys, results = table
    means, covariances, log_evidence = results[name]
    oracle_means, oracle_covariances, oracle_evidence = joint_kalman(ys)
    error = rms(means, oracle_means)
    assert error[0] < pose
    assert error[1] < velocity
    ratio = (np.diagonal(covariances, axis1=-2, axis2=-1) / np.diagonal(oracle_covariances, axis1=-2, axis2=-1)).mean(
        (0, 1)
    )
    np.testing.assert_allclose(ratio, 1, atol=0.03)
    assert abs(log_evidence.sum(-1).mean() - oracle_evidence) < evidence


@pytest.mark.system
def test_the_papers_proposal_is_overconfident_and_filters_a_one_noise_model(table):
    ys, results = table
    means, covariances, _ = results["plug_in"]
    _, oracle_covariances, _ = joint_kalman(ys)
    ratio = (covariances[..., 0, 0] / oracle_covariances[..., 0, 0]).mean()
    assert 0.90 < ratio < 0.95
    gains, _ = gains_and_variances(len(ys))
    root = [np.sqrt(DT * Q_N) * np.array([1.0, gain]) for gain in gains]
    own_means, _, _ = kalman_oracle(
        ys, lambda t: np.array([[1, DT], [0, 1]]), lambda t: np.outer(root[t], root[t]), np.diag([PRIOR_X, 0.0])
    )
    assert rms(means, own_means)[0] < 0.005
    assert rms(means, joint_kalman(ys)[0])[0] > 0.01


def test_velocity_recursion_equals_batch_conditioning():
    # Given the path, displacements are linear in the velocities: one big Gaussian conditioning is the truth.
    with jax.enable_x64(True):
        length, rng = 40, np.random.default_rng(0)
        z = rng.normal(size=length) * 0.1
        belief = Gaussian(jnp.zeros(1), jnp.full((1, 1), PRIOR_V))
        for shift in z:
            belief = propagate(belief, shift - DT * belief.mean, velocity_step(jnp.zeros(1)))
        steps = np.arange(length + 1)
        prior = PRIOR_V + DT * Q_L * np.minimum.outer(steps, steps)
        H = np.c_[DT * np.eye(length), np.zeros(length)]
        S = H @ prior @ H.T + DT * Q_N * np.eye(length)
        K = np.linalg.solve(S, H @ prior).T
        np.testing.assert_allclose(belief.mean[0], (K @ z)[-1], rtol=1e-9)
        np.testing.assert_allclose(belief.covariance[0, 0], (prior - K @ H @ prior)[-1, -1], rtol=1e-9)
        np.testing.assert_allclose(belief.covariance[0, 0], 4.194335081, rtol=1e-9)


def test_general_matrices_equal_the_printed_recursion():
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        A_n, A_l, root_P, root_Qn, root_Ql = (rng.normal(size=s) for s in [(3, 2), (2, 2), (2, 2), (3, 3), (2, 2)])
        P, Q_n, Q_l, m, delta, f_l = (
            root_P @ root_P.T,
            root_Qn @ root_Qn.T,
            root_Ql @ root_Ql.T,
            *rng.normal(size=(2, 3))[:, :2],
            rng.normal(size=2),
        )
        delta = rng.normal(size=3)
        step = MixedDynamics(jnp.zeros(3), *map(jnp.asarray, (A_n, Q_n, f_l, A_l, Q_l)))
        belief = propagate(Gaussian(jnp.asarray(m), jnp.asarray(P)), jnp.asarray(delta), step)
        N = A_n @ P @ A_n.T + Q_n
        L = A_l @ P @ A_n.T @ np.linalg.inv(N)
        np.testing.assert_allclose(belief.mean, f_l + A_l @ m + L @ delta, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.covariance, A_l @ P @ A_l.T + Q_l - L @ N @ L.T, rtol=1e-10, atol=1e-10)


def next_variance(P, dt, q_n, q_l):
    step = velocity_step(jnp.zeros(1), dt, q_n, q_l)
    return propagate(Gaussian(jnp.zeros(1), P[None, None]), jnp.zeros(1), step).covariance[0, 0]


def test_steady_state_variance():
    with jax.enable_x64(True):
        P = jnp.asarray(PRIOR_V)
        for _ in range(200):
            P = next_variance(P, DT, Q_N, Q_L)
        assert abs(float(P) - 0.5 * (DT * Q_L + np.sqrt((DT * Q_L) ** 2 + 4 * Q_L * Q_N))) < 1e-10


@pytest.mark.system
@pytest.mark.parametrize("x64", [False, True])
def test_variance_stays_positive_over_eight_decades(x64):
    with jax.enable_x64(x64):
        dt, q_n, q_l, P = jnp.asarray(10 ** np.random.default_rng(2).uniform(-4, 4, (4, 10_000)), dtype=float)
        variance = jax.vmap(next_variance)(P, dt, q_n, q_l)
        assert jnp.all(variance > 0)
        stable = P * (q_n / (dt * P + q_n)) + dt * q_l
        np.testing.assert_allclose(variance, stable, rtol=1e-9 if x64 else 1e-3)


def test_changing_the_unit_of_time_changes_nothing():
    with jax.enable_x64(True):
        seconds, milliseconds = jnp.asarray(PRIOR_V), jnp.asarray(PRIOR_V * 1e-6)
        for _ in range(10):
            seconds = next_variance(seconds, DT, Q_N, Q_L)
            milliseconds = next_variance(milliseconds, DT * 1e3, Q_N * 1e-3, Q_L * 1e-9)
        np.testing.assert_allclose(milliseconds * 1e6, seconds, rtol=1e-12)


@pytest.mark.system
def test_without_information_exact_keeps_the_open_loop_spread_and_paper_loses_it():
    def flat(x, y):
        del x, y
        return jnp.zeros(())

    length = 30
    P = np.diag([PRIOR_X, PRIOR_V])
    F, Q = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * Q_L])
    for _ in range(length):
        P = F @ P @ F.T + Q
    spread = {}
    for proposal in (exact, plug_in):
        pf = make_filter(proposal, num_particles=20_000, likelihood=flat)
        state, _ = run(pf, jax.random.key(0), jnp.zeros(length))
        spread[proposal.__name__] = float(weights.covariance(state.particles, state.log_weights)[0, 0])
    # The sample variance of 20000 draws is within 4 sqrt(2 / 20000) = 4 % of the true one.
    assert spread["exact"] == pytest.approx(P[0, 0], rel=0.05)
    assert spread["plug_in"] < 0.8 * P[0, 0]


@pytest.mark.system
def test_own_and_shared_covariance_give_the_same_filter():
    ys = jnp.asarray(simulate(20), dtype=float)
    shared = run(make_filter(num_particles=200), jax.random.key(1), ys)[0]
    own = run(make_filter(num_particles=200, builder=rao_blackwell), jax.random.key(1), ys)[0]
    np.testing.assert_allclose(own.particles, shared.particles, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(own.linear_mean, shared.linear_mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(own.covariance, np.broadcast_to(shared.covariance[..., None], (1, 1, 200)), rtol=1e-5)


def test_matrices_that_depend_on_the_particle_cannot_be_shared():
    def nonlinear(x, inputs):
        return dynamics(x, inputs)._replace(A_n=DT * jnp.cos(x)[:, None])

    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    pf = rao_blackwell_shared(sample_prior, prior, nonlinear, log_likelihood, num_particles=8, noise_dim=1)
    with pytest.raises(ValueError, match="A_n"):
        run(pf, jax.random.key(0), jnp.zeros(3))
    assert jnp.isfinite(
        log_evidence(
            rao_blackwell(*[sample_prior, prior, nonlinear, log_likelihood], num_particles=8, noise_dim=1),
            jax.random.key(0),
            jnp.zeros(3),
        )
    )


def observe_both(x):
    return LinearObservation(x, jnp.full((1, 1), 0.1), jnp.full((1, 1), R))


@pytest.mark.system
@pytest.mark.parametrize("builder", [rao_blackwell, rao_blackwell_shared])
def test_an_observed_linear_state_matches_the_joint_kalman_filter(builder):
    # y = x + 0.1 v + e; the evidence is unbiased: z-test over 400 runs at 4 sigma.
    ys = simulate(10, seed=5)
    m, P, total = np.zeros(2), np.diag([PRIOR_X, PRIOR_V]), 0.0
    F, Q, H = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * Q_L]), np.array([1.0, 0.1])
    for y in ys:
        m, P = F @ m, F @ P @ F.T + Q
        S = H @ P @ H + R
        total += -0.5 * ((y - H @ m) ** 2 / S + np.log(2 * np.pi * S))
        K = P @ H / S
        m, P = m + K * (y - H @ m), P - np.outer(K, K) * S
    pf = builder(
        sample_prior,
        Gaussian(jnp.zeros(1), PRIOR_V * jnp.eye(1)),
        dynamics,
        num_particles=300,
        noise_dim=1,
        observe=observe_both,
    )
    keys = jax.random.split(jax.random.key(3), 400)
    observations = jnp.asarray(ys, dtype=float)[:, None]
    ratio = np.exp(
        np.asarray(jax.jit(jax.vmap(log_evidence, in_axes=(None, 0, None)))(pf, keys, observations), np.float64) - total
    )
    assert abs((ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))) < 4


def test_exactly_one_kind_of_observation():
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    for given in ({}, {"observe": observe_both, "log_likelihood": log_likelihood}):
        with pytest.raises(ValueError, match=r"Exactly one of log_likelihood .* and observe"):
            rao_blackwell(sample_prior, prior, dynamics, num_particles=8, noise_dim=1, **given)


@pytest.mark.system
@pytest.mark.parametrize("proposal", [exact, plug_in_corrected])
def test_gradient_is_finite(proposal):
    pf, ys = make_filter(proposal, num_particles=50, ess_threshold=0.5), jnp.asarray(simulate(20), dtype=float)
    gradient = jax.jit(jax.grad(lambda pf: log_evidence(pf, jax.random.key(0), ys)))(pf)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    assert gradient.params.linear_prior.covariance[0, 0] != 0


@pytest.mark.parametrize("build", [rao_blackwell, rao_blackwell_shared])
def test_transport_is_refused(build):
    """It would average Gaussians that belong to different particles."""
    with pytest.raises(ValueError, match="scheme must choose ancestors: transport averages"):
        build(
            lambda key: jnp.zeros(1),
            Gaussian(jnp.zeros(1), jnp.eye(1)),
            lambda x, inputs: None,
            lambda x, y: jnp.zeros(()),
            num_particles=4,
            noise_dim=1,
            scheme=transport(0.5),
        )


@pytest.mark.parametrize("builder", [rao_blackwell, rao_blackwell_shared])
def test_an_observation_that_is_no_number_leaves_the_linear_beliefs_as_they_are(builder):
    one = jnp.ones((1, 1))
    filter = builder(
        lambda key: jax.random.normal(key, (1,)),
        Gaussian(jnp.zeros(1), one),
        lambda x: MixedDynamics(x, 0.0 * one, one, jnp.zeros(1), one, 0.1 * one),
        observe=lambda x: LinearObservation(x, one, one),
        num_particles=20,
        noise_dim=1,
    )
    _, (states, infos) = run(filter, jax.random.key(0), jnp.array([[0.0], [jnp.nan], [0.0]]))
    assert np.isfinite(states.linear_mean).all()
    assert np.isfinite(states.covariance).all()
    assert np.isfinite(infos.log_evidence).tolist() == [True, False, True]


@pytest.mark.parametrize("direction", [0, 1])
def test_a_direction_without_noise_needs_no_correction(direction, x64):
    """The other direction has the correction that it has alone."""
    noise, N, Q = np.array([0.7, -0.4]), np.diag([4.0, 4.0]), np.diag([1.0, 1.0])
    N[direction, direction] = Q[direction, direction] = 0.0
    other = slice(1 - direction, 2 - direction)
    _, found = plug_in_corrected(*map(jnp.asarray, (noise, N, Q)))
    _, alone = plug_in_corrected(*map(jnp.asarray, (noise[other], N[other, other], Q[other, other])))
    np.testing.assert_allclose(found - 0.5 * noise[direction] ** 2, alone, rtol=1e-12)
