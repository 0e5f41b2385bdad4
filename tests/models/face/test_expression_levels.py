"""Levels of an expression out of sequences, and people in one frame, on the generator's faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face.expression_levels import deformation_rate, face_length, mouth_width, sampled_levels
from jaxfilters.models.face.landmarks import EYES, NOSTRILS
from jaxfilters.models.face.people_alignment import aligned_people
from jaxfilters.models.synthetic.face import face_shape, make_identity
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

SKULL = np.isin(np.arange(10), [*EYES, *NOSTRILS]).astype(float)


def moved(shape, draw):
    """A shape after some motion of the head."""
    R = Rotation.from_rotvec(draw.normal(0, 0.2, 3)).as_matrix()
    return np.asarray(shape) @ R.T + draw.normal(0, 50, 3)


def test_rates_run_from_shortest_to_longest(x64):
    np.testing.assert_allclose(deformation_rate(jnp.array([3.0, 5, 4, 7])), [0, 0.5, 0.25, 1])
    with pytest.raises(ValueError, match="lengths must differ"):
        deformation_rate(jnp.ones(3))
    with pytest.raises(ValueError, match="lengths must be finite"):
        deformation_rate(jnp.array([1, np.nan]))


@pytest.mark.system
@pytest.mark.parametrize(("length", "strengths"), [(mouth_width, (0.9, 0.0)), (face_length, (0.0, 0.9))])
def test_levels_lie_where_the_length_says(x64, length, strengths):
    draw = np.random.default_rng(0)
    person = make_identity(jax.random.key(2))
    phases = np.sin(np.linspace(0, 9, 400))[:, None] * strengths
    faces = jax.vmap(lambda e: face_shape(person, e[0], e[1]))(jnp.asarray(phases))
    sequence = jnp.asarray(np.stack([moved(face, draw) for face in faces]))
    levels = sampled_levels(sequence, person.neutral, length, levels=5)
    lengths = np.array([length(level) for level in levels])
    least, most = float(jax.vmap(length)(faces).min()), float(jax.vmap(length)(faces).max())
    np.testing.assert_allclose(lengths, np.linspace(least, most, 5), atol=0.05)
    # Each is a face that there was; what nostrils and eyes do themselves tilts the alignment a little.
    nearest = np.min(np.sqrt(np.mean(np.sum((levels[:, None] - faces) ** 2, axis=-1), axis=-1)), axis=1)
    assert np.all(nearest < 1.0)


def test_wrong_sequences_are_refused():
    neutral = jnp.asarray(np.random.default_rng(1).normal(size=(10, 3)), float)
    with pytest.raises(ValueError, match="levels must be 2 or more"):
        sampled_levels(neutral[None], neutral, mouth_width, levels=1)
    with pytest.raises(ValueError, match="shapes must be finite"):
        sampled_levels(neutral[None] * jnp.nan, neutral, mouth_width)


@pytest.mark.system
def test_people_are_aligned_whatever_their_heads_did(x64):
    draw = np.random.default_rng(3)
    straight = generator_shapes(jax.random.key(0), people_of(jax.random.key(1), 4), 0.0)
    # The first person looks ahead; the neutral face is the one between the second and the third level.
    shapes = np.array([[moved(face, draw) for face in person] for person in straight])
    shapes[0, 1] = straight[0, 1]
    shapes[2, 5] = np.nan
    aligned = aligned_people(jnp.asarray(shapes), 1, jnp.asarray(SKULL))
    assert np.isnan(aligned[2, 5]).all()
    expected = aligned_people(straight, 1, jnp.asarray(SKULL))
    observed = ~np.isnan(shapes)
    np.testing.assert_allclose(np.asarray(aligned)[observed], np.asarray(expected)[observed], atol=1e-6)
    assert np.sqrt(np.mean(np.square(expected - straight))) < 2.0
    sizes = lambda faces: np.linalg.norm(faces - np.mean(faces, axis=2, keepdims=True), axis=(2, 3))
    np.testing.assert_allclose(sizes(np.asarray(expected)), sizes(np.asarray(straight)), rtol=1e-9)
