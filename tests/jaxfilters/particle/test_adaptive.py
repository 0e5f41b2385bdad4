"""The adaptive particle filter against a Kalman filter that coasts and learns by ridge regression."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters.filter import init, keep_all, keep_info, log_evidence, predict, run, step, update
from jaxfilters.math import diffusion
from jaxfilters.particle.adaptive import adaptive_diffusion
from jaxfilters.particle.partitioned import Partitions, batch_log_likelihood, consecutive, corrected

SCALE, STEADY = np.array([1.0, 0.5]), np.array([0.3])
NOISE = np.array([0.5, 0.4, 0.6])
PRIOR = np.array([1.0, 1.0, 0.5])
LOW, HIGH = 0.2, 3.0
TRACES = []


def sample_prior(key):
    return jnp.asarray(PRIOR, dtype=float) * jax.random.normal(key, (3,))


def log_likelihood(x, y):
    TRACES.append(1)
    return norm.logpdf(y, x, jnp.asarray(NOISE, dtype=float)).sum()


def make_filter(num_particles=200, **options):
    options = {
        "mode_scale": jnp.ones(3),
        "mode_distance": 1e6,
        "steady_std": jnp.asarray(STEADY),
        "low": LOW,
        "high": HIGH,
    } | options
    fit = options.pop("fit", diffusion.start(jnp.asarray(SCALE)))
    return adaptive_diffusion(
        sample_prior, batch_log_likelihood(log_likelihood), fit, num_particles=num_particles, **options
    )


def simulate(seed, length=9):
    """Observations of a target that moves off, and intervals that vary."""
    rng = np.random.default_rng(seed)
    tau = rng.uniform(0.5, 1.5, length)
    path = np.cumsum(np.linspace(0, 2, length)[:, None] * [1.0, -0.4, 0.0], axis=0)
    return jnp.asarray(path + NOISE * rng.normal(size=(length, 3)), dtype=float), jnp.asarray(tau, dtype=float)


def kalman(ys, taus):
    """Mean, variance and log evidence in every frame; the diffusion learnt by ridge regression."""
    m, P, v, num_estimates = np.zeros(3), PRIOR**2, np.zeros(2), 0
    first = np.vstack([np.eye(2), np.ones(2)])
    Z, Y, found = np.zeros((0, 3)), np.zeros((0, 2)), []
    for y, tau in zip(np.asarray(ys), np.asarray(taus), strict=True):
        theta = np.linalg.solve(Z.T @ Z + 10 * np.eye(3), Z.T @ Y + 10 * first)
        z = np.append(np.abs(v) / SCALE, 1)
        spread = tau * np.clip(SCALE * (z @ theta), LOW, HIGH)
        before, m, P = m, m + np.append(tau * v, 0), P + np.append(spread**2, tau * STEADY**2)
        S = P + NOISE**2
        log_evidence = norm.logpdf(y, m, np.sqrt(S)).sum()
        m, P = m + P / S * (y - m), P * NOISE**2 / S
        velocity = (m - before)[:2] / tau if num_estimates else v
        if num_estimates >= 2:
            Z = np.vstack([Z, z])
            Y = np.vstack([Y, np.sqrt(np.pi / 2) * np.abs(velocity - v) / SCALE])
        v, num_estimates = velocity, num_estimates + 1
        found.append((m, P, log_evidence))
    return [np.array(rows) for rows in zip(*found, strict=True)]


def keep_belief(state, info):
    variance = jnp.diagonal(weights.covariance(state.particles, state.log_weights))
    return state.estimate, variance, info.log_evidence


@pytest.mark.system
def test_estimates_are_those_of_a_kalman_filter_that_coasts_and_learns():
    ys, taus = simulate(0)
    keys = jax.random.split(jax.random.key(0), 40)
    follow = jax.vmap(lambda key: run(make_filter(20_000), key, ys, taus, collect=keep_belief)[1])
    estimates, variances, _ = map(np.asarray, follow(keys))
    mean, variance, _ = kalman(ys, taus)
    # Bias is of the order of 1 / 20000 of a standard deviation, 40 runs leave 1 / sqrt(800000) of it by chance.
    for found, exact in ((estimates, mean), (variances, variance)):
        z = (found.mean(0) - exact) / (found.std(0, ddof=1) / np.sqrt(40))
        assert np.max(np.abs(z)) < 4


@pytest.mark.system
def test_a_large_ensemble_has_the_variance_and_the_evidence_of_the_kalman_filter():
    ys, taus = simulate(1)
    estimates, variances, log_evidence = run(make_filter(400_000), jax.random.key(1), ys, taus, collect=keep_belief)[1]
    mean, variance, exact_evidence = kalman(ys, taus)
    np.testing.assert_allclose(variances, variance, rtol=0.05)
    # An eighth of the particles counts at least; the velocity passes the error of one frame on to the next, threefold.
    assert np.max(np.abs(estimates - mean) / np.sqrt(variance)) < 4 * 3 / np.sqrt(50_000)
    np.testing.assert_allclose(log_evidence, exact_evidence, atol=0.05)


@pytest.mark.system
def test_the_fit_has_learnt_from_the_estimates_from_the_third_on():
    ys, taus = simulate(2)
    state, (states, _) = run(make_filter(partitions=Partitions(consecutive(2, 1))), jax.random.key(2), ys, taus)
    steps = np.diff(np.asarray(states.estimate), axis=0)[:, :2] / np.asarray(taus)[1:, None]
    np.testing.assert_allclose(states.velocity[1:], steps, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(states.velocity[0], 0)
    np.testing.assert_array_equal(states.fit.coefficients[1], diffusion.start(jnp.asarray(SCALE)).coefficients)
    fit = diffusion.start(jnp.asarray(SCALE))
    for before, after in pairwise(steps):
        fit = diffusion.update(fit, jnp.asarray(before), jnp.asarray(after - before))
    np.testing.assert_allclose(state.fit.coefficients, fit.coefficients, rtol=1e-3, atol=1e-4)


def test_noise_adapts_to_speed_and_grows_with_the_interval():
    pf = make_filter()
    still = init(pf, jax.random.key(3))
    moving = still._replace(velocity=jnp.array([2.0, -1.0]))
    np.testing.assert_allclose(predict(pf, jax.random.key(0), still).spread, [1.0, 0.5, 0.3], rtol=1e-6)
    np.testing.assert_allclose(predict(pf, jax.random.key(0), moving).spread, [3.0, 1.5, 0.3], rtol=1e-6)
    slow = predict(pf, jax.random.key(0), moving, 4.0)
    np.testing.assert_allclose(slow.spread, [12.0, 6.0, 0.6], rtol=1e-6)
    noise = (slow.particles - moving.particles[:, slow.ancestors] - jnp.array([[8.0], [-4.0], [0.0]])) / slow.spread[
        :, None
    ]
    # 200 normal numbers: mean within 4 / sqrt(200), standard deviation within 4 / sqrt(400).
    np.testing.assert_allclose(noise.mean(1), 0, atol=0.29)
    np.testing.assert_allclose(noise.std(1), 1, atol=0.2)


def test_a_given_diffusion_is_kept():
    ys, taus = simulate(4)
    fit = diffusion.start(jnp.array([0.7, 0.2]), slope=0.0)
    state, _ = run(make_filter(fit=fit, update_fit=diffusion.fixed), jax.random.key(4), ys, taus)
    jax.tree.map(np.testing.assert_array_equal, state.fit, fit)
    np.testing.assert_allclose(state.spread[:2], taus[-1] * np.array([0.7, 0.2]), rtol=1e-6)


def unexplained(kind, ys):
    """The same frames, of which the fifth and sixth are not seen or explained by nothing."""
    gone = (jnp.arange(len(ys)) == 4) | (jnp.arange(len(ys)) == 5)
    return {"ys": ys, "mask": ~gone} if kind == "masked" else {"ys": jnp.where(gone[:, None], kind, ys), "mask": None}


@pytest.mark.parametrize("partitions", [None, Partitions(consecutive(2, 1))])
@pytest.mark.parametrize("kind", ["masked", np.nan, 1e30])
def test_frames_that_say_nothing_are_coasted_through(kind, partitions):
    ys, taus = simulate(5)
    frames = unexplained(kind, ys)
    run_it = partial(
        run, make_filter(partitions=partitions), jax.random.key(5), frames["ys"], taus, mask=frames["mask"]
    )
    state, (states, infos) = run_it(collect=keep_all)
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(np.isfinite(leaf), True), states)
    for t in (4, 5):
        np.testing.assert_array_equal(states.estimate[t], states.estimate[3])
        np.testing.assert_array_equal(states.velocity[t], states.velocity[3])
        np.testing.assert_allclose(states.elapsed[t], taus[4 : t + 1].sum(), rtol=1e-6)
        assert infos.log_evidence[t] == (0 if kind == "masked" else -jnp.inf)
    velocity = (states.estimate[6] - states.estimate[3])[:2] / taus[4:7].sum()
    np.testing.assert_allclose(states.velocity[6], velocity, rtol=1e-5)
    assert state.elapsed == 0


@pytest.mark.parametrize("tau", [0.0, -1.0, np.nan])
def test_no_time_no_motion(tau):
    ys, taus = simulate(6)
    state, _ = run(make_filter(), jax.random.key(6), ys, taus)
    again, _ = step(make_filter(), jax.random.key(7), state, ys[-1], tau)
    assert set(np.asarray(again.particles[0]).tolist()) <= set(np.asarray(state.particles[0]).tolist())
    np.testing.assert_array_equal(again.velocity, state.velocity)
    assert np.all(np.isfinite(again.estimate))


def test_layers_move_each_particle_move_one_group_and_jitter_without_drift():
    pf = make_filter(5000, partitions=Partitions(consecutive(2, 1), 0.25, corrected))
    start = init(pf, jax.random.key(8))._replace(velocity=jnp.array([30.0, -40.0]))
    moved = predict(pf, jax.random.key(9), start)
    gone = np.asarray(moved.particles - start.particles[:, moved.ancestors])
    assert np.all((gone[:2] == 0).all(0) == (gone[2] != 0))
    assert abs(gone[0, ::2].mean() - 30) < 4 * 3 / np.sqrt(2500)
    np.testing.assert_array_equal(gone[2, ::2], 0)
    flat = partial(adaptive_diffusion, sample_prior, anything, diffusion.start(jnp.asarray(SCALE)))
    pf = flat(
        num_particles=5000,
        partitions=Partitions(consecutive(2, 1)),
        mode_scale=jnp.ones(3),
        steady_std=jnp.asarray(STEADY),
        high=HIGH,
    )
    after, _ = update(pf, jax.random.key(10), moved, jnp.zeros(3))
    jitter = (after.particles - moved.particles) / moved.spread[:, None]
    # Even weights: nobody is drawn twice. 5000 normal numbers.
    np.testing.assert_allclose(jitter.mean(1), 0, atol=4 * 0.25 / np.sqrt(5000))
    np.testing.assert_allclose(jitter.std(1), 0.25, rtol=4 / np.sqrt(10000))


def anything(particles, y):
    return jnp.zeros(particles.shape[1])


@pytest.mark.system
@pytest.mark.parametrize("partitions", [None, Partitions(consecutive(2, 1))])
def test_filters_compile_once_and_run_together_as_they_do_alone(partitions):
    ys, taus = simulate(10)
    alone = [
        log_evidence(make_filter(partitions=partitions), key, ys, taus)
        for key in jax.random.split(jax.random.key(0), 2)
    ]
    TRACES.clear()
    log_evidence(make_filter(partitions=partitions), jax.random.key(1), ys + 1, taus)
    assert not TRACES
    keys = jax.random.split(jax.random.key(0), 2)
    together = jax.vmap(lambda key: log_evidence(make_filter(partitions=partitions), key, ys, taus))(keys)
    np.testing.assert_allclose(together, alone, rtol=1e-4)


@pytest.mark.system
def test_the_evidence_is_differentiable_in_the_parameters():
    ys, taus = simulate(11)
    pf = make_filter(partitions=Partitions(consecutive(2, 1)))
    gradient = jax.grad(lambda pf: log_evidence(pf, jax.random.key(0), ys, taus), allow_int=True)(pf).params
    for leaf in (gradient.steady_std, gradient.fit.coefficients, gradient.fit.scale):
        assert np.all(np.isfinite(leaf))
        assert np.any(leaf != 0)


def test_double_precision_stays_double(x64):
    ys, taus = simulate(12)
    state, infos = run(
        make_filter(partitions=Partitions(consecutive(2, 1))), jax.random.key(0), ys, taus, collect=keep_info
    )
    floating = [leaf.dtype for leaf in jax.tree.leaves((state, infos)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert set(floating) == {jnp.dtype(jnp.float64)}


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_particles": 0}, "num_particles"),
        ({"mode_scale": jnp.array([1.0, 0.0, 1.0])}, "mode_scale must be positive"),
        ({"mode_distance": 0.0}, "mode_distance must be positive"),
        ({"mode_scale": jnp.ones(4)}, r"each of 2 \+ 1 coordinates; got .* mode_scale \(4,\)"),
        ({"low": -1.0}, "low and high"),
        ({"low": 2.0, "high": 1.0}, "low and high"),
        (
            {"partitions": Partitions(consecutive(2, 2))},
            r"shape \(g, 3\); got \(2, 4\)",
        ),
    ],
)
def test_parameters_that_cannot_be_are_rejected(options, named):
    with pytest.raises(ValueError, match=named):
        make_filter(**options)


def test_a_prior_of_another_size_is_rejected():
    with pytest.raises(ValueError, match="sample_prior must draw 2 numbers; got 3"):
        init(make_filter(steady_std=None, mode_scale=jnp.ones(2)), jax.random.key(0))
