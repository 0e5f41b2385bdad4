"""Key frames of a turned head: when one is kept, which is compared with, and what they are good for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.landmarks import MEAN_SHAPE, NUM_LANDMARKS
from jaxfilters.models.face.patches import SKIN_NORMALS, patches
from jaxfilters.models.face.rig import nominal
from jaxfilters.trackers.head.common.recent import nothing_changed
from jaxfilters.trackers.head.stereo import key_frames as module
from jaxfilters.trackers.head.stereo.key_frames import nearest_patches, no_key_frames, with_key_frame

RIG = nominal()
EVERY = np.ones((2, NUM_LANDMARKS), bool)
VARIANCE = 0.25


def turned(yaw_deg=0.0, roll_deg=0.0):
    return jnp.asarray([0.0, 0.0, 650.0, *np.radians([roll_deg, yaw_deg, 0.0])], jnp.float32)


def at_registration(seed=0):
    images = np.random.default_rng(seed).integers(0, 256, (2, 480, 640)).astype(np.float32)
    shape = jnp.asarray(MEAN_SHAPE, jnp.float32)
    return patches(jnp.asarray(images), shape, turned(), RIG, jnp.asarray(SKIN_NORMALS, jnp.float32)), images, shape


def with_frame(kept, pose, images, shape, is_placed=EVERY, score=0.9):
    recent = nothing_changed(jnp.asarray(images), shape, pose, RIG)
    belief = Gaussian(pose, VARIANCE * jnp.eye(6))
    return with_key_frame(kept, turned(), belief, recent, jnp.asarray(is_placed), jnp.asarray(score), RIG)


@pytest.mark.system
def test_a_frame_is_kept_that_shows_a_new_side_well():
    registered, images, shape = at_registration()
    none = no_key_frames(registered)
    few = EVERY & (np.arange(NUM_LANDMARKS) < module.FEWEST_LANDMARKS - 1)
    assert int(with_frame(none, turned(module.FARTHEST - 1), images, shape).num_kept) == 0
    assert int(with_frame(none, turned(roll_deg=60.0), images, shape).num_kept) == 0, "turned in the image's plane"
    assert int(with_frame(none, turned(30.0), images, shape, score=module.LEAST_SCORE - 0.01).num_kept) == 0
    assert int(with_frame(none, turned(30.0), images, shape, is_placed=few).num_kept) == 0
    one = with_frame(none, turned(30.0), images, shape)
    assert int(one.num_kept) == 1
    np.testing.assert_allclose(one.outward[0], -Rotation.from_euler("Y", 30, degrees=True).as_matrix()[:, 2], atol=1e-6)
    assert int(with_frame(one, turned(30.0 + module.FARTHEST - 1), images, shape).num_kept) == 1, "near the other one"
    many = one
    for yaw in (60.0, -30.0, -60.0, 90.0, -90.0, 120.0, 150.0):
        many = with_frame(many, turned(yaw), images, shape)
    assert int(many.num_kept) == module.NUM_KEY_FRAMES
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), many.patches, one.patches)


@pytest.mark.system
def test_each_landmark_is_compared_with_the_most_similar_side_that_shows_it():
    registered = at_registration()[0]
    shown = EVERY.copy()
    shown[1, 3] = False
    kept = with_frame(no_key_frames(registered), turned(30.0), *at_registration(1)[1:])
    kept = with_frame(kept, turned(60.0), *at_registration(2)[1:], is_placed=shown)

    def compared(yaw, roll=0.0):
        return np.asarray(nearest_patches(kept, registered, turned(), turned(yaw, roll))[0].template)

    first, second = np.asarray(kept.patches.template[:2])
    np.testing.assert_array_equal(compared(0.0), registered.template)
    np.testing.assert_array_equal(compared(0.0, 70.0), registered.template)
    np.testing.assert_array_equal(
        compared(15.0 + 0.4 * module.PREFERENCE), registered.template, "as far, but the first"
    )
    np.testing.assert_array_equal(compared(30.0), first)
    expected = second.copy()
    expected[1, 3] = first[1, 3]
    np.testing.assert_array_equal(compared(55.0), expected)
    np.testing.assert_array_equal(compared(55.0, 40.0), expected)
    lasting = lambda yaw: np.asarray(nearest_patches(kept, registered, turned(), turned(yaw))[1])
    np.testing.assert_array_equal(lasting(0.0), np.zeros((6, 6)), "registration is right by definition")
    np.testing.assert_allclose(lasting(30.0), VARIANCE * np.eye(6), rtol=1e-6)
