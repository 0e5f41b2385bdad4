"""The size that the shape of a face tells."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.scenarios import _mono_floor
from jaxfilters.benchmarks.scenarios._mono_floor import size_errors
from jaxfilters.models.synthetic.face import make_identity


@pytest.mark.system
def test_sizes_of_other_people_are_told_better_than_by_guessing():
    """Of 500 who were not learnt from; their mean error is within five of its standard deviations of zero."""
    shapes = np.asarray(jax.vmap(make_identity)(jax.random.split(jax.random.key(11), 500)).neutral, float)
    errors = size_errors(shapes)
    sizes = np.linalg.norm(shapes, axis=(1, 2))
    assert np.std(errors) < 0.95 * np.std(np.log(sizes))
    assert abs(np.mean(errors)) < 5 * np.std(errors) / np.sqrt(500)


def test_shapes_with_errors_tell_less_of_the_size_and_a_shape_that_gives_it_away_tells_all():
    """Faces whose proportions are a function of their size, and others whose size is independent of them."""
    draw, count = np.random.default_rng(0), _mono_floor.NUM_MODELLED + 200
    size = np.exp(0.05 * draw.normal(size=count))[:, None, None]
    one, other = draw.normal(size=(2, 8, 3))
    telling, silent = (
        size * (one + 2 * (size - 1) * other),
        size * (one + 0.1 * draw.normal(size=(count, 1, 1)) * other),
    )
    spread = lambda shapes, noise: np.std(
        _mono_floor._size_errors_of_others(shapes, shapes + draw.normal(0, noise, shapes.shape))
    )
    assert spread(telling, 0.0) < 0.003
    assert spread(telling, 0.0) < spread(telling, 0.1) < 0.05
    logarithms = np.log(np.linalg.norm(silent - silent.mean(axis=1, keepdims=True), axis=(1, 2)))
    assert spread(silent, 0.0) > 0.8 * np.std(logarithms)


@pytest.mark.system
def test_a_larger_face_of_the_same_shape_is_taken_for_as_large_as_before():
    shapes = np.asarray(jax.vmap(make_identity)(jax.random.split(jax.random.key(12), 3)).neutral, float)
    np.testing.assert_allclose(1 + size_errors(1.1 * shapes), (1 + size_errors(shapes)) / 1.1, rtol=1e-9)


def test_a_shape_that_gives_its_rotation_away_tells_all_and_one_that_does_not_nothing():
    """Faces that are turned by 2 degrees: alike all, and others that change with the angle of each axis."""
    draw, count = np.random.default_rng(0), _mono_floor.NUM_MODELLED + 200
    mean, changes = 40 * draw.normal(size=(8, 3)), draw.normal(size=(3, 8, 3))
    turns = np.radians(2.0) * draw.normal(size=(count, 3))
    turned = Rotation.from_euler("ZYX", turns)
    alike = np.stack([turned.apply(np.tile(point, (count, 1))) for point in mean], axis=1)
    shapes = mean + np.tensordot(60 * turns, changes, 1)
    telling = np.stack([turned.apply(shapes[:, k]) for k in range(8)], axis=1)
    spread = lambda faces: np.degrees(np.std(_mono_floor._rotation_errors_of_others(faces), axis=0))
    # Of 200 draws the deviation is off by more than three of its own, 0.3, once in 370 times an axis.
    np.testing.assert_allclose(spread(alike), 2.0, atol=0.3)
    assert np.all(spread(telling) < 0.1)
