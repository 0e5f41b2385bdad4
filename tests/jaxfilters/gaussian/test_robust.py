import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jaxfilters import log_evidence, run, update
from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, extended_kalman
from jaxfilters.gaussian.robust import robust

KEY = jax.random.key(0)
PRIOR = Gaussian(jnp.array([0.5]), jnp.array([[2.0]]))


def still(x, inputs):
    del inputs
    return x


def itself(x):
    return x


def filter_of(noise=0.3, share=0.1, wild=20.0, prior=PRIOR, drift=0.0):
    inner = extended_kalman(prior, still, jnp.array([[drift]]), itself, jnp.array([[noise]]))
    return robust(inner, share, jnp.array([[wild]]))


@pytest.mark.parametrize("y", [0.7, 3.0, 9.0])
def test_the_posterior_has_the_moments_of_bayes_rule(y):
    belief, info = update(filter_of(), KEY, PRIOR, jnp.array([y]))
    x = np.linspace(-30, 30, 200_001)
    likelihood = 0.9 * norm.pdf(y, x, np.sqrt(0.3)) + 0.1 * norm.pdf(y, x, np.sqrt(20.0))
    joint = norm.pdf(x, 0.5, np.sqrt(2.0)) * likelihood
    evidence = np.trapezoid(joint, x)
    mean = np.trapezoid(x * joint, x) / evidence
    variance = np.trapezoid((x - mean) ** 2 * joint, x) / evidence
    np.testing.assert_allclose(info.log_evidence, np.log(evidence), atol=2e-6, rtol=2e-6)
    np.testing.assert_allclose([belief.mean[0], belief.covariance[0, 0]], [mean, variance], rtol=2e-5)


def test_a_wild_observation_is_hardly_believed_and_a_good_one_is():
    near, far = (update(filter_of(), KEY, PRIOR, jnp.array([y]))[1].inlier_probability for y in (0.6, 12.0))
    assert near > 0.95
    assert far < 0.01


def test_nothing_seen_changes_nothing():
    unseen = Observation(jnp.array([3.0]), jnp.array([False]))
    belief, info = update(filter_of(), KEY, PRIOR, unseen)
    np.testing.assert_allclose([belief.mean[0], belief.covariance[0, 0]], [0.5, 2.0], rtol=1e-6)
    np.testing.assert_allclose([info.log_evidence, info.inlier_probability], [0.0, 0.9], atol=1e-6)


def test_one_noise_is_the_filter_inside():
    ys = jnp.array([[0.1], [0.4], [-0.3]])
    both = run(filter_of(noise=0.3, wild=0.3), KEY, ys)[0]
    inner = run(filter_of().params.inner, KEY, ys)[0]
    np.testing.assert_allclose(both.mean, inner.mean, rtol=1e-6)
    np.testing.assert_allclose(both.covariance, inner.covariance, rtol=1e-6)


def test_it_comes_back_after_it_went_astray():
    sure = Gaussian(jnp.array([0.0]), jnp.array([[1e-3]]))
    final, _ = run(filter_of(prior=sure, drift=0.05), KEY, jnp.full((60, 1), 8.0))
    np.testing.assert_allclose(final.mean, 8.0, atol=0.3)


@pytest.mark.system
def test_the_share_of_outliers_is_learnt_by_gradient():
    def evidence(share):
        prior = Gaussian(jnp.array([0.5]), jnp.array([[2.0]]))
        return log_evidence(filter_of(share=share, prior=prior), KEY, ys)

    with jax.enable_x64(True):
        ys = jnp.array([[0.1], [0.4], [9.0], [-0.3]])
        gradient = jax.grad(evidence)(0.2)
        difference = (evidence(0.2 + 1e-5) - evidence(0.2 - 1e-5)) / 2e-5
    np.testing.assert_allclose(gradient, difference, rtol=1e-8)


def test_what_does_not_fit_is_refused():
    root = GaussianRoot(PRIOR.mean, jnp.ones((1, 1)))
    rooted = extended_kalman(root, still, jnp.ones((1, 1)), itself, jnp.ones((1, 1)), arithmetic=arithmetic.square_root)
    with pytest.raises(ValueError, match="prior; its prior is a GaussianRoot"):
        robust(rooted, 0.1, jnp.eye(1))
    with pytest.raises(ValueError, match="outlier_noise"):
        robust(filter_of().params.inner, 0.1, jnp.eye(2))


def test_a_frame_that_no_noise_explains_leaves_the_prediction():
    """The observation of a model whose function is no number in one frame: the next frame is as after a gap."""
    prior, noise = Gaussian(jnp.zeros(1), jnp.eye(1)), 0.1 * jnp.eye(1)
    broken = lambda x, inputs: jnp.where(inputs > 0, x, jnp.nan)
    inner = extended_kalman(prior, still, noise, broken, noise)
    filter = robust(inner, outlier_probability=0.1, outlier_noise=jnp.eye(1))
    y, inputs = jnp.array([[0.5], [0.6], [0.7]]), jnp.array([1.0, 0.0, 1.0])
    _, (beliefs, infos) = run(filter, jax.random.key(0), y, inputs)
    assert np.isfinite(beliefs.mean).all()
    assert np.isneginf(infos.log_evidence[1])
    _, (expected, _) = run(filter, jax.random.key(0), y, jnp.ones(3), mask=jnp.array([True, False, True]))
    np.testing.assert_allclose(beliefs.mean[2], expected.mean[2], rtol=1e-5)
