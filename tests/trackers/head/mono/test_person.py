"""The face model of one person against the multilinear model that it stands for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.multilinear import MultilinearFace, expression_basis
from jaxfilters.models.face.person_prior import Person, posed_shape
from jaxfilters.models.face.shape_model import shape
from jaxfilters.trackers.head.common.state import NUM_MODES
from jaxfilters.trackers.head.mono.person import model_of

TEMPLATES = np.zeros((1, 10, 16, 16))


def random_face(num_expressions, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (num_expressions, num_expressions)) + 2 * np.eye(num_expressions)
    return MultilinearFace(
        mean=jnp.asarray(rng.normal(0, 40, (10, 3))),
        tensor=jnp.asarray(rng.normal(0, 3, (10, 3, 4, num_expressions))),
        identity_mean=jnp.asarray(rng.normal(1, 0.2, 4)),
        identity_covariance=jnp.eye(4),
        expression_mean=jnp.asarray(rng.normal(0, 0.3, num_expressions)),
        expression_covariance=jnp.asarray(0.1 * root @ root.T),
    )


def somebody(face, seed=1):
    rng = np.random.default_rng(seed)
    return Person(face.identity_mean + jnp.asarray(rng.normal(0, 0.3, 4)), jnp.asarray(rng.normal(0, 1, (10, 3))))


@pytest.mark.system
@pytest.mark.parametrize("num_expressions", [3, NUM_MODES])
def test_every_expression_is_the_same_shape_in_both_models(x64, num_expressions):
    face = random_face(num_expressions)
    person = somebody(face)
    model, modes = jax.jit(model_of)(face, person, jnp.asarray(TEMPLATES))
    assert model.num_modes == NUM_MODES
    for a in np.random.default_rng(2).normal(0, 1, (5, num_expressions)):
        c = modes.coefficients(face, jnp.asarray(a))
        np.testing.assert_allclose(shape(model, c), posed_shape(face, person, jnp.asarray(a)), atol=1e-10)
        np.testing.assert_allclose(modes.expression(face, c), a, atol=1e-10)


def test_modes_are_orthonormal_and_vary_as_expressions_do(x64):
    face = random_face(NUM_MODES)
    person = somebody(face)
    model, _ = model_of(face, person, jnp.asarray(TEMPLATES))
    np.testing.assert_allclose(model.basis.T @ model.basis, np.eye(NUM_MODES), atol=1e-12)
    M = np.asarray(expression_basis(face, person.identity)).reshape(30, -1)
    expected = M @ np.asarray(face.expression_covariance) @ M.T
    np.testing.assert_allclose(model.basis * model.deviation**2 @ model.basis.T, expected, atol=1e-9)
    assert np.all(np.diff(model.deviation) <= 0)


@pytest.mark.system
def test_of_many_expressions_the_strongest_modes_stay(x64):
    face = random_face(8)
    person = somebody(face)
    model, modes = model_of(face, person, jnp.asarray(TEMPLATES))
    M = np.asarray(expression_basis(face, person.identity)).reshape(30, -1)
    strengths = np.linalg.svd(M @ np.linalg.cholesky(np.asarray(face.expression_covariance)))[1]
    np.testing.assert_allclose(model.deviation, strengths[:NUM_MODES], rtol=1e-10)
    c = jnp.asarray(np.random.default_rng(3).normal(0, 1, NUM_MODES))
    np.testing.assert_allclose(modes.coefficients(face, modes.expression(face, c)), c, atol=1e-10)


@pytest.mark.system
def test_expressions_that_do_nothing_are_no_modes():
    face = random_face(NUM_MODES)
    still = MultilinearFace(**{**face.__dict__, "tensor": face.tensor.at[..., 2:].set(0.0)})
    covariance = jnp.diag(jnp.full(NUM_MODES, 0.1))
    still = MultilinearFace(**{**still.__dict__, "expression_covariance": covariance})
    model, modes = model_of(still, somebody(still), jnp.asarray(TEMPLATES, float))
    assert np.count_nonzero(model.deviation) == 2
    assert np.isfinite(modes.to_expression).all()
    assert np.isfinite(modes.from_expression).all()
