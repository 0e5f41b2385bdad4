import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters.filter import Filter, run
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.smoothing import filter_and_smooth
from jaxfilters.math import diffusion
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.adaptive import adaptive_diffusion
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.differentiable_resampling import transport
from jaxfilters.particle.fixed_lag import fixed_lag, fixed_lag_rts
from jaxfilters.particle.guidance import Guidance
from jaxfilters.particle.guided_rao_blackwell import guided_rao_blackwell
from jaxfilters.particle.partitioned import Partitions, batch_log_likelihood, consecutive
from jaxfilters.particle.rao_blackwell import MixedDynamics, rao_blackwell_shared
from jaxfilters.particle.smoothing import keep_history, trajectories
from jaxfilters.priors import gaussian_prior

KEY = jax.random.key(1)
RNG = np.random.default_rng(2)
LENGTH, LAG = 7, 2
F, H = 0.7 * RNG.normal(size=(2, 2)), RNG.normal(size=(1, 2))
ROOT_P, ROOT_Q = np.tril(RNG.normal(size=(2, 2))), np.tril(RNG.normal(size=(2, 2)))
YS, CONTROLS = RNG.normal(size=(LENGTH, 1)), RNG.normal(size=LENGTH)
MASK = jnp.asarray(np.arange(LENGTH) != 3)


def transition(x, inputs):
    return F @ x + inputs


def observe(x):
    return H @ x


def delayed(state, info):
    return state.delayed, info.log_evidence


@pytest.mark.system
@pytest.mark.parametrize("arithmetic", [arithmetics.joseph, arithmetics.square_root])
def test_beliefs_are_those_of_the_smoother_of_what_was_seen(x64, arithmetic):
    root = arithmetic is arithmetics.square_root
    prior = (
        GaussianRoot(jnp.zeros(2), jnp.asarray(ROOT_P))
        if root
        else Gaussian(jnp.zeros(2), jnp.asarray(ROOT_P @ ROOT_P.T))
    )
    Q = jnp.asarray(ROOT_Q if root else ROOT_Q @ ROOT_Q.T)
    R = (0.5**0.5 if root else 0.5) * jnp.eye(1)
    inner = extended_kalman(prior, transition, Q, observe, R, arithmetic=arithmetic)
    ys, inputs = jnp.asarray(YS), jnp.asarray(CONTROLS)
    filter = fixed_lag_rts(inner, LAG, inputs=jnp.zeros(()))
    _, (found, evidences) = run(filter, KEY, ys, inputs, mask=MASK, collect=delayed)
    smooth_until = jax.jit(lambda mask: filter_and_smooth(inner, KEY, ys, inputs, mask=mask))
    for t in range(LENGTH):
        # What comes later is as if it had not been seen.
        beliefs, infos = smooth_until(MASK & (jnp.arange(LENGTH) <= t))
        assert evidences[t] == pytest.approx(infos.log_evidence[t])
        if t >= LAG:
            np.testing.assert_allclose(found.mean[t], beliefs.mean[t - LAG], atol=1e-10)
            spread = [leaf.root @ leaf.root.swapaxes(-1, -2) if root else leaf.covariance for leaf in (found, beliefs)]
            np.testing.assert_allclose(spread[0][t], spread[1][t - LAG], atol=1e-10)
    # In the first frame it is the state before, given that frame.
    S = (H @ (F @ ROOT_P @ ROOT_P.T @ F.T + ROOT_Q @ ROOT_Q.T) @ H.T + 0.5).item()
    expected = (ROOT_P @ ROOT_P.T @ F.T @ H.T / S * (YS[0] - H @ np.full(2, CONTROLS[0]))).sum(axis=1)
    np.testing.assert_allclose(found.mean[0], expected, atol=1e-10)


def sample_prior(key):
    return jax.random.normal(key)


def move(noise, x, inputs):
    return 0.9 * x + inputs + 0.5 * noise[0]


def log_likelihood(x, y):
    return norm.logpdf(y[0], x, 0.4)


def window_and_history(state, info):
    return state.delayed, keep_history(state.inner, info)


@pytest.mark.system
def test_delayed_particles_are_those_of_the_lineages():
    pf = bootstrap(sample_prior, move, log_likelihood, num_particles=30, noise=StandardNormal(1))
    ys, inputs = jnp.asarray(YS, jnp.float32), jnp.asarray(CONTROLS, jnp.float32)
    _, (found, history) = run(fixed_lag(pf, LAG), KEY, ys, inputs, mask=MASK, collect=window_and_history)
    particles, ancestors = np.asarray(history.particles), np.asarray(history.ancestors)
    for t in range(LAG, LENGTH):
        indices = np.arange(30)
        for parents in ancestors[t : t - LAG : -1]:
            indices = parents[indices]
        np.testing.assert_array_equal(found[t], particles[t - LAG, indices])
    np.testing.assert_array_equal(found[-1], trajectories(history)[-1 - LAG])
    _, plain = run(pf, KEY, ys, inputs, mask=MASK, collect=keep_history)
    np.testing.assert_array_equal(history.particles, plain.particles)


def any_window_and_history(state, info):
    return state.delayed, keep_history(getattr(state.inner, "ensemble", state.inner), info)


def layered():
    prior, flat = (
        gaussian_prior(Gaussian(jnp.zeros(2), jnp.eye(2))),
        batch_log_likelihood(lambda x, y: norm.logpdf(y[0], x[0])),
    )
    return adaptive_diffusion(
        prior,
        flat,
        diffusion.start(jnp.ones(2)),
        num_particles=40,
        mode_scale=jnp.ones(2),
        partitions=Partitions(consecutive(1, 1)),
    )


def drift(x, inputs):
    del inputs
    one = jnp.ones((1, 1))
    return MixedDynamics(x, 0.3 * one, 0.1 * one, jnp.zeros(1), 0.9 * one, 0.2 * one)


def looked_at(num_particles):
    start, linear = gaussian_prior(Gaussian(jnp.zeros(1), jnp.eye(1))), Gaussian(jnp.zeros(1), jnp.eye(1))
    log_likelihood = lambda x, y: norm.logpdf(y[0], x[0], 0.4)
    inner = rao_blackwell_shared(start, linear, drift, log_likelihood, num_particles=num_particles, noise_dim=1)
    return guided_rao_blackwell(inner, lambda particles, log_weights, y: Guidance(y, jnp.eye(1) / 0.16))


@pytest.mark.system
@pytest.mark.parametrize("make", [layered, lambda: looked_at(40)], ids=["layered", "guided"])
def test_filters_that_move_or_resample_in_their_update_keep_their_lineages(make):
    _, (found, history) = run(fixed_lag(make(), LAG), KEY, jnp.asarray(YS, jnp.float32), collect=any_window_and_history)
    np.testing.assert_array_equal(found[-1], trajectories(history)[-1 - LAG])


@pytest.mark.system
def test_delayed_particles_of_a_guided_filter_have_the_mean_of_the_kalman_smoother():
    F, Q, H = np.array([[1, 0.3], [0, 0.9]]), np.diag([0.1, 0.2]), np.array([[1.0, 0]])
    model = extended_kalman(
        Gaussian(jnp.zeros(2), jnp.eye(2)), lambda x, u: F @ x, jnp.asarray(Q), lambda x: H @ x, 0.16 * jnp.eye(1)
    )
    ys = jnp.asarray(YS, jnp.float32)
    exact = filter_and_smooth(model, KEY, ys)[0].mean[-1 - LAG, 0]

    def delayed_mean(key):
        state, _ = run(fixed_lag(looked_at(400), LAG), key, ys)
        return weights.mean(state.delayed[0], state.inner.ensemble.log_weights)

    found = jax.lax.map(delayed_mean, jax.random.split(KEY, 100))
    # 4 standard errors; the bias of weighted means, of the order of the variance of one, is far below that.
    assert abs(found.mean() - exact) < 4 * found.std(ddof=1) / 10
    assert found.std(ddof=1) < 0.1


def test_what_does_not_fit_is_rejected():
    gaussian = extended_kalman(Gaussian(jnp.zeros(2), jnp.eye(2)), transition, jnp.eye(2), observe, jnp.eye(1))
    pf = bootstrap(sample_prior, move, log_likelihood, num_particles=3, noise=StandardNormal(1))
    with pytest.raises(ValueError, match="lag must be an integer of at least 1; got 0"):
        fixed_lag(pf, 0)
    averaged = bootstrap(sample_prior, move, log_likelihood, num_particles=3, scheme=transport(0.5))
    with pytest.raises(ValueError, match="inner must choose ancestors"):
        fixed_lag(averaged, 2)
    with pytest.raises(ValueError, match="inner must be made by kalman or extended_kalman"):
        fixed_lag_rts(pf, 2)
    with pytest.raises(ValueError, match="inner must have particles"):
        run(fixed_lag(gaussian, 2), KEY, jnp.asarray(YS))
    with pytest.raises(ValueError, match="inputs of fixed_lag_rts"):
        run(fixed_lag_rts(gaussian, 2), KEY, jnp.asarray(YS, jnp.float32), jnp.asarray(CONTROLS, jnp.float32))
    assert isinstance(fixed_lag_rts(gaussian, 2), Filter)
