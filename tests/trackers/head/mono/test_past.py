"""Frames that are marginalised against the same frames that stay."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.bundle import Bundle, Reach, Views, adjust, projected
from jaxfilters.models.face.gallery import hypotheses, remember
from jaxfilters.models.face.multilinear import learn
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.face.square_root_prior import joined
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of
from jaxfilters.trackers.head.mono.adjustment import informed
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.past import about_face, marginalize_frame
from jaxfilters.trackers.head.mono.state import Window, prior_of

NUM, KEPT = 8, 5
REACH = Reach(np.array([60.0, 60, 100, 0.5, 0.5, 0.5]), 4.0, 4.0, 4.0)
OPTIONS = MonoConfig(offset_std=0.7e-3, past="marginalised")


@pytest.fixture(scope="module")
def scene(rig):
    """Eight frames of somebody, adjusted together to the last bit; a model, and the same for one of the gallery."""
    with jax.enable_x64(True):
        shapes = generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 11))
        face = learn(shapes)
        known = jax.tree.map(lambda leaf: leaf[1], hypotheses(face, remember(face, shapes[3:4])))
        rng = np.random.default_rng(0)
        poses = np.array([0.0, 0, 650, 0, 0, 0]) + rng.normal(0, [20, 15, 30, 0.06, 0.26, 0.1], (NUM, 6))
        how = face.expression_mean + 0.5 * face.expression_std * rng.normal(size=(NUM, face.num_expressions))
        truth = Bundle(jnp.asarray(poses), how, Person(known.identity_mean, jnp.zeros((10, 3))))
        uv = projected(known, rig, truth) + rng.normal(0, 0.3, (NUM, 10, 2))
        views = Views(uv, 0.09 * jnp.tile(jnp.eye(2), (NUM, 10, 1, 1)), jnp.ones((NUM, 10), bool))
        return face, known, views, truth


@jax.jit
def best(face, rig, views, start, prior):
    return adjust(face, rig, views, start, prior, REACH, steps=(20, 80))[0]


def window_of(face, rig, views, bundle, prior):
    n, size = len(bundle.poses), face.num_identities + 30
    empty = Window(
        views, bundle.poses, bundle.expressions, jnp.arange(n), jnp.zeros((n, size, size)), jnp.zeros((n, size))
    )
    return informed(face, rig, empty, bundle.person, prior)


@pytest.mark.system
@pytest.mark.parametrize("who", ["unknown", "remembered"])
def test_the_best_face_stays_the_best_when_frames_leave(x64, rig, scene, who):
    """The past's Gaussian has the gradient of the frames that it replaces: nothing moves, but for rounding.

    And but for the size in proportion to which an offset is held: that of the expressions in the frames at hand, here
    about one per cent more or less, and so are offsets of half a millimetre.
    """
    unknown, known, views, truth = scene
    face = unknown if who == "unknown" else known
    prior = prior_of(OPTIONS)
    together = best(face, rig, views, truth, prior)
    window = window_of(face, rig, views, together, prior)
    left = partial(marginalize_frame, unknown, face, window, together.person)
    gone = [left(jnp.asarray(i), prior_of(OPTIONS)) for i in range(KEPT, NUM)]
    past = about_face(joined(joined(*gone[:2]), gone[2]), unknown, face)
    few = jax.tree.map(lambda leaf: leaf[:KEPT], views)
    start = together._replace(poses=together.poses[:KEPT], expressions=together.expressions[:KEPT])
    with_past = best(face, rig, few, start, prior._replace(past=past))
    without = best(face, rig, few, start, prior)
    unit = np.asarray(unknown.identity_std)
    moved = lambda bundle: np.abs(np.asarray(bundle.person.identity - together.person.identity)) / unit
    assert moved(with_past).max() < 5e-3
    assert moved(without).max() > 0.02
    np.testing.assert_allclose(with_past.person.offset, together.person.offset, atol=5e-3)
    np.testing.assert_allclose(with_past.poses[:, 2], together.poses[:KEPT, 2], atol=0.1)


@pytest.mark.system
def test_a_past_is_about_the_same_faces_whoever_it_is_told_to(x64, rig, scene):
    """Differences of its energy, for two faces written once about the unknown and once about the other."""
    unknown, known, views, truth = scene
    window = window_of(unknown, rig, views, truth, Prior(1.0, 0.7))
    past = marginalize_frame(unknown, unknown, window, truth.person, jnp.asarray(2), prior_of(OPTIONS))
    other = about_face(past, unknown, known)
    rng = np.random.default_rng(1)
    about_stranger = rng.normal(0, 0.3, (2, 40))
    apart = np.concatenate([np.zeros(10), np.asarray(known.mean - unknown.mean).ravel()])

    def energy(past, p):
        return 0.5 * p @ np.asarray(past.information) @ p - p @ np.asarray(past.root.T @ past.towards)

    differences = [
        energy(past, about_stranger[0]) - energy(past, about_stranger[1]),
        energy(other, about_stranger[0] - apart) - energy(other, about_stranger[1] - apart),
    ]
    assert differences[0] == pytest.approx(differences[1], rel=1e-9)
