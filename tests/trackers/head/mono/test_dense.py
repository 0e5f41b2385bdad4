"""The start from 68 landmarks: of people of a model, against the truth and against the whole normal matrix."""

import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from jaxfilters.models.face.bundle import Bundle, Views, frame_residuals
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.person_prior import (
    Person,
    Prior,
    log_size,
    observed_size,
    parameters,
    posed_shape,
    residuals,
)
from jaxfilters.models.face.rig import project_shape
from jaxfilters.trackers.head.mono.dense import Dense, information_of_ten, start_densely, tracked
from jaxfilters.trackers.head.mono.start import initialise

PRIOR = Prior(1.0, 0.7)
NUM_PEOPLE = 8
YAWS = np.radians([-20.0, -10, 0, 10, 20])


@jax.jit
def projections(face, rig, bundle):
    one = lambda pose, a: project_shape(rig, posed_shape(face, bundle.person, a), pose)[0][0]
    return jax.vmap(one)(bundle.poses, bundle.expressions)


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
    uv = np.asarray(projections(face, rig, bundle))
    return uv + rng.normal(0, 0.5, uv.shape), bundle


def dense_of(points, misplaced_mm=0.0):
    covariance = np.broadcast_to(0.25 * np.eye(2), (*points.shape, 2))
    return Dense(points, covariance, np.ones(points.shape[:2], bool), misplaced_mm)


def begun(face68, rig, points, misplaced_mm=0.0):
    ten = tracked(face68)
    first = initialise(ten, rig, jnp.asarray(points[:, list(FROM_68)], float), PRIOR, detected_px=0.5)
    return first, start_densely(face68, rig, first, dense_of(points, misplaced_mm), PRIOR)


@pytest.mark.system
def test_faces_are_as_large_as_they_are_on_average(face68, rig):
    """People drawn from the model: the size is claimed as well as it is known, and it is not always too small."""
    deviations = []
    for seed in range(NUM_PEOPLE):
        points, truth = somebody(face68, rig, seed)
        _, many = begun(face68, rig, points)
        apart = float(jnp.mean(jnp.log(many.start.bundle.poses[:, 2] / truth.poses[:, 2])))
        deviations.append(apart / claimed(tracked(face68), many))
    # The mean of so many standard normal numbers, and the sum of their squares, are within these but for .2 % each.
    assert abs(np.mean(deviations)) < 3.1 / np.sqrt(NUM_PEOPLE)
    assert np.sum(np.square(deviations)) < chi2.isf(0.002, NUM_PEOPLE)


def claimed(face, many):
    """Standard deviation of the logarithm of the size, by what is known of identity and offset."""
    J, slope = (np.asarray(a, float) for a in prior_and_size(face, many.start.bundle.person))
    precision = np.asarray(many.past.information, float) + J.T @ J
    return np.sqrt(slope @ np.linalg.solve(precision, slope))


@jax.jit
def prior_and_size(face, person):
    """Jacobian of what holds the person, and the gradient of the logarithm of the size."""
    y, count = parameters(person), face.num_identities
    who = lambda y: Person(y[:count], y[count:].reshape(-1, 3))
    held = lambda y: residuals(face, who(y), face.expression_mean[None], PRIOR)
    return jax.jacfwd(held)(y), jax.grad(lambda y: log_size(face, y[:count]))(y)


@pytest.mark.system
def test_what_is_kept_leads_to_the_same_person(face68, rig):
    """The least of the energy of the prior and of what is kept, which is all that is left of the detections."""
    misplaced_mm = 1.0
    points, _ = somebody(face68, rig, 3)
    _, (start, past) = begun(face68, rig, points, misplaced_mm)
    ten, person = tracked(face68), start.bundle.person
    count = ten.num_identities
    who = lambda y: Person(y[:count], y[count:].reshape(ten.mean.shape))
    held = lambda y: residuals(ten, who(jnp.asarray(y, float)), start.bundle.expressions, PRIOR._replace(past=past))
    jacobian = jax.jit(jax.jacfwd(held))
    found = least_squares(jax.jit(held), parameters(person), jacobian, x_scale="jac")
    J = np.asarray(jacobian(parameters(person)), float)
    std = np.sqrt(np.diagonal(np.linalg.inv(J.T @ J)))
    apart = np.abs(found.x - np.asarray(parameters(person))) / std
    assert apart.max() < 0.3
    np.testing.assert_allclose(start.uv, points[:, list(FROM_68)], atol=3.0)


@pytest.mark.system
@pytest.mark.parametrize("misplaced_mm", [1.5])
def test_what_the_views_tell_is_the_schur_complement_of_the_whole_normal_matrix(x64, face68, rig, misplaced_mm):
    """With a detector's part of the offset of every landmark as parameters of their own."""
    points, truth = somebody(face68, rig, 1)
    widened = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, float) if a.dtype != bool else a, tree)
    face, rig, truth = (widened(tree) for tree in (face68, rig, truth))
    views = Views(*(jnp.asarray(part) for part in dense_of(points)[:3]))
    chosen = jnp.asarray(FROM_68)
    both = np.hypot(PRIOR.offset_std, misplaced_mm)
    own = (PRIOR.offset_std / both) ** 2 * truth.person.offset[chosen]
    person = Person(truth.person.identity, own)
    past = jax.jit(information_of_ten)(face, rig, views, truth, person, Prior(1.0, both), misplaced_mm)
    kept = parameters(person)
    parts = truth.poses, truth.expressions, truth.person.offset.at[chosen].add(-own)
    flat, unravel = jax.flatten_util.ravel_pytree(parts)

    def held(identity, ours, others, expressions):
        """Offsets of the ten, of the others, and of the detector, in proportion to the size in every frame."""
        ratio = jnp.stack([observed_size(face, identity, a[None]) for a in expressions])[:, None, None] * np.sqrt(5)
        std = jnp.full((68, 1), both).at[chosen].set(misplaced_mm if misplaced_mm else 1e-4)
        return (ours / PRIOR.offset_std / ratio).ravel(), (others / std / ratio).ravel()

    split = lambda y: (y[: face.num_identities], y[face.num_identities : kept.size].reshape(-1, 3))

    def rest(y):
        (identity, ours), (poses, expressions, offset) = split(y), unravel(y[kept.size :])
        who = Person(identity, offset.at[chosen].add(ours))
        of_frames = frame_residuals(face, rig, views, Bundle(poses, expressions, who), 1.0)
        return jnp.concatenate([of_frames, *held(identity, ours, offset, expressions)])

    y = jnp.concatenate([kept, flat])
    J, r = np.asarray(jax.jit(jax.jacfwd(rest))(y)), np.asarray(jax.jit(rest)(y))
    normal, gradient = J.T @ J, J.T @ r
    n = kept.size
    share = np.linalg.solve(normal[n:, n:], normal[n:, :n])
    # Less what holds the offsets of the ten, which the tracker knows.
    ours = lambda y: held(*split(y), parts[2], truth.expressions)[0]
    J, r = np.asarray(jax.jit(jax.jacfwd(ours))(kept)), np.asarray(jax.jit(ours)(kept))
    expected = normal[:n, :n] - normal[:n, n:] @ share - J.T @ J
    expected_pull = expected @ np.asarray(kept) - (gradient[:n] - share.T @ gradient[n:] - J.T @ r)
    np.testing.assert_allclose(past.information, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    pull = past.root.T @ past.towards
    np.testing.assert_allclose(pull, expected_pull, rtol=1e-3, atol=1e-3 * np.abs(expected_pull).max())


@pytest.mark.system
def test_what_a_detector_misplaces_is_no_part_of_the_face(face68, rig):
    points, _ = somebody(face68, rig, 2)
    beside = np.random.default_rng(0).normal(0, 3.0, (68, 2))
    _, exact = begun(face68, rig, points + beside, misplaced_mm=0.0)
    _, loose = begun(face68, rig, points + beside, misplaced_mm=2.5)
    rms = lambda found: float(jnp.sqrt(jnp.mean(found.start.bundle.person.offset**2)))
    assert rms(loose) < 0.3 * rms(exact)
    trace = lambda found: float(jnp.trace(found.past.information))
    assert trace(loose) < 0.5 * trace(exact)


@pytest.mark.system
def test_no_detection_counts_for_more_than_a_model_knows_of_faces(face68, rig):
    """To .05 px instead of .5, of what the model leaves of a face: .68 px at 650 mm."""
    points, _ = somebody(face68, rig, 4)
    first, usual = begun(face68, rig, points)
    exact = dense_of(points)._replace(covariance=dense_of(points).covariance / 100)
    precise = start_densely(face68, rig, first, exact, PRIOR)
    trace = lambda found: float(jnp.trace(found.past.information))
    assert 1.0 < trace(precise) / trace(usual) < 1 + 0.25 / 0.457


def test_models_of_other_landmarks_are_refused(face, face68):
    assert tracked(face) is face
    np.testing.assert_array_equal(tracked(face68).mean, np.asarray(face68.mean)[list(FROM_68)])
    other = dataclasses.replace(face68, mean=face68.mean[:40], tensor=face68.tensor[:40])
    with pytest.raises(ValueError, match="face must have 10 landmarks, or the 68 of iBUG; got 40"):
        tracked(other)
