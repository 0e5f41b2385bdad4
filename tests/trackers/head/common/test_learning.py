"""What the deformation model learns of given shapes, and shapes recalculated on rendered frames (oracle 9)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import subspace_angles

from jaxfilters.models.face import recalculation
from jaxfilters.models.face.landmarks import MEAN_SHAPE, RIGID_WEIGHTS
from jaxfilters.models.face.rigid import remove_rigid
from jaxfilters.models.face.shape_model import rigid, shape
from jaxfilters.models.synthetic.face import face_shape, make_identity
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.head.common import learning
from jaxfilters.trackers.head.common.learning import (
    LEAST_CHANGE,
    LEAST_SCORE,
    MOST_PITCH,
    MOST_YAW,
    without_weighted_motion,
)
from jaxfilters.trackers.head.common.search import LEAST_DEVIATION
from jaxfilters.trackers.head.common.state import NUM_MODES

NEUTRAL = jnp.asarray(MEAN_SHAPE, jnp.float32)
WINDOWS = jnp.zeros((2, 10, 16, 16))
learned = jax.jit(learning.learned, static_argnames=("follow", "still"))
recalculated = jax.jit(learning.recalculated)


def as_it_is(change, mean):
    return change


def begin(neutral=NEUTRAL):
    neutral = jnp.asarray(neutral)
    return learning.empty_learner(neutral, WINDOWS), rigid(neutral, WINDOWS, num_modes=NUM_MODES)


def follow_all(shapes, follow=1.0, still=as_it_is):
    """Learner and model after shapes that were all measured."""

    def one(carry, M):
        return learning.learned(*carry, M, WINDOWS, jnp.ones((), bool), follow, still), carry[1].mean

    return jax.jit(lambda shapes: jax.lax.scan(one, begin(), shapes))(jnp.asarray(shapes, jnp.float32))


def deformed(seed, count, std=(5.0, 3.0)):
    """Shapes with two modes, and the modes."""
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.normal(size=(30, 2)))[0]
    a = rng.normal(0, std, (count, 2))
    return MEAN_SHAPE + (a @ modes.T).reshape(count, 10, 3), modes


@pytest.mark.parametrize(
    ("yaw", "pitch", "score", "expected"),
    [
        (0.0, 0.0, 0.9, True),
        (MOST_YAW - 0.01, -MOST_PITCH + 0.01, LEAST_SCORE + 0.01, True),
        (MOST_YAW + 0.01, 0.0, 0.9, False),
        (-MOST_YAW - 0.01, 0.0, 0.9, False),
        (0.0, MOST_PITCH + 0.01, 0.9, False),
        (0.0, 0.0, LEAST_SCORE - 0.01, False),
        (np.nan, 0.0, 0.9, False),
        (0.0, 0.0, np.nan, False),
    ],
)
def test_shapes_are_measured_on_faces_that_are_turned_to_the_cameras(yaw, pitch, score, expected):
    pose = jnp.array([50.0, 0, 600, 2.0, yaw, pitch])
    assert bool(learning.measurable(pose, jnp.asarray(score))) == expected


def test_the_mean_is_that_of_all_shapes():
    """[S3.20]; the registered shape is the first."""
    shapes, _ = deformed(0, 40)
    (learner, model), _ = follow_all(shapes)
    expected = np.concatenate([MEAN_SHAPE[None], shapes]).mean(axis=0)
    np.testing.assert_allclose(model.mean, expected, atol=1e-4)
    assert int(learner.num_shapes) == 41
    np.testing.assert_allclose(learner.shape, shapes[-1], atol=1e-4)
    assert bool(learner.is_fresh)


def test_the_mean_may_stay_where_it_is():
    shapes, _ = deformed(0, 40)
    (learner, model), _ = follow_all(shapes, follow=0.0)
    np.testing.assert_array_equal(model.mean, NEUTRAL)
    assert int(learner.num_shapes) == 41


def test_only_deformations_change_the_modes():
    """Norms over all landmarks, from the mean before the shape: 5.9 mm is none, 6.1 mm is one."""
    learner, model = begin()
    direction = np.random.default_rng(1).normal(size=(10, 3))
    direction /= np.linalg.norm(direction)
    for norm, count in ((LEAST_CHANGE - 0.1, 0), (LEAST_CHANGE + 0.1, 1)):
        M = jnp.asarray(MEAN_SHAPE + norm * direction, jnp.float32)
        after, changed = learned(learner, model, M, WINDOWS, jnp.ones((), bool), 1.0, as_it_is)
        assert int(after.subspace.num_samples) == count
        assert bool(jnp.any(changed.deviation > 0)) == bool(count)
        np.testing.assert_allclose(changed.mean, MEAN_SHAPE + 0.5 * norm * direction, atol=1e-4)


@pytest.mark.parametrize("why", ["not measured", "not finite"])
def test_shapes_that_were_not_measured_change_nothing(why):
    learner, model = begin()
    M = NEUTRAL + 3.0 if why == "not measured" else NEUTRAL.at[3, 1].set(jnp.nan)
    after, same = learned(learner, model, M, WINDOWS, jnp.asarray(why == "not finite"), 1.0, as_it_is)
    jax.tree.map(np.testing.assert_array_equal, same, model)
    jax.tree.map(np.testing.assert_array_equal, after.subspace, learner.subspace)
    np.testing.assert_array_equal(after.shape, NEUTRAL)
    assert int(after.num_shapes) == 1
    assert not bool(after.is_fresh)


def test_modes_and_deviations_are_those_of_the_shapes():
    """Two modes of second moments that were drawn; small ones are not among them."""
    shapes, modes = deformed(2, 400, (7.0, 4.0))
    (learner, model), _ = follow_all(shapes, follow=0.0)
    assert np.degrees(subspace_angles(np.asarray(model.basis)[:, :2], modes)).max() < 3
    np.testing.assert_allclose(model.basis.T @ model.basis, np.diag([1.0, 1, 0, 0, 0]), atol=1e-4)
    far = shapes[np.linalg.norm((shapes - MEAN_SHAPE).reshape(400, -1), axis=1) > LEAST_CHANGE] - MEAN_SHAPE
    moments = np.linalg.svd(far.reshape(len(far), -1))[1][:2] / np.sqrt(len(far))
    # Later shapes count up to three times as much: of 300 shapes some 100 are left, 4 deviations of 7 %.
    np.testing.assert_allclose(model.deviation[:2], moments, rtol=0.28)
    np.testing.assert_array_equal(model.deviation[2:], 0)
    assert float(learning.contribution(learner)) > 0.99


def test_a_deviation_is_not_smaller_than_noise():
    """Two directions; the second of 0.05 mm only."""
    rng = np.random.default_rng(3)
    modes = np.linalg.qr(rng.normal(size=(30, 2)))[0]
    shapes = MEAN_SHAPE + (rng.normal(0, (10, 0.05), (50, 2)) @ modes.T).reshape(50, 10, 3)
    _, model = follow_all(shapes, follow=0.0)[0]
    assert float(model.deviation[1]) == pytest.approx(LEAST_DEVIATION)


def test_contribution_falls_with_what_the_modes_cannot_explain():
    rng = np.random.default_rng(4)
    shapes = MEAN_SHAPE + rng.normal(0, 3, (60, 10, 3))
    (learner, _), _ = follow_all(shapes, follow=0.0)
    assert 0.2 < float(learning.contribution(learner)) < 0.8
    assert float(learning.contribution(begin()[0])) == 0


@pytest.mark.system
def test_the_motion_of_the_skull_is_taken_out():
    """A turn of 1 degree and a shift of 2 mm, beside a mouth that opens."""
    turn = np.radians([0.6, -0.8, 0.2])
    moved = MEAN_SHAPE + np.cross(turn, MEAN_SHAPE) + [1.0, 2, -1]
    M = moved + np.array([[0, 8.0 * (k in (4, 5)), 0] for k in range(10)])
    learner, model = begin()
    arguments = jnp.asarray(M, jnp.float32), WINDOWS, jnp.ones((), bool), 0.0
    _, still = learned(learner, model, *arguments, without_weighted_motion)
    direction = remove_rigid(*(jnp.asarray(a, jnp.float32) for a in (M - MEAN_SHAPE, MEAN_SHAPE, RIGID_WEIGHTS)))
    unit = np.asarray(direction).ravel() / np.linalg.norm(direction)
    np.testing.assert_allclose(np.abs(np.asarray(still.basis)[:, 0] @ unit), 1, atol=1e-5)
    mouth = np.zeros((10, 3))
    mouth[4:6, 1] = 1 / np.sqrt(2)
    assert abs(np.asarray(still.basis)[:, 0] @ mouth.ravel()) > 0.97


@pytest.mark.system
def test_coefficients_are_carried_over_to_another_model():
    shapes, _ = deformed(5, 30)
    (_, before), _ = follow_all(shapes)
    (_, after), _ = follow_all(deformed(5, 60)[0])
    # The same two directions in other axes, about another mean within them.
    a = jnp.asarray(np.random.default_rng(6).normal(0, 4, (NUM_MODES, 7)), jnp.float32).at[2:].set(0.0)
    carried = learning.carried(a, before, after)
    for i in range(7):
        np.testing.assert_allclose(shape(after, carried[:, i]), shape(before, a[:, i]), atol=0.05)
    turning = np.asarray(learning.turning(before, after))
    difference = learning.carried(a, before, after) - learning.carried(jnp.zeros_like(a), before, after)
    np.testing.assert_allclose(turning @ np.asarray(a), difference, atol=1e-3)
    np.testing.assert_allclose(learning.carried(a, before, before), a, atol=1e-4)


class Frames:
    """Two frames of one pose, the second of another expression."""

    def __init__(self, seed, expression=(0.2, 0.1)):
        poses = np.tile([*STEREO_PLACE_MM, 0.0, 0, 0], (2, 1))
        self.video = face_sequence(jax.random.key(seed), poses, expressions=np.array([(0.0, 0.0), expression]))
        self.images = jnp.asarray(self.video.frames(0, 2), float)
        self.shapes = jnp.asarray(self.video.shapes)
        self.pose = jnp.asarray(poses[0], float)
        self.windows = recalculation.patches(self.images[0], self.shapes[0], self.pose, self.video.rig)


@pytest.mark.system
def test_shapes_recalculated_on_rendered_frames_are_right():
    """Oracle 9: a neutral model, the true pose, an expression that it has never seen; six faces."""
    before, after = [], []
    for seed in range(6):
        frames = Frames(seed)
        learner = learning.empty_learner(frames.shapes[0], frames.windows)
        images = frames.images[1]
        found, windows = recalculated(learner, frames.shapes[0], images, frames.windows, frames.pose, frames.video.rig)
        before.append(frames.shapes[0] - frames.shapes[1])
        after.append(found - frames.shapes[1])
        again = recalculation.patches(images, found, frames.pose, frames.video.rig)
        np.testing.assert_allclose(windows, again, atol=1e-3)
    rms = lambda errors: np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    assert np.all(rms(before) > [0.6, 0.3, 0.3])
    assert np.all(rms(after) <= [0.1, 0.1, 0.6])
    _, info = jax.jit(recalculation.recalculate)(
        frames.shapes[0], frames.shapes[0], images, frames.windows, frames.windows, frames.pose, frames.video.rig
    )
    assert int(info.iterations) <= 5


@pytest.mark.system
def test_recalculation_goes_on_from_the_frame_before():
    """From windows of the frame before where there are such, else from the registered ones."""
    frames = Frames(1)
    run = partial(recalculated, images=frames.images[1], pose=frames.pose, rig=frames.video.rig)
    fresh = learning.empty_learner(frames.shapes[1], frames.windows)._replace(
        windows=recalculation.patches(frames.images[1], frames.shapes[1], frames.pose, frames.video.rig),
        is_fresh=jnp.ones((), bool),
    )
    stale = fresh._replace(is_fresh=jnp.zeros((), bool))
    arguments = {"estimated": frames.shapes[0], "templates": frames.windows}
    error = [np.abs(run(one, **arguments)[0] - frames.shapes[1]).max() for one in (fresh, stale)]
    assert error[0] < error[1]
    untouched = learning.empty_learner(frames.shapes[0], frames.windows)
    np.testing.assert_array_equal(run(stale, **arguments)[0], run(untouched, **arguments)[0])


def test_faces_of_the_generator_are_learnt_with_two_modes():
    """Expressions of one person: the two modes explain nearly all of their shapes."""
    identity = make_identity(jax.random.key(7))
    rng = np.random.default_rng(8)
    shapes = jax.vmap(partial(face_shape, identity))(*jnp.asarray(rng.uniform(-0.4, 0.7, (2, 150)), float))
    learner, model = begin(identity.neutral)
    for M in shapes[:40]:
        learner, model = learned(learner, model, M, WINDOWS, jnp.ones((), bool), 0.0, without_weighted_motion)
    change = np.asarray(shapes - identity.neutral)
    still = np.stack([without_weighted_motion(jnp.asarray(one), identity.neutral) for one in change[40:60]])
    left = still.reshape(20, -1) - still.reshape(20, -1) @ np.asarray(model.basis) @ np.asarray(model.basis).T
    assert np.sum(left**2) < 0.05 * np.sum(still**2)
    assert float(learning.contribution(learner)) > 0.9
