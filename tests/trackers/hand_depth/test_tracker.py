"""The hand tracker, whole: on rendered sequences with known truth, through loss and silence, and on real depth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.observation import crop, hand_image
from jaxfilters.models.hand.skeleton import anatomical_hand, forward_kinematics, hand_center, open_palm, retract
from jaxfilters.models.rendering.depth import capsule_depth
from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.trackers.hand_depth import filtering
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.trackers.hand_depth.recording import with_nan_for_nothing
from jaxfilters.trackers.hand_depth.tracker import DOUBTFUL, LOST, SEARCHING, TRACKING
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.tracker import CHUNK

pytestmark = pytest.mark.optimised

NUM_PARTICLES = 64


@pytest.fixture(scope="module")
def sequence():
    made = simulate_sequence(jax.random.key(1), "B", num_frames=2 * CHUNK, geometry=anatomical_hand())
    depth = np.asarray(made.depth_mm, np.float32) / 1000
    return depth, np.asarray(made.joints)


@pytest.fixture(scope="module")
def tracker():
    return hand_depth.build(kinect_v2(), HandDepthConfig(num_particles=NUM_PARTICLES))


def follow(tracker, depth, seed=0):
    state, rows = tracker.init(jax.random.key(seed), depth[0]), []
    for first in range(0, len(depth), CHUNK):
        times = np.arange(first, first + CHUNK, dtype=np.float32) / 30
        state, track = tracker.step(state, depth[first : first + CHUNK], times)
        rows.append(track)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *rows)


def joint_errors_mm(track, joints):
    return 1000 * np.linalg.norm(track.joints - joints, axis=-1).mean(-1)


@pytest.fixture(scope="module")
def track(tracker, sequence):
    return follow(tracker, sequence[0])


def test_images_of_another_size_than_the_cameras_are_refused(tracker, sequence):
    depth = sequence[0]
    shape = r"\(424, 512\) rows and columns"
    with pytest.raises(ValueError, match=f"frame: expected the camera's {shape}; got \\(212, 256\\)"):
        hand_depth.track([depth[0, ::2, ::2]], np.zeros(1), kinect_v2())
    state = tracker.init(jax.random.key(0), depth[0])
    with pytest.raises(ValueError, match=f"frames: expected {shape} each; got \\(212, 256\\)"):
        tracker.step(state, depth[:CHUNK, ::2, ::2], np.arange(CHUNK, dtype=np.float32) / 30)


def test_nothing_was_read_where_a_frame_is_zero_or_infinite():
    frame = np.array([[0.5, 0.0], [np.inf, -1.0]])
    np.testing.assert_array_equal(with_nan_for_nothing(frame), np.array([[0.5, np.nan], [np.nan, np.nan]], np.float32))


@pytest.mark.system
def test_a_moving_hand_is_followed_from_an_automatic_start(track, sequence):
    errors = joint_errors_mm(track, sequence[1])
    assert np.all(track.status == TRACKING)
    assert errors.mean() < 12
    assert np.all(np.isfinite(track.log_evidence))
    assert np.all((track.effective_sample_size >= 1) & (track.effective_sample_size <= NUM_PARTICLES))
    assert np.all(track.pose_std > 0)
    np.testing.assert_allclose(np.linalg.norm(track.pose[:, 3:7], axis=1), 1, atol=1e-5)


@pytest.mark.system
def test_the_same_key_gives_the_same_track(tracker, track, sequence):
    again = follow(tracker, sequence[0])
    for name in track._fields:
        np.testing.assert_array_equal(getattr(again, name), getattr(track, name), err_msg=name)


@pytest.mark.system
def test_what_comes_later_changes_nothing_before(tracker, track, sequence):
    depth = sequence[0].copy()
    depth[7:] = np.nan
    np.testing.assert_array_equal(follow(tracker, depth[:CHUNK]).joints[:7], track.joints[:7])


@pytest.mark.system
def test_a_hand_that_leaves_and_returns_is_said_lost_and_found_again(tracker, sequence):
    depth, joints = sequence
    away = slice(5, 14)
    depth = depth.copy()
    depth[away] = 3.0
    track = follow(tracker, depth)
    assert np.all(track.status[:5] == TRACKING)
    assert np.all(track.status[5:10] == LOST)
    assert np.all(track.status[10:14] == SEARCHING)
    assert np.all(np.isnan(track.joints[10:14]))
    assert np.all(track.status[14:] == TRACKING)
    assert joint_errors_mm(track, joints)[14:].mean() < 20


@pytest.mark.system
def test_a_hand_that_jumps_away_is_found_one_frame_after_it_was_missed(tracker, sequence):
    depth, joints = sequence[0][:CHUNK].copy(), sequence[1][:CHUNK]
    depth[5:] = np.roll(depth[5:], 150, axis=2)
    track = follow(tracker, depth)
    np.testing.assert_array_equal(track.status, [TRACKING] * 5 + [LOST] + [TRACKING] * (CHUNK - 6))
    aside = joints[6:, :, 2:] * np.array([150 / float(kinect_v2().focal[0]), 0.0, 0.0])
    assert 1000 * np.linalg.norm(track.joints[6:] - joints[6:] - aside, axis=-1).mean() < 20


@pytest.mark.system
def test_an_estimate_that_suddenly_explains_less_is_doubtful(tracker, sequence):
    depth = sequence[0][:CHUNK].copy()
    depth[5:] = np.roll(depth[5:], 25, axis=2)
    track = follow(tracker, depth)
    assert np.all(track.status[:5] == TRACKING)
    assert track.status[5] == DOUBTFUL
    assert joint_errors_mm(track, sequence[1][:CHUNK])[5] > 25


@pytest.mark.system
@pytest.mark.parametrize("value", [np.nan, 3.0])
def test_without_any_hand_the_tracker_searches(tracker, value):
    track = follow(tracker, np.full((CHUNK, 424, 512), value, np.float32))
    assert np.all(track.status == SEARCHING)
    assert np.all(np.isnan(track.joints))


@pytest.mark.system
def test_the_size_is_fitted_to_the_first_frame_that_shows_a_hand(tracker, sequence):
    blank = np.full((424, 512), 3.0, np.float32)
    state = tracker.init(jax.random.key(0), blank)
    assert np.isnan(state.scale)
    depth = np.concatenate([np.stack([blank] * 2), sequence[0][: CHUNK - 2]])
    state, track = tracker.step(state, depth, np.arange(CHUNK, dtype=np.float32) / 30)
    assert np.all(track.status == [SEARCHING] * 2 + [TRACKING] * (CHUNK - 2))
    assert abs(float(state.scale) - 1) < 0.051
    assert joint_errors_mm(track, np.concatenate([sequence[1][:2], sequence[1]])[:CHUNK])[2:].mean() < 15


@pytest.mark.system
def test_the_other_hand_is_never_tracked_without_a_doubt(sequence):
    config = HandDepthConfig(num_particles=NUM_PARTICLES, hand="left")
    track = follow(hand_depth.build(kinect_v2(), config), sequence[0][:CHUNK])
    assert not np.any(track.status == TRACKING)


@pytest.mark.system
def test_the_plain_filter_follows_without_a_guide_too(sequence):
    tracker = hand_depth.build(kinect_v2(), HandDepthConfig(num_particles=256, filter="pf", guide=False))
    track = follow(tracker, sequence[0][:CHUNK])
    assert np.all(np.isfinite(track.joints))
    assert joint_errors_mm(track, sequence[1][:CHUNK]).mean() < 60


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"filter": "kalman"}, "filter must be one of rbpf, pf"),
        ({"hand": "both"}, "hand must be one of"),
        ({"missing": "maybe"}, "missing must be one of"),
        ({"num_particles": 0}, "num_particles must be at least 1"),
        ({"stride": 0}, "stride must be at least 1"),
        ({"scale": 5.0}, "scale must be between 0.5 and 2"),
    ],
)
def test_settings_that_cannot_be_are_named(options, named):
    with pytest.raises(ValueError, match=named):
        HandDepthConfig(**options)


@pytest.mark.data
@pytest.mark.system
def test_a_real_hand_is_followed(data_dir):
    # A loose fist that opens within half a second; its truth is itself a model fit, 6 mm off the depth in the median.
    recording = open_depth(data_dir / "hpx_hand_rgbd" / "hpx.npz")
    tracker = hand_depth.build(recording.camera, HandDepthConfig())
    depth = np.stack([recording[i] for i in range(len(recording))])
    times = (recording.times_s - recording.times_s[0]).astype(np.float32)
    _, track = tracker.step(tracker.init(jax.random.key(0), depth[0]), depth, times)
    assert np.isin(track.status, (TRACKING, DOUBTFUL)).all()  # a fist is explained as well by the other hand
    # Of two seeds 13.8 and 13.8 mm; 15.2 and 16.1 where the best finalists are registered with every size only once.
    assert joint_errors_mm(track, recording.joints).mean() < 14.5


def test_the_velocity_of_a_hidden_digit_decays_sooner_and_that_of_others_as_before():
    dt, hidden = 1 / 30, np.arange(5) == 2
    decay = np.diagonal(filtering._slowed(filtering.MOTION, jnp.asarray(hidden)).dynamics(jnp.zeros(22), dt).A_l)
    usual = np.diagonal(filtering.MOTION.dynamics(jnp.zeros(22), dt).A_l)
    middle = slice(6 + 3 * 2, 6 + 3 * 3)
    np.testing.assert_allclose(decay[middle], np.exp(-dt / filtering.HIDDEN_DIGIT_S), rtol=1e-5)
    np.testing.assert_array_equal(np.delete(decay, middle), np.delete(usual, middle))


@pytest.mark.system
def test_a_frame_without_readings_of_the_fingers_slows_them(tracker, sequence):
    depth, joints = sequence[0].copy(), sequence[1]
    times = np.arange(2 * CHUNK, dtype=np.float32) / 30
    state, _ = tracker.step(tracker.init(jax.random.key(0), depth[0]), depth[:CHUNK], times[:CHUNK])
    assert not np.any(state.hidden)
    pixels = np.asarray(kinect_v2().project(jnp.asarray(joints[CHUNK:, 6:].reshape(-1, 3))))
    low, high = np.floor(pixels.min(0)).astype(int) - 5, np.ceil(pixels.max(0)).astype(int) + 5
    depth[CHUNK:, low[1] : high[1], low[0] : high[0]] = np.nan
    after, track = tracker.step(state, depth[CHUNK:], times[CHUNK:])
    assert np.all(np.asarray(after.hidden)[1:])
    # The first frame alone is predicted with what the state says of the last one.
    other = state._replace(hidden=jnp.ones(5, bool))
    assert not np.array_equal(tracker.step(other, depth[CHUNK:], times[CHUNK:])[1].pose[0], track.pose[0])


@pytest.mark.system
def test_a_hand_that_moved_far_is_found_from_a_particle_but_not_while_a_digit_is_hidden():
    """The mean pose shows the other side of the hand; from there, registration ends 55 mm away, from a particle 13."""
    setup = hand_depth.set_up(kinect_v2(), HandDepthConfig(hand="right", scale=1.0))
    true = open_palm(jnp.array([0.0, 0.09, 0.7]))
    turned = retract(true, jnp.zeros(21).at[4].set(2.5))
    window, empty = crop(setup.camera, jnp.full(setup.camera.shape, jnp.inf), hand_center(true), filtering.WINDOW, 1)
    depth = capsule_depth(window, forward_kinematics(true, setup.likelihood.geometry).capsules)
    image = hand_image(window, jnp.minimum(depth, empty))
    noise = 0.01 * jax.random.normal(jax.random.key(0), (21, 60))
    near = retract(true, jnp.zeros(21).at[:3].set(0.012).at[5].set(0.15))
    particles = jax.vmap(retract, in_axes=(None, 1), out_axes=1)(turned, noise).at[:, 30].set(near)

    found = filtering._look(setup.likelihood, particles, jnp.full(60, -jnp.log(60)), image)

    def error_mm(pose):
        joints = [forward_kinematics(each, setup.likelihood.geometry).joints for each in (pose, true)]
        return 1000 * float(jnp.linalg.norm(joints[0] - joints[1], axis=-1).mean())

    best = int(jnp.argmax(found.log_likelihoods))
    assert best != 0
    assert error_mm(found.points[best]) < 20 < 30 < error_mm(near)
    assert error_mm(found.points[0]) > 40
    hidden = image._replace(observed=image.observed.at[:60].set(jnp.nan))
    assert not np.isfinite(
        filtering._look(setup.likelihood, particles, jnp.full(60, -jnp.log(60)), hidden).log_likelihoods[1:]
    ).any()
