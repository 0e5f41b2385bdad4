"""Where a search places the hand: on whole arms, before a depth camera and made of capsules."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.skeleton import anatomical_hand, forward_kinematics, open_palm
from jaxfilters.models.hand.start import Start
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.rendering.geometry import Capsules
from jaxfilters.models.synthetic.hand import kinect_v2
from jaxfilters.trackers.hand_depth import search
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.filtering import particles_of, pose_moments

pytestmark = [pytest.mark.system, pytest.mark.optimised]

UPSIDE_DOWN = np.array([0.0, 0.0, 0.0, 1.0], np.float32)
"""A quaternion: half a turn about the optical axis."""


def searched(camera, depth):
    """Joints of the hand that is found in a frame, metres."""
    config = HandDepthConfig(num_particles=64)
    state = hand_depth.build(camera, config).init(jax.random.key(0), depth)
    assert int(state.misses) == 0
    pose, _ = pose_moments(*particles_of(state.ensemble))
    geometry = hand_depth.set_up(camera, config).hand(state).geometry
    return np.asarray(forward_kinematics(pose, geometry).joints)


def test_a_hand_upside_down_on_the_forearm_must_explain_the_fingers_too(monkeypatch):
    # The start on the arm costs less about its own place than the true one about the palm, as on recordings of arms.
    hand, wrist = anatomical_hand(), jnp.array([0.0, 0.0, 0.6])
    true = forward_kinematics(open_palm(wrist), hand)
    arm = Capsules(wrist[None], wrist[None] + jnp.array([[0.0, 0.26, 0.0]]), jnp.array([0.03]))
    capsules = jax.tree.map(lambda *parts: jnp.concatenate(parts), true.capsules, arm)
    depth = np.asarray(jax.jit(render_capsules)(kinect_v2(), capsules))
    right = Start(np.asarray(open_palm(wrist), np.float32), 1.0, 1.0, 0.012)
    wrong = right._replace(pose=right.pose.copy(), cost=0.001)
    wrong.pose[3:7] = UPSIDE_DOWN

    def starts(camera, observed, center, *rest):
        return [wrong if center[1] > 0.05 else right]

    monkeypatch.setattr(search, "find_starts", starts)
    found = searched(kinect_v2(), depth)
    np.testing.assert_allclose(found.mean(axis=0), np.asarray(true.joints).mean(axis=0), atol=0.01)


def test_a_race_waits_while_the_fingers_are_hidden_but_not_for_small_holes(monkeypatch):
    camera, wrist = kinect_v2(), jnp.array([0.0, 0.05, 0.6])
    true = forward_kinematics(open_palm(wrist), anatomical_hand())
    shown = np.asarray(jax.jit(render_capsules)(camera, true.capsules))
    frame = np.where(np.isfinite(shown), shown, 1.5).astype(np.float32)
    knuckle = int(camera.project(true.joints[9])[1])
    hidden = np.where(np.arange(len(frame))[:, None] < knuckle, np.nan, frame)
    setup = hand_depth.set_up(camera, HandDepthConfig(num_particles=64))
    start = Start(np.asarray(open_palm(wrist), np.float32), 1.0, 1.0, 0.005)
    monkeypatch.setattr(search, "find_starts", lambda *_: [start])
    state = hand_depth.build(camera, setup.config).init(jax.random.key(0), frame)
    raced = []
    monkeypatch.setattr(search, "find_starts", lambda *_: raced.append(True) or [])
    after = search.race(setup, state, hidden, 1.0)
    assert not raced
    assert float(after.race_time) == pytest.approx(1.0 + search.SECOND_CHANCE)
    holes = np.where(np.arange(frame.size).reshape(frame.shape) % 2, np.nan, frame)
    search.race(setup, state, holes, 1.0)
    assert len(raced) == 1


@pytest.mark.data
@pytest.mark.parametrize(("number", "quarters"), [(2, 2), (4, 1), (4, 3)])
def test_the_hand_of_a_real_arm_is_found_however_the_camera_is_turned(data_dir, number, quarters):
    # In all three an upside-down hand on the forearm used to cost least.
    recorded = np.load(data_dir / "hadjust_user1_depth" / "user1.npz")
    depth, mask = (np.rot90(recorded[name][number], quarters) for name in ("depth_mm", "mask"))
    rows, cols = depth.shape
    focal = float(recorded["K"][0, 0])
    camera = Pinhole.from_intrinsics(focal, [cols / 2, rows / 2], (rows, cols))
    joints = searched(camera, np.where(depth > 0, depth / 1000, np.nan).astype(np.float32))
    u, v = np.round(focal * joints[:, :2] / joints[:, 2:] + [cols / 2, rows / 2]).astype(int).T
    # Of the hand without its wrist, by an orange band.
    assert mask[np.clip(v, 0, rows - 1), np.clip(u, 0, cols - 1)].mean() > 0.8
