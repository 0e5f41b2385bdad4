"""What is known of a face before the images: sizes of strangers on average, and what counts in proportion to them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.bundle import Bundle, Reach, Views, adjust, projected
from jaxfilters.models.face.multilinear import learn, shape
from jaxfilters.models.face.person_prior import Person, Prior, expression_residuals, log_size, observed_size, residuals
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

pytestmark = pytest.mark.system

NUM_PEOPLE, NUM = 40, 5
PRIOR = Prior(1.0, 0.7)
REACH = Reach(np.array([300.0, 300, 400, 1, 1, 1]), 4.0, 4.0, 4.0)


@cache
def face():
    """Learnt once, in double precision, for all tests."""
    with jax.enable_x64(True):
        return learn(generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 60)), identities=12)


@cache
def rig():
    return monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))


def unknown(seed):
    """A person of the model with an offset, in five frames."""
    rng = np.random.default_rng(seed)
    normal = lambda covariance, *n: rng.normal(size=(*n, len(covariance))) @ np.linalg.cholesky(covariance).T
    identity = face().identity_mean + normal(np.asarray(face().identity_covariance))
    expressions = face().expression_mean + normal(np.asarray(face().expression_covariance), NUM)
    poses = np.array([0.0, 0, 650, 0, 0, 0]) + rng.normal(0, [20, 15, 30, 0.05, 0.2, 0.1], (NUM, 6))
    offset = jnp.asarray(rng.normal(0, PRIOR.offset_std, (10, 3)))
    return Bundle(jnp.asarray(poses), expressions, Person(identity, offset)), rng.normal(0, 0.5, (NUM, 10, 2))


@jax.jit
def solved(views, start):
    numbers = jax.tree.map(lambda a: jnp.asarray(a, float), (PRIOR, REACH))
    return adjust(face(), rig(), views, start, *numbers, steps=(10, 40))[0]


def test_strangers_are_not_taken_for_smaller_than_they_are(x64):
    """Whatever counts in squared millimetres makes faces small, and the likeliest face is then some per cent too near.

    The size is regressed on the shape, so its errors scatter by at most what sizes do; the mean of forty is within 3.3
    of its standard deviations of zero but for one in a thousand. With millimetres as they are it is four per cent.
    """
    errors = []
    for seed in range(NUM_PEOPLE):
        true, noise = unknown(seed)
        covariance = 0.25 * jnp.tile(jnp.eye(2), (NUM, 10, 1, 1))
        views = Views(projected(face(), rig(), true) + noise, covariance, jnp.ones((NUM, 10), bool))
        start = true._replace(person=Person(face().identity_mean, jnp.zeros((10, 3))))
        errors.append(float(jnp.mean(jnp.log(solved(views, start).poses[:, 2] / true.poses[:, 2]))))
    assert abs(np.mean(errors)) < 3.3 * np.std(errors) / np.sqrt(NUM_PEOPLE)
    assert np.std(errors) < np.sqrt(float(variance_of_sizes()))


def variance_of_sizes():
    slope = jax.grad(lambda s: log_size(face(), s))(face().identity_mean)
    return slope @ face().identity_covariance @ slope


def test_near_the_mean_person_the_identity_is_as_likely_as_its_covariance_says(x64):
    rng = np.random.default_rng(0)
    apart = 1e-4 * np.asarray(face().identity_std) * rng.normal(size=12)
    person = Person(face().identity_mean + apart, jnp.zeros((10, 3)))
    found = float(jnp.sum(residuals(face(), person, face().expression_mean[None], PRIOR) ** 2))
    assert found == pytest.approx(apart @ np.linalg.solve(np.asarray(face().identity_covariance), apart), rel=1e-3)


def test_the_size_is_as_likely_as_sizes_vary_and_the_rest_counts_in_proportion(x64):
    """Along what the size varies with the rest stays at its mean; at right angles to that the size hardly changes."""
    covariance = np.asarray(face().identity_covariance)
    slope = np.asarray(jax.grad(lambda s: log_size(face(), s))(face().identity_mean))
    std = np.sqrt(slope @ covariance @ slope)
    of = lambda identity: np.asarray(
        residuals(face(), Person(jnp.asarray(identity), jnp.zeros((10, 3))), face().expression_mean[None], PRIOR)
    )[:12]
    larger = face().identity_mean + 2 * covariance @ slope / std
    log_ratio = float(jnp.log(observed_size(face(), larger, face().expression_mean[None])))
    assert log_ratio == pytest.approx(2 * std, rel=0.05)
    assert np.linalg.norm(of(larger)) == pytest.approx(log_ratio / std, rel=1e-9)
    # Somebody of that size, and the same deviation beside it as of somebody of the mean size.
    beside = np.random.default_rng(1).normal(size=12)
    beside -= covariance @ slope * (slope @ beside) / std**2
    both = of(larger + 1e-3 * beside) - of(larger)
    mean = of(face().identity_mean + 1e-3 * beside)
    assert np.linalg.norm(both) == pytest.approx(np.linalg.norm(mean) / np.exp(log_ratio), rel=1e-2)


def test_an_offset_counts_in_proportion_to_the_size_with_the_expressions_that_are_seen(x64):
    """Sizes are the spread of the landmarks across the line of sight, the geometric mean over the frames."""
    rng = np.random.default_rng(2)
    identity = face().identity_mean + face().identity_std * rng.normal(size=12)
    expressions = face().expression_mean + face().expression_std * rng.normal(size=(3, face().num_expressions))
    offset = rng.normal(size=(10, 3))
    spread = lambda s, a: float(np.sqrt(np.sum(np.var(np.asarray(shape(face(), s, a))[:, :2], axis=0))))
    mean = spread(face().identity_mean, face().expression_mean)
    ratio = np.prod([spread(identity, a) / mean for a in expressions]) ** (1 / 3)
    found = residuals(face(), Person(identity, jnp.asarray(offset)), expressions, PRIOR)[12:42]
    np.testing.assert_allclose(found, offset.ravel() / (ratio * PRIOR.offset_std), rtol=1e-9)


def test_expressions_count_by_what_they_move_in_proportion_to_the_size(x64):
    """Of the mean person with the mean expression by the covariance; of others by the motion of all landmarks."""
    rng = np.random.default_rng(3)
    identity = face().identity_mean + face().identity_std * rng.normal(size=12)
    away = rng.normal(size=face().num_expressions)
    root = np.linalg.cholesky(np.asarray(face().expression_covariance))
    spread = lambda s, a: float(np.sqrt(np.sum(np.var(np.asarray(shape(face(), s, a))[:, :2], axis=0))))
    at = lambda s, a: np.asarray(shape(face(), s, jnp.asarray(a)))
    moved = lambda s: np.linalg.norm([at(s, r) - at(s, 0 * r) for r in root.T])
    expression = face().expression_mean + root @ away
    ratio = spread(identity, expression) / spread(face().identity_mean, face().expression_mean)
    expected = away * moved(identity) / moved(face().identity_mean) / ratio
    np.testing.assert_allclose(expression_residuals(face(), identity, expression[None])[0], expected, rtol=1e-9)
