"""People who may come back: what is known of them, and the models that stand for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.gallery import hypotheses, joined, remember
from jaxfilters.models.face.multilinear import learn, shape, shape_tensor
from jaxfilters.models.face.multilinear_fit import MEASURED_MM, likeliest
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

NUM_PEOPLE = 30


@pytest.fixture(scope="module")
def taught():
    """A model with its training faces, in double precision."""
    with jax.enable_x64(True):
        shapes = generator_shapes(jax.random.key(1), people_of(jax.random.key(0), NUM_PEOPLE))
        return learn(shapes, identities=8, expressions=4), shapes


@pytest.mark.system
def test_the_covariance_is_what_the_estimates_scatter_by(x64, taught):
    """200 people of the model with four expressions each, and noise of `MEASURED_MM`.

    Squared Mahalanobis distances have a chi-square distribution with 8 degrees of freedom: their mean over 200 has a
    standard deviation of 4 / sqrt(200) = .28, five of which are allowed: one in a million. The model is bilinear, so
    Laplace's approximation is one; a factor of two in the covariance would be 4 to 8 off.
    """
    face, _ = taught
    rng = np.random.default_rng(0)
    roots = [np.linalg.cholesky(np.asarray(c)) for c in (face.identity_covariance, face.expression_covariance)]
    who = np.asarray(face.identity_mean) + rng.normal(size=(200, 8)) @ roots[0].T
    how = np.asarray(face.expression_mean) + rng.normal(size=(200, 4, 4)) @ roots[1].T
    shapes = jax.vmap(lambda s, a: jax.vmap(lambda one: shape(face, s, one))(a))(jnp.asarray(who), jnp.asarray(how))
    shapes = shapes + MEASURED_MM * rng.normal(size=shapes.shape)
    fit, covariance, left_over = jax.lax.map(lambda own: likeliest(face, own), shapes)
    apart = np.asarray(fit.identity) - who
    distance = np.einsum("ni,ni->n", apart, np.linalg.solve(np.asarray(covariance), apart[..., None])[..., 0])
    assert distance.mean() == pytest.approx(8.0, abs=5 * 4 / np.sqrt(200))
    assert np.all(np.asarray(fit.log_size) == 0)
    # Noise of four faces, less what eight parameters of one person and sixteen of four take up of 120 numbers.
    assert np.sqrt(np.mean(np.square(left_over))) < 0.6 * MEASURED_MM


@pytest.mark.system
def test_a_training_person_is_known_within_the_training_noise(x64, taught):
    """Its mean face, from identity and offset with the mean expression of the training set."""
    face, shapes = taught
    known = remember(face, shapes[:5])
    assert jax.tree.map(jnp.shape, known) == ((5, 8), (5, 8, 8), (5, 10, 3))
    std = np.sqrt(np.diagonal(known.covariance, axis1=1, axis2=2))
    # The first parameter is nearly the same for everybody, and with it the expressions of one person are scaled.
    assert np.all(std[:, 1:] < 0.25 * np.asarray(face.identity_std)[1:])
    halves = np.asarray(shape_tensor(shapes)).reshape(10, 3, 2, NUM_PEOPLE, -1).mean(axis=2)
    for i, (identity, offset) in enumerate(zip(known.identity, known.offset, strict=True)):
        basis = np.asarray(jnp.einsum("kdsa,s->kda", face.tensor, identity)).reshape(30, -1)
        target = (halves[:, :, i] - np.asarray(face.mean + offset)[..., None]).reshape(30, -1)
        missing = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
        # Half a millimetre of noise, halved in power by symmetry, and what four of ten expressions cannot form.
        assert np.sqrt(np.mean(missing**2)) < 0.6


@pytest.mark.system
def test_hypotheses_are_the_model_and_one_of_each_person(x64, taught):
    face, shapes = taught
    known = remember(face, shapes[:3])
    stacked = hypotheses(face, joined(known, jax.tree.map(lambda leaf: leaf[:1], known)))
    assert stacked.identity_mean.shape == (5, 8)
    np.testing.assert_array_equal(stacked.mean[0], face.mean)
    np.testing.assert_array_equal(stacked.identity_covariance[0], face.identity_covariance)
    np.testing.assert_array_equal(stacked.identity_mean[1:], known.identity[np.array([0, 1, 2, 0])])
    np.testing.assert_allclose(stacked.mean[2] - face.mean, known.offset[1], atol=1e-5)
    np.testing.assert_array_equal(stacked.tensor[4], face.tensor)


def test_faces_of_other_landmarks_or_without_numbers_are_refused(x64, taught):
    face, shapes = taught
    with pytest.raises(ValueError, match=r"shapes must be \(P, A, 10, 3\), as the model's; got \(2, 10, 6, 3\)"):
        remember(face, shapes[:2, :, :6])
    with pytest.raises(ValueError, match="shapes must be finite"):
        remember(face, shapes[:2].at[0, 0, 0].set(jnp.nan))
