"""Training faces: the generator's levels, additive models, and a small stand-in for the ICT face model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math.multilinear import numerical_ranks
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.mirroring import PAIRS_68
from jaxfilters.models.face.multilinear import learn
from jaxfilters.models.synthetic.face import face_shape
from jaxfilters.models.synthetic.face_training import (
    ICT_EXPRESSIONS,
    additive_shapes,
    expression_weights,
    generator_shapes,
    ict_shapes,
    people_of,
)
from jaxfilters.models.synthetic.ict_face import IctModel, read_ict

NAMES = tuple(sorted({name for mixed in ICT_EXPRESSIONS for name in mixed} | {"jawLeft"}))


@pytest.fixture
def small_ict(x64):
    draw = np.random.default_rng(0)
    normal = lambda *shape: jnp.asarray(draw.normal(size=(*shape, 70, 3)))
    return IctModel(40 * normal(), normal(100), normal(len(NAMES)), jnp.arange(2, 70), jnp.zeros((1, 3), int), NAMES)


@pytest.mark.system
def test_the_generator_gives_the_levels_of_the_specification(x64):
    people = people_of(jax.random.key(0), 3)
    shapes = generator_shapes(jax.random.key(1), people, 0.0)
    second = jax.tree.map(lambda leaf: leaf[1], people)
    np.testing.assert_allclose(shapes[1, 0], face_shape(second, -0.4, 0.0), atol=1e-12)
    np.testing.assert_allclose(shapes[1, 4], face_shape(second, 0.6, 0.0), atol=1e-12)
    np.testing.assert_allclose(shapes[1, 5], face_shape(second, 0.0, -0.3), atol=1e-12)
    np.testing.assert_allclose(shapes[1, 8], face_shape(second, 0.0, 0.45), atol=1e-12)
    noise = generator_shapes(jax.random.key(1), people) - shapes
    # 900 numbers: four standard deviations of their standard deviation.
    assert np.std(noise) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(1800))


@pytest.mark.system
def test_an_additive_model_has_no_more_ranks_than_parts(x64):
    draw = np.random.default_rng(1)
    normal = lambda *shape: jnp.asarray(draw.normal(size=shape))
    neutral, identity, expression = normal(12, 3), normal(4, 12, 3), normal(5, 12, 3)
    people, weights = normal(9, 4), normal(8, 5)
    shapes = additive_shapes(neutral, identity, expression, people, weights)
    expected = neutral + np.einsum("m,mkd->kd", people[3], identity) + np.einsum("e,ekd->kd", weights[6], expression)
    np.testing.assert_allclose(shapes[3, 6], expected, atol=1e-12)
    centred = jnp.transpose(shapes - jnp.mean(shapes, axis=(0, 1)), (2, 3, 0, 1)).reshape(36, 9, 8)
    assert numerical_ranks(centred).tolist() == [9, 5, 6]
    own = additive_shapes(neutral, identity, expression, people, jnp.broadcast_to(weights, (9, 8, 5)))
    np.testing.assert_allclose(own, shapes, atol=1e-12)


@pytest.mark.system
def test_people_of_the_ict_model_have_their_own_strengths(small_ict):
    shapes = ict_shapes(jax.random.key(3), small_ict, 5, landmarks=tuple(range(68)))
    assert shapes.shape == (5, len(ICT_EXPRESSIONS), 68, 3)
    np.testing.assert_allclose(np.mean(shapes[:, 0, np.array(FROM_68)], axis=1), 0, atol=1e-9)
    steps = np.asarray(shapes - shapes[:, :1])
    jaw = np.asarray(small_ict.expression[NAMES.index("jawOpen"), 2:])
    strengths = np.einsum("skd,kd->s", steps[:, 2], jaw) / np.sum(jaw**2)
    np.testing.assert_allclose(steps[:, 2], strengths[:, None, None] * jaw, atol=1e-9)
    assert 0.3 < strengths.min() < strengths.max() < 1.2
    np.testing.assert_allclose(ict_shapes(jax.random.key(3), small_ict, 5), shapes[:, :, np.array(FROM_68)], atol=1e-9)


def test_missing_expressions_are_named():
    assert np.count_nonzero(expression_weights(NAMES)[0]) == 0
    with pytest.raises(ValueError, match="lacks browDown_L, jawOpen"):
        expression_weights(tuple(name for name in NAMES if name not in ("jawOpen", "browDown_L")))


@pytest.mark.system
@pytest.mark.data
def test_the_ict_model_is_learnt_in_68_landmarks(x64, data_dir):
    model = read_ict(data_dir / "ict_face_model")
    shapes = ict_shapes(jax.random.key(0), model, 30, landmarks=tuple(range(68)))
    learned = learn(shapes, identities=20, expressions=8, pairs=PAIRS_68)
    centred = np.sum(np.var(np.asarray(shapes), axis=(0, 1)))
    assert learned.tensor.shape == (68, 3, 20, 8)
    # Faces are nearly symmetric: what both halves' model captures is most of what the faces vary.
    assert np.sum(np.square(learned.tensor)) / (60 * len(ICT_EXPRESSIONS)) > 0.9 * centred
