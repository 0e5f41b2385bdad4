"""Palm and forearm of shapes that are drawn: discs and bars, whose middles are known."""

import math

import cv2
import numpy as np
import pytest

from jaxfilters.models.fingertip.arm import border_contact, find_arm, find_palm


def silhouette(*, angle=0.0, shape=(240, 320)):
    """A disc of radius 30 at (160, 90), and a bar of half width 18 from it to beyond the border."""
    image = np.zeros(shape, np.uint8)
    end = np.array([160, 90]) + 400 * np.array([-math.sin(angle), math.cos(angle)])
    cv2.line(image, (160, 90), tuple(int(n) for n in np.rint(end)), 255, 37)
    cv2.circle(image, (160, 90), 30, 255, -1)
    return image


def palm_of(image):
    return find_palm(cv2.distanceTransform(image, cv2.DIST_L2, 5), border_contact(image))


def test_the_palm_is_the_largest_disc():
    palm = palm_of(silhouette())
    np.testing.assert_allclose(palm.center, (160, 90), atol=2.0)
    assert palm.radius == pytest.approx(30.5, abs=1.0)


@pytest.mark.parametrize("angle", [-0.6, -0.2, 0.0, 0.3, 0.7, 0.74, 0.9])
def test_the_arm_points_along_the_bar(angle):
    """Also where it leaves the image around a corner."""
    image = silhouette(angle=angle)
    arm = find_arm(image, palm_of(image), border_contact(image))
    assert arm.is_observed
    assert arm.direction @ [math.sin(angle), -math.cos(angle)] > math.cos(math.radians(0.5))


def test_a_finger_that_also_reaches_the_border_is_not_the_arm():
    image = silhouette()
    cv2.line(image, (160, 90), (160, 0), 255, 13)
    contact = border_contact(image)
    np.testing.assert_allclose([contact[:, 0].min(), contact[:, 0].max()], (142, 178), atol=1)
    assert (contact[:, 1] == 239).all()
    assert find_arm(image, palm_of(image), contact).direction @ [0, -1] > 0.999


def test_a_contact_around_a_corner_is_one():
    image = np.zeros((50, 60), np.uint8)
    image[:7, :5] = 255
    assert len(border_contact(image)) == 7 + 5  # the corner, of both sides, counts twice


def test_contact_with_all_of_the_border_and_with_none():
    assert len(border_contact(np.full((5, 6), 255, np.uint8))) == 2 * (5 + 6)
    assert len(border_contact(np.zeros((5, 6), np.uint8))) == 0


def test_away_from_the_border_the_arm_is_the_principal_axis_towards_the_palm():
    image = np.zeros((400, 400), np.uint8)
    cv2.line(image, (100, 300), (200, 200), 255, 30)
    cv2.circle(image, (200, 200), 35, 255, -1)
    arm = find_arm(image, palm_of(image), border_contact(image))
    assert not arm.is_observed
    assert arm.direction @ np.array([1, -1]) / math.sqrt(2) > math.cos(math.radians(2))
