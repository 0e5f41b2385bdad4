import cv2
import numpy as np
import pytest

from jaxfilters.models.calibration import Calibration
from jaxfilters.models.calibration_board import (
    BoardView,
    calibrate_intrinsics,
    calibrate_on_floor,
    charuco_board,
    detect_board,
)

SIZE = (640, 480)
K = np.array([[520.0, 0, 324], [0, 516, 236], [0, 0, 1]])
LENS = np.array([-0.15, 0.05, 0.0, 0.0, 0.0])
BOARD = charuco_board((7, 5), 0.04, 0.03)
PIXELS_PER_SQUARE = 80


def rendered(R, t):
    """The board as a camera with distortion sees it: every pixel looks up where its ray meets the board."""
    drawn = BOARD.generateImage((7 * PIXELS_PER_SQUARE, 5 * PIXELS_PER_SQUARE))
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    straight = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, LENS).reshape(-1, 2)
    H = np.linalg.inv(np.column_stack([R[:, :2], t]))
    on_board = np.column_stack([straight, np.ones(len(straight))]) @ H.T
    metres = (on_board[:, :2] / on_board[:, 2:]).reshape(SIZE[1], SIZE[0], 2)
    # The drawing's first pixel covers the board from 0 to one pixel: its centre is half a pixel in.
    places = (metres / 0.04 * PIXELS_PER_SQUARE - 0.5).astype(np.float32)
    sharp = cv2.remap(drawn, places[..., 0], places[..., 1], cv2.INTER_AREA, borderValue=128)
    return cv2.GaussianBlur(sharp, (3, 3), 0.7)


def pose(turn, middle):
    """The board turned by a rotation vector, its middle at a place in the camera."""
    R = cv2.Rodrigues(np.asarray(turn, float))[0]
    return R, np.asarray(middle, float) - R @ [0.14, 0.10, 0]


@pytest.fixture(scope="module")
def poses():
    turns = [(0.5, 0, 0), (-0.5, 0.1, 0.2), (0, 0.5, 0), (0.1, -0.5, -0.3), (0.35, 0.35, 0.6), (-0.3, 0.4, 1.4)]
    middles = [
        (0, 0, 0.42),
        (0.08, 0.03, 0.45),
        (-0.08, 0.04, 0.4),
        (0.03, -0.05, 0.5),
        (-0.05, -0.03, 0.4),
        (0.1, 0, 0.5),
    ]
    return [pose(turn, middle) for turn, middle in zip(turns, middles, strict=True)]


@pytest.fixture(scope="module")
def views(poses):
    return [detect_board(rendered(R, t), BOARD) for R, t in poses]


def test_corners_are_found_where_they_are(poses, views):
    for (R, t), view in zip(poses, views, strict=True):
        assert len(view.pixels) >= 20
        errors = Calibration(K, LENS, R, t, 0.0).project(view.points_m) - view.pixels
        assert np.abs(errors).max() < 0.6
        assert np.abs(errors.mean(axis=0)).max() < 0.15


def test_intrinsics_come_back(views):
    found, distortion, rms_px = calibrate_intrinsics(views, SIZE)
    assert rms_px < 0.3
    np.testing.assert_allclose(found[[0, 1], [0, 1]], [520, 516], rtol=0.01)
    np.testing.assert_allclose(found[:2, 2], [324, 236], atol=4)
    rim = np.array([[0.45, 0.3], [-0.45, 0.3], [0.0, 0.35]])
    ours, truth = (
        Calibration(matrix, lens, np.eye(3), np.zeros(3), 0.0).project(np.column_stack([rim, np.ones(3)]))
        for matrix, lens in ((found, distortion), (K, LENS))
    )
    np.testing.assert_allclose(ours, truth, atol=3)


def test_a_board_on_the_floor_gives_a_world_with_z_up():
    """The camera 0.45 m above the board, looking down at 50 degrees."""
    R, t = pose((-0.7, 0, 0), (0, 0.02, 0.55))
    found = calibrate_on_floor(detect_board(rendered(R, t), BOARD), K, LENS)
    center_on_board = -R.T @ t
    assert center_on_board[2] < 0
    np.testing.assert_allclose(-found.R.T @ found.t, center_on_board * [1, -1, -1], atol=0.005)
    assert found.rms_px < 0.4


def test_an_image_without_the_board_shows_nothing():
    view = detect_board(np.full((480, 640, 3), 90, np.uint8), BOARD)
    assert (view.points_m.shape, view.pixels.shape) == ((0, 3), (0, 2))


def noisy_view(turn, middle, seed, lens=LENS):
    """The corners of the board in the image, with 0.1 px of noise."""
    R, t = pose(turn, middle)
    inner = np.stack([*np.meshgrid(np.arange(1, 7), np.arange(1, 5)), np.zeros((4, 6))], axis=-1).reshape(-1, 3) * 0.04
    pixels = Calibration(K, lens, R, t, 0.0).project(inner)
    pixels += np.random.default_rng(seed).normal(0, 0.1, pixels.shape)
    is_inside = ((pixels > 0) & (pixels < (639, 479))).all(axis=1)
    return BoardView(inner[is_inside], pixels[is_inside])


@pytest.mark.parametrize("num_views", [6, 12])
def test_boards_that_face_the_camera_leave_the_focal_length_open(num_views):
    """OpenCV finds another focal length, and calls it good: its own standard deviations miss the open direction."""
    middles = [(0.004 * i - 0.02, 0.0, 0.45 + 0.02 * i) for i in range(num_views)]
    facing = [noisy_view((0, 0, 0.05 * i), middle, i) for i, middle in enumerate(middles)]
    with pytest.raises(ValueError, match=r"leave the focal length open: .* tilted by 30 degrees"):
        calibrate_intrinsics(facing, SIZE)
    alike = [noisy_view((0.3, 0.2, 0), middle, i) for i, middle in enumerate(middles[:3])]
    with pytest.raises(ValueError, match="leave the focal length open"):
        calibrate_intrinsics(alike, SIZE)


def test_a_picture_counts_once():
    """The noise of copies does not average out, so that their number must not lower the standard deviation."""
    copies = [noisy_view((0.5, 0.3, 0), (0, 0, 0.42), 0)] * 12
    with pytest.raises(ValueError, match="with the board moved in between; 1 of 12 do"):
        calibrate_intrinsics(copies, SIZE)


@pytest.mark.parametrize("seed", range(5))
def test_four_tilted_pictures_are_enough(seed):
    turns = [(0.5, 0, 0), (-0.5, 0.1, 0.2), (0, 0.5, 0), (0.1, -0.5, -0.3)]
    tilted = [noisy_view(turn, (0.02 * i - 0.03, 0, 0.42), 10 * seed + i) for i, turn in enumerate(turns)]
    found, _, rms_px = calibrate_intrinsics(tilted, SIZE)
    np.testing.assert_allclose(found[[0, 1], [0, 1]], [520, 516], rtol=0.03)
    assert rms_px < 0.2


def test_a_lens_never_folds_in_the_image():
    """Corners in the middle of the image leave k3 to their noise: directions must still keep their order at the rim."""
    turns = [(0.6, 0, 0), (-0.6, 0.1, 0.2), (0, 0.6, 0), (0.1, -0.6, -0.3)]
    for seed in range(6):
        central = [noisy_view(turn, (0, 0, 0.6), 10 * seed + i) for i, turn in enumerate(turns)]
        found, lens, _ = calibrate_intrinsics(central, SIZE)
        rim = np.linalg.norm((found[:2, 2] + 0.5) / found[[0, 1], [0, 1]])
        radii = np.linspace(0, 1.5 * rim, 400)
        mapped = Calibration(np.eye(3), lens * [1, 1, 0, 0, 1], np.eye(3), np.zeros(3), 0.0).project(
            np.column_stack([radii, 0 * radii, 1 + 0 * radii])
        )[:, 0]
        until = np.argmax(mapped > rim) or len(radii)
        assert (np.diff(mapped[:until]) > 0).all()
        assert mapped.max() > rim


def test_too_little_to_see_is_named(views):
    nothing = BoardView(np.zeros((0, 3)), np.zeros((0, 2)))
    row = BoardView(np.column_stack([np.arange(8.0), np.zeros((8, 2))]), np.zeros((8, 2)))
    with pytest.raises(ValueError, match=r"with the board moved in between; 2 of 4 do \(are the squares"):
        calibrate_intrinsics([*views[:2], nothing, row], SIZE)
    with pytest.raises(ValueError, match="corners or more of the board on the floor, not in one line; got 0"):
        calibrate_on_floor(nothing, K, LENS)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (((2, 5), 0.04, 0.03), {}, "squares must be three or more each way; got 2x5"),
        (((7, 5), 0.03, 0.04), {}, "marker_m must be positive and less than square_m"),
        (((7, 5), 0.04, 0.03), {"dictionary": "4X4"}, "dictionary must be one of .*DICT_4X4_50.*; got '4X4'"),
        (((20, 10), 0.04, 0.03), {}, "need 100 markers; DICT_4X4_50 has 50"),
    ],
)
def test_boards_that_cannot_be_are_named(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        charuco_board(*arguments, **options)
