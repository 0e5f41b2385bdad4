"""What a detector misplaces, as a Gaussian of the offset: against SciPy's density and the conditional mean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters.models.face import person_prior
from jaxfilters.models.face.misplacement import misplacement
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.trackers.io.face_models import default_face_model

OFFSET_STD = 0.7


@pytest.fixture(scope="module")
def drawn():
    """Mean, covariance and an offset of four landmarks."""
    rng = np.random.default_rng(0)
    root = rng.normal(0, 1, (12, 12))
    return rng.normal(0, 2, (4, 3)), root @ root.T, rng.normal(0, 2, (4, 3))


def of_offset(offset, prior, size):
    person = Person(jnp.zeros(1), jnp.asarray(offset))
    return np.asarray(person_prior._of_offset(person, jnp.asarray(size), prior), float).ravel()


def test_residuals_are_those_of_the_gaussian_whatever_the_size(drawn):
    mean, covariance, offset = drawn
    prior = Prior(1.0, OFFSET_STD, misplaced=misplacement(mean, covariance, OFFSET_STD))
    total = covariance + OFFSET_STD**2 * np.eye(12)
    at_mean = of_offset(1.1 * mean, prior, 1.1)
    np.testing.assert_allclose(at_mean, 0, atol=1e-4)
    of_one = multivariate_normal(1.1 * mean.ravel(), 1.21 * total)
    energy = of_one.logpdf(1.1 * mean.ravel()) - of_one.logpdf(offset.ravel())
    np.testing.assert_allclose(0.5 * np.sum(np.square(of_offset(offset, prior, 1.1))), energy, rtol=1e-4)
    np.testing.assert_allclose(prior.offset_deviations.ravel() ** 2, np.diagonal(total), rtol=1e-5)


def test_what_is_the_face_s_own_is_the_conditional_mean(drawn):
    mean, covariance, offset = drawn
    prior = Prior(1.0, OFFSET_STD, misplaced=misplacement(mean, covariance, OFFSET_STD))
    total = covariance + OFFSET_STD**2 * np.eye(12)
    expected = OFFSET_STD**2 * np.linalg.solve(total, (offset - mean).ravel()).reshape(4, 3)
    own = person_prior.own_offset(Person(jnp.zeros(1), jnp.asarray(offset)), prior)
    np.testing.assert_allclose(own, expected, rtol=1e-3, atol=1e-5)
    whole = person_prior.own_offset(Person(jnp.zeros(1), jnp.asarray(offset)), Prior(1.0, OFFSET_STD))
    np.testing.assert_allclose(whole, offset, rtol=1e-6)


def test_a_known_distance_of_the_eyes_is_that_of_the_face_not_of_what_the_detector_finds():
    """Conditioned by hand: the distance that the face has, given the offset, is a Gaussian that the known one meets."""
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        face = default_face_model().model
        root = 0.3 * rng.normal(0, 1, (30, 30))
        mean, covariance = np.zeros((10, 3)), root @ root.T
        mean[:, 0] = 3.0 * np.sign(np.asarray(face.mean)[:, 0])
        beside = misplacement(mean, covariance, OFFSET_STD)
        prior = Prior(1.0, OFFSET_STD, 63.0, 1.0, misplaced=beside)
        offset = mean + rng.normal(0, 0.5, (10, 3))
        person = Person(face.identity_mean, jnp.asarray(offset))
        gain = OFFSET_STD**2 * np.linalg.inv(covariance + OFFSET_STD**2 * np.eye(30))
        own = (gain @ (offset - mean).ravel()).reshape(10, 3)
        left_over = OFFSET_STD**2 * (np.eye(30) - gain)
        across = np.zeros((10, 3))
        across[:4, 0] = -0.5, -0.5, 0.5, 0.5
        variance = 1.0 + across.ravel() @ left_over @ across.ravel()
        apart = float(person_prior.eyes_apart(face, Person(face.identity_mean, jnp.asarray(own))))
        found = person_prior.residuals(face, person, face.expression_mean[None], prior)[-1]
        # The direction between the eyes is that of the x axis to a degree.
        np.testing.assert_allclose(found, (apart - 63.0) / np.sqrt(variance), rtol=1e-6)
        exact = person_prior.residuals(face, person, face.expression_mean[None], prior._replace(misplaced=None))[-1]
        np.testing.assert_allclose(exact, float(person_prior.eyes_apart(face, person)) - 63.0, rtol=1e-6)


def test_a_covariance_without_a_root_is_refused():
    with pytest.raises(ValueError, match="positive definite once offset_std"):
        misplacement(np.zeros((1, 3)), -np.eye(3), 0.5)
