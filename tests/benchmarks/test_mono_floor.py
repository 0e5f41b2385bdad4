"""The size that the shape of a face tells."""

import jax
import numpy as np
import pytest

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


@pytest.mark.system
def test_a_larger_face_of_the_same_shape_is_taken_for_as_large_as_before():
    shapes = np.asarray(jax.vmap(make_identity)(jax.random.split(jax.random.key(12), 3)).neutral, float)
    np.testing.assert_allclose(1 + size_errors(1.1 * shapes), (1 + size_errors(shapes)) / 1.1, rtol=1e-9)
