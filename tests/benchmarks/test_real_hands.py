"""Recordings of hands: what is rendered agrees with the joints, and the comparison of filters on them."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import _real_comparison, _real_hands, hand_starts
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.skeleton import anatomical_hand, forward_kinematics, open_palm
from jaxfilters.trackers.hand_depth.tracker import DOUBTFUL, SEARCHING, TRACKING
from jaxfilters.trackers.tracker import Tracker


def test_the_flexion_of_second_joints_is_that_of_the_pose():
    bent = np.array([0.1, 0.4, 0.8, 1.2])
    pose = open_palm(jnp.array([0.0, 0.1, 0.7])).at[jnp.array([12, 15, 18, 21])].set(bent)
    joints = np.asarray(forward_kinematics(pose.at[jnp.array([10, 14])].set(0.3), anatomical_hand()).joints)
    np.testing.assert_allclose(_real_hands.pip_flexion(joints[None])[0], bent, atol=1e-4)


def test_a_triangle_is_rendered_at_its_depth_and_nothing_beside_it():
    matrix = np.array([[100.0, 0, 20], [0, 100.0, 15], [0, 0, 1]])
    corners = np.array([[-10.0, -10, 500], [10, -10, 500], [-10, 10, 600]])
    depth = _real_hands._rendered(corners, np.array([[0, 1, 2]]), matrix, (30, 40))
    v, u = np.nonzero(np.isfinite(depth))
    assert {(13, 18), (13, 22), (17, 18)} <= set(zip(v.tolist(), u.tolist(), strict=True))
    # Depth is 550 + 5 y on the plane, y = (v - 15) z / 100; a reading is up to half a pixel from the pixel's middle.
    plane = 0.55 / (1 - 0.05 * (v - 15))
    np.testing.assert_allclose(depth[v, u], plane, atol=0.02)
    assert set(u) <= set(range(18, 23))
    assert set(v) <= set(range(13, 18))


@pytest.mark.data
@pytest.mark.parametrize("name", ["08_R", "03_L"])
def test_joints_lie_within_the_hand_that_is_rendered(name, data_dir):
    del data_dir
    found = _real_hands.load(name, num_frames=2)
    uv = np.asarray(found.camera.project(jnp.asarray(found.joints)))
    u, v = np.rint(np.moveaxis(uv, -1, 0)).astype(int)
    skin = found.depth[np.arange(2)[:, None], v, u]
    behind = found.joints[..., 2] - skin
    under_the_skin = np.abs(behind - 0.015) < 0.025
    inner = np.setdiff1d(np.arange(21), (4, 8, 12, 16, 20))  # a tip's own pixel may be beside the hand
    assert under_the_skin[:, inner].mean() > 0.8  # some lie behind a finger
    assert np.isnan(found.depth).sum() == 0


@pytest.mark.data
def test_a_lower_rate_takes_frames_at_its_own_times(data_dir):
    del data_dir
    all_of_them, every = _real_hands.load("08_R", num_frames=4), _real_hands.load("08_R", num_frames=2, every=2)
    np.testing.assert_array_equal(every.joints, all_of_them.joints[::2])
    np.testing.assert_allclose(every.times_s, [0, 2 / 30], atol=1e-7)
    assert np.abs(every.depth - all_of_them.depth[::2]).max() < 12 * _real_hands.NOISE_M


@pytest.mark.data
def test_a_turned_motion_is_the_same_hand_about_the_same_palm(data_dir):
    del data_dir
    plain, turned = (_real_hands.load("02_L", 2, evenly=True, turned_deg=turn) for turn in ((0.0, 0.0), (30.0, -40.0)))
    middle = plain.joints[:, _real_hands.PALM].mean(axis=1, keepdims=True)
    turn = Rotation.from_euler("xy", [30, -40], degrees=True)
    expected = turn.apply((plain.joints - middle).reshape(-1, 3)).reshape(plain.joints.shape) + middle
    np.testing.assert_allclose(turned.joints, expected, atol=1e-6)
    uv = np.rint(np.asarray(turned.camera.project(jnp.asarray(turned.joints)))).astype(int)
    shown = turned.depth[np.arange(2)[:, None], uv[..., 1], uv[..., 0]] < 1
    assert shown.mean() > 0.7


def test_starts_are_counted_by_their_errors_and_what_their_status_says():
    outcomes = [(8.0, TRACKING), (30.0, TRACKING), (60.0, DOUBTFUL), (float("nan"), SEARCHING)]
    found = hand_starts._metrics(outcomes, np.array([24.0, 26.0, 60.0, np.nan]), "_turned")
    values = {name: metric.value for name, metric in found.items()}
    assert values == {
        "found_turned": 25,
        "wrong_turned": 25,
        "searching_turned": 25,
        "median_error_mm_turned": 30,
        "found_turned_simple": 25,
        "median_error_mm_turned_simple": 26,
    }


def test_hidden_fingers_have_no_readings_and_only_they_count():
    camera = Pinhole.from_intrinsics(100.0, (50.0, 50.0), (100, 100))
    joints = np.tile([0.0, 0.0, 1.0], (48, 21, 1))
    joints[:, 5:, 0] = np.tile([-0.3, 0.1, 0.1, 0.2], 4)  # metres, in a plane: a pixel is a centimetre
    depth, times = np.ones((48, 100, 100), np.float32), np.arange(48, dtype=np.float32) / 30
    found = _real_comparison.with_hidden_fingers(_real_hands.HandRecording(camera, times, depth, joints, 1.0))
    hidden = np.isnan(found.depth)
    assert np.flatnonzero(hidden.any(axis=(1, 2))).tolist() == [*range(10, 20), *range(32, 42)]
    # From the second joints to the tips, columns 60 to 70, with 12 pixels on each side; rows about 50.
    rows, columns = (np.flatnonzero(hidden[12].any(axis=1 - axis)) for axis in range(2))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (38, 61, 48, 81)
    assert np.isfinite(found.joints).all(axis=(1, 2)).tolist() == hidden.any(axis=(1, 2)).tolist()
    assert not np.isnan(depth).any()


def test_registration_alone_is_told_the_time_between_frames(monkeypatch):
    """A stand-in puts every joint as many metres aside as the frame comes seconds after the one before."""
    camera = Pinhole.from_intrinsics(1.0, (0.0, 0.0), (1, 1))
    times, joints = np.array([5.0, 5.1, 5.4], np.float32), np.zeros((3, 21, 3))
    recording = _real_hands.HandRecording(camera, times, np.zeros((3, 1, 1), np.float32), joints, 1.0)
    tracker = Tracker(lambda key, frame: None, lambda state, frames, times: None)
    monkeypatch.setattr(_real_comparison.hand_depth, "build", lambda camera, config: tracker)
    aside = lambda setup, state, frames, elapsed: (None, jnp.zeros((3, 21, 3)).at[..., 0].set(elapsed[:, None]))
    monkeypatch.setattr(_real_comparison, "registered", aside)
    expected = 1e3 * np.mean([1 / 30, 0.1, 0.3])
    assert _real_comparison.registration_error(recording, 0).mm == pytest.approx(expected, rel=1e-5)


def test_real_hands_are_compared_recording_by_recording(monkeypatch):
    millimetres = {"rbpf": [5.0, 6, 7, 8, 9], "pf": [6.0, 7, 8, 9, 10], "registration": [4.0, 5, 6, 7, 8]}
    camera = Pinhole.from_intrinsics(1.0, (0.0, 0.0), (1, 1))
    empty = (np.zeros(0, np.float32), np.zeros((0, 1, 1), np.float32), np.zeros((0, 21, 3)))
    recordings = [_real_hands.HandRecording(camera, *empty, float(i)) for i in range(5)]

    def error_of(name, each, count=1000):
        return _real_comparison.RunErrors(millimetres[name][int(each.side)] + 100 / count, int(each.side) // 2)

    # At the lower rate only the first four are there.
    monkeypatch.setattr(_real_comparison, "_recordings", lambda quick, every=1: recordings[: 4 if every == 6 else 5])
    monkeypatch.setattr(_real_comparison, "_hidden", lambda quick: recordings[1:])
    monkeypatch.setattr(_real_comparison, "registration_error", lambda each, seed: error_of("registration", each, 1e9))
    monkeypatch.setattr(_real_comparison, "tracker_error", lambda name, count, each, seed: error_of(name, each, count))
    found = {name: metric.value for name, metric in _real_comparison.real_metrics(100, True, Finished(None)).items()}
    assert found["joint_error_mm_real_rbpf"] == pytest.approx(8.0)
    assert found["joint_error_mm_real_registration"] == pytest.approx(6.0)
    assert found["median_joint_error_mm_real_rbpf"] == pytest.approx(8.0)
    assert found["largest_joint_error_mm_real_rbpf"] == pytest.approx(10.0)
    assert found["median_joint_error_mm_real_hidden_pf"] == pytest.approx(9.5)
    assert found["wrong_frames_real_rbpf"] == 0 + 0 + 1 + 1 + 2
    assert found["wrong_frames_real_every_6_pf"] == 0 + 0 + 1 + 1
    assert "wrong_frames_real_registration" not in found  # which has no status
    assert found["p_value_rbpf_better_real"] == pytest.approx(1 / 32)  # all five pairs fall the same way
    assert found["p_value_rbpf_better_than_registration_real"] == pytest.approx(1.0)
    assert found["errors_by_n_real_rbpf_n8"] == pytest.approx(7 + 100 / 8)
    assert found["joint_error_mm_real_every_6_rbpf"] == pytest.approx(7.5)
    assert found["p_value_rbpf_better_real_every_6"] == pytest.approx(1 / 16)
    assert found["p_value_rbpf_better_than_registration_real_every_6"] == pytest.approx(1.0)
    assert found["joint_error_mm_real_hidden_pf"] == pytest.approx(9.5)
    # Of the first four recordings, 6.5 and twice 7.5, the last without the first one.
    assert found["joint_error_mm_real_all_cases_rbpf"] == pytest.approx((7.5 + 7.5 + 8.5) / 3)
    assert found["p_value_rbpf_better_real_all_cases"] == pytest.approx(1 / 16)


def test_without_recordings_there_is_nothing_to_compare(monkeypatch):
    def missing(quick, every=1):
        raise RecordingError("not here")

    monkeypatch.setattr(_real_comparison, "_recordings", missing)
    assert _real_comparison.real_metrics(16, True, Finished(None)) == {}


def test_joints_without_an_estimate_count_as_those_of_a_lost_hand():
    truth, camera = np.zeros((4, 21, 3)), Pinhole.from_intrinsics(100.0, (0.0, 0.0), (1, 1))
    truth[3, 5] = np.nan
    recording = _real_hands.HandRecording(camera, np.arange(4.0), np.zeros((4, 1, 1), np.float32), truth, 1.0)
    joints = np.full((4, 21, 3), [0.01, 0.0, 0.0])
    joints[:2] = np.nan
    errors = _real_comparison._joint_errors(joints, recording)
    assert np.nanmean(errors) == pytest.approx((42 * _real_comparison.MISSING_MM + 41 * 10.0) / 83)


def test_a_wrong_status_is_one_of_frames_that_are_far_off_and_called_tracking():
    errors = np.repeat([24.9, 25.0, 80.0, 80.0, 80.0, np.nan], 21).reshape(6, 21)
    errors[2, :20] = np.nan  # one joint alone is known
    status = np.array([TRACKING, TRACKING, TRACKING, DOUBTFUL, SEARCHING, TRACKING])
    assert _real_comparison.num_wrong(errors, status) == 2
