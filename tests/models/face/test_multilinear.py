"""Multilinear faces: oracles of the monocular tracker's specification, section 8, on the generator's people."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math.multilinear import compose, hooi, hosvd, mode_product, numerical_ranks
from jaxfilters.models.face import multilinear
from jaxfilters.models.face.landmarks import FROM_68, MIRROR
from jaxfilters.models.face.mirroring import PAIRS, PAIRS_68, mirror_map, mirrored, symmetrised
from jaxfilters.models.face.multilinear import EXPRESSION_MODE, PEOPLE_MODE, learn, of_tensor, shape_tensor
from jaxfilters.models.face.multilinear_fit import fitted, fitted_up_to_size, leave_one_out
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

RANKS = {PEOPLE_MODE: 10, EXPRESSION_MODE: 5}


@pytest.fixture(scope="module")
def shapes():
    """Eleven people with the noise of the specification, section 2.2."""
    with jax.enable_x64(True):
        return generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 11))


@pytest.fixture(scope="module")
def tensor(shapes):
    with jax.enable_x64(True):
        return shape_tensor(shapes)


@pytest.fixture(scope="module")
def model(shapes):
    with jax.enable_x64(True):
        return learn(shapes)


def rms_of_a_point(T, approximation):
    return float(np.sqrt(np.mean(np.sum(np.square(T - approximation), axis=1))))


def test_pairs_of_68_landmarks_contain_those_of_ten():
    mirror = mirror_map(PAIRS_68, 68)
    assert [mirror[FROM_68[k]] for k in range(10)] == [FROM_68[MIRROR[k]] for k in range(10)]
    assert mirror_map(PAIRS, 10) == MIRROR
    assert [k for k in range(68) if mirror[k] == k] == [8, 27, 28, 29, 30, 33, 51, 57, 62, 66]


@pytest.mark.system
@pytest.mark.parametrize(("pairs", "size"), [(PAIRS, 10), (PAIRS_68, 68), (((1, 0),), 3)])
def test_both_halves_are_symmetric_and_hold_half_of_the_shape(x64, pairs, size):
    shape = jnp.asarray(np.random.default_rng(0).normal(size=(size, 3)))
    from_right, from_left = symmetrised(shape, pairs)
    for half in (from_right, from_left):
        np.testing.assert_allclose(mirrored(half, pairs), half, atol=1e-12)
    for right, left in pairs:
        np.testing.assert_array_equal(from_right[right], shape[right])
        np.testing.assert_array_equal(from_left[left], shape[left])


@pytest.mark.system
def test_the_data_tensor_holds_symmetric_halves_of_everybody(x64, shapes, tensor):
    assert tensor.shape == (10, 3, 22, 10)
    for person, expression in ((0, 0), (7, 4), (10, 9)):
        both = symmetrised(shapes[person, expression] - jnp.mean(shapes[person, expression], axis=0) * jnp.eye(3)[0])
        np.testing.assert_allclose(tensor[:, :, person, expression], both[0], atol=1e-12)
        np.testing.assert_allclose(tensor[:, :, 11 + person, expression], both[1], atol=1e-12)
    assert numerical_ranks(tensor.reshape(30, 22, 10))[0] <= 15


# The specification's 0.88, 0.67 and 0.96 mm are of a point, the root of the sum over its three coordinates; other
# people are drawn here, whence the tolerance.
@pytest.mark.system
@pytest.mark.parametrize(("ranks", "expected_mm"), [((10, 5), 0.88), ((15, 5), 0.67), ((10, 3), 0.96)])
def test_the_error_of_the_model_is_that_of_the_specification(x64, tensor, ranks, expected_mm):
    model = of_tensor(tensor, {PEOPLE_MODE: ranks[0], EXPRESSION_MODE: ranks[1]})
    centred = tensor - model.mean[:, :, None, None]
    error2 = np.sum(np.square(centred)) - np.sum(np.square(model.tensor))
    assert np.sqrt(error2 / (10 * 22 * 10)) == pytest.approx(expected_mm, rel=0.08)


def test_rows_of_the_factors_reproduce_the_training_faces(x64, tensor, model):
    centred = tensor - jnp.mean(tensor, axis=(2, 3), keepdims=True)
    core, factors, _ = hooi(centred, RANKS)
    np.testing.assert_array_equal(core, model.tensor)
    best = compose(core, factors) + model.mean[:, :, None, None]
    people, actions = factors[PEOPLE_MODE], factors[EXPRESSION_MODE]
    for i, j in ((0, 0), (21, 9), (13, 4)):
        face = multilinear.shape(model, people[i], actions[j])
        np.testing.assert_allclose(face, best[:, :, i, j], atol=1e-9)
        assert rms_of_a_point(tensor[:, :, i, j], face) < 3 * rms_of_a_point(tensor, best)
    np.testing.assert_allclose(model.identity_mean, np.mean(people, axis=0), atol=1e-12)
    for rows, covariance in ((people, model.identity_covariance), (actions, model.expression_covariance)):
        sample = np.cov(rows.T)
        least = multilinear.LEAST_VARIANCE * np.trace(sample) / len(sample)
        np.testing.assert_allclose(covariance, sample + least * np.eye(len(sample)), atol=1e-12)


@pytest.mark.system
def test_as_many_parameters_as_examples_have_a_covariance_of_full_rank():
    """Five expressions in five parameters: their sample covariance alone is singular."""
    shapes = generator_shapes(jax.random.key(3), people_of(jax.random.key(2), 6))[:, :5]
    face = multilinear.learn(shapes, identities=8, expressions=5)
    assert np.isfinite(np.linalg.cholesky(np.asarray(face.expression_covariance))).all()


def test_one_parameter_of_either_kind_is_nearly_constant(x64, model):
    constant = int(np.argmax(model.identity_mean))
    assert model.identity_mean[constant] == pytest.approx(22**-0.5, abs=0.01)
    assert np.max(model.expression_mean) == pytest.approx(10**-0.5, abs=0.02)
    np.testing.assert_allclose(np.delete(model.identity_std, constant), 21**-0.5, atol=0.01)


def test_the_core_through_the_data_is_the_core_through_the_feature_mode(x64, tensor):
    T = (tensor - jnp.mean(tensor, axis=(2, 3), keepdims=True)).reshape(30, 22, 10)
    core, factors = hosvd(T)
    through_features = mode_product(core, factors[0], 0)
    np.testing.assert_allclose(compose(T, {n: factors[n].T for n in (1, 2)}), through_features, atol=1e-11)


def test_a_face_is_bilinear_in_identity_and_expression(x64, model):
    draw = np.random.default_rng(1)
    s, a = jnp.asarray(draw.normal(size=10)), jnp.asarray(draw.normal(size=5))
    face = multilinear.shape(model, s, a)
    unfolded = np.asarray(model.tensor).reshape(30, 50)
    np.testing.assert_allclose((face - model.mean).ravel(), unfolded @ np.kron(s, a), atol=1e-12)
    by_expression, by_identity = multilinear.expression_basis(model, s), multilinear.identity_basis(model, a)
    np.testing.assert_allclose(model.mean + np.asarray(by_expression) @ np.asarray(a), face, atol=1e-12)
    np.testing.assert_allclose(model.mean + np.asarray(by_identity) @ np.asarray(s), face, atol=1e-12)
    np.testing.assert_allclose(mirrored(face), face, atol=1e-12)
    # Gauge: only the product of both sizes is seen, and nothing of one where the other is 0.
    np.testing.assert_allclose(multilinear.shape(model, 1.7 * s, a / 1.7), face, atol=1e-12)
    by_s, by_a = jax.jacfwd(lambda s, a: multilinear.shape(model, s, a), (0, 1))(s, a)
    np.testing.assert_allclose(by_s @ s - by_a @ a, 0, atol=1e-12)
    np.testing.assert_array_equal(multilinear.identity_basis(model, 0 * a), 0)


@pytest.mark.system
def test_missing_faces_are_completed(x64, shapes, model):
    draw = np.random.default_rng(2)
    observed = np.ones((11, 10), bool)
    observed[np.arange(11), draw.integers(0, 10, 11)] = False
    holes = jnp.where(observed[:, :, None, None], shapes, jnp.nan)
    whole = shape_tensor(shapes)
    filled = multilinear.completed(holes, jnp.asarray(observed), {PEOPLE_MODE: 4, EXPRESSION_MODE: 3})
    missing = np.tile(~observed, (2, 1))
    errors = np.sqrt(np.sum(np.square(filled - whole), axis=(0, 1)) / 10)
    np.testing.assert_allclose(errors[~missing], 0, atol=1e-9)
    by_mean = np.asarray(whole) - np.nanmean(np.where(missing, np.nan, whole), axis=2, keepdims=True)
    assert np.mean(errors[missing]) < 0.75 * np.mean(np.sqrt(np.sum(by_mean**2, axis=(0, 1)) / 10)[missing])
    partly = learn(holes, observed=jnp.asarray(observed))
    apart = np.linalg.norm(partly.mean - model.mean, axis=-1)
    assert np.all(apart < 0.3)
    with_all = learn(shapes, observed=jnp.ones((11, 10), bool))
    np.testing.assert_allclose(with_all.tensor, model.tensor, atol=1e-9)


@pytest.mark.system
def test_a_person_is_fitted_and_an_unknown_one_less_well(x64, tensor, model):
    known = []
    for person in range(3):
        faces = jnp.moveaxis((tensor[:, :, person] + tensor[:, :, person + 11]) / 2, -1, 0)
        fit = fitted(model, faces)
        assert np.all(np.abs(fit.identity - model.identity_mean) <= 2 * model.identity_std + 1e-9)
        assert np.all(np.abs(fit.expressions - model.expression_mean) <= 2 * model.expression_std + 1e-9)
        assert fit.log_size == 0
        near = jax.vmap(lambda a, s=fit.identity: multilinear.shape(model, s, a))(fit.expressions)
        known.append(np.sqrt(np.mean(np.sum(np.square(faces - near), axis=-1))))
    left_out = leave_one_out(tensor, [0, 1, 2])
    assert np.mean(known) < 0.6
    assert np.mean(known) < 0.6 * np.mean(left_out.rms_mm)
    assert np.all(left_out.rms_mm < 3)


@pytest.mark.system
def test_size_is_told_from_shape_where_the_training_faces_allow(x64, tensor, model):
    faces = jnp.moveaxis((tensor[:, :, 1] + tensor[:, :, 12]) / 2, -1, 0)
    fit = fitted_up_to_size(model, faces)
    np.testing.assert_allclose(fit.log_size, 0, atol=0.03)
    # Shapes of another size say the same.
    smaller = fitted_up_to_size(model, 0.9 * faces)
    np.testing.assert_allclose(smaller.log_size - fit.log_size, -np.log(0.9), atol=0.01)


@pytest.mark.system
def test_wrong_input_is_refused(x64, shapes):
    with pytest.raises(ValueError, match="shapes must be finite; 3 of"):
        learn(shapes.at[2, 3, 4].set(jnp.nan))
    with pytest.raises(ValueError, match="two people and two expressions"):
        learn(shapes[:1])
    with pytest.raises(ValueError, match="ranks must be 1 to 22 for mode 2"):
        learn(shapes, identities=23, expressions=10)
    with pytest.raises(ValueError, match="ranks must be 1 to 10 for mode 3"):
        learn(shapes, expressions=11)
    with pytest.raises(ValueError, match=r"observed must be \(11, 10\)"):
        learn(shapes, observed=jnp.ones((10, 11), bool))
    with pytest.raises(ValueError, match=r"index of mode 2; \[3, 14\] have none"):
        learn(shapes, observed=jnp.ones((11, 10), bool).at[3].set(False))
    with pytest.raises(ValueError, match="pairs must name each of 10 landmarks at most once"):
        learn(shapes, pairs=((0, 3), (3, 2)))
    with pytest.raises(ValueError, match="three people or more"):
        leave_one_out(shape_tensor(shapes[:2]), [0])
