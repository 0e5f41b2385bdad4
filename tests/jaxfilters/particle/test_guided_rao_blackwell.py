"""The guided proposal: its densities by Monte Carlo, and the filter against the joint Kalman filter."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm
from scipy.stats import multivariate_normal

from jaxfilters import weights
from jaxfilters.filter import keep_info, log_evidence, run
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.particle.differentiable_resampling import soft
from jaxfilters.particle.guidance import Guidance, GuidanceMixture, as_mixture, draw
from jaxfilters.particle.guided_rao_blackwell import Jump, guided_rao_blackwell
from jaxfilters.particle.rao_blackwell import MixedDynamics, rao_blackwell, rao_blackwell_shared
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import AdaptiveTempering

DT, Q_N, Q_L, R = 0.1, 0.3, 40.0, 0.001


def sample_prior(key):
    return jax.random.normal(key, (1,))


def dynamics(x, inputs):
    del inputs
    one = jnp.ones((1, 1))
    return MixedDynamics(x, DT * one, DT * Q_N * one, jnp.zeros(1), one, DT * Q_L * one)


def log_likelihood(x, y):
    return norm.logpdf(y, x[0], jnp.sqrt(R))


def look(particles, log_weights, y):
    del particles, log_weights
    return Guidance(y[None], jnp.eye(1) / R)


def look_past(particles, log_weights, y):
    return look(particles, log_weights, y + 0.2)


def look_nowhere(particles, log_weights, y):
    return look(particles, log_weights, y)._replace(information=jnp.zeros((1, 1)))


def look_twice(particles, log_weights, y):
    """The true maximum, and one that is not there."""
    del particles, log_weights
    information = jnp.array([[[1 / R]], [[0.3 / R]]])
    return GuidanceMixture(jnp.stack([y + 0.1, y - 0.3])[:, None], information, jnp.array([0.0, 1.0]))


def make_inner(builder=rao_blackwell_shared, num_particles=200, **options):
    prior = Gaussian(jnp.zeros(1), 4.0 * jnp.eye(1))
    return builder(sample_prior, prior, dynamics, log_likelihood, num_particles=num_particles, noise_dim=1, **options)


def simulate(length=12):
    rng = np.random.default_rng(0)
    x, v, ys = rng.normal(), 2 * rng.normal(), []
    for _ in range(length):
        x += DT * v + np.sqrt(DT * Q_N) * rng.normal()
        v += np.sqrt(DT * Q_L) * rng.normal()
        ys.append(x + np.sqrt(R) * rng.normal())
    return np.array(ys)


def exact_log_evidence(ys):
    m, P, total = np.zeros(2), np.diag([1.0, 4.0]), 0.0
    F, Q = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * Q_L])
    for y in ys:
        m, P = F @ m, F @ P @ F.T + Q
        S = P[0, 0] + R
        total += norm.logpdf(y, m[0], np.sqrt(S))
        K = P[:, 0] / S
        m, P = m + K * (y - m[0]), P - np.outer(K, K) * S
    return float(total)


@pytest.mark.system
@pytest.mark.parametrize(
    ("guide", "scheme"),
    [(look_past, systematic), (look_nowhere, systematic), (look_twice, systematic), (look, soft(0.6))],
)
def test_evidence_is_unbiased_whatever_the_guide_says(guide, scheme):
    # z-test at 4 sigma over 600 runs of the unbiased evidence: fails by chance once in 16000.
    ys = simulate()
    keys = jax.random.split(jax.random.key(1), 600)
    pf = guided_rao_blackwell(make_inner(scheme=scheme), guide)
    estimates = jax.jit(jax.vmap(log_evidence, in_axes=(None, 0, None)))(pf, keys, jnp.asarray(ys, dtype=float))
    ratio = np.exp(np.asarray(estimates, np.float64) - exact_log_evidence(ys))
    assert abs((ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))) < 4


@pytest.mark.system
def test_a_good_guide_keeps_more_particles_alive():
    ys = jnp.asarray(simulate(), dtype=float)
    with_guide = run(guided_rao_blackwell(make_inner(), look), jax.random.key(2), ys, collect=keep_info)[1]
    without = run(make_inner(), jax.random.key(2), ys, collect=keep_info)[1]
    assert with_guide.effective_sample_size.mean() > 3 * without.effective_sample_size.mean()


def test_an_unseen_frame_is_a_plain_prediction():
    ys = jnp.asarray(simulate(), dtype=float)
    mask = jnp.arange(len(ys)) % 3 != 1
    state, infos = run(
        guided_rao_blackwell(make_inner(), look),
        jax.random.key(2),
        jnp.where(mask, ys, jnp.nan),
        mask=mask,
        collect=keep_info,
    )
    assert np.all(np.isfinite(infos.log_evidence))
    assert np.all(np.isfinite(state.ensemble.particles))


def mixture_of(points):
    """Guidance in three dimensions of very different units, with the first of two points or with both."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) * [1.0, 0.01, 3.0]
    inverse = np.linalg.inv(root @ root.T)
    towards = root @ np.array([[1.0, -0.5, 0.7], [-0.8, 0.9, 0.2]]).T
    information = np.stack([5 * inverse, 2 * inverse])[:points]
    mixture = GuidanceMixture(jnp.zeros((points, 0)), jnp.asarray(information), jnp.asarray([0.0, 0.4])[:points])
    return root @ root.T, mixture, towards.T[:points]


@pytest.mark.system
@pytest.mark.parametrize("points", [1, 2])
def test_importance_weights_restore_the_prior(points):
    # 4e5 draws; each moment within 4 standard errors of the truth.
    with jax.enable_x64(True):
        spread, mixture, towards = mixture_of(points)
        towards = jnp.repeat(jnp.asarray(towards)[..., None], 400_000, axis=-1)
        delta, log_ratio = draw(jax.random.key(0), jnp.asarray(spread), mixture, towards, 0.2)
    weight = np.exp(np.asarray(log_ratio))
    delta = np.asarray(delta)
    assert weight.max() <= 1 / 0.2 + 1e-9
    for value, truth in [
        (np.ones_like(weight), 1.0),
        (delta[0], 0.0),
        (delta[2] ** 2, spread[2, 2]),
        (delta[0] * delta[1], spread[0, 1]),
    ]:
        product = weight * value
        assert abs(product.mean() - truth) < 4 * product.std() / np.sqrt(product.size)


def test_shares_of_points_are_the_integrals_of_their_products(x64):
    """If the likelihood L is the sum of both functions, q is p L / Z. Z in closed form, particles at two places."""
    spread, mixture, towards = mixture_of(2)
    information, heights, share = np.asarray(mixture.information), np.asarray(mixture.log_likelihoods), 0.3
    towards = np.stack([towards, 0.01 - 0.7 * towards], axis=-1)  # (points, 3, particles)
    several = jnp.asarray(np.repeat(towards, 50, axis=-1))
    delta, log_ratio = draw(jax.random.key(1), jnp.asarray(spread), mixture, several, share)
    covariances = np.linalg.inv(information)
    volumes = np.sqrt(np.linalg.det(2 * np.pi * covariances))
    for k, (d, found) in enumerate(zip(np.asarray(delta).T, np.asarray(log_ratio), strict=True)):
        there = towards[..., k // 50]
        functions = np.exp(heights - 0.5 * np.einsum("mi,mij,mj->m", d - there, information, d - there))
        integrals = [
            np.exp(height) * volume * multivariate_normal.pdf(t, cov=spread + covariance)
            for height, volume, t, covariance in zip(heights, volumes, there, covariances, strict=True)
        ]
        ratio = share + (1 - share) * functions.sum() / np.sum(integrals)
        np.testing.assert_allclose(-found, np.log(ratio), atol=1e-8)


@pytest.mark.system
def test_derivative_of_evidence_with_points_that_are_not_there():
    # One step, 60 runs of 4000 particles, 4 standard errors: by chance once in 16000.
    y = 1.3

    def evidence(shift, key):
        inner = one_step(lambda x, y: norm.logpdf(y, x[0], 0.5), 1.0, shift, num_particles=4000)
        wrong = GuidanceMixture(jnp.array([[1.5], [-1.0]]), jnp.array([[[5.0]], [[8.0]]]), jnp.array([0.0, 0.5]))
        return log_evidence(guided_rao_blackwell(inner, lambda x, lw, y: wrong), key, jnp.full(1, y))

    keys = jax.random.split(jax.random.key(6), 60)
    slopes = np.asarray(jax.jit(jax.vmap(jax.grad(evidence), in_axes=(None, 0)))(0.2, keys))
    exact = (y - 0.2) / (1 + 1 + 0.25)
    assert abs(slopes.mean() - exact) < 4 * slopes.std(ddof=1) / np.sqrt(slopes.size)


def one_step(log_likelihood, std, shift=0.0, **options):
    """From a normal prior of this standard deviation by a standard normal step about a shift; no linear state."""
    nothing = jnp.zeros((0, 0))
    return rao_blackwell_shared(
        lambda key: std * jax.random.normal(key, (1,)),
        Gaussian(jnp.zeros(0), nothing),
        lambda x: MixedDynamics(x + shift, jnp.zeros((1, 0)), jnp.eye(1), jnp.zeros(0), nothing, nothing),
        log_likelihood,
        noise_dim=1,
        **options,
    )


def test_evidence_varies_less_with_both_maxima_than_with_one():
    """Where the distance from the origin is observed: half of the evidence lies on either side."""
    inner = one_step(lambda x, y: norm.logpdf(y, jnp.abs(x[0]), 0.02), 0.3, num_particles=200)
    keys = jax.random.split(jax.random.key(0), 40)

    def spread(signs):
        def guide(particles, log_weights, y):
            return GuidanceMixture(jnp.array(signs) * y, jnp.full((len(signs), 1, 1), 2500.0), jnp.zeros(len(signs)))

        pf = guided_rao_blackwell(inner, guide)
        return float(jnp.std(jax.vmap(lambda key: log_evidence(pf, key, jnp.ones(1)))(keys)))

    assert spread([[1.0], [-1.0]]) < 0.5 * spread([[1.0]])


def test_a_point_that_is_left_out_may_be_anything_and_one_point_is_a_mixture_of_one():
    one = Guidance(jnp.ones(2), 3.0 * jnp.eye(2))
    both = GuidanceMixture(
        jnp.stack([jnp.full(2, jnp.nan), one.point]),
        jnp.stack([jnp.full((2, 2), jnp.nan), one.information]),
        jnp.array([-jnp.inf, 0.0]),
    )
    origins = jnp.linspace(-1, 1, 14).reshape(2, 7)

    def drawn(mixture):
        return draw(jax.random.key(2), jnp.eye(2), mixture, mixture.points[..., None] - origins, 0.2)

    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    jax.tree.map(close, drawn(as_mixture(one)), drawn(both))
    close(drawn(both._replace(log_likelihoods=jnp.full(2, -jnp.inf)))[1], 0.0)


SHARP = 1e-4
"""Variance of an observation of six walking positions, which one prediction spreads by a variance of 0.03 and more."""


def guided_errors(keys, num_particles):
    """Root mean square distance of posterior means from those of the Kalman filter, in standard deviations of y."""
    size, eye = 6, jnp.eye(6)
    inner = rao_blackwell_shared(
        lambda key: jax.random.normal(key, (size,)),
        Gaussian(jnp.zeros(size), 4.0 * eye),
        lambda x, inputs: MixedDynamics(x, DT * eye, DT * Q_N * eye, jnp.zeros(size), eye, 0.4 * eye),
        lambda x, y: -0.5 * jnp.sum((y - x) ** 2) / SHARP,
        num_particles=num_particles,
        noise_dim=size,
        ess_threshold=1.0,
        temper=AdaptiveTempering(0.02),
    )
    # A rough guide: one standard deviation off in every coordinate, with half of the information.
    pf = guided_rao_blackwell(inner, lambda x, lw, y: Guidance(y + SHARP**0.5, 0.5 * eye / SHARP), prior_share=0.1)
    F = jnp.kron(jnp.array([[1.0, DT], [0.0, 1.0]]), eye)
    Q = jnp.diag(jnp.repeat(jnp.array([DT * Q_N, 0.4]), size))
    start = Gaussian(jnp.zeros(2 * size), jnp.diag(jnp.repeat(jnp.array([1.0, 4.0]), size)))
    exact = extended_kalman(start, lambda s, u: F @ s, Q, lambda s: s[:size], SHARP * eye)

    @jax.jit
    def squared_error(key):
        def walk(state, key):
            state = F @ state + jnp.sqrt(jnp.diagonal(Q)) * jax.random.normal(key, (2 * size,))
            return state, state[:size] + SHARP**0.5 * jax.random.normal(jax.random.fold_in(key, 1), (size,))

        _, ys = jax.lax.scan(walk, jax.random.normal(key, (2 * size,)), jax.random.split(key, 8))
        means = run(pf, jax.random.fold_in(key, 2), ys, collect=ensemble_mean)[1]
        return jnp.mean((means - run(exact, key, ys)[1][0].mean[:, :size]) ** 2)

    return np.sqrt(np.mean(jax.lax.map(squared_error, keys)) / SHARP)


def ensemble_mean(state, info):
    return weights.mean(state.ensemble.particles, state.ensemble.log_weights)


@pytest.mark.system
def test_more_particles_do_not_make_a_tempered_guided_filter_worse():
    """Errors 0.69 and 0.32, with standard errors of 0.04 and 0.01 over 12 sequences.

    Tempering the likelihood alone, against the effective sample size of the corrected weights, gave 0.66 and 16: the
    correction of a sharp guide leaves weight to the few particles drawn from the transition, and the more of them there
    are, the more the likelihood was flattened.
    """
    keys = jax.random.split(jax.random.key(11), 12)
    few, many = guided_errors(keys, 64), guided_errors(keys, 4096)
    assert many < few
    assert many < 0.5


def test_only_a_shared_covariance_can_be_guided():
    with pytest.raises(ValueError, match="rao_blackwell_shared"):
        guided_rao_blackwell(make_inner(rao_blackwell), look)
    with pytest.raises(ValueError, match="prior_share"):
        guided_rao_blackwell(make_inner(), look, prior_share=0.0)


JUMP_SHARE, JUMP_VARIANCE = 0.2, 4.0


def jump(inputs):
    del inputs
    return Jump(JUMP_SHARE, JUMP_VARIANCE * jnp.eye(1))


def over_all_histories(ys, velocity_variance, velocity_rate, jump_share=JUMP_SHARE):
    """Mean and covariance of position and velocity, and the log evidence: Kalman filters of all histories of jumps."""
    F, usual = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * velocity_rate])
    histories = [(0.0, np.zeros(2), np.diag([1.0, velocity_variance]))]
    for y in ys:
        following = []
        for log_weight, m, P in histories:
            for share, extra in ((1 - jump_share, 0.0), (jump_share, JUMP_VARIANCE)):
                mean, cov = F @ m, F @ P @ F.T + usual + np.diag([extra, 0.0])
                S, K = cov[0, 0] + R, cov[:, 0] / (cov[0, 0] + R)
                here = log_weight + np.log(share) + norm.logpdf(y, mean[0], np.sqrt(S))
                following.append((float(here), mean + K * (y - mean[0]), cov - np.outer(K, K) * S))
        histories = following
    logs, means, covariances = (np.array(part) for part in zip(*histories, strict=True))
    share = np.exp(logs - logs.max())
    mean = share @ means / share.sum()
    inner = np.einsum("h,hij->ij", share, covariances) + np.einsum("h,hi,hj->ij", share, means - mean, means - mean)
    return mean, inner / share.sum(), logs.max() + np.log(share.sum())


def jumping_walk(length, velocity):
    """Observations of a position that jumps by two in two of its steps."""
    rng = np.random.default_rng(5)
    steps = velocity * DT + np.sqrt(DT * Q_N) * rng.normal(size=length) + 2.0 * (np.arange(length) % 4 == 2)
    return np.cumsum(steps) + np.sqrt(R) * rng.normal(size=length)


def walking(num_particles, **options):
    """A position that walks at random, with a linear state of no dimensions."""
    nothing = jnp.zeros((0, 0))
    return rao_blackwell_shared(
        sample_prior,
        Gaussian(jnp.zeros(0), nothing),
        lambda x: MixedDynamics(x, jnp.zeros((1, 0)), DT * Q_N * jnp.eye(1), jnp.zeros(0), nothing, nothing),
        log_likelihood,
        num_particles=num_particles,
        noise_dim=1,
        **options,
    )


@pytest.mark.system
@pytest.mark.parametrize("guide", [look, look_past, look_twice])
def test_evidence_is_unbiased_with_jumps(guide):
    # Without a linear state nothing is approximated. z-test at 4 sigma over 600 runs: fails by chance once in 16000.
    ys = jumping_walk(8, 0.0)
    pf = guided_rao_blackwell(walking(200), guide, jump=jump)
    keys = jax.random.split(jax.random.key(1), 600)
    estimates = jax.jit(jax.vmap(log_evidence, in_axes=(None, 0, None)))(pf, keys, jnp.asarray(ys, dtype=float))
    ratio = np.exp(np.asarray(estimates, np.float64) - over_all_histories(ys, 0.0, 0.0)[2])
    assert abs((ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(ratio.size))) < 4


@pytest.mark.system
def test_jumps_are_told_from_velocity():
    """A jump leaves the velocity alone: off by 0.01 standard deviations, by 6 without jumps in the model."""
    ys = jumping_walk(8, 3.0)
    mean, covariance, _ = over_all_histories(ys, 4.0, 0.05)
    inner = rao_blackwell_shared(
        sample_prior,
        Gaussian(jnp.zeros(1), 4.0 * jnp.eye(1)),
        lambda x: dynamics(x, None)._replace(Q_l=DT * 0.05 * jnp.eye(1)),
        log_likelihood,
        num_particles=4000,
        noise_dim=1,
    )

    def deviation(**options):
        state = run(guided_rao_blackwell(inner, look, **options), jax.random.key(3), jnp.asarray(ys, dtype=float))[0]
        velocity = weights.mean(state.ensemble.linear_mean, state.ensemble.log_weights)[0]
        return abs(float(velocity) - mean[1]) / np.sqrt(covariance[1, 1])

    assert deviation(jump=jump) < 0.2
    assert deviation() > 2.0


@pytest.mark.system
def test_derivative_of_evidence_by_the_probability_of_jumps():
    # Without resampling, which breaks it. 40 runs of 2000 particles, 4 standard errors: by chance once in 16000.
    ys = jumping_walk(4, 0.0)
    inner = walking(2000, ess_threshold=0.0)

    def evidence(share, key):
        pf = guided_rao_blackwell(inner, look, jump=lambda inputs: jump(inputs)._replace(probability=share))
        return log_evidence(pf, key, jnp.asarray(ys, dtype=float))

    keys = jax.random.split(jax.random.key(4), 40)
    slopes = np.asarray(jax.jit(jax.vmap(jax.grad(evidence), in_axes=(None, 0)))(JUMP_SHARE, keys))
    exact = [over_all_histories(ys, 0.0, 0.0, JUMP_SHARE + step)[2] for step in (1e-4, -1e-4)]
    assert abs(slopes.mean() - (exact[0] - exact[1]) / 2e-4) < 4 * slopes.std(ddof=1) / np.sqrt(slopes.size)
