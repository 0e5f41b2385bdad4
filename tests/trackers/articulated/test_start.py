"""Starts from one image: the true pose is among them where it can be told, and what was not seen does not matter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.anatomy import (
    five_finger_limits,
    flexion_correlation,
    relaxed_angles,
    template_shape,
)
from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.filters import inequalities
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import five_fingers
from jaxfilters.models.articulated.limits import limit_rows
from jaxfilters.models.articulated.motion import about_ease
from jaxfilters.models.articulated.projection import Perspective, WeakPerspective
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.articulated.start import ANGLE_STD, NUM_STARTS, size_of, starts_from_points

pytestmark = pytest.mark.system

CAMERA = Pinhole.from_intrinsics(600.0, (320.0, 240.0), (480, 640))


def hand_in(projection):
    layout = five_fingers(projection.position_size)
    hand = articulated_hand(layout, projection=projection, features=KEYPOINTS)
    return hand, inequalities(limit_rows(layout, five_finger_limits(layout))).constraints


def true_state(hand, turned, rng):
    """A hand near ease, palm up and to the camera, then turned by a rotation vector in degrees."""
    layout, in_space = hand.layout, hand.layout.position_size == 3
    upright = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
    x, y, z, w = (Rotation.from_rotvec(turned, degrees=True) * upright).as_quat()
    state = np.zeros(layout.size)
    state[layout.position] = (0.03, -0.05, 0.55) if in_space else (300.0, 260.0)
    state[layout.quaternion], state[layout.static] = (w, x, y, z), template_shape() * (1e-3 if in_space else 1.0)
    angles = relaxed_angles(layout) + np.radians(6.0) * rng.standard_normal((5, 4))
    state[layout.angles] = angles.ravel()
    return jnp.asarray(state, jnp.float32)


@pytest.fixture(scope="module", params=[WeakPerspective(), Perspective(CAMERA)], ids=["weak", "perspective"])
def scene(request):
    hand, limits = hand_in(request.param)
    std = jnp.full(42, 2.0)
    return hand, jax.jit(lambda y, mask: starts_from_points(hand, limits, y, mask, std))


def rotation_error(hand, states, truth):
    q = np.asarray(states)[:, hand.layout.quaternion]
    p = np.asarray(truth)[hand.layout.quaternion]
    return np.degrees(2 * np.arccos(np.clip(np.abs(q @ p), 0, 1)))


@pytest.mark.parametrize("turned", [(0, 0, 0), (35, 0, 0), (0, 0, 120), (0, 170, 0), (20, 30, -60)])
def test_the_true_pose_is_among_the_starts(scene, turned):
    hand, starts = scene
    truth = true_state(hand, turned, np.random.default_rng(1))
    found = starts(hand.observe(truth), jnp.ones(42, bool))
    assert bool(found.found)
    assert rotation_error(hand, found.means[:3], truth).min() < 15.0
    image = hand.image_points(found.means[0]) - hand.image_points(truth)
    assert float(jnp.sqrt(jnp.mean(image**2))) < 3.0


def test_what_was_not_measured_does_not_matter(scene):
    """Middle joints, tips and the wrist alone, with anything in the other rows."""
    hand, starts = scene
    truth = true_state(hand, (20, 0, 10), np.random.default_rng(2))
    joints = np.zeros((5, 3, 2), bool)
    joints[:, [0, 2]] = True
    mask = jnp.asarray(np.concatenate([[True, True], np.zeros(10, bool), joints.ravel()]))
    y = hand.observe(truth)
    one, other = (starts(jnp.where(mask, y, rest), mask) for rest in (0.0, 1e4))
    np.testing.assert_array_equal(one.means, other.means)
    assert rotation_error(hand, one.means[:3], truth).min() < 25.0


def test_covariances_are_positive_and_leave_a_weak_scale_alone(scene):
    hand, starts = scene
    truth = true_state(hand, (10, 0, 0), np.random.default_rng(3))
    found = starts(hand.observe(truth), jnp.ones(42, bool))
    for mean, covariance in zip(np.asarray(found.means, float), np.asarray(found.covariances, float), strict=True):
        eigenvalues = np.linalg.eigvalsh(covariance)
        assert eigenvalues[0] > -1e-6 * eigenvalues[-1]
        q = mean[hand.layout.quaternion]
        assert abs(q @ covariance[hand.layout.quaternion, hand.layout.quaternion] @ q) < 1e-6


def test_a_hidden_finger_is_as_those_beside_it_let_expect():
    """What nothing is measured of has its conditional mean, and a start the correlation of angles at rest."""
    layout, projection = five_fingers(3), Perspective(CAMERA)
    alike, ease = flexion_correlation(layout), relaxed_angles(layout).ravel()
    motion = about_ease(layout, ease, correlation=alike)
    hand = articulated_hand(layout, projection=projection, features=KEYPOINTS, motion=motion)
    truth = np.array(true_state(hand, (20, 0, 0), np.random.default_rng(5)))
    bent = np.radians([[0, 0, 0, 0], *[[0, 10, 25, 20]] * 4])
    truth[layout.angles] += bent.ravel()
    hidden = np.zeros((5, 4), bool)
    hidden[3, 1:] = True  # the flexions of the ring finger
    points = np.ones((5, 3, 2), bool)
    points[3] = False
    mask = jnp.asarray(np.concatenate([np.ones(12, bool), points.ravel()]))
    found = starts_from_points(hand, None, hand.observe(jnp.asarray(truth)), mask, jnp.full(42, 1.0))
    off = np.asarray(found.means[0])[layout.angles] - ease
    ring = hidden.ravel()
    expected = alike[np.ix_(ring, ~ring)] @ np.linalg.solve(alike[np.ix_(~ring, ~ring)], off[~ring])
    assert (expected[1:] > np.radians(8.0)).all()
    np.testing.assert_allclose(off[ring], expected, atol=np.radians(0.5))
    block = np.asarray(found.covariances[0])[layout.angles, layout.angles]
    np.testing.assert_allclose(block, ANGLE_STD**2 * alike, atol=1e-6)


def test_too_few_points_are_no_start(scene):
    hand, starts = scene
    truth = true_state(hand, (0, 0, 0), np.random.default_rng(4))
    found = starts(hand.observe(truth), jnp.arange(42) < 6)
    assert not bool(found.found)
    assert found.means.shape[0] == NUM_STARTS
    assert bool(jnp.all(jnp.isfinite(found.means)))


def test_a_measured_palm_gives_the_size_and_the_distance():
    """A small hand: its image alone is that of an average hand farther away; with its palm's width it is not."""
    hand, limits = hand_in(Perspective(CAMERA))
    layout, share = hand.layout, 0.8
    truth = true_state(hand, (0, 0, 0), np.random.default_rng(5)).at[layout.static].multiply(share)
    y, mask, std = hand.observe(truth), jnp.ones(42, bool), jnp.full(42, 2.0)
    average, measured = (
        jax.jit(lambda size: starts_from_points(hand, limits, y, mask, std, size))(size_of(width))
        for width in (None, share * 0.08)
    )
    wide, deep = layout.palm.start, 2
    assert average.means[0, deep] > 1.1 * truth[deep]
    assert measured.means[0, deep] == pytest.approx(float(truth[deep]), rel=0.06)
    assert measured.means[0, wide] == pytest.approx(share * 0.08, rel=0.03)
    # A ruler's error for the width, and a third of what nobody measured for the distance's.
    deviations = [np.sqrt(np.diagonal(found.covariances[0])) for found in (average, measured)]
    assert deviations[1][wide] == pytest.approx(0.002, rel=0.05)
    assert deviations[1][deep] < 0.6 * deviations[0][deep]
