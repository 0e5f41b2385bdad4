import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from jaxfilters import weights
from jaxfilters.filter import run
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.smoothing import History, backward_sampling, keep_history, trajectories

RATE, PROCESS_STD, NOISE_STD = 0.9, 0.5, 0.4
KEY = jax.random.key(3)
LENGTH = 12


def sample_prior(key):
    return jax.random.normal(key)


def move(noise, x, inputs):
    return RATE * x + inputs + PROCESS_STD * noise[0]


def log_likelihood(x, y):
    return norm.logpdf(y, x, NOISE_STD)


def log_transition(x_next, x, inputs):
    return norm.logpdf(x_next, RATE * x + inputs, PROCESS_STD)


def simulate(seed):
    rng = np.random.default_rng(seed)
    x, ys = rng.normal(), []
    inputs = rng.normal(size=LENGTH)
    for push in inputs:
        x = RATE * x + push + PROCESS_STD * rng.normal()
        ys.append(x + NOISE_STD * rng.normal())
    return jnp.asarray(ys, jnp.float32), jnp.asarray(inputs, jnp.float32)


def joint_posterior(ys, inputs):
    """Of all states, from their joint Gaussian."""
    carry = np.tril(RATE ** np.subtract.outer(np.arange(LENGTH), np.arange(LENGTH)).astype(float))
    mean = carry @ inputs
    start = RATE ** np.arange(1, LENGTH + 1)
    P = np.outer(start, start) + PROCESS_STD**2 * carry @ carry.T
    gain = P @ np.linalg.inv(P + NOISE_STD**2 * np.eye(LENGTH))
    return mean + gain @ (ys - mean), P - gain @ P


def filtered(key, num_particles, ys, inputs):
    pf = bootstrap(sample_prior, move, log_likelihood, num_particles=num_particles, noise=StandardNormal(1))
    return run(pf, key, ys, inputs, collect=keep_history)[1]


@pytest.mark.system
def test_both_smoothers_agree_with_the_joint_gaussian():
    # Means over independent runs; their bias, O(1/N), is far below four standard errors of the mean.
    ys, inputs = simulate(0)
    mean, covariance = joint_posterior(np.asarray(ys, float), np.asarray(inputs, float))

    @jax.jit
    @jax.vmap
    def smoothed(key):
        filter_key, path_key = jax.random.split(key)
        history = filtered(filter_key, 200, ys, inputs)
        paths = backward_sampling(path_key, history, log_transition, inputs, num_paths=100)
        traced = weights.mean(trajectories(history), history.log_weights[-1])
        # The covariance of neighbours is that of whole paths, not of frames.
        neighbours = jnp.mean(paths[1:] * paths[:-1], axis=-1)
        return traced, jnp.mean(paths, axis=-1), neighbours

    found = [np.asarray(leaf, float) for leaf in smoothed(jax.random.split(KEY, 200))]
    products = np.diagonal(covariance, 1) + mean[1:] * mean[:-1]
    for estimates, exact in zip(found, (mean, mean, products), strict=True):
        z = (estimates.mean(axis=0) - exact) / (estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates)))
        assert abs(z).max() < 4
    # What backward simulation is for: early means are less noisy than those of the few lineages.
    assert found[1][:, 0].std() < 0.8 * found[0][:, 0].std()


def test_lineages_follow_the_ancestors():
    particles = {"x": jnp.arange(9.0).reshape(3, 3), "v": 10 * jnp.arange(18.0).reshape(3, 2, 3)}
    ancestors = jnp.array([[0, 1, 2], [2, 2, 0], [1, 0, 2]], jnp.int32)
    found = trajectories(History(particles, jnp.zeros((3, 3)), ancestors))
    np.testing.assert_array_equal(found["x"], [[2, 2, 0], [4, 3, 5], [6, 7, 8]])
    np.testing.assert_array_equal(found["v"][0], [[20, 20, 0], [50, 50, 30]])


def test_what_is_impossible_is_not_drawn():
    # Two islands between which nothing moves, and a particle without weight.
    particles = jnp.tile(jnp.array([0.0, 1.0, 10.0, 11.0]), (3, 1))
    log_weights = jnp.log(jnp.array([[0.1, 0.2, 0.7, 0.0], [0.3, 0.0, 0.3, 0.4], [0.5, 0.0, 0.5, 0.0]]))
    history = History(particles, log_weights, jnp.tile(jnp.arange(4, dtype=jnp.int32), (3, 1)))

    def near(x_next, x, inputs):
        del inputs
        return jnp.where(abs(x_next - x) < 5, 0.0, -jnp.inf)

    paths = np.asarray(backward_sampling(KEY, history, near, num_paths=4000))
    assert ((paths < 5).all(axis=0) | (paths > 5).all(axis=0)).all()
    assert not np.isin(paths[1], 1).any()
    assert not np.isin(paths[2], [1, 11]).any()
    # On the lower island, of which half of the paths are, the first particle has a third of the weight.
    lower = paths[:, paths[2] == 0]
    assert abs(lower.shape[1] - 2000) < 4 * np.sqrt(4000 / 4)
    assert abs((lower[0] == 0).mean() - 1 / 3) < 4 * np.sqrt(2 / 9 / lower.shape[1])


def test_wrong_arguments_are_rejected():
    history = History(jnp.zeros((3, 2)), jnp.zeros((3, 2)), jnp.zeros((3, 2), jnp.int32))
    with pytest.raises(ValueError, match="num_paths must be an integer of at least 1; got 0"):
        backward_sampling(KEY, history, log_transition, num_paths=0)
    with pytest.raises(ValueError, match="inputs must have as many frames as history, 3; got"):
        backward_sampling(KEY, history, log_transition, jnp.zeros(2), num_paths=5)
