import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.calibration import Calibration
from jaxfilters.models.calibration_board import BoardView
from jaxfilters.models.calibration_stereo import calibrate_stereo, epipolar_rms

SIZE = (640, 480)
K_LEFT = np.array([[520.0, 0, 324], [0, 516, 236], [0, 0, 1]])
K_RIGHT = np.array([[540.0, 0, 316], [0, 537, 242], [0, 0, 1]])
LENSES = np.array([-0.15, 0.05, 0, 0, 0]), np.array([0.08, -0.03, 0.001, 0, 0])
R = Rotation.from_rotvec([0.02, -0.15, 0.01]).as_matrix()
T = np.array([-0.12, 0.004, 0.01])
INTRINSICS = ((K_LEFT, LENSES[0]), (K_RIGHT, LENSES[1]))
BOARD = np.stack([*np.meshgrid(np.arange(1, 7), np.arange(1, 5)), np.zeros((4, 6))], axis=-1).reshape(-1, 3) * 0.04


def views(noise_px=0.0, pairs=8):
    """What both cameras see of a board that is held in several ways; each misses some corners."""
    rng = np.random.default_rng(0)
    left, right = [], []
    for _ in range(pairs):
        turn = Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix()
        middle = rng.uniform([-0.05, -0.05, 0.5], [0.1, 0.05, 0.7])
        t = middle - turn @ [0.14, 0.10, 0]
        for observed, K, lens, pose in (
            (left, K_LEFT, LENSES[0], (turn, t)),
            (right, K_RIGHT, LENSES[1], (R @ turn, R @ t + T)),
        ):
            kept = rng.permutation(len(BOARD))[:20]
            pixels = Calibration(K, lens, *pose, 0.0).project(BOARD[kept])
            observed.append(BoardView(BOARD[kept], pixels + rng.normal(0, noise_px, pixels.shape)))
    return left, right


def test_exact_corners_give_the_exact_pose():
    """Corners go through single precision on their way into OpenCV: 1e-7 of 600 px, over 0.6 m."""
    found = calibrate_stereo(*views(), INTRINSICS, SIZE)
    np.testing.assert_allclose(found.R, R, atol=1e-5)
    np.testing.assert_allclose(found.t, T, atol=1e-5)
    assert found.baseline == pytest.approx(np.linalg.norm(T), abs=1e-5)
    assert found.rms_px < 1e-3
    assert found.epipolar_px.max() < 1e-3


def test_noise_shows_in_the_errors_at_its_own_size():
    """A corner's distance from its line is one coordinate of it and, through the line, one of its partner: each way
    sqrt(2) sigma. With 8 x 17 corners its standard error is 5 %; 20 % allow for the fit and four of these."""
    found = calibrate_stereo(*views(0.3), INTRINSICS, SIZE)
    assert np.sqrt(np.mean(found.epipolar_px**2)) == pytest.approx(np.sqrt(2) * 0.3, rel=0.2)
    np.testing.assert_allclose(found.t, T, atol=2e-3)


def test_the_distance_from_a_line_is_that_of_a_rectified_pair():
    """Between parallel cameras the lines are rows: points that are 2 rows off are 2 px off."""
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    points = np.random.default_rng(1).uniform(0, 400, (10, 2))
    assert epipolar_rms(F, points, points - (30, 0)) == pytest.approx(0, abs=1e-9)
    assert epipolar_rms(F, points, points - (30, -2)) == pytest.approx(2)


def test_a_pair_of_different_moments_stands_out():
    left, right = views(0.1)
    right[3] = views(0.1, 9)[1][8]
    found = calibrate_stereo(left, right, INTRINSICS, SIZE)
    assert np.argmax(found.epipolar_px) == 3


def test_pairs_that_show_too_little_are_left_out_or_refused():
    left, right = views()
    nothing = BoardView(np.zeros((0, 3)), np.zeros((0, 2)))
    found = calibrate_stereo([*left[:4], nothing], right[:5], INTRINSICS, SIZE)
    np.testing.assert_array_equal(np.isnan(found.epipolar_px), [False] * 4 + [True])
    np.testing.assert_allclose(found.t, T, atol=1e-5)
    row = [BoardView(BOARD[:6], np.zeros((6, 2)))] * 8
    lines = [BoardView(BOARD[:6], Calibration(K_RIGHT, LENSES[1], R, (0, 0, 0.5), 0.0).project(BOARD[:6]))] * 8
    with pytest.raises(ValueError, match="not in one line, in 3 pairs of pictures or more; they do in 0 of 8"):
        calibrate_stereo(row, lines, INTRINSICS, SIZE)
    with pytest.raises(ValueError, match="one view each for every moment; got 4, 5"):
        calibrate_stereo(left[:4], right[:5], INTRINSICS, SIZE)
    with pytest.raises(ValueError, match="in 3 pairs of pictures or more; they do in 2 of 3"):
        calibrate_stereo([*left[:2], nothing], right[:3], INTRINSICS, SIZE)
