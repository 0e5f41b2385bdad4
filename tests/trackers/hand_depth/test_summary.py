from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app.chart import Curve, draw_chart, ticks
from jaxfilters.trackers.hand_depth.summary import draw_summary, joint_errors, mean_joint_error, write_summary
from jaxfilters.trackers.hand_depth.table import TimedHandTrack
from jaxfilters.trackers.io.errors import OutputError

RED = (0, 0, 255)


def make_results(recording, joints):
    frames = len(recording)
    pose = np.concatenate([joints[:, 0], np.ones((frames, 1)), np.zeros((frames, 18))], axis=1)
    spread, ones, counts = np.full((frames, 21), 0.003), np.ones(frames), np.zeros((frames, 2), int)
    return TimedHandTrack(recording.times_s, pose, spread, joints, counts, ones, ones, ones.astype(int))


def test_joint_error_is_the_mean_distance(recording):
    joints = recording.joints + np.asarray([0.003, 0.0, 0.004])
    joints[0, 3] += (0.0, 0.012, 0.0)  # 3, 12, 4: 13 mm away
    expected = np.full(len(recording), 0.005)
    expected[0] = (20 * 0.005 + 0.013) / 21
    np.testing.assert_allclose(joint_errors(recording, make_results(recording, joints)), expected, rtol=1e-5)


def test_frames_without_an_estimate_do_not_count_in_the_mean(recording):
    joints = recording.joints + np.asarray([0.003, 0.0, 0.004])
    joints[::2] = np.nan
    results = make_results(recording, joints)
    np.testing.assert_array_equal(np.isnan(joint_errors(recording, results)), np.arange(len(recording)) % 2 == 0)
    assert mean_joint_error(recording, results) == pytest.approx(0.005, rel=1e-5)
    assert mean_joint_error(recording, make_results(recording, np.full_like(joints, np.nan))) is None
    assert mean_joint_error(replace(recording, joints=None), results) is None


@pytest.mark.parametrize("gaps", [slice(0), slice(0, None, 2), slice(None)])
def test_the_picture_has_the_montage_and_the_charts(tmp_path, recording, gaps):
    joints = recording.joints.copy()
    joints[gaps] = np.nan
    results = make_results(recording, joints)
    write_summary(tmp_path / "s.png", recording, results)
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture.shape == (2 * 320 + 3 * 190, 960, 3)
    # Every tile shows a part of its frame, every chart its paper.
    tiles = picture[:640].reshape(2, 320, 3, 320, 3)
    assert (tiles.max(axis=(1, 3, 4)) > 100).all()
    assert (picture[640:] == 255).mean() > 0.5
    with pytest.raises(OutputError, match="cannot write"):
        write_summary(tmp_path / "missing" / "s.png", recording, results)


def test_a_hand_apart_from_its_truth_looks_different(recording):
    same = draw_summary(recording, make_results(recording, recording.joints))
    apart = draw_summary(recording, make_results(recording, recording.joints + np.float32([0.05, 0, 0])))
    assert (same[:640] != apart[:640]).any()


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 10.0, [0, 2, 4, 6, 8, 10]), (-0.3, 0.55, [-0.2, 0, 0.2, 0.4]), (101.0, 350.0, [150, 200, 250, 300, 350])],
)
def test_ticks_are_round_numbers(low, high, expected):
    np.testing.assert_allclose(ticks(low, high), expected, atol=1e-12)
    assert not np.signbit(ticks(low, high)[np.asarray(expected) == 0]).any()


def test_a_straight_line_is_drawn_straight_from_corner_to_corner():
    x = np.linspace(0, 1, 11)
    image = draw_chart((200, 400), "", x, [Curve("", 5 * x, RED)], from_zero=True)
    v, u = np.nonzero((image[..., 2] > 200) & (image[..., 1] < 100))
    slope, start = np.polyfit(u, v, 1)
    assert np.abs(v - (start + slope * u)).max() < 2.5
    left, right, top, bottom = u.min(), u.max(), v.min(), v.max()
    # The box starts 62 pixels from the left and ends 14 from the right; 6 % are left free above the curve.
    assert abs(left - 62) <= 2
    assert abs(right - 386) <= 2
    assert abs(bottom - 176) <= 2
    assert abs(top - (26 + (176 - 26) * 0.06 / 1.06)) <= 2


def test_gaps_and_constant_curves_are_no_trouble():
    x = np.arange(6.0)
    gap = draw_chart((120, 200), "", x, [Curve("", np.asarray([1, 1, np.nan, np.nan, 1, 1.0]), RED, np.ones(6))])
    columns = np.flatnonzero(((gap[..., 2] > 200) & (gap[..., 1] < 100)).any(axis=0))
    middle = (62 + 186) / 2
    assert columns.size
    assert not ((columns > middle - 15) & (columns < middle + 15)).any()
    draw_chart((120, 200), "one point", x[:1], [Curve("a", np.zeros(1), RED)])
    draw_chart((120, 200), "nothing", x, [Curve("a", np.full(6, np.nan), RED)])
