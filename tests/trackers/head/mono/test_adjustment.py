"""Adjusting a face on the way: which frame goes, what is not known of the person, and where the belief moves."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.bundle import Adjustment, Bundle, projected
from jaxfilters.models.face.multilinear import expression_basis, shape
from jaxfilters.models.face.person_prior import Person
from jaxfilters.models.face.rig import project_shape
from jaxfilters.models.face.shape_model import shape as shape_of_model
from jaxfilters.trackers.head.mono.adjustment import Frame, adjusted, choose, frame_of, informed, uncertainty
from jaxfilters.trackers.head.mono.config import PUBLISHED, MonoConfig
from jaxfilters.trackers.head.mono.repetition import total_information
from jaxfilters.trackers.head.mono.start import Start, begin, detected
from jaxfilters.trackers.head.mono.state import REACH, Window, prior_of

pytestmark = pytest.mark.system

NUM = 5
USUAL = MonoConfig(num_particles=20)
PAPER = replace(PUBLISHED, num_particles=20)
LANDMARK_PX = 0.5


def bundle_of(face, seed=0):
    """Somebody in five frames, turned and with expressions."""
    rng = np.random.default_rng(seed)
    person = Person(
        jnp.asarray(face.identity_mean + 0.5 * face.identity_std * rng.normal(size=face.num_identities), jnp.float32),
        jnp.asarray(0.4 * rng.normal(size=face.mean.shape), jnp.float32),
    )
    poses = np.array([0.0, 0, 650, 0, 0, 0]) + rng.normal(0, [20, 15, 30, 0.06, 0.2, 0.1], (NUM, 6))
    expressions = face.expression_mean + 0.7 * face.expression_std * rng.normal(size=(NUM, face.num_expressions))
    return Bundle(jnp.asarray(poses, jnp.float32), jnp.asarray(expressions, jnp.float32), person)


def mean_person(face):
    """At whom what holds a person is the inverse covariance of the training set."""
    return Person(face.identity_mean, jnp.zeros_like(face.mean))


@pytest.fixture(scope="module")
def observed(rig, face):
    """What five frames of somebody show, exactly, and who it is."""
    true = bundle_of(face)
    return true, detected(projected(face, rig, true), LANDMARK_PX)


def window_of(rig, face, observed, options):
    """The five frames as a window, the oldest last but for the first."""
    true, views = observed
    size = face.num_identities + face.mean.size
    ages = jnp.array([9, 1, 2, 4, 3], jnp.int32)
    empty = jnp.zeros((NUM, size, size)), jnp.zeros((NUM, size))
    return jax.jit(informed)(
        face, rig, Window(views, true.poses, true.expressions, ages, *empty), true.person, prior_of(options)
    )


def told_by(window, information):
    """A frame that looks as the window's last one, and tells something else."""
    view = jax.tree.map(lambda leaf: leaf[-1:], window.views)
    message = type("FrameInformation", (), {"information": information})
    return Frame(view, window.poses[-1], window.expressions[-1], message)


def state_of(rig, face, observed, options):
    """At the start, with the truth a little beside; images do not matter."""
    true, views = observed
    shift = np.random.default_rng(2).normal(0, [1.0, 1, 4, 0.01, 0.02, 0.02], (NUM, 6))
    bundle = true._replace(poses=true.poses + jnp.asarray(shift, jnp.float32))
    start = Start(bundle, Adjustment(*jnp.zeros(3)), views.uv)
    images = jnp.asarray(np.random.default_rng(1).uniform(0, 255, (2, 480, 640)), jnp.float32)
    return begin(
        jax.random.key(0),
        face,
        rig,
        start,
        views,
        jnp.zeros((), int),
        images,
        jnp.zeros(()),
        options,
        prior_of(options),
    )


def new_frame(rig, face, state, observed, options):
    """The person once more, in the pose of the fourth frame moved, believed to be a little beside."""
    true, _ = observed
    apart = jnp.array([12.0, -6, 20, 0.02, -0.15, 0.1])
    now = Bundle(true.poses[3:4] + apart, true.expressions[3:4], true.person)
    view = detected(projected(face, rig, now), LANDMARK_PX)
    believed = now.poses[0] + jnp.array([0.5, 0.5, 3, 0.01, 0.01, -0.01])
    x = jnp.concatenate([believed, state.modes.coefficients(face, now.expressions[0])])
    return jax.jit(frame_of)(face, rig, view, state.person, x, state.modes, prior_of(options))


@pytest.fixture(scope="module")
def moved(rig, face, observed):
    """The usual tracker before and after an adjustment, with particles and a belief that are not trivial."""
    rng = np.random.default_rng(3)
    state = state_of(rig, face, observed, USUAL)
    root = 0.3 * rng.normal(size=(state.belief.mean.size,) * 2)
    covariance = jnp.asarray(root @ root.T, jnp.float32)
    spread = jnp.asarray(rng.normal(size=state.search.particles.shape), jnp.float32)
    state = state._replace(
        belief=Gaussian(state.belief.mean, covariance),
        search=state.search._replace(particles=state.search.particles + spread),
    )
    place = jnp.asarray(3)
    frame = new_frame(rig, face, state, observed, USUAL)
    return state, jax.jit(lambda state, frame: adjusted(face, face, rig, state, frame, place, USUAL))(state, frame), 3


def discounted(face, frames):
    """Information of frames (pose, expression, information), each divided by how many show the same view."""
    total = 0.0
    for pose, expression, information in frames:
        count = 0.0
        for other_pose, other_expression, _ in frames:
            turned = np.degrees(np.linalg.norm(np.subtract(pose, other_pose)[3:])) / 20
            moved = np.subtract(expression, other_expression) / np.asarray(face.expression_std) / 2
            count += np.exp(-0.5 * (turned**2 + np.mean(moved**2)))
        total = total + np.asarray(information, float) / count
    return total


def frames_of(window):
    return list(zip(window.poses, window.expressions, window.information, strict=True))


def gains(window, new, options, face):
    """Of every exchange, in nats, by determinants; the prior is that of the training set and of the offset."""
    std = np.asarray(face.identity_std, float)
    prior = 1e-6 * np.eye(std.size + face.mean.size)
    weight = options.prior_weight**2
    prior[: std.size, : std.size] += (
        weight * std[:, None] * np.linalg.inv(np.asarray(face.identity_covariance, float)) * std
    )
    prior[std.size :, std.size :] += np.eye(face.mean.size)
    all_of_them = prior + np.asarray(window.information, float).sum(axis=0)
    log_det = lambda matrix: np.linalg.slogdet(matrix)[1]
    exchanged = [all_of_them - np.asarray(old, float) + np.asarray(new, float) for old in window.information]
    return np.array([0.5 * (log_det(matrix) - log_det(all_of_them)) for matrix in exchanged])


@pytest.mark.parametrize("landmarks", ["aligned", "recalculated"])
def test_the_frame_of_least_information_goes(rig, face, observed, landmarks):
    """Of the first one too if it may: it is made the one that tells least."""
    options = replace(USUAL, landmarks=landmarks)
    window = window_of(rig, face, observed, options)
    # The frames tell 0.3, 0.9, 0.5, 1 and 0.8 of what they do.
    window = window._replace(information=window.information * jnp.array([0.3, 0.9, 0.5, 1.0, 0.8])[:, None, None])
    new = window.information[3]
    place, does = choose(face, window, prior_of(options), mean_person(face), told_by(window, new), options)
    expected = gains(window, new, options, face)
    first = 0 if options.is_published else 1
    assert int(place) == first + int(np.argmax(expected[first:]))
    assert int(np.argmax(expected)) == 0
    assert bool(does)


def test_a_frame_that_tells_less_than_all_others_is_not_taken(rig, face, observed):
    window = window_of(rig, face, observed, USUAL)
    _, does = choose(
        face, window, prior_of(USUAL), mean_person(face), told_by(window, 0.01 * window.information[2]), USUAL
    )
    assert not bool(does)


@pytest.mark.parametrize("landmarks", ["aligned", "recalculated"])
def test_the_frame_goes_without_which_the_face_turns_most(rig, face, observed, landmarks):
    options = replace(USUAL, landmarks=landmarks, selection="angles")
    window = window_of(rig, face, observed, options)
    frame = told_by(window, window.information[3])._replace(pose=window.poses[0].at[4:].set(jnp.array([0.6, -0.4])))
    # The first frame faces the middle of all: to let it go gains most.
    poses = window.poses.at[0, 4:].set(jnp.mean(window.poses[1:, 4:], axis=0) + jnp.array([0.1, -0.06]))
    window = window._replace(poses=poses)
    place, does = choose(face, window, prior_of(options), mean_person(face), frame, options)
    spreads = []
    for i in range(NUM):
        angles = np.asarray(poses[:, 4:], float)
        angles[i] = frame.pose[4:]
        spreads.append(np.var(angles[:, 0]) + np.var(angles[:, 1]))
    assert int(np.argmax(spreads)) == 0
    first = 0 if options.is_published else 1
    assert int(place) == first + int(np.argmax(spreads[first:]))
    assert bool(does)


@pytest.mark.parametrize(("landmarks", "oldest"), [("aligned", 3), ("recalculated", 0)])
def test_the_oldest_frame_goes_that_may(rig, face, observed, landmarks, oldest):
    options = replace(USUAL, landmarks=landmarks, selection="latest")
    window = window_of(rig, face, observed, options)
    place, does = choose(
        face, window, prior_of(options), mean_person(face), told_by(window, window.information[3]), options
    )
    assert int(place) == oldest
    assert bool(does)


def test_uncertainty_is_the_spread_over_persons_that_are_as_likely(rig, face, observed):
    """Pose and expression are solved for anew for 4000 persons drawn from the posterior, with a linear camera.

    Whitened by the covariance under test, the sample covariance of m = 11 numbers has 66 entries, each nearly normal
    about the unit matrix with variance 1 / n, on the diagonal 2 / n: that any is more than 4.5 standard deviations
    away has a probability of 66 times 7e-6, or 5e-4.
    """
    num_persons, m = 4000, 6 + face.num_expressions
    true, views = observed
    window = window_of(rig, face, observed, USUAL)
    alone = jax.tree.map(lambda leaf: leaf[2:3], views)
    x = jnp.concatenate([true.poses[2], jnp.zeros(face.num_expressions)])
    state = state_of(rig, face, observed, USUAL)
    x = x.at[6:].set(state.modes.coefficients(face, true.expressions[2]))
    frame = jax.jit(frame_of)(face, rig, alone, true.person, x, state.modes, prior_of(USUAL))
    response = frame.about_person.response
    found = np.asarray(jax.jit(uncertainty)(face, window, prior_of(USUAL), mean_person(face), response), float)

    units = np.concatenate([face.identity_std, np.full(face.mean.size, USUAL.offset_std_mm)])
    root = np.linalg.cholesky(np.linalg.inv(np.asarray(face.expression_covariance, float))).T

    def rows(who, own):
        """Landmarks to half a pixel; the expression as in the training set, in proportion to the size."""
        person = Person(who[: face.num_identities], who[face.num_identities :].reshape(face.mean.shape))
        uv = projected(face, rig, Bundle(own[None, :6], own[None, 6:], person)).ravel()
        held = root @ (own[6:] - face.expression_mean) * strength(person.identity) / strength(face.identity_mean)
        ratio = size(person.identity, own[6:]) / size(face.identity_mean, face.expression_mean)
        return jnp.concatenate([uv / LANDMARK_PX, held / ratio])

    size = lambda who, a: jnp.linalg.norm(jnp.std(shape(face, who, a)[:, :2], axis=0))
    strength = lambda who: jnp.linalg.norm(expression_basis(face, who) @ np.linalg.inv(root))

    here = jnp.concatenate([true.person.identity, true.person.offset.ravel()])
    by_person, by_own = jax.jit(jax.jacfwd(rows, (0, 1)))(here, jnp.concatenate([true.poses[2], frame.expression]))
    prior = np.linalg.inv(np.asarray(face.identity_covariance, float))
    known = np.zeros((units.size, units.size))
    known[: len(prior), : len(prior)] = face.identity_std[:, None] * prior * face.identity_std
    known[len(prior) :, len(prior) :] = np.eye(face.mean.size)
    posterior = np.linalg.inv(known + discounted(face, frames_of(window)))
    rng = np.random.default_rng(4)
    persons = rng.normal(size=(num_persons, units.size)) @ np.linalg.cholesky(posterior).T * units
    answers = -np.linalg.lstsq(np.asarray(by_own, float), np.asarray(by_person, float) @ persons.T)[0]

    whitened = np.linalg.solve(np.linalg.cholesky(found), answers)
    sample = whitened @ whitened.T / num_persons
    z = (sample - np.eye(m)) / np.sqrt((1 + np.eye(m)) / num_persons)
    assert np.abs(z).max() < 4.5


def test_the_same_view_many_times_tells_as_much_as_once(rig, face, observed):
    """What copies of one frame tell, beside those of another view that stand at right angles to it."""
    true, views = observed
    far = true._replace(poses=true.poses.at[:, 3:].set(0.0).at[0, 4].set(1.5))
    pick = lambda rows: jax.tree.map(lambda leaf: leaf[jnp.asarray(rows)], (views, far.poses, far.expressions))

    def told(rows):
        some, poses, expressions = pick(rows)
        size = face.num_identities + face.mean.size
        empty = jnp.zeros((len(rows), size, size)), jnp.zeros((len(rows), size))
        window = Window(some, poses, expressions, jnp.zeros(len(rows), jnp.int32), *empty)
        window = jax.jit(informed)(face, rig, window, true.person, prior_of(USUAL))
        return np.asarray(total_information(face, window))

    one, other = told([2]), told([0])
    close = lambda found, expected: np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    close(told([2] * 5), one)
    close(told([0, 2, 2, 2]), one + other)


def test_the_published_person_is_the_mean_of_the_last_identities(rig, face, observed):
    rng = np.random.default_rng(5)
    state = state_of(rig, face, observed, PAPER)
    scatter = 0.5 * face.identity_std * rng.normal(size=state.identities.shape)
    identities = jnp.asarray(face.identity_mean + scatter, jnp.float32)
    state = state._replace(identities=identities, num_adjusted=jnp.asarray(3))
    frame = new_frame(rig, face, state, observed, PAPER)
    after = jax.jit(lambda state, frame: adjusted(face, face, rig, state, frame, jnp.asarray(1), PAPER))(state, frame)
    assert int(after.num_adjusted) == 4
    np.testing.assert_array_equal(after.identities[1:], identities[:-1])
    np.testing.assert_allclose(after.person.identity, np.mean(np.asarray(after.identities[:4]), axis=0), rtol=1e-5)
    # It began at the mean of those before, and went no farther than the box allows.
    start = np.mean(np.asarray(identities[:3]), axis=0)
    way = np.abs(np.asarray(after.identities[0]) - start) / np.asarray(face.identity_std)
    assert 0.01 < way.max() <= REACH.identity * (1 + 1e-4)


def test_the_usual_person_is_the_adjusted_one(moved):
    _, after, _ = moved
    np.testing.assert_array_equal(after.person.identity, after.identities[0])


def test_the_belief_moves_to_where_the_bundle_has_the_face(rig, face, moved):
    _, after, place = moved
    window = after.window
    bundle = Bundle(window.poses[place][None], window.expressions[place][None], after.person)
    expected = projected(face, rig, bundle)[0]
    mean = after.belief.mean
    points = project_shape(rig, shape_of_model(after.model, mean[6:]), mean[:6])[0][0]
    # Single precision of pixels up to 640.
    np.testing.assert_allclose(points, expected, atol=2e-3)
    np.testing.assert_array_equal(after.search.estimate, mean)


def test_an_adjustment_finds_the_landmarks_of_the_new_frame(rig, face, observed, moved):
    """They are exact: what is left is what the prior pulls."""
    before, after, place = moved
    mean = after.belief.mean
    points = project_shape(rig, shape_of_model(after.model, mean[6:]), mean[:6])[0][0]
    uv = after.window.views.uv[place]
    assert np.abs(np.asarray(points - uv)).max() < 1.0
    assert not np.allclose(uv, before.window.views.uv[place], atol=5.0)


def test_an_adjustment_keeps_the_covariance_of_the_pose(moved):
    before, after, _ = moved
    old, new = before.belief.covariance, after.belief.covariance
    np.testing.assert_allclose(new[:6, :6], old[:6, :6], rtol=1e-5, atol=1e-6)
    # Displacements of the landmarks spread as before, as far as the new modes can form them.
    spread = lambda model, covariance: np.asarray(model.basis @ covariance[6:, 6:] @ model.basis.T)
    onto = np.asarray(after.model.basis @ jnp.linalg.pinv(after.model.basis))
    expected = onto @ spread(before.model, old) @ onto.T
    np.testing.assert_allclose(spread(after.model, new), expected, atol=1e-4 * np.abs(expected).max())


def test_particles_go_with_the_estimate(moved):
    before, after, _ = moved
    apart_before = np.asarray(before.search.particles - before.belief.mean[:, None])
    apart_after = np.asarray(after.search.particles - after.belief.mean[:, None])
    np.testing.assert_allclose(apart_after[:6], apart_before[:6], atol=1e-3)
    nearest = np.linalg.lstsq(np.asarray(after.model.basis), np.asarray(before.model.basis) @ apart_before[6:])[0]
    np.testing.assert_allclose(apart_after[6:], nearest, atol=1e-3)
    np.testing.assert_array_equal(after.search.velocity, before.search.velocity)


def test_what_frames_leave_behind_never_stops_an_adjustment(rig, face, observed):
    """Each tells nothing of some directions, but for rounding: in single precision the sum has no Cholesky root."""
    options = replace(USUAL, past="marginalised")
    state = state_of(rig, face, observed, options)
    adjust = jax.jit(lambda state, frame, place: adjusted(face, face, rig, state, frame, place, options))
    held = []
    for i in range(8):
        state = adjust(state, new_frame(rig, face, state, observed, options), jnp.asarray(1 + i % 4))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.person))
        held.append(float(jnp.trace(state.prior.past.information)))
    assert np.all(np.diff(held) > 0)
