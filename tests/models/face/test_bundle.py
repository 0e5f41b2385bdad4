"""Bundle adjustment of multilinear faces against known faces, SciPy and finite differences (oracles 6, 7, 10, 12)."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.bundle import Bundle, Reach, Views, adjust, all_residuals, box, projected
from jaxfilters.models.face.multilinear import learn
from jaxfilters.models.face.person_prior import Person, Prior, nothing_past, parameters, posed_shape
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.face.square_root_prior import of_measurements
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of

pytestmark = pytest.mark.system

NUM = 5
FREE, HELD = Prior(0.0, 0.0), Prior(1.0, 1.0)
WIDE = Reach(np.array([300.0, 300, 400, 1, 1, 1]), 4.0, 4.0, 2.0)
STEPS = (60, 70)
"""Of every adjustment, so that one program serves them all."""
_residuals = jax.jit(all_residuals)


@cache
def rig():
    return monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))


@cache
def face():
    """Learnt once, in double precision, for all tests."""
    return learn(generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 11)))


def truth(seed):
    """A face that the model can form, in five frames with yaws some 15 degrees apart."""
    rng = np.random.default_rng(seed)
    uniform = lambda mean, std, *shape: jnp.asarray(mean + std * rng.uniform(-1, 1, (*shape, len(mean))))
    person = Person(uniform(face().identity_mean, face().identity_std), jnp.zeros((10, 3)))
    poses = np.array([0.0, 0, 650, 0, 0, 0]) + rng.normal(0, [20, 15, 30, 0.06, 0.26, 0.1], (NUM, 6))
    return Bundle(jnp.asarray(poses), uniform(face().expression_mean, face().expression_std, NUM), person)


def preset():
    """The start of the specification: in front of the camera, looking into it, the mean person."""
    poses = jnp.tile(jnp.array([0.0, 0, 650, 0, 0, 0]), (NUM, 1))
    person = Person(face().identity_mean, jnp.zeros((10, 3)))
    return Bundle(poses, jnp.tile(face().expression_mean, (NUM, 1)), person)


@jax.jit
def _solved(views, start, prior, reach, face, rig):
    return adjust(face, rig, views, start, prior, reach, steps=STEPS)


def _adjusted(views, start, prior, reach=WIDE):
    reach = jax.tree.map(lambda a: jnp.asarray(a, float), reach)
    return _solved(views, start, jax.tree.map(jnp.asarray, prior), reach, face(), rig())


def views_of(bundle, std=1.0, noise=None):
    uv = projected(face(), rig(), bundle)
    uv = uv if noise is None else uv + noise
    covariance = std**2 * jnp.tile(jnp.eye(2), (NUM, 10, 1, 1))
    return Views(uv, covariance, jnp.ones((NUM, 10), bool))


def test_exact_landmarks_give_back_the_face_and_where_it_is(x64):
    """Oracle 12: without a prior, from the preset start."""
    true = truth(0)
    views = views_of(true)
    found, info = _adjusted(views, preset(), FREE)
    assert info.reprojection_px < 1e-6
    np.testing.assert_allclose(found.poses[:, 2], true.poses[:, 2], atol=1e-3)
    of = lambda bundle: jax.vmap(lambda a: posed_shape(face(), bundle.person, a))(bundle.expressions)
    np.testing.assert_allclose(of(found), of(true), atol=1e-3)


def test_the_least_energy_within_the_box_is_that_of_scipy(x64):
    """Noise of 1 px and a narrow box, of which several bounds are met."""
    rng = np.random.default_rng(7)
    true = truth(3)
    views = views_of(true, noise=rng.normal(0, 1, (NUM, 10, 2)))
    reach = Reach(np.array([4.0, 4, 8, 0.03, 0.03, 0.03]), 0.3, 0.3, 2.0)
    shift = jnp.asarray(rng.uniform(-1, 1, (NUM, 6)) * np.array([6.0, 6, 12, 0.05, 0.05, 0.05]))
    start = true._replace(poses=true.poses + shift)
    found, info = _adjusted(views, start, HELD, reach)
    low, high = box(face(), start, HELD, reach)
    flat, unravel = jax.flatten_util.ravel_pytree(start)
    bounds = tuple(np.asarray(jax.flatten_util.ravel_pytree(side)[0]) for side in (low, high))
    of_flat = jax.jit(lambda x: all_residuals(face(), rig(), views, unravel(x), HELD))
    inside = np.clip(np.asarray(flat), bounds[0] + 1e-9, bounds[1] - 1e-9)
    peer = least_squares(of_flat, inside, jax.jit(jax.jacfwd(of_flat)), bounds, x_scale="jac", xtol=1e-14, ftol=1e-14)
    assert float(info.energy) <= peer.cost * (1 + 1e-6)
    x = np.asarray(jax.flatten_util.ravel_pytree(found)[0])
    assert np.all(x >= bounds[0] - 1e-12)
    assert np.all(x <= bounds[1] + 1e-12)
    assert np.sum((x <= bounds[0] + 1e-9) | (x >= bounds[1] - 1e-9)) >= 3


def test_scaling_identity_against_expression_changes_no_pixel(x64):
    """Oracle 6: the null direction of the Jacobian, with the expressions' own parts of it."""
    at = truth(4)
    along = Bundle(jnp.zeros_like(at.poses), -at.expressions, Person(at.person.identity, jnp.zeros((10, 3))))
    _, change = jax.jvp(lambda bundle: projected(face(), rig(), bundle), (at,), (along,))
    assert np.abs(change).max() < 1e-9


def test_derivatives_are_those_of_finite_differences(x64):
    """Oracle 7: of the residuals that the solver sees, the robust ones and the prior's included."""
    at = truth(5)
    views = views_of(at, noise=np.random.default_rng(1).normal(0, 4, (NUM, 10, 2)))
    flat, unravel = jax.flatten_util.ravel_pytree(at)
    of_flat = jax.jit(lambda x: all_residuals(face(), rig(), views, unravel(x), HELD))
    J = np.asarray(jax.jacfwd(of_flat)(flat))
    h = 1e-5
    for i in range(0, flat.size, 7):
        step = jnp.zeros_like(flat).at[i].set(h)
        difference = (of_flat(flat + step) - of_flat(flat - step)) / (2 * h)
        np.testing.assert_allclose(J[:, i], difference, atol=1e-6 * max(1.0, np.abs(J[:, i]).max()))


@pytest.mark.parametrize("far", [0.0, 1.5, -5.0])
def test_the_box_is_never_empty_and_holds_the_clipped_start(x64, far):
    """Oracle 10: also from five standard deviations beyond the training set."""
    start = preset()
    beyond = start._replace(
        expressions=start.expressions + far * face().expression_std,
        person=start.person._replace(identity=start.person.identity + far * face().identity_std),
    )
    low, high = box(face(), beyond, HELD, Reach(np.ones(6), 0.5, 0.1, 2.0))
    for a, b in zip(jax.tree.leaves(low), jax.tree.leaves(high), strict=True):
        assert np.all(a <= b)
    most = face().identity_mean + 2 * face().identity_std
    assert np.all(high.person.identity <= most + 1e-12)
    inside = jnp.clip(beyond.person.identity, face().identity_mean - 2 * face().identity_std, most)
    assert np.all((low.person.identity <= inside + 1e-12) & (inside <= high.person.identity + 1e-12))


def test_landmarks_that_are_not_seen_say_nothing(x64):
    true = truth(6)
    views = views_of(true)
    hidden = views.observed.at[2, 4:].set(False)
    wrong = views.uv.at[2, 4:].add(50.0).at[2, 5].set(jnp.nan)
    one, _ = _adjusted(views._replace(observed=hidden), preset(), HELD)
    other, _ = _adjusted(views._replace(observed=hidden, uv=wrong), preset(), HELD)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_one_landmark_gone_astray_hardly_moves_the_face(x64):
    """30 px off in one frame: plain least squares would turn the head by degrees."""
    true = truth(8)
    views = views_of(true, std=0.3)
    astray = views._replace(uv=views.uv.at[1, 4].add(jnp.array([30.0, 0.0])))
    good, _ = _adjusted(views, true, HELD)
    bad, _ = _adjusted(astray, true, HELD)
    turned = np.degrees(np.abs(bad.poses[1, 3:] - good.poses[1, 3:]))
    assert turned.max() < 1.0


def test_the_offset_takes_up_what_the_model_lacks(x64):
    """A face with 1 mm of its own at every landmark, seen from five sides to 0.1 px."""
    rng = np.random.default_rng(9)
    true = truth(9)
    true = true._replace(person=true.person._replace(offset=jnp.asarray(rng.normal(0, 1, (10, 3)))))
    views = views_of(true, std=0.1)
    of = lambda bundle: np.asarray(jax.vmap(lambda a: posed_shape(face(), bundle.person, a))(bundle.expressions))

    def error(prior):
        found = of(_adjusted(views, preset(), prior)[0])
        size = lambda shapes: np.sqrt(np.sum((shapes - shapes.mean(axis=1, keepdims=True)) ** 2, axis=(1, 2)))
        scaled = found * (size(of(true)) / size(found))[:, None, None]
        return np.sqrt(np.mean((scaled - of(true)) ** 2))

    assert error(Prior(1.0, 1.0)) < 0.5 * error(Prior(1.0, 0.0))


def test_a_point_behind_the_camera_is_a_large_residual_and_no_nan(x64):
    behind = preset()._replace(poses=preset().poses.at[0, 2].set(-500.0))
    assert np.isfinite(_residuals(face(), rig(), views_of(preset()), behind, HELD)).all()


def test_a_past_is_the_gaussian_that_it_says(x64):
    """Energies of two people differ by what was measured, also where that tells nothing of a direction."""
    rng = np.random.default_rng(11)
    true = truth(10)
    views = views_of(true)
    root = rng.normal(size=(12, 40))
    values = rng.normal(size=12)
    past = of_measurements(jnp.asarray(root), jnp.asarray(values))

    def energy(bundle, prior):
        return 0.5 * np.sum(np.square(all_residuals(face(), rig(), views, bundle, prior)))

    def message(bundle):
        p = np.asarray(parameters(bundle.person))
        return 0.5 * np.sum((root @ p - values) ** 2)

    other = true._replace(person=truth(12).person._replace(offset=jnp.asarray(rng.normal(0, 0.5, (10, 3)))))
    held = HELD._replace(past=past)
    added = [energy(bundle, held) - energy(bundle, HELD) for bundle in (true, other)]
    assert added[0] - added[1] == pytest.approx(message(true) - message(other), rel=1e-4)


def test_a_past_that_tells_nothing_changes_nothing(x64):
    views = views_of(truth(13), noise=np.random.default_rng(2).normal(0, 1, (NUM, 10, 2)))
    one, _ = _adjusted(views, preset(), HELD)
    other, _ = _adjusted(views, preset(), HELD._replace(past=nothing_past(face())))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
