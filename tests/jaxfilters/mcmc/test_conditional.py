"""Conditional resampling against the exact law of its unconditional scheme; conditional SMC against the smoother."""

import itertools
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilters as jf

A, Q, R, COUNT = 0.8, 0.7, 0.5, 4
YS = jnp.array([0.3, -0.9, -1.4, 0.8])
WEIGHTS = np.array([0.45, 0.05, 0.2, 0.3])
normal = jax.scipy.stats.norm.logpdf


def law_of_systematic(weights):
    """Probability of each list of ancestors: a grid with a uniform offset, and the places rotated uniformly."""
    n, ends = len(weights), np.cumsum(weights)
    borders = np.unique(np.concatenate([[0.0, 1.0], (ends * n) % 1]))
    law = Counter()
    for low, high in itertools.pairwise(borders):
        ancestors = np.searchsorted(ends, (np.arange(n) + (low + high) / 2) / n)
        for turn in range(n):
            law[tuple(np.roll(ancestors, turn))] += (high - low) / n
    return law


def law_of_multinomial(weights):
    lists = itertools.product(range(len(weights)), repeat=len(weights))
    return Counter({ancestors: np.prod(weights[list(ancestors)]) for ancestors in lists})


@pytest.mark.parametrize(
    ("scheme", "law"),
    [
        (jf.mcmc.conditional_systematic, law_of_systematic(WEIGHTS)),
        (jf.mcmc.conditional_multinomial, law_of_multinomial(WEIGHTS)),
    ],
)
def test_conditional_schemes_have_the_law_of_the_unconditional_one(scheme, law):
    """A parent by its weight, then the others: chi-square tests, whose false alarms have a probability of 1e-4."""

    def one(key):
        parent_key, key = jax.random.split(key)
        log_weights = jnp.log(jnp.asarray(WEIGHTS, jnp.float32))
        return scheme(key, log_weights, jax.random.categorical(parent_key, log_weights))

    drawn = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 8_000)))
    # The order of the others does not matter to multinomial draws; that of systematic ones does.
    ordered = scheme is jf.mcmc.conditional_systematic
    as_cell = (lambda a: tuple(a)) if ordered else (lambda a: (a[0], *sorted(a[1:])))
    found, expected = Counter(map(as_cell, drawn.tolist())), Counter()
    for ancestors, probability in law.items():
        expected[as_cell(tuple(map(int, ancestors)))] += probability * len(drawn)
    assert set(found) <= set(expected)
    often = [cell for cell, number in expected.items() if number > 5]
    observed = [found[cell] for cell in often]
    observed.append(len(drawn) - sum(observed))
    numbers = [expected[cell] for cell in often]
    numbers.append(len(drawn) - sum(numbers))
    if numbers[-1] < 5:
        observed, numbers = observed[:-1], np.array(numbers[:-1]) * sum(observed[:-1]) / sum(numbers[:-1])
    assert stats.chisquare(observed, numbers).pvalue > 1e-4


def smoother_of_textbook():
    """Mean and variance of every state, x_0 first, as parts of one Gaussian vector conditioned on the observations."""
    rows, columns = np.mgrid[0 : len(YS) + 1, 0 : len(YS) + 1]
    powers = np.where(columns <= rows, A ** np.clip(rows - columns, 0, None).astype(float), 0.0)
    L = powers * np.where(columns == 0, 1.0, Q)
    S = L @ L.T
    K = S[:, 1:] @ np.linalg.inv(S[1:, 1:] + R**2 * np.eye(len(YS)))
    return K @ np.asarray(YS, float), np.diag(S - K @ S[1:])


def filter_of():
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
    move, likelihood = lambda e, x: A * x + Q * e, lambda x, y: normal(y, x[0], R)
    return jf.bootstrap(prior, move, likelihood, num_particles=COUNT, noise=jf.StandardNormal(1))


def log_transition(after, x):
    return normal(after[0], A * x[0], Q)


@pytest.mark.system
@pytest.mark.parametrize(
    ("redraw", "scheme"),
    [
        (jf.mcmc.ancestral(), jf.mcmc.conditional_systematic),
        (jf.mcmc.ancestor_sampling(log_transition), jf.mcmc.conditional_systematic),
        (jf.mcmc.backward_sampling(log_transition), jf.mcmc.conditional_systematic),
        (jf.mcmc.ancestor_sampling(log_transition), jf.mcmc.conditional_multinomial),
    ],
    ids=["ancestral", "ancestor sampling", "backward sampling", "ancestor sampling, multinomial"],
)
def test_trajectories_have_the_marginals_of_the_smoother(redraw, scheme):
    """With 4 particles; over 200 chains, at four standard errors: a false alarm of any of 10 numbers has 6e-4."""
    kernel = jf.mcmc.conditional_smc(filter_of(), redraw, scheme=scheme)
    mean, variance = smoother_of_textbook()

    def chain(key):
        path, _ = jf.mcmc.initial_path(key, kernel, YS)

        def sweep(path, key):
            path, info = jf.mcmc.update_path(key, kernel, path, YS)
            return path, (path[:, 0], info)

        return jax.lax.scan(sweep, path, jax.random.split(key, 200))[1]

    paths, info = jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(0), 200))
    paths = np.asarray(paths, float)[:, 50:]
    for found, expected in ((paths.mean(1), mean), (((paths - mean) ** 2).mean(1), variance)):
        assert (abs(found.mean(0) - expected) < 4 * found.std(0, ddof=1) / np.sqrt(len(found))).all()
    assert not np.asarray(info.num_invalid).any()
    assert not np.asarray(info.num_impossible).any()
    # Trajectories by ancestry rarely change their beginning; the others do in a third of all sweeps, at least.
    rate = np.asarray(info.changed).mean((0, 1))
    assert rate[0] < 0.2 if isinstance(redraw, type(jf.mcmc.ancestral())) else rate.min() > 0.3


@pytest.mark.system
def test_frames_without_observations_and_inputs_reach_the_model():
    """One frame is not observed, and holds NaN; the inputs are known steps of the state, and scale the noise."""
    move = lambda e, x, inputs: A * x + inputs + Q * e[0]
    likelihood = lambda x, y, inputs: normal(y, x, R + 0 * inputs)
    filter = jf.bootstrap(lambda key: 0.0, move, likelihood, num_particles=200, noise=jf.StandardNormal(1))
    kernel = jf.mcmc.conditional_smc(
        filter, jf.mcmc.backward_sampling(lambda after, x, inputs: normal(after, A * x + inputs, Q))
    )
    inputs, mask = jnp.array([0.0, 50.0, 0.0]), jnp.array([True, False, True])
    data = jnp.array([0.0, jnp.nan, 40.0]), inputs
    path, info = jf.mcmc.initial_path(jax.random.key(0), kernel, *data, mask=mask)
    path, info = jf.mcmc.update_path(jax.random.key(1), kernel, path, *data, mask=mask)
    assert int(info.num_invalid) == 0
    np.testing.assert_allclose(path, [0.0, 0.0, 50.0, 40.0], atol=4.0)


@pytest.mark.system
def test_a_transition_that_cannot_have_led_here_is_announced():
    kernel = jf.mcmc.conditional_smc(filter_of(), jf.mcmc.ancestor_sampling(lambda after, x: -jnp.inf + x[0]))
    path, _ = jf.mcmc.initial_path(jax.random.key(0), kernel, YS)
    _, info = jf.mcmc.update_path(jax.random.key(1), kernel, path, YS)
    assert int(info.num_impossible) == len(YS)
