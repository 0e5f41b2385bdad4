"""What the angles at which faces are found tell of a person, against Bayes' rule with the whole normal matrix."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.bundle import all_residuals
from jaxfilters.models.face.person_prior import Prior, parameters
from jaxfilters.models.face.pose import rotation
from jaxfilters.trackers.head.mono.facing import turned_away, with_facing
from jaxfilters.trackers.head.mono.start import detected, initialise

PRIOR = Prior(1.0, 0.7)
STD = np.radians([3.0, 6.0, 6.0])


def test_a_head_that_looks_into_the_camera_is_not_turned_wherever_it_is():
    rng = np.random.default_rng(0)
    turns = rng.normal(0, 0.3, (20, 3))
    for place, turn in zip(rng.uniform([-400, -300, 500], [400, 300, 900], (20, 3)), turns, strict=True):
        before = turned_away(jnp.asarray(np.concatenate([place, turn]), float))
        facing = turn - np.asarray(before)
        ahead = rotation(jnp.asarray([0.0, *facing[1:]])) @ jnp.asarray([0.0, 0.0, -1.0])
        np.testing.assert_allclose(ahead, -place / np.linalg.norm(place), atol=1e-5)
        assert abs(facing[0]) < 1e-6


@pytest.mark.system
def test_the_start_turns_as_far_as_the_angles_are_known_beside_the_landmarks(face, rig, detected_points):
    points = detected_points
    start = initialise(face, rig, points, PRIOR)
    after, past = with_facing(face, rig, start, detected(points, 1.0), None, STD, PRIOR)
    step, mean_turn = joint_step(face, rig, points, start.bundle)
    moved = jax.tree.map(lambda a, b: a - b, after.bundle, start.bundle)
    before, now = mean_turn(start.bundle), mean_turn(after.bundle)
    expected = mean_turn(jax.tree.map(jnp.add, start.bundle, step))
    assert np.abs(before - expected).max() > np.radians(0.5)
    np.testing.assert_allclose(now, expected, atol=0.15 * np.abs(before - expected).max())
    np.testing.assert_allclose(
        moved.person.identity, step.person.identity, atol=0.1 * np.abs(step.person.identity).max()
    )
    # The landmarks stay where they are in the image, as far as a face that is turned otherwise can have them there.
    np.testing.assert_allclose(after.uv, start.uv, atol=2.0)
    # The measurement of the person is as far from its value as the mean turn is from none.
    away = past.root @ parameters(start.bundle.person) - past.towards
    np.testing.assert_allclose(jnp.sum(away**2), np.sum((before / STD) ** 2), rtol=1e-3)


@pytest.fixture(scope="module")
def detected_points(face, rig, talking):
    """Landmarks of a face that is turned by some 10 degrees, to half a pixel."""
    made, _ = talking
    frames = [24, 28, 32, 36, 40]
    return jnp.asarray(made.uv[frames, 0] + np.random.default_rng(0).normal(0, 0.5, (5, 10, 2)), float)


def joint_step(face, rig, points, bundle):
    """The Gauss-Newton step of all unknowns at once once the mean turn is measured, and the mean turn of a bundle."""
    views = detected(points, 1.0)
    flat, unravel = jax.flatten_util.ravel_pytree(bundle)
    mean_turn = lambda b: jnp.mean(jax.vmap(turned_away)(b.poses), axis=0)
    residuals = lambda y: all_residuals(face, rig, views, unravel(y), PRIOR)
    J = np.asarray(jax.jit(jax.jacfwd(residuals))(flat), float)
    turns = np.asarray(jax.jacfwd(lambda y: mean_turn(unravel(y)))(flat), float) / STD[:, None]
    away = np.asarray(mean_turn(bundle), float) / STD
    unit = 1 / np.linalg.norm(J, axis=0)  # of each column, for the sake of rounding
    J, turns = J * unit, turns * unit
    # The bundle is the most probable one without the measurement: the gradient of the rest is zero there.
    step = -unit * np.linalg.solve(J.T @ J + turns.T @ turns, turns.T @ away)
    return unravel(jnp.asarray(step, flat.dtype)), lambda b: np.asarray(mean_turn(b), float)
