"""Detection in the real video, and the camera that takes key points to an image, on points whose camera is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import _hand_video as hand_video
from jaxfilters.models.fingertip.detection import no_hand

FOLDER = "dexretarget_hand_video"


def posed(seed=0):
    """Key points of an open hand, and an observation of them by a known camera, the tips shuffled."""
    rng = np.random.default_rng(seed)
    joints = np.zeros((21, 3))
    for finger, (side, reach) in enumerate([(0.09, 0.09), (0.03, 0.16), (0.0, 0.17), (-0.03, 0.16), (-0.06, 0.13)]):
        for joint in range(4):
            share = (joint + 2) / 5
            joints[1 + 4 * finger + joint] = [0.04 * share**2, side * share, reach * share]
    turn = Rotation.from_rotvec([0.2, -1.4, 0.3])
    camera = np.array([*turn.as_rotvec(), np.log(900.0), 330.0, 170.0])
    tips = hand_video._projected(camera, joints[hand_video.TIPS])
    palm = hand_video._projected(camera, joints[hand_video.PALM]).mean(axis=0)
    order = rng.permutation(5)
    observed = no_hand()._replace(
        tips=tips[order].astype(np.float32),
        is_tip=np.ones(5, bool),
        palm=palm.astype(np.float32),
        is_hand=np.asarray(True),
    )
    return joints, camera, observed, order


def test_the_camera_of_a_frame_is_found_from_one_nearby():
    joints, camera, observed, order = posed()
    before = camera + np.array([0.05, -0.05, 0.05, 0.01, 4.0, -3.0])
    fit = hand_video._frame_fit(observed, joints, before, 0.17)
    np.testing.assert_array_equal(fit.finger, order)
    assert np.nanmax(fit.distance) < 1.5
    assert np.nanmax(fit.left_out) < 4.0
    assert np.nanmean(fit.left_out) > np.nanmean(fit.distance)


def test_a_tip_that_is_far_from_every_key_point_is_nobodys():
    joints, camera, observed, _ = posed()
    tips = observed.tips.copy()
    tips[2] = (600, 20)
    fit = hand_video._frame_fit(observed._replace(tips=tips), joints, camera, 0.17)
    assert fit.finger[2] == -1
    assert np.isnan(fit.distance[2])
    assert np.sum(fit.finger >= 0) == 4


def test_a_frame_without_a_hand_keeps_the_camera():
    joints, camera, _, _ = posed()
    fit = hand_video._frame_fit(no_hand(), joints, camera, 0.17)
    np.testing.assert_allclose(fit.camera, camera, atol=1e-6)
    assert (fit.finger == -1).all()


def test_reach_tells_a_fist_from_an_open_hand():
    joints = np.tile(posed()[0], (20, 1, 1))
    joints[-1, hand_video.TIPS] = joints[-1, hand_video.KNUCKLES]
    reach = hand_video.finger_reach(joints)
    np.testing.assert_allclose(reach[:-1], 1.0)
    np.testing.assert_allclose(reach[-1], 0.0)


def test_a_folder_without_the_recording_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"detected_joints\.npz"):
        hand_video.hand_video_metrics(tmp_path)


@pytest.mark.system
@pytest.mark.data
def test_tips_of_the_real_hand_are_near_its_key_points(data_dir, tmp_path):
    """The first 300 frames: open hand, pinches with every finger, a fist."""
    metrics = hand_video.hand_video_metrics(data_dir / FOLDER, tmp_path, num_frames=300)
    assert metrics["frames"] == 300
    assert metrics["tip_distance_percent_of_hand"] < 2.0
    assert metrics["tip_left_out_percent_of_hand"] < 3.0
    assert metrics["extended_with_tip_percent"] > 90
    assert metrics["tips_without_finger_percent"] < 3
    assert metrics["fist_frames"] > 10
    assert metrics["tips_per_fist"] < 0.2
    assert len(list(tmp_path.glob("*.png"))) >= 24
