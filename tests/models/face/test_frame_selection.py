"""Which frames are chosen, against exhaustive search and normal matrices written out (oracle 13)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face import frame_selection
from jaxfilters.models.face.bundle import POSE_UNITS, Bundle, Views, all_residuals, projected
from jaxfilters.models.face.frame_selection import by_angles, information_gain
from jaxfilters.models.face.multilinear import expression_basis, learn, shape
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

frame_information, projections = jax.jit(frame_selection.frame_information), jax.jit(projected)
AGES, ALL = jnp.array([4, 3, 2, 1, 0]), jnp.ones(5, bool)


@pytest.mark.parametrize("seed", range(5))
def test_angles_choose_as_exhaustive_search_does(x64, seed):
    rng = np.random.default_rng(seed)
    angles, new = rng.normal(0, 0.2, (5, 2)), rng.normal(0, 0.2, 2)
    sets = [np.concatenate([np.delete(angles, i, axis=0), new[None]]) for i in range(5)]
    spreads = [kept.var(axis=0).sum() for kept in sets]
    place, spread = by_angles(jnp.asarray(angles), jnp.asarray(new), AGES, ALL)
    assert place == int(np.argmax(spreads))
    assert float(spread) == pytest.approx(max(spreads), rel=1e-12)


def test_of_sets_that_are_as_good_the_oldest_frame_goes(x64):
    same = jnp.zeros((5, 2))
    assert by_angles(same, jnp.zeros(2), AGES, ALL)[0] == 0
    assert by_angles(same, jnp.ones(2), jnp.array([0, 1, 2, 4, 3]), ALL)[0] == 3


def test_a_frame_that_must_stay_stays(x64):
    """The first is the farthest from the others' mean and would go."""
    angles = jnp.array([[0.0, 0.0], [0.3, 0.0], [-0.3, 0.1], [0.2, -0.2], [-0.1, 0.2]])
    new = jnp.array([0.6, 0.0])
    free, _ = by_angles(angles, new, AGES, ALL)
    held, _ = by_angles(angles, new, AGES, ALL.at[free].set(False))
    assert held != free


def random_information(rng, n, d=4, rank=2):
    roots = rng.normal(0, 1, (n, d, rank))
    return roots @ roots.transpose(0, 2, 1)


@pytest.mark.system
@pytest.mark.parametrize("seed", range(5))
def test_information_chooses_as_exhaustive_search_does(x64, seed):
    rng = np.random.default_rng(seed)
    frames, prior = random_information(rng, 6), np.eye(4)
    may_go = np.array([False, True, True, True, True])
    gains = [
        0.5
        * (np.linalg.slogdet(prior + frames.sum(0) - frames[i])[1] - np.linalg.slogdet(prior + frames[:5].sum(0))[1])
        for i in range(5)
    ]
    place, gain = information_gain(*(jnp.asarray(a) for a in (frames[:5], frames[5], prior, may_go)))
    assert place == 1 + int(np.argmax(gains[1:]))
    assert float(gain) == pytest.approx(max(gains[1:]), rel=1e-9)


def test_a_frame_that_tells_nothing_gains_nothing(x64):
    frames = jnp.asarray(random_information(np.random.default_rng(0), 5))
    _, gain = information_gain(frames, jnp.zeros((4, 4)), jnp.eye(4), jnp.ones(5, bool))
    assert gain < 0


@pytest.fixture(scope="module")
def scene():
    """A frame of a face with landmarks to half a pixel; in double precision."""
    with jax.enable_x64(True):
        face = learn(generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 11)))
        rig = monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))
        pose = jnp.array([[10.0, -5, 650, 0.05, 0.2, -0.1]])
        frame = Bundle(pose, face.expression_mean[None], Person(face.identity_mean, jnp.zeros((10, 3))))
        covariance = 0.25 * jnp.tile(jnp.eye(2), (1, 10, 1, 1))
        view = Views(projected(face, rig, frame), covariance, jnp.ones((1, 10), bool))
        return face, rig, view, frame


def whole_jacobian(scene, offset_std):
    """Of 20 whitened rows by pose, expression, identity and offset, by central differences."""
    face, rig, _, frame = scene
    units = np.concatenate([POSE_UNITS, face.expression_std, face.identity_std, np.full(30, offset_std)])

    def pixels(y):
        y = jnp.asarray(units * y)
        who = Person(frame.person.identity + y[11:21], y[21:].reshape(10, 3))
        return np.asarray(projections(face, rig, Bundle(frame.poses + y[:6], frame.expressions + y[6:11], who))).ravel()

    h = 1e-4
    columns = [(pixels(h * e) - pixels(-h * e)) / (2 * h) for e in np.eye(len(units))]
    return np.stack(columns, axis=1) / 0.5, units


def held(face):
    """What holds the expression, in its standard deviations."""
    std = np.asarray(face.expression_std)
    inverse = std[:, None] * np.linalg.inv(np.asarray(face.expression_covariance)) * std
    return 1e-6 * np.eye(11) + np.block([[np.zeros((6, 6)), np.zeros((6, 5))], [np.zeros((5, 6)), inverse]])


@pytest.mark.system
def test_what_a_frame_tells_is_the_schur_complement(x64, scene):
    face, rig, view, frame = scene
    found = frame_information(face, rig, view, frame, Prior(1.0, 0.8))
    J, _ = whole_jacobian(scene, 0.8)
    N = J.T @ J + np.pad(held(face), (0, 40))
    own, cross = N[:11, :11], N[:11, 11:]
    np.testing.assert_allclose(found.information, N[11:, 11:] - cross.T @ np.linalg.solve(own, cross), atol=2e-5)


@pytest.mark.system
def test_the_estimate_responds_to_the_person_as_its_normal_equations_say(x64, scene):
    face, rig, view, frame = scene
    found = frame_information(face, rig, view, frame, Prior(1.0, 0.8))
    J, units = whole_jacobian(scene, 0.8)
    own = J[:, :11].T @ J[:, :11] + held(face)
    expected = -units[:11, None] * np.linalg.solve(own, J[:, :11].T @ J[:, 11:])
    np.testing.assert_allclose(found.response, expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.system
def test_the_estimate_responds_to_the_focal_length_as_its_normal_equations_say(x64, scene):
    """Mostly in depth, which grows in proportion to it."""
    face, rig, view, frame = scene
    found = frame_information(face, rig, view, frame, Prior(1.0, 0.8)).by_focal
    J, units = whole_jacobian(scene, 0.8)
    h = 1e-5
    longer, shorter = (replace(rig, focal=rig.focal * np.exp(step)) for step in (h, -h))
    by_focal = (projections(face, longer, frame) - projections(face, shorter, frame)).ravel() / (2 * h) / 0.5
    expected = -units[:11] * np.linalg.solve(J[:, :11].T @ J[:, :11] + held(face), J[:, :11].T @ by_focal)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
    assert float(found[2]) == pytest.approx(650, rel=0.05)


@pytest.mark.system
def test_hidden_landmarks_tell_less(x64, scene):
    face, rig, view, frame = scene
    some = view._replace(observed=view.observed.at[0, :4].set(False))
    more, less = (frame_information(face, rig, v, frame, Prior(1.0, 1.0)).information for v in (view, some))
    assert np.linalg.eigvalsh(np.asarray(more - less)).min() > -1e-8
    assert np.trace(more) > np.trace(less)


@pytest.mark.system
def test_the_gradient_is_that_of_the_energy_with_the_frame_at_its_best(x64, scene):
    """Of the least energy over pose and expression as a function of the person, by central differences.

    At the frame's own best pose and expression for the person, where the derivative by them vanishes.
    """
    face, rig, view, frame = scene
    prior = Prior(1.0, 0.8)
    noisy = view._replace(uv=view.uv + 0.3 * jax.random.normal(jax.random.key(3), view.uv.shape))
    units = np.concatenate([face.identity_std, np.full(30, 0.8)])

    root = np.linalg.cholesky(np.asarray(face.expression_covariance))

    @jax.jit
    def residuals(own, y):
        who = Person(frame.person.identity + y[:10], y[10:].reshape(10, 3))
        bundle = Bundle(frame.poses + POSE_UNITS * own[:6], frame.expressions + face.expression_std * own[6:], who)
        observed = all_residuals(face, rig, noisy, bundle, Prior(0.0, 0.0))
        apart = bundle.expressions[0] - face.expression_mean
        # What it moves in proportion to the size of the face.
        spread = lambda who, a: jnp.linalg.norm(jnp.std(shape(face, who, a)[:, :2], axis=0))
        moved = lambda who: jnp.linalg.norm(expression_basis(face, who) @ root)
        ratio = spread(who.identity, bundle.expressions[0]) / spread(face.identity_mean, face.expression_mean)
        ratio = ratio * moved(face.identity_mean) / moved(who.identity)
        return jnp.concatenate([observed, jax.scipy.linalg.solve_triangular(root, apart, lower=True) / ratio])

    jacobian = jax.jit(jax.jacfwd(residuals))

    def best(y):
        """Pose and expression by SciPy, and their energy; without the prior of the person."""
        found = least_squares(
            residuals, np.zeros(11), jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-12, args=(jnp.asarray(units * y),)
        )
        return found.x, found.cost

    own, _ = best(np.zeros(40))
    at = frame._replace(
        poses=frame.poses + POSE_UNITS * own[:6], expressions=frame.expressions + face.expression_std * own[6:]
    )
    found = frame_information(face, rig, noisy, at, prior)
    h = 1e-4
    for i in (0, 3, 9, 11, 25, 39):
        along = h * np.eye(40)[i]
        difference = (best(along)[1] - best(-along)[1]) / (2 * h)
        assert float(found.gradient[i]) == pytest.approx(difference, abs=2e-4)
