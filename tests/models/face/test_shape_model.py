"""The linear model of a face's shape."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.shape_model import FaceModel, rigid, shape


def model(num_modes=5):
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.normal(size=(30, num_modes)))
    arrays = (MEAN_SHAPE, basis, rng.uniform(1, 8, num_modes), rng.uniform(0, 255, (2, 10, 16, 16)))
    return FaceModel(*(jnp.asarray(a) for a in arrays))


def test_shapes_are_the_mean_and_a_sum_of_modes(x64):
    face, a = model(), np.array([3.0, -1.0, 0.5, 2.0, -4.0])
    expected = (MEAN_SHAPE.ravel() + np.asarray(face.basis) @ a).reshape(10, 3)
    assert face.num_modes == 5
    np.testing.assert_allclose(shape(face, jnp.asarray(a)), expected, atol=1e-12)


def test_orthonormal_modes_move_the_landmarks_by_the_length_of_their_coefficients(x64):
    face, a = model(), jnp.array([3.0, -1.0, 0.5, 2.0, -4.0])
    np.testing.assert_allclose(jnp.linalg.norm(shape(face, a) - face.mean), jnp.linalg.norm(a), rtol=1e-12)


def test_ensembles_run_along_the_last_axis(x64):
    face, a = model(), np.random.default_rng(1).normal(size=(5, 7))
    shapes = jax.vmap(lambda a: shape(face, a), -1, -1)(jnp.asarray(a))
    np.testing.assert_allclose(shapes[..., 3], shape(face, jnp.asarray(a[:, 3])), atol=1e-12)


def test_a_rigid_face_stays_as_it_is():
    mean, templates = jnp.asarray(MEAN_SHAPE), jnp.zeros((2, 10, 16, 16))
    for num_modes in (0, 5):
        face = rigid(mean, templates, num_modes=num_modes)
        assert face.num_modes == num_modes
        np.testing.assert_array_equal(shape(face, jnp.ones(num_modes)), mean)
