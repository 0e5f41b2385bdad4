import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io.undistortion import Undistortion

K, LENS = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]]), np.array([-0.3, 0.1, 0.001, 0, 0])


def test_images_are_straightened_as_by_opencv():
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 3)
    ours = Undistortion((120, 160), K, LENS).apply(image)
    np.testing.assert_allclose(ours.astype(int), cv2.undistort(image, K, LENS), atol=2)
    assert np.abs(ours.astype(int) - image).mean() > 1


@pytest.mark.parametrize("lens", [LENS, (-0.35, 0.15, 0.0, 0.0, -0.03)])
def test_pixels_are_straightened_up_to_the_border(lens):
    """Both ways are each other's inverse; five iterations of OpenCV's are off by up to 50 pixels with the second."""
    undistortion = Undistortion((960, 1280), np.array([[700.0, 0, 640], [0, 700, 480], [0, 0, 1]]), np.array(lens))
    straight = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 959, 7)), axis=-1)
    np.testing.assert_allclose(undistortion.straightened(undistortion.distorted(straight)), straight, atol=0.05)


@pytest.mark.parametrize("arguments", [(), (K,), (K, np.zeros(5))])
def test_without_distortion_an_image_passes_as_it_is(arguments):
    image = np.zeros((120, 160), np.uint8)
    undistortion = Undistortion((120, 160), *arguments)
    assert undistortion.is_identity
    assert undistortion.apply(image) is image


def test_an_image_of_another_size_is_named():
    with pytest.raises(ValueError, match=r"120 rows and 160 columns; got \(160, 120\)"):
        Undistortion((120, 160), K, LENS).apply(np.zeros((160, 120), np.uint8))
