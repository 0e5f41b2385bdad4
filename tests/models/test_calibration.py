import cv2
import numpy as np
import pytest

from jaxfilters.models.calibration import (
    Calibration,
    calibrate_dlt,
    calibrate_floor,
    calibrate_points,
    calibrate_pose,
    decompose,
    distort,
    floor_errors_m,
    refine,
)
from jaxfilters.models.floor_camera import FloorCamera, canonical

LENS = np.array([-0.21, 0.07, 0.001, -0.0015, -0.01])


def paper_camera():
    """Camera 1 of Kato et al.: (-1, -1.74, 2.64) m, heading +Y, 37 degrees down, 160 x 120 pixels."""
    pitch = np.deg2rad(37)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]])
    K = np.array([[139, 0, 79.5], [0, 139, 59.5], [0, 0, 1.0]])
    return Calibration(K, np.zeros(5), R, -R @ [-1, -1.74, 2.64], 0.0)


def wide_camera():
    """A web camera with distortion, 2.4 m above the floor, turned a little about its axis."""
    camera = paper_camera()
    roll = cv2.Rodrigues(np.array([0, 0, 0.15]))[0]
    K = np.array([[610, 0, 322], [0, 604, 236], [0, 0, 1.0]])
    return Calibration(K, LENS, roll @ camera.R, -roll @ camera.R @ [-0.5, -2.5, 2.4], 0.0)


def level_camera():
    """Where the paper's camera is, with 640 x 480 pixels."""
    return paper_camera()._replace(K=np.array([[560.0, 0, 319.5], [0, 560, 239.5], [0, 0, 1]]))


def points_in_view(seed, n, *, height=1.8):
    rng = np.random.default_rng(seed)
    return rng.uniform([-2, 0.3, 0], [0.3, 3, height], (n, 3))


def test_exact_points_give_the_matrix_back():
    points, camera = points_in_view(0, 8), paper_camera()
    P, rms_px = calibrate_dlt(points, camera.project(points))
    assert rms_px < 1e-8
    np.testing.assert_allclose(P, camera.P, rtol=1e-7, atol=1e-7)


def test_thirty_points_with_half_a_pixel_of_noise_place_the_floor_within_three_centimetres():
    """The oracle of the specification, section 7, number 12."""
    camera, errors = paper_camera(), []
    grid = np.stack(np.meshgrid([0, -1, -2], [0.2, 1.0, 2.0]), axis=-1).reshape(-1, 2)
    floor = np.column_stack([grid, np.zeros(len(grid))])
    for seed in range(10):
        points = points_in_view(seed, 30)
        pixels = camera.project(points) + np.random.default_rng(seed).normal(0, 0.5, (30, 2))
        P, _ = calibrate_dlt(points, pixels)
        K, R, t = decompose(P)
        errors.append(np.nanmean(floor_errors_m(Calibration(K, np.zeros(5), R, t, 0.0), floor, camera.project(floor))))
    assert np.mean(errors) <= 0.03


def test_a_matrix_is_taken_apart_and_put_together():
    camera = wide_camera()
    for scale in (-3.7, 0.02):
        K, R, t = decompose(scale * camera.P)
        np.testing.assert_allclose(K, camera.K, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(R, camera.R, atol=1e-10)
        np.testing.assert_allclose(t, camera.t, atol=1e-10)
    with pytest.raises(ValueError, match="invertible left block"):
        decompose(np.zeros((3, 4)))


def test_distortion_is_that_of_opencv():
    camera, points = wide_camera(), points_in_view(3, 20)
    turn = cv2.Rodrigues(camera.R)[0]
    theirs = cv2.projectPoints(points, turn, camera.t, camera.K, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), theirs, atol=1e-9)
    straight = camera._replace(distortion=np.zeros(5)).project(points)
    np.testing.assert_allclose(camera.undistort(theirs), straight, atol=1e-7)
    np.testing.assert_array_equal(distort(points[:, :2], np.zeros(5)), points[:, :2])


@pytest.mark.parametrize("coefficients", [2, 5])
def test_refinement_finds_the_lens(coefficients):
    truth = wide_camera()
    truth = truth._replace(distortion=np.where(np.arange(5) < coefficients, truth.distortion, 0))
    points = points_in_view(1, 60)
    found = calibrate_points(points, truth.project(points), (640, 480), coefficients=coefficients)
    assert found.rms_px < 1e-6
    np.testing.assert_allclose(found.K, truth.K, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(found.P, truth.P, rtol=1e-4, atol=1e-3)
    everywhere = points_in_view(2, 200)
    np.testing.assert_allclose(found.project(everywhere), truth.project(everywhere), atol=1e-3)


def test_refinement_never_reprojects_worse_than_what_it_began_with():
    truth, points = wide_camera(), points_in_view(4, 25)
    pixels = truth.project(points) + np.random.default_rng(0).normal(0, 1, (25, 2))
    K, R, t = decompose(calibrate_dlt(points, pixels)[0])
    start = Calibration(K * (1 - np.eye(3, k=1)) + np.diag([0, 0, 0]), np.zeros(5), R, t, 0.0)
    start = start._replace(K=np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]))
    before = np.sqrt(((start.project(points) - pixels) ** 2).sum(axis=1).mean())
    poses = [refine(points, pixels, start, coefficients=count).rms_px for count in (0, 2, 5)]
    assert before >= poses[0] >= poses[1] >= poses[2] > 0.5


def test_points_on_the_floor_alone_place_a_camera_with_square_pixels():
    truth = paper_camera()
    floor = points_in_view(5, 9, height=0.0)
    found = calibrate_floor(floor[:, :2], truth.project(floor), (160, 120))
    np.testing.assert_allclose(found.P, truth.P, rtol=1e-4, atol=1e-4)
    four = np.array([[0.0, 0.3, 0], [-2, 0.3, 0], [-2, 3, 0], [0, 3, 0]])
    np.testing.assert_allclose(calibrate_floor(four, truth.project(four), (160, 120)).P, truth.P, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_nearly_level_floor_fixes_no_matrix_but_a_camera_with_square_pixels(seed):
    """All heights are errors of 1 cm, over 3 m of floor."""
    truth, rng = level_camera(), np.random.default_rng(seed)
    floor = points_in_view(seed, 12, height=0.0)
    measured = floor + rng.normal(0, 0.01, floor.shape)
    pixels = truth.project(floor) + rng.normal(0, 0.5, (12, 2))
    with pytest.raises(ValueError, match=r"leave the camera open|behind it"):
        calibrate_points(measured, pixels, (640, 480))
    found = calibrate_floor(measured, pixels, (640, 480))
    assert abs(np.log(found.K[0, 0] / 560)) < 3 * found.deviations.focal < 0.2
    assert (np.abs(found.position - truth.position) < 3 * found.deviations.position_m).all()


def test_standard_deviations_are_those_of_the_errors():
    """Squared errors over their variances have a mean of one; of 3 x 40, its standard error is about 0.2."""
    truth, shares, focals = level_camera(), [], []
    for seed in range(40):
        points = points_in_view(seed, 20)
        found = calibrate_points(
            points, truth.project(points) + np.random.default_rng(seed).normal(0, 0.7, (20, 2)), (640, 480)
        )
        shares.append((found.position - truth.position) / found.deviations.position_m)
        focals.append(np.log(found.K[0, 0] / 560) / found.deviations.focal)
    assert 0.5 < np.mean(np.square(shares)) < 1.6
    assert 0.4 < np.mean(np.square(focals)) < 1.6


def test_cameras_that_none_builds_are_named():
    points, truth = points_in_view(0, 20), level_camera()
    flat = truth._replace(K=np.diag([560.0, 300.0, 1]) + np.array([[0, 0, 319.5], [0, 0, 239.5], [0, 0, 0]]))
    with pytest.raises(ValueError, match=r"focal lengths of 560 x 300 px .* ratio of at most 1\.5"):
        calibrate_points(points, flat.project(points), (640, 480))
    with pytest.raises(ValueError, match=r"principal point at \(319\.5, 239\.5\); .* in the image of 640x200"):
        calibrate_points(points, truth.project(points), (640, 200))


def test_known_intrinsics_leave_the_pose():
    truth = wide_camera()
    floor = points_in_view(6, 6, height=0.0)
    found = calibrate_pose(floor, truth.project(floor), truth.K, truth.distortion)
    np.testing.assert_allclose(found.P, truth.P, rtol=1e-5, atol=1e-4)
    assert found.rms_px < 1e-4


def test_floor_errors_are_the_metres_that_pixels_make():
    camera = paper_camera()
    points = points_in_view(7, 12)
    assert floor_errors_m(camera, points, camera.project(points)).max() < 1e-9
    moved = points + np.array([0.03, -0.04, 0])
    np.testing.assert_allclose(floor_errors_m(camera, points, camera.project(moved)), 0.05, rtol=1e-9)
    assert np.isnan(floor_errors_m(camera, np.array([[0, 1.0, 0]]), np.array([[80.0, -500.0]]))).all()


def test_the_scale_is_that_of_floor_cameras():
    camera = paper_camera()
    np.testing.assert_allclose(canonical(camera.P), camera.P, rtol=1e-12)
    np.testing.assert_allclose(FloorCamera.from_matrix(-2 * camera.P, (120, 160)).P, camera.P, rtol=1e-5, atol=1e-5)


def replaced(points, **axes):
    points = points.copy()
    for name, value in axes.items():
        points[:, "xyz".index(name)] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (points_in_view(0, 5), "points_m must be 6 points or more for this; got 5"),
        (points_in_view(0, 9, height=0.0), "points_m lie in one plane"),
        (replaced(points_in_view(0, 9), x=-1.0), "points_m lie in one plane"),
        (np.full((8, 3), np.nan), "must be finite"),
        (points_in_view(0, 9)[:, :2], r"points_m must be \(n, 3\) and pixels \(n, 2\); got \(9, 2\)"),
    ],
)
def test_points_that_fix_no_matrix_are_named(points, message):
    with pytest.raises(ValueError, match=message):
        calibrate_dlt(points, np.random.default_rng(0).uniform(0, 100, (len(points), 2)))


def test_a_left_handed_world_is_named():
    points, camera = points_in_view(0, 12), paper_camera()
    with pytest.raises(ValueError, match="12 of 12 points behind it: the world must be right-handed"):
        calibrate_dlt(points * [-1, 1, 1], camera.project(points))


def test_questions_without_an_answer_are_named():
    camera, floor = paper_camera(), points_in_view(0, 8, height=0.0)
    with pytest.raises(ValueError, match="one height"):
        calibrate_floor(points_in_view(0, 8), camera.project(floor), (160, 120))
    with pytest.raises(ValueError, match="lie on one line"):
        calibrate_floor(replaced(floor, x=-1.0), camera.project(replaced(floor, x=-1.0)), (160, 120))
    with pytest.raises(ValueError, match="lie on one line"):
        calibrate_pose(replaced(floor, x=-1.0), camera.project(floor), camera.K, np.zeros(5))
    down = camera._replace(R=np.diag([1.0, -1, -1]), t=np.array([0, 0, 3.0]))
    with pytest.raises(ValueError, match="leave the focal length open"):
        calibrate_floor(floor, down.project(floor), (160, 120))
    with pytest.raises(ValueError, match="coefficients must be from 0 to 5; got 6"):
        refine(floor, camera.project(floor), camera, coefficients=6)
    with pytest.raises(ValueError, match="8 points or more"):
        refine(floor[:7], camera.project(floor)[:7], camera, coefficients=5)


def test_pixels_on_one_line_or_repeated_fix_no_camera_and_are_named():
    """What a person types who reads the same pixel off again and again, or off one edge of the image."""
    floor = np.array([[0.0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0], [2, 1, 0]])
    space = np.vstack([floor, [[1, 1, 2], [3, 2, 1], [0, 1, 1.0]]])
    K = level_camera().K
    line = np.linspace([20, 30], [370, 205], 8)
    for pixels, message in (
        (line, r"pixels of all \d points lie on one line, or nearly, from \(20, 30\) to"),
        (np.full((8, 2), 50.0), r"pixels of all \d points lie on one line, or nearly, from \(50, 50\) to \(50, 50\)"),
    ):
        for solve in (
            lambda pixels=pixels: calibrate_floor(floor, pixels[:5], (640, 480)),
            lambda pixels=pixels: calibrate_pose(floor, pixels[:5], K, np.zeros(5)),
            lambda pixels=pixels: calibrate_points(space, pixels, (640, 480)),
        ):
            with pytest.raises(ValueError, match=message):
                solve()


@pytest.mark.system
def test_no_points_end_in_another_error_than_one_about_points():
    """Few points on a coarse grid, which are often the same, on a line or of no camera: OpenCV and NumPy then raise."""
    messages = []
    for number in range(300):
        rng = np.random.default_rng(number)
        count = int(rng.integers(4, 8))
        points = rng.integers(0, 3, (count, 3)) * [1.0, 1.0, rng.integers(2)]
        pixels = rng.integers(0, 3, (count, 2)) * 100.0
        for solve in (
            lambda points=points, pixels=pixels: calibrate_floor(points, pixels, (640, 480)),
            lambda points=points, pixels=pixels: calibrate_pose(points, pixels, level_camera().K, np.zeros(5)),
            lambda points=points, pixels=pixels: calibrate_points(points, pixels, (640, 480)),
        ):
            try:
                found = solve()
            except ValueError as error:
                messages.append(str(error))
            else:
                assert np.isfinite(found.P).all()
    assert [message for message in messages if "points" not in message] == []
