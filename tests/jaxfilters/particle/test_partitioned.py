"""Layered sampling against the closed form of what it draws from when everything is Gaussian."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm
from scipy import stats

from jaxfilters import weights
from jaxfilters.particle.differentiable_resampling import transport
from jaxfilters.particle.partitioned import (
    Partitions,
    consecutive,
    corrected,
    move_one_group,
    partitioned_update,
    uncorrected,
)
from jaxfilters.particle.partitioned import batch_log_likelihood as batched

PARENT_VARIANCE, MOVE_VARIANCE, JITTER_VARIANCE = 0.25, 1.0, 0.0625
OBSERVED = np.array([1.0, 0.5])
TRACES = []


def log_likelihood(x, y):
    TRACES.append(1)
    return norm.logpdf(x, y).sum()


def closed_form(second_likelihood):
    """Mean and variance of each coordinate after both stages, and the evidence of the first.

    Half of the particles had moved in one coordinate, half in the other: two Gaussians. `second_likelihood` says
    how often the observation counts.
    """
    v = PARENT_VARIANCE + MOVE_VARIANCE * np.eye(2)  # a row for each half
    share = 0.5 * stats.norm.pdf(OBSERVED, 0, np.sqrt(v + 1)).prod(1)
    evidence = share.sum()
    m = np.zeros((2, 2))
    if second_likelihood == "twice":
        m, v = m + v / (v + 1) * (OBSERVED - m), v / (v + 1)
    else:
        share = np.array([0.5, 0.5])
    v = v + JITTER_VARIANCE
    share = share * stats.norm.pdf(OBSERVED, m, np.sqrt(v + 1)).prod(1)
    m, v = m + v / (v + 1) * (OBSERVED - m), v / (v + 1)
    share = share / share.sum()
    mean = share @ m
    return mean, share @ (v + m**2) - mean**2, np.log(evidence)


def moved(key, num_particles):
    """Particles that went in one coordinate each."""
    parent_key, move_key = jax.random.split(key)
    parents = np.sqrt(PARENT_VARIANCE) * jax.random.normal(parent_key, (2, num_particles))
    moves = np.sqrt(MOVE_VARIANCE) * jax.random.normal(move_key, (2, num_particles))
    return parents + move_one_group(moves, consecutive(1, 1))


@partial(jax.jit, static_argnums=(2, 3))
def twice(key, particles, log_likelihood, stage_weights=uncorrected):
    n = particles.shape[1]
    ancestors = jnp.arange(n, dtype=jnp.int32)
    jitter = jnp.full(2, np.sqrt(JITTER_VARIANCE))
    even = weights.uniform(n)
    return partitioned_update(key, particles, even, ancestors, log_likelihood, jitter, stage_weights=stage_weights)


@pytest.mark.system
@pytest.mark.parametrize(("stage_weights", "counts"), [(uncorrected, "twice"), (corrected, "once")])
def test_both_stages_give_the_moments_of_their_closed_form(stage_weights, counts):
    mean, variance, log_evidence = closed_form(counts)
    particle_key, update_key = jax.random.split(jax.random.key(0))
    likelihood = batched(log_likelihood)
    particles, log_weights, _, info = twice(
        update_key, moved(particle_key, 400_000), lambda x: likelihood(x, jnp.asarray(OBSERVED)), stage_weights
    )
    # At least 1e5 independent particles; a variance then has a relative standard deviation below sqrt(2 / 1e5), and
    # somewhat more for two Gaussians: 4 sigma are 2.5 %. Resampling in between adds as much noise as one stage.
    assert info.effective_sample_size > 1e5
    np.testing.assert_allclose(weights.mean(particles, log_weights), mean, atol=4 * np.sqrt(2 * 0.5 / 1e5))
    found = np.diagonal(weights.covariance(particles, log_weights))
    np.testing.assert_allclose(found, variance, rtol=0.025)
    assert info.log_evidence == pytest.approx(log_evidence, abs=4 / np.sqrt(1e5))


def test_the_observation_counted_twice_shrinks_the_spread():
    # Section 2.8: 0.34 and 0.29, corrected 0.44 and 0.40, where the posterior of one stage has 0.556.
    as_published, corrected = closed_form("twice")[1], closed_form("once")[1]
    np.testing.assert_allclose(as_published, [0.34, 0.29], atol=0.005)
    np.testing.assert_allclose(corrected, [0.44, 0.40], atol=0.005)


def test_each_particle_moves_move_one_group_and_siblings_take_turns():
    groups = consecutive(2, 1, 3)
    np.testing.assert_array_equal(groups.sum(0), np.ones(6))
    np.testing.assert_array_equal(groups.sum(1), [2, 1, 3])
    displacement = 1 + jax.random.uniform(jax.random.key(0), (6, 10))
    moves = move_one_group(displacement, groups)
    for i in range(10):
        np.testing.assert_array_equal(moves[:, i], np.where(groups[i % 3], displacement[:, i], 0))


@pytest.mark.parametrize("sizes", [(), (3, 0)])
def test_groups_that_cannot_be_are_rejected(sizes):
    with pytest.raises(ValueError, match="sizes of consecutive must be"):
        consecutive(*sizes)


def test_the_likelihood_of_one_particle_serves_all_and_is_traced_once():
    particles, y = jax.random.normal(jax.random.key(1), (2, 5)), jnp.zeros(2)
    value = jax.jit(lambda likelihood, x: likelihood(x, y))
    expected = [log_likelihood(x, y) for x in particles.T]
    np.testing.assert_allclose(value(batched(log_likelihood), particles), expected, rtol=1e-6)
    TRACES.clear()
    value(batched(log_likelihood), particles + 1)
    assert not TRACES


@pytest.mark.system
def test_where_nothing_explains_the_observation_weights_are_even_and_the_evidence_says_so():
    particles = moved(jax.random.key(2), 64)
    calls = []

    def dead_in_the_second_stage(x):
        calls.append(1)
        return jnp.full(64, 0.0 if len(calls) == 1 else -jnp.inf)

    def spoilt(x):
        return jnp.where(jnp.arange(64) < 10, jnp.nan, -jnp.inf)

    for likelihood, num_invalid in ((dead_in_the_second_stage, 0), (spoilt, 20)):
        for stage_weights in (uncorrected, corrected):
            calls.clear()
            after, log_weights, _, info = twice(jax.random.key(3), particles, likelihood, stage_weights)
            assert info.log_evidence == -jnp.inf
            assert info.num_invalid == num_invalid
            np.testing.assert_allclose(log_weights, -np.log(64), rtol=1e-6)
            assert np.all(np.isfinite(after))


@pytest.mark.system
def test_ancestors_lead_back_through_both_resamplings():
    particles = jnp.stack([jnp.arange(8.0), jnp.zeros(8)])
    ancestors = jnp.array([0, 0, 1, 3, 3, 3, 6, 7], dtype=jnp.int32)
    likes_the_fourth = lambda x: jnp.where(abs(x[0] - 3) < 0.5, 0.0, -jnp.inf)
    arguments = (particles, weights.uniform(8), ancestors, likes_the_fourth, jnp.zeros(2))
    after, _, found, _ = partitioned_update(jax.random.key(4), *arguments)
    np.testing.assert_array_equal(found, 3)
    np.testing.assert_array_equal(after[0], 3)


@pytest.mark.system
def test_the_gradient_of_the_evidence_is_that_of_the_closed_form_on_the_drawn_particles(x64):
    particles = moved(jax.random.key(5), 1000)

    def log_evidence(y):
        likelihood = batched(log_likelihood)
        return twice.__wrapped__(jax.random.key(6), particles, lambda x: likelihood(x, y))[3].log_evidence

    def direct(y):
        return jax.scipy.special.logsumexp(norm.logpdf(particles, y[:, None]).sum(0)) - jnp.log(1000)

    y = jnp.asarray(OBSERVED)
    np.testing.assert_allclose(jax.jit(jax.grad(log_evidence))(y), jax.grad(direct)(y), rtol=1e-9)


def test_layers_are_data():
    leaves, tree = jax.tree.flatten(Partitions(consecutive(6, 5)))
    assert len(leaves) == 2
    assert jax.tree.structure(Partitions(consecutive(6, 5))) == tree


def test_transport_is_refused():
    """What it makes are averages, whose likelihoods nobody has evaluated."""
    particles, log_weights = jnp.zeros((1, 4)), jnp.full(4, -np.log(4.0))
    likelihood = lambda x: jnp.zeros(x.shape[1])
    with pytest.raises(ValueError, match="scheme must choose ancestors between the stages"):
        partitioned_update(
            jax.random.key(0), particles, log_weights, jnp.arange(4), likelihood, jnp.ones(1), scheme=transport(0.5)
        )
