"""`run`, `step` and masks, on a small linear-Gaussian particle filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters.filter import Filter, init, keep_all, log_evidence, predict, run, step
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap

TRACES = []


def sample_prior(key):
    return jax.random.normal(key, (2,))


def sample_transition(noise, x, inputs):
    dt = 0.1 if inputs is None else inputs
    return jnp.array([x[0] + dt * x[1], x[1]]) + 0.1 * noise


def log_likelihood(x, y):
    TRACES.append(1)
    return norm.logpdf(y, x[0], 0.3)


def make_filter(num_particles=64):
    return bootstrap(
        sample_prior, sample_transition, log_likelihood, num_particles=num_particles, noise=StandardNormal(2)
    )


def keep_mean(state, info):
    return state.particles.mean(-1), info


OBSERVATIONS = jnp.sin(jnp.arange(12) * 0.3)
KEY = jax.random.key(3)


def test_five_steps_trace_the_model_once():
    pf = make_filter(65)
    state = init(pf, KEY)
    TRACES.clear()
    for y in OBSERVATIONS[:5]:
        state, _ = step(pf, KEY, state, y)
    assert len(TRACES) == 1


def test_a_filter_built_again_from_the_same_functions_compiles_nothing():
    run(make_filter(66), KEY, OBSERVATIONS, collect=keep_mean)
    TRACES.clear()
    run(make_filter(66), KEY, OBSERVATIONS + 1, collect=keep_mean)
    assert not TRACES


@pytest.mark.system
def test_scan_equals_a_loop_of_steps():
    pf = make_filter()
    init_key, scan_key = jax.random.split(KEY)
    state = init(pf, init_key)
    for key, y in zip(jax.random.split(scan_key, len(OBSERVATIONS)), OBSERVATIONS, strict=True):
        state, info = step(pf, key, state, y)
    scanned, (_, infos) = run(pf, KEY, OBSERVATIONS, collect=keep_all)
    np.testing.assert_allclose(scanned.particles, state.particles, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(infos.log_evidence[-1], info.log_evidence, rtol=1e-4)


@pytest.mark.system
def test_vmap_over_keys_equals_single_runs():
    pf, keys = make_filter(), jax.random.split(KEY, 3)
    together = jax.vmap(log_evidence, in_axes=(None, 0, None))(pf, keys, OBSERVATIONS)
    alone = [log_evidence(pf, key, OBSERVATIONS) for key in keys]
    np.testing.assert_allclose(together, alone, rtol=1e-5)


@pytest.mark.system
@pytest.mark.parametrize("hidden", [0.0, jnp.nan, jnp.inf])
def test_unseen_frames_change_nothing_whatever_they_hold(hidden):
    pf = make_filter()
    mask = jnp.arange(12) % 3 != 1
    hidden_there = jnp.where(mask, OBSERVATIONS, hidden)

    def evidence(dt, ys):
        return log_evidence(pf, KEY, ys, jnp.full(12, dt), mask=mask)

    value, slope = jax.value_and_grad(evidence)(0.1, hidden_there)
    reference, reference_slope = jax.value_and_grad(evidence)(0.1, OBSERVATIONS)
    assert value == reference
    assert jnp.isfinite(slope)
    np.testing.assert_allclose(slope, reference_slope, rtol=1e-6)


def test_unseen_frame_is_a_prediction_without_an_update():
    pf = make_filter()
    _, (means, infos) = run(pf, KEY, OBSERVATIONS, mask=jnp.arange(12) < 11, collect=keep_mean)
    assert infos.log_evidence[-1] == 0
    assert infos.effective_sample_size[-1] == 0
    assert np.all(infos.effective_sample_size[:-1] > 1)
    assert np.all(np.isfinite(means))


def test_controls_reach_the_transition():
    pf = make_filter()
    slow = run(pf, KEY, OBSERVATIONS, jnp.full(12, 0.01), collect=keep_mean)[1][0]
    fast = run(pf, KEY, OBSERVATIONS, jnp.full(12, 0.5), collect=keep_mean)[1][0]
    assert not np.allclose(slow, fast)
    assert not np.allclose(
        predict(pf, KEY, init(pf, KEY), 0.01).particles, predict(pf, KEY, init(pf, KEY), 0.5).particles
    )


def test_continuing_from_a_state_uses_it():
    pf = make_filter()
    state, _ = run(pf, KEY, OBSERVATIONS)
    moved = state._replace(particles=state.particles + 100.0)
    _, (means, _) = run(pf, KEY, OBSERVATIONS, state=moved, collect=keep_mean)
    assert np.all(means[0] > 50)


@pytest.mark.parametrize(
    ("observations", "inputs", "mask", "named"),
    [
        (jnp.zeros(5), jnp.zeros(4), None, "inputs: 4"),
        (jnp.zeros(5), None, jnp.ones(6, bool), "mask: 6"),
        ({"a": jnp.zeros(5), "b": jnp.zeros((6, 2))}, None, None, r"observations\['b'\]: 6"),
        ((), None, None, "at least one array leaf"),
        (jnp.float32(1.0), None, None, "a scalar"),
    ],
)
def test_lengths_that_disagree_are_named(observations, inputs, mask, named):
    with pytest.raises(ValueError, match=named):
        run(make_filter(), KEY, observations, inputs, mask=mask)


def test_a_filter_is_data():
    leaves, tree = jax.tree.flatten(make_filter())
    assert isinstance(jax.tree.unflatten(tree, leaves), Filter)
    assert jax.tree.structure(make_filter()) == tree
