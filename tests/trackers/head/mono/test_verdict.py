"""When a track is no longer that of the registered face, with SciPy's rotations as the oracle for the turn."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face.patches import SKIN_NORMALS, patches_of
from jaxfilters.trackers.head.common.state import LOST
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.head.mono.verdict import is_outlier
from jaxfilters.trackers.head.stereo.tracking import MOST_OUTLIERS


def outlier(num_anchored, score, turn_deg=0.0):
    """With a random registered pose and another one that is turned by that angle from it, about a random axis."""
    draw = np.random.default_rng(4)
    registered = Rotation.from_euler("ZYX", draw.normal(0, 0.3, 3))
    axis = draw.normal(size=3)
    other = Rotation.from_rotvec(np.radians(turn_deg) * axis / np.linalg.norm(axis)) * registered
    poses = [jnp.asarray([*draw.normal(0, 50, 3), *one.as_euler("ZYX")], float) for one in (other, registered)]
    return bool(is_outlier(jnp.asarray(float(num_anchored)), jnp.asarray(score), *poses))


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 44.0])
def test_a_face_that_looks_as_at_registration_must_correlate_with_it(turn_deg):
    assert outlier(5, 0.3, turn_deg)
    assert not outlier(5, 0.4, turn_deg)


@pytest.mark.parametrize("turn_deg", [46.0, 90.0, 170.0])
def test_a_face_that_is_turned_away_need_not(turn_deg):
    assert not outlier(5, 0.1, turn_deg)
    assert outlier(1, 0.9, turn_deg)


@pytest.mark.system
def test_what_has_slipped_off_the_registered_face_is_lost(rig, face, talking, detected):
    """Seven patches of the registered face are another's: three landmarks still fit, and the last frame's looks do."""
    made, images = talking
    session = MonoSession(rig, face, detections=detected)
    session.process(images[:24], made.times[:24])
    following = session._following
    state = following.state
    wide = np.array(state.registered.wide)
    wide[:, 3:] = np.random.default_rng(2).uniform(0, 255, wide[:, 3:].shape)
    patches = patches_of(jnp.asarray(wide), state.model.mean, state.window.poses[0], rig, jnp.asarray(SKIN_NORMALS))
    following.state = state._replace(
        registered=state.registered._replace(wide=jnp.asarray(wide), patches=patches),
        recent=state.recent._replace(has_changed=jnp.arange(10)[None] >= 3),
    )
    back_and_forth = np.resize(np.r_[24:56, 55:23:-1], 96)
    times = made.times[23] + np.arange(1, 97) / 30
    track = session.process(images[back_and_forth], times)
    assert not np.any(track.status[:MOST_OUTLIERS] == LOST)
    assert np.any(track.status[MOST_OUTLIERS:] == LOST)
