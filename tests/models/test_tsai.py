import json

import numpy as np
import pytest

from jaxfilters.models.tsai import TsaiCamera, calibration_of_tsai
from jaxfilters.trackers.io.cameras import read_tsai

CAMERA = TsaiCamera(
    image_size=(768, 576),
    focal=5.5,
    kappa1=0.005,
    center=(320.0, 280.0),
    sx=1.1,
    pixel=(0.005, 0.0046),
    translation=(800.0, -3000.0, 35000.0),
    rotation=(2.0, -0.9, -0.4),
)


FOLDED = TsaiCamera(
    image_size=(720, 576),
    focal=3.69,
    kappa1=-0.062,
    center=(436.0, 258.0),
    sx=1.0,
    pixel=(0.00465, 0.00465),
    translation=(8600.0, -450.0, 14600.0),
    rotation=(1.77, 0.36, 0.09),
)
"""As view 7 of PETS 2009: the model folds beyond 499 pixels from the centre, in the corners on the left."""


def tsai_pixels(camera, points_m):
    """Pixels as Tsai's program makes them: fixed-point iteration on the distorted sensor coordinates."""
    cx, cy, cz, sx, sy, sz = (f(angle) for f in (np.cos, np.sin) for angle in camera.rotation)
    R = np.array(
        [
            [cy * cz, cz * sx * sy - cx * sz, sx * sz + cx * cz * sy],
            [cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - cz * sx],
            [-sy, cy * sx, cx * cy],
        ]
    )
    x = 1000 * points_m @ R.T + camera.translation
    undistorted = camera.focal * x[:, :2] / x[:, 2:]
    distorted = undistorted
    for _ in range(200):
        distorted = undistorted / (1 + camera.kappa1 * (distorted**2).sum(axis=-1, keepdims=True))
    return distorted / camera.pixel * [camera.sx, 1] + camera.center


def points_in_view(camera, seed=0):
    """World points that the camera sees all over its image, at 10 to 40 m."""
    rng = np.random.default_rng(seed)
    calibration = calibration_of_tsai(camera, camera.image_size).calibration
    depth = rng.uniform(10, 40, (300, 1))
    uv = rng.uniform(0, 1, (300, 2)) * camera.image_size
    rays = np.column_stack([(uv - calibration.K[:2, 2]) / calibration.K[[0, 1], [0, 1]] * 0.9, np.ones(300)])
    return (rays * depth - calibration.t) @ calibration.R


def test_points_project_as_with_tsais_own_equations():
    calibration, worst_px, fitted_share = calibration_of_tsai(CAMERA, CAMERA.image_size)
    points = points_in_view(CAMERA)
    np.testing.assert_allclose(calibration.project(points), tsai_pixels(CAMERA, points), atol=0.02)
    assert 0 < worst_px < 0.02
    assert fitted_share == 1


def test_another_image_size_moves_pixel_centres_with_it():
    points = points_in_view(CAMERA)
    halved = calibration_of_tsai(CAMERA, (384, 288)).calibration
    expected = (tsai_pixels(CAMERA, points) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(halved.project(points), expected, atol=0.02)


def test_no_distortion_stays_none():
    calibration, worst_px, _ = calibration_of_tsai(CAMERA._replace(kappa1=0.0), CAMERA.image_size)
    np.testing.assert_allclose(calibration.distortion, 0, atol=1e-12)
    assert worst_px < 1e-9


def test_parameters_that_are_no_camera_are_named():
    with pytest.raises(ValueError, match="must be positive"):
        calibration_of_tsai(CAMERA._replace(focal=0.0), (768, 576))
    with pytest.raises(ValueError, match=r"kappa1 = -0.1 folds \d+\.\d% of the image"):
        calibration_of_tsai(CAMERA._replace(kappa1=-0.1), (768, 576))


def test_a_fold_in_the_corners_is_left_out_and_the_rest_is_the_same_camera():
    """Points all over the part that was fitted, by radius in the image; the equation of Tsai is the oracle.

    The inverse near the fold is no polynomial: errors are largest there, and below a pixel in the middle.
    """
    calibration, worst_px, fitted_share = calibration_of_tsai(FOLDED, FOLDED.image_size)
    rows, cols = np.mgrid[0:576, 0:720]
    radius_mm = 0.00465 * np.hypot(cols - 436.0, rows - 258.0)
    # The slope 1 + 3 kappa r^2 is a fifth.
    farthest_mm = np.sqrt(0.8 / (3 * 0.062))
    assert fitted_share == pytest.approx(np.mean(radius_mm <= farthest_mm), abs=0.002)
    assert 0.9 < fitted_share < 0.97
    directions = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    radii_mm = np.linspace(0.02, 0.999, 30)[:, None] * farthest_mm
    undistorted = (radii_mm * (1 - 0.062 * radii_mm**2) / 3.69)[..., None]
    rays = undistorted * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    rays = np.concatenate([rays.reshape(-1, 2), np.ones((30 * 24, 1))], axis=1)
    points = (20.0 * rays - calibration.t) @ calibration.R
    expected = tsai_pixels(FOLDED, points)
    np.testing.assert_allclose(np.hypot(*(expected - [436, 258]).T), np.repeat(radii_mm, 24) / 0.00465, atol=0.05)
    errors = np.linalg.norm(calibration.project(points) - expected, axis=1).reshape(30, 24)
    assert errors.max() < 1.05 * worst_px
    assert worst_px < 8
    assert errors[:15].max() < 1.2
    assert np.sqrt(np.mean(errors**2)) < 2


def test_a_fold_of_more_than_the_corners_is_refused():
    """Where kappa1 is such that 1.5 and 2.5 % of the pixels lie beyond the fold."""
    rows, cols = np.mgrid[0:576, 0:720]
    radius_mm = 0.00465 * np.hypot(cols - 436.0, rows - 258.0)
    little, much = (-1 / (3 * np.quantile(radius_mm, 1 - share) ** 2) for share in (0.015, 0.025))
    assert calibration_of_tsai(FOLDED._replace(kappa1=little), (720, 576)).fitted_share < 1
    with pytest.raises(ValueError, match=r"folds 2\.5% of the image .* at most 2%"):
        calibration_of_tsai(FOLDED._replace(kappa1=much), (720, 576))


@pytest.mark.data
@pytest.mark.parametrize("size", [(768, 576), (480, 360)])
def test_the_camera_of_pets_is_that_of_its_description(data_dir, size):
    folder = data_dir / "pets09_s2l1_view001"
    theirs = json.loads((folder / "calibration.json").read_text())
    calibration, worst_px, _ = calibration_of_tsai(read_tsai(folder / "View_001.xml"), size)
    name = f"{size[0]}x{size[1]}"
    points = np.random.default_rng(0).uniform([-14, -14, 0], [4, 1.7, 2], (200, 3))
    homogeneous = np.column_stack([points, np.ones(200)])
    ours, expected = (homogeneous @ np.asarray(P).T for P in (calibration.P, theirs[f"P_{name}"]))
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], expected[:, :2] / expected[:, 2:], atol=1e-6)
    raw = calibration._replace(distortion=np.asarray(theirs["opencv_distCoeffs"])).project(points)
    np.testing.assert_allclose(calibration.project(points), raw, atol=0.01)
    assert worst_px < 0.01
