"""Random faces of ten landmarks, against the numbers of the specification worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import MEAN_SHAPE, MIRROR
from jaxfilters.models.synthetic.face import Identity, face_shape, make_identity

MANY = 4000


def mean_person():
    return Identity(jnp.asarray(MEAN_SHAPE), jnp.ones(2), jnp.zeros(2))


@pytest.fixture(scope="module")
def people():
    return jax.vmap(make_identity)(jax.random.split(jax.random.key(0), MANY))


@pytest.mark.system
def test_people_are_centred_on_their_landmarks(people):
    np.testing.assert_allclose(people.neutral.mean(axis=1), 0, atol=1e-4)


def test_people_vary_around_the_mean_face(people):
    """Mean within 4 standard errors; the largest deviation of a coordinate is below 4 mm."""
    error = np.asarray(people.neutral, float).mean(axis=0) - MEAN_SHAPE
    assert np.abs(error).max() < 4 * 4.0 / np.sqrt(MANY)


def test_distances_vary_as_their_modes_add_up(people):
    """Standard deviations within 4 of their own, std / sqrt(2 n): width of eyes and mouth, height of nostrils."""
    x, y, z = np.moveaxis(np.asarray(people.neutral, float), -1, 0)
    pair = 2 * 0.7**2
    expected = {
        "outer eyes": (x[:, 3] - x[:, 0], (90 * 0.035) ** 2 + 3.6**2 + 3.0**2 + pair),
        "inner eyes": (x[:, 2] - x[:, 1], (34 * 0.035) ** 2 + 3.6**2 + pair),
        "mouth": (x[:, 5] - x[:, 4], (50 * 0.035) ** 2 + 4.4**2 + pair),
        "nostrils": (x[:, 7] - x[:, 6], (18 * 0.035) ** 2 + 2.0**2 + pair),
        "brows": (x[:, 9] - x[:, 8], (26 * 0.035) ** 2 + 3.0**2 + pair),
        "nostril below eye": (y[:, 6] - y[:, 1], (45 * 0.04) ** 2 + 2.0**2 + pair),
        "brow above eye": (y[:, 8] - y[:, 1], (21 * 0.04) ** 2 + 2.0**2 + pair),
        "nose length": (z[:, 6] - z[:, 1], 1.8**2 + pair),
        "mouth depth": (z[:, 4] - z[:, 1], 2.0**2 + pair),
        "outer eye depth": (z[:, 0] - z[:, 1], 1.5**2 + pair),
    }
    for name, (distance, variance) in expected.items():
        ratio = distance.std() / np.sqrt(variance)
        assert abs(ratio - 1) < 4 / np.sqrt(2 * MANY), name


def test_gains_are_log_normal_and_curvatures_standard_normal(people):
    for values, std in ((np.log(people.gains), 0.15), (np.asarray(people.curvatures), 1.0)):
        assert np.abs(values.mean(axis=0)).max() < 4 * std / np.sqrt(MANY)
        assert np.abs(values.std(axis=0) / std - 1).max() < 4 / np.sqrt(2 * MANY)


@pytest.mark.system
def test_a_face_without_expression_is_neutral():
    person = make_identity(jax.random.key(3))
    np.testing.assert_array_equal(face_shape(person, 0.0, 0.0), person.neutral)


def test_a_wide_mouth_moves_by_the_printed_amounts():
    """a = 0.6: mouth (sg 7.2, -3.84, 3), nostrils sg 0.72 outwards; nothing else."""
    step = np.asarray(face_shape(mean_person(), 0.6, 0.0)) - MEAN_SHAPE
    expected = np.zeros((10, 3))
    expected[4], expected[5] = (-7.2, -3.84, 3.0), (7.2, -3.84, 3.0)
    expected[6, 0], expected[7, 0] = -0.72, 0.72
    np.testing.assert_allclose(step, expected, atol=1e-5)


def test_an_open_mouth_moves_by_the_printed_amounts():
    """b = 0.7: mouth (-sg 2.8, 11.27, 2.1), nostrils 1.05 down, brows (sg 0.7, -9.17), outer eyes 0.56 up."""
    step = np.asarray(face_shape(mean_person(), 0.0, 0.7)) - MEAN_SHAPE
    expected = np.zeros((10, 3))
    expected[4], expected[5] = (2.8, 11.27, 2.1), (-2.8, 11.27, 2.1)
    expected[6:8, 1], expected[[0, 3], 1] = 1.05, -0.56
    expected[8], expected[9] = (-0.7, -9.17, 0), (0.7, -9.17, 0)
    np.testing.assert_allclose(step, expected, atol=1e-5)


def test_gains_and_curvatures_act_on_their_expression():
    """g = (1.2, 0.8), q = (1, -1): e1 = 0.5 gives 9 - 5 1.3 0.36 at the mouth; e2 = 0.5 gives 5.6 + 3 0.7 0.16."""
    person = Identity(jnp.asarray(MEAN_SHAPE), jnp.array([1.2, 0.8]), jnp.array([1.0, -1.0]))
    wide, opened = (np.asarray(face_shape(person, *e)) - MEAN_SHAPE for e in ((0.5, 0.0), (0.0, 0.5)))
    assert wide[5, 0] == pytest.approx(9 - 6.5 * 0.36, abs=1e-5)
    assert opened[5, 1] == pytest.approx(5.6 + 2.1 * 0.16, abs=1e-5)


def test_expressions_of_the_mean_person_are_symmetric():
    shape = np.asarray(face_shape(mean_person(), 0.4, 0.5))
    np.testing.assert_allclose(shape[list(MIRROR)] * [-1, 1, 1], shape, atol=1e-5)
