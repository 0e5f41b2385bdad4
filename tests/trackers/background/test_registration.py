"""Rotations of a camera against images of a sphere of known brightness, rendered pixel by pixel without any warp."""

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.background.registration import Registration, intrinsics

SHAPE = (120, 160)
K = np.array([[180.0, 0.0, 82.0], [0.0, 175.0, 57.0], [0.0, 0.0, 1.0]])
AT = np.random.default_rng(0)
CENTERS = AT.uniform([-0.6, -0.5], [0.6, 0.5], (150, 2)).astype(np.float32)
WIDTHS, LEVELS = AT.uniform(0.01, 0.05, 150).astype(np.float32), AT.normal(size=150).astype(np.float32)


def rendered(rotation: np.ndarray) -> np.ndarray:
    """The image (rows, cols, 3) of blobs on a sphere by a camera that is turned by `rotation`."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ rotation
    xy = (rays[..., :2] / rays[..., 2:]).astype(np.float32)
    squared = np.sum((xy[:, :, None] - CENTERS) ** 2, axis=-1)
    grey = 120 + 60 * np.sum(LEVELS * np.exp(-squared / (2 * WIDTHS**2)), axis=-1)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def turn(*angles_px: float) -> np.ndarray:
    return cv2.Rodrigues(np.array(angles_px) / K[0, 0])[0]


def off_px(registration: Registration, rotation: np.ndarray) -> float:
    """Largest distance between where pixels are in the video by the rotation that was found, and where they are."""
    uv = np.array([[5.0, 5.0], [150.0, 8.0], [8.0, 110.0], [152.0, 112.0], [80.0, 60.0]])
    found, true = (
        np.insert(uv, 2, 1.0, axis=1) @ (K @ one @ np.linalg.inv(K)).T
        for one in (registration.state()["rotation"], rotation)
    )
    return float(np.linalg.norm(found[:, :2] / found[:, 2:] - true[:, :2] / true[:, 2:], axis=1).max())


@pytest.mark.parametrize("angles_px", [(2.0, -3.0, 0.0), (0.0, 0.0, 8.0), (-7.0, 10.0, 4.0)])
def test_the_turn_of_a_camera_is_found_and_undone(angles_px):
    registration, rotation = Registration(K), turn(*angles_px)
    still = rendered(np.eye(3))
    same, nothing = registration.straightened(still)
    assert same is still
    assert nothing is None
    image, blank = registration.straightened(rendered(rotation))
    # Another picture of that moment, as the boxes of a detector are drawn, turns with it.
    np.testing.assert_array_equal(registration.as_last(rendered(rotation)), image)
    assert np.abs(registration.as_last(still).astype(int) - still).mean() > 1
    # Forty corners, of which the far ones leave the image, and a light that is that of other parts of the scene.
    assert off_px(registration, rotation) < 0.4
    differences = np.abs(image.astype(int) - still)[blank == 0]
    assert np.mean(differences) < 2.5
    assert 0 < np.mean(blank > 0) < 0.25
    assert registration.failures == 0


def test_people_and_light_do_not_turn_a_camera():
    """A third of the image moves by eight pixels as one body, and everything is darker."""
    registration, rotation = Registration(K), turn(1.0, 2.0, 0.0)
    registration.straightened(rendered(np.eye(3)))
    image = rendered(rotation)
    image[:, 50:105] = rendered(turn(0.0, 8.0, 0.0))[:, 50:105]
    registration.straightened((0.75 * image).astype(np.uint8))
    assert off_px(registration, rotation) < 0.3


def test_a_crowd_that_fills_most_of_the_image_does_not_turn_a_camera():
    """Three fifths of the image move by six pixels as one body, a train; the camera stands in its last pose."""
    registration, rotation = Registration(K), turn(1.0, 3.0, 0.0)
    registration.straightened(rendered(np.eye(3)))
    registration.straightened(rendered(rotation))
    image = rendered(rotation)
    image[:, 64:] = rendered(turn(1.0, 9.0, 0.0))[:, 64:]
    registration.straightened(image)
    assert off_px(registration, rotation) < 0.3


def test_a_camera_that_stands_still_or_sees_nothing_to_hold_on_to_is_left_as_it_is():
    registration = Registration(K)
    still, noise = rendered(np.eye(3)), np.random.default_rng(1)
    registration.straightened(still)
    noisy = np.clip(still + noise.normal(0, 4, still.shape), 0, 255).astype(np.uint8)
    assert registration.straightened(noisy)[0] is noisy
    plain = Registration(K)
    for _ in range(3):
        flat = np.full((*SHAPE, 3), 90, np.uint8)
        assert plain.straightened(flat)[0] is flat
    assert plain.most_px == registration.most_px == 0


def test_the_reference_is_the_usual_pose_of_the_beginning():
    """Two fifths of the images, the last, are from a camera that was knocked; the first ones tremble."""
    random = np.random.default_rng(2)
    rotations = [turn(*random.normal(0, 0.7, 3)) for _ in range(6)] + [turn(0.0, 9.0, 5.0)] * 4
    registration = Registration(K)
    straight, blank = registration.prime([rendered(one) for one in rotations])
    expected = rendered(np.eye(3)).astype(int)
    inner = np.s_[20:100, 25:135]
    assert all(np.mean(np.abs(image - expected)[inner]) < 6 for image in straight)
    assert [bool(one.any()) for one in blank[6:]] == [True] * 4
    assert all(one[inner].max() == 0 for one in blank)
    # Differences between the images are those of interpolation; the pose itself is known as well as two are on average.
    assert max(np.mean(np.abs(a.astype(int) - straight[0])[inner]) for a in straight) < 2.5


def test_intrinsics_come_back_from_a_projection():
    R = cv2.Rodrigues(np.array([1.9, 0.2, -0.1]))[0]
    P = K @ np.column_stack([R, [0.3, 1.0, 6.0]])
    np.testing.assert_allclose(intrinsics(3 * P), K, atol=1e-9)
    with pytest.raises(ValueError, match="regular matrix"):
        Registration(np.zeros((3, 3)))


def test_a_saved_registration_goes_on():
    first, second = Registration(K), Registration(K)
    first.straightened(rendered(np.eye(3)))
    first.straightened(rendered(turn(1.0, 4.0, 2.0)))
    second.restore(first.state())
    image = rendered(turn(2.0, 5.0, 2.0))
    for a, b in zip(first.straightened(image), second.straightened(image), strict=True):
        np.testing.assert_array_equal(a, b)
    assert Registration(K).state() == {}
