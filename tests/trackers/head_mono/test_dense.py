"""The start from 68 landmarks: of people of a model, against the truth and against the whole normal matrix."""

import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.bundle import Bundle, Person, Prior, Views, adjust, all_residuals, parameters, posed_shape
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.rig import project_shape
from jaxfilters.trackers.head_mono.dense import REACH, Dense, log_size, start_densely, told_of_identity, tracked
from jaxfilters.trackers.head_mono.start import initialise

PRIOR = Prior(1.0, 0.7)
NUM_PEOPLE = 4
YAWS = np.radians([-20.0, -10, 0, 10, 20])


def somebody(face, rig, seed):
    """Landmarks of a person of the model in five frames, to half a pixel; and the bundle that they are of."""
    rng = np.random.default_rng(seed)
    normal = lambda covariance, *n: rng.normal(size=(*n, len(covariance))) @ np.linalg.cholesky(covariance).T
    identity = face.identity_mean + normal(np.asarray(face.identity_covariance, float))
    expressions = face.expression_mean + normal(np.asarray(face.expression_covariance, float), 5)
    offset = rng.normal(0, PRIOR.offset_std, face.mean.shape)
    poses = np.column_stack([rng.normal(0, 30, (5, 2)), np.full(5, 650.0), rng.normal(0, 0.05, 5), YAWS, 0 * YAWS])
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, float), tree)
    bundle = numbers(Bundle(poses, expressions, Person(identity, offset)))
    one = lambda pose, a: project_shape(rig, posed_shape(face, bundle.person, a), pose)[0][0]
    uv = np.asarray(jax.vmap(one)(bundle.poses, bundle.expressions))
    return uv + rng.normal(0, 0.5, uv.shape), bundle


def dense_of(points, misplaced_mm=0.0):
    covariance = np.broadcast_to(0.25 * np.eye(2), (*points.shape, 2))
    return Dense(points, covariance, np.ones(points.shape[:2], bool), misplaced_mm)


def begun(face68, rig, points, misplaced_mm=0.0):
    ten = tracked(face68)
    first = initialise(ten, rig, jnp.asarray(points[:, list(FROM_68)], float), PRIOR, detected_px=0.5)
    return first, start_densely(face68, rig, first, dense_of(points, misplaced_mm), PRIOR)


@pytest.mark.slow
def test_the_push_takes_away_most_of_what_faces_shrink_by(face68, rig):
    """People drawn from the model, against the likeliest face without the push, which is nothing but `adjust`."""
    shrunk, pushed, deviations = [], [], []
    plain = jax.jit(lambda views, bundle: adjust(face68, rig, views, bundle, PRIOR, REACH, steps=(10, 20))[0])
    for seed in range(NUM_PEOPLE):
        points, truth = somebody(face68, rig, seed)
        few, many = begun(face68, rig, points)
        depth = lambda bundle, truth=truth: float(jnp.mean(jnp.log(bundle.poses[:, 2] / truth.poses[:, 2])))
        views = Views(*(jnp.asarray(part, few.uv.dtype) for part in dense_of(points)[:2]), jnp.ones((5, 68), bool))
        person = Person(few.bundle.person.identity, jnp.zeros_like(face68.mean))
        shrunk.append(depth(plain(views, few.bundle._replace(person=person))))
        pushed.append(depth(many.start.bundle))
        deviations.append(pushed[-1] / claimed(tracked(face68), many))
    assert np.mean(shrunk) < -0.06
    assert abs(np.mean(pushed)) < 0.6 * abs(np.mean(shrunk))
    # The sum of four squared standard normal numbers is within this but for .1 %.
    assert np.sum(np.square(deviations)) < 18.5


def claimed(face, many):
    """Standard deviation of the logarithm of the size, by what is known of the identity."""
    count, person = face.num_identities, many.start.bundle.person
    precision = np.asarray(many.past.information, float)[:count, :count]
    precision = precision + np.linalg.inv(np.asarray(face.identity_covariance, float))
    slope = np.asarray(jax.grad(lambda s: log_size(face, Person(s, person.offset)))(person.identity), float)
    return np.sqrt(slope @ np.linalg.solve(precision, slope))


def test_the_person_is_the_likeliest_one_by_what_is_kept(face68, rig):
    points, _ = somebody(face68, rig, 3)
    _, (start, past) = begun(face68, rig, points)
    ten, count = tracked(face68), face68.num_identities
    beforehand = np.linalg.inv(np.asarray(ten.identity_covariance, float))
    total = beforehand + np.asarray(past.information, float)[:count, :count]
    pull = beforehand @ np.asarray(ten.identity_mean, float) + np.asarray(past.pull, float)[:count]
    std = np.sqrt(np.diagonal(np.linalg.inv(total)))
    apart = np.abs(np.linalg.solve(total, pull) - np.asarray(start.bundle.person.identity)) / std
    assert apart.max() < 0.25
    assert not np.any(np.asarray(past.information)[count:])
    assert parameters(start.bundle.person).shape == past.pull.shape
    np.testing.assert_allclose(start.uv, points[:, list(FROM_68)], atol=3.0)


def test_what_the_views_tell_is_the_schur_complement_of_the_whole_normal_matrix(x64, face68, rig):
    points, truth = somebody(face68, rig, 1)
    widened = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, float) if a.dtype != bool else a, tree)
    face, rig, truth = (widened(tree) for tree in (face68, rig, truth))
    views = Views(*(jnp.asarray(part) for part in dense_of(points)[:3]))
    information, pull = told_of_identity(face, rig, views, truth, PRIOR)
    # Nothing known of the identity beforehand, the rest as it is.
    free = dataclasses.replace(face, identity_covariance=1e12 * face.identity_covariance)
    flat, unravel = jax.flatten_util.ravel_pytree((truth.person.identity, truth.poses, truth.expressions))
    rest = truth.person.offset

    def residuals(y):
        identity, poses, expressions = unravel(y[: flat.size])
        person = Person(identity, y[flat.size :].reshape(rest.shape))
        return all_residuals(free, rig, views, Bundle(poses, expressions, person), PRIOR)

    y = jnp.concatenate([flat, rest.ravel()])
    J, r = np.asarray(jax.jacfwd(residuals)(y)), np.asarray(residuals(y))
    # The order of `ravel_pytree`: identity first.
    count = face.num_identities
    normal, gradient = J.T @ J, J.T @ r
    share = np.linalg.solve(normal[count:, count:], normal[count:, :count])
    expected = normal[:count, :count] - normal[:count, count:] @ share
    slope = gradient[:count] - share.T @ gradient[count:]
    np.testing.assert_allclose(information, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    expected_pull = expected @ np.asarray(truth.person.identity) - slope
    np.testing.assert_allclose(pull, expected_pull, rtol=1e-3, atol=1e-3 * np.abs(expected_pull).max())


def test_what_a_detector_misplaces_is_no_part_of_the_face(face68, rig):
    points, _ = somebody(face68, rig, 2)
    beside = np.random.default_rng(0).normal(0, 3.0, (68, 2))
    _, exact = begun(face68, rig, points + beside, misplaced_mm=0.0)
    _, loose = begun(face68, rig, points + beside, misplaced_mm=2.5)
    rms = lambda found: float(jnp.sqrt(jnp.mean(found.start.bundle.person.offset**2)))
    assert rms(loose) < 0.3 * rms(exact)
    trace = lambda found: float(jnp.trace(found.past.information))
    assert trace(loose) < 0.5 * trace(exact)


def test_models_of_other_landmarks_are_refused(face, face68):
    assert tracked(face) is face
    np.testing.assert_array_equal(tracked(face68).mean, np.asarray(face68.mean)[list(FROM_68)])
    other = dataclasses.replace(face68, mean=face68.mean[:40], tensor=face68.tensor[:40])
    with pytest.raises(ValueError, match="face must have 10 landmarks, or the 68 of iBUG; got 40"):
        tracked(other)
