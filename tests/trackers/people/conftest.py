"""A camera above a floor, and silhouettes of people in it that are drawn point by point."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.foreground import PARTS

SHAPE = (120, 160)


def made_camera(position=(0.0, -5.0, 3.0), pitch_deg=25.0):
    """Looks along +Y from a position, turned down."""
    a = np.deg2rad(pitch_deg)
    R = np.array([[1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, np.cos(a), -np.sin(a)]])
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    return FloorCamera.from_matrix(K @ np.column_stack([R, -R @ np.asarray(position)]), SHAPE)


def drawn_people(camera, places):
    """Foreground times 255, and who is where (-1 for nobody): the hull of the surface points of each part of a body.

    Args:
        camera: Who looks.
        places: X, Y, height and width of each, the farthest first.
    """
    P = np.asarray(camera.P, float)
    latitude, longitude = np.meshgrid(np.linspace(0, np.pi, 40), np.linspace(0, 2 * np.pi, 60))
    sphere = np.stack([np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude)])
    who = np.full(camera.shape, -1, np.int16)
    for number, (x, y, height, width) in enumerate(places):
        for part in PARTS:
            radii = np.array([part.radius * width, part.radius * width, part.half_height * height])
            points = radii[:, None] * sphere.reshape(3, -1) + np.array([[x], [y], [part.center * height]])
            u, v, w = P[:, :3] @ points + P[:, 3:]
            hull = cv2.convexHull(np.stack([u / w, v / w], axis=-1).round().astype(np.int32))
            cv2.fillConvexPoly(who, hull, number)
    return (255 * (who >= 0)).astype(np.uint8), who


@pytest.fixture(scope="session")
def camera():
    return made_camera()


@pytest.fixture(scope="session")
def low_camera():
    """At 4 m, with people 40 m away around the origin, where a pixel is a quarter of a metre of floor."""
    zoom = np.array([[10, 0, -9 * 79.5], [0, 10, -9 * 59.5], [0, 0, 1.0]])
    return FloorCamera.from_matrix(zoom @ np.asarray(made_camera((0.0, -40.0, 4.0), 4.5).P, float), SHAPE)


@pytest.fixture(scope="session")
def draw():
    return drawn_people


@pytest.fixture(scope="session")
def camera_at():
    return made_camera


@pytest.fixture(scope="session")
def floor():
    return jnp.array([(-4.0, -2.0), (4.0, -2.0), (4.0, 4.0), (-4.0, 4.0)])
