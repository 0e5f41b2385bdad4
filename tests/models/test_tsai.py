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
    calibration, _ = calibration_of_tsai(camera, camera.image_size)
    depth = rng.uniform(10, 40, (300, 1))
    uv = rng.uniform(0, 1, (300, 2)) * camera.image_size
    rays = np.column_stack([(uv - calibration.K[:2, 2]) / calibration.K[[0, 1], [0, 1]] * 0.9, np.ones(300)])
    return (rays * depth - calibration.t) @ calibration.R


def test_points_project_as_with_tsais_own_equations():
    calibration, worst_px = calibration_of_tsai(CAMERA, CAMERA.image_size)
    points = points_in_view(CAMERA)
    np.testing.assert_allclose(calibration.project(points), tsai_pixels(CAMERA, points), atol=0.02)
    assert 0 < worst_px < 0.02


def test_another_image_size_moves_pixel_centres_with_it():
    points = points_in_view(CAMERA)
    halved, _ = calibration_of_tsai(CAMERA, (384, 288))
    expected = (tsai_pixels(CAMERA, points) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(halved.project(points), expected, atol=0.02)


def test_no_distortion_stays_none():
    calibration, worst_px = calibration_of_tsai(CAMERA._replace(kappa1=0.0), CAMERA.image_size)
    np.testing.assert_allclose(calibration.distortion, 0, atol=1e-12)
    assert worst_px < 1e-9


def test_parameters_that_are_no_camera_are_named():
    with pytest.raises(ValueError, match="must be positive"):
        calibration_of_tsai(CAMERA._replace(focal=0.0), (768, 576))
    with pytest.raises(ValueError, match="folds the image"):
        calibration_of_tsai(CAMERA._replace(kappa1=-0.1), (768, 576))


@pytest.mark.data
@pytest.mark.parametrize("size", [(768, 576), (480, 360)])
def test_the_camera_of_pets_is_that_of_its_description(data_dir, size):
    folder = data_dir / "pets09_s2l1_view001"
    theirs = json.loads((folder / "calibration.json").read_text())
    calibration, worst_px = calibration_of_tsai(read_tsai(folder / "View_001.xml"), size)
    name = f"{size[0]}x{size[1]}"
    points = np.random.default_rng(0).uniform([-14, -14, 0], [4, 1.7, 2], (200, 3))
    homogeneous = np.column_stack([points, np.ones(200)])
    ours, expected = (homogeneous @ np.asarray(P).T for P in (calibration.P, theirs[f"P_{name}"]))
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], expected[:, :2] / expected[:, 2:], atol=1e-6)
    raw = calibration._replace(distortion=np.asarray(theirs["opencv_distCoeffs"])).project(points)
    np.testing.assert_allclose(calibration.project(points), raw, atol=0.01)
    assert worst_px < 0.01
