"""A head of six plane patches whose pictures are computed pixel by pixel in NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import CameraRig

ROWS, COLS, FOCAL, BASELINE = 170, 230, 800.0, 120.0
REGISTERED = np.array([0.0, 0.0, 650.0, 0.0, 0.0, 0.0])
SHAPE = np.array([(-42, -25, 6), (0, -22, -5), (42, -26, 4), (-40, 24, -3), (2, 26, -12), (43, 23, 5)], float)
NORMALS = np.array([(-0.5, 0.1, -0.85), (0, 0.2, -1), (0.5, 0, -0.8), (-0.3, -0.2, -0.9), (0.1, 0.3, -1), (0.4, 0, -1)])
MIDDLES = np.array([[COLS / 2, ROWS / 2], [COLS / 2 + FOCAL * BASELINE / 650, ROWS / 2]])
PLACES = np.array([[0.0, 0.0, 0.0], [-BASELINE, 0.0, 0.0]])
"""The second camera sees the same part of space as the first: its principal point is off."""


class PlaneScene:
    """Every patch is a plane with waves of 11 to 25 mm on it; a pixel belongs to the nearest patch."""

    registered, shape = REGISTERED, SHAPE
    normals = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        angle, length = rng.uniform(0, np.pi, (6, 8)), rng.uniform(11, 25, (6, 8))
        self._waves = 2 * np.pi / length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        self._phases = rng.uniform(0, 2 * np.pi, (6, 8))

    @property
    def rig(self):
        """In the precision of the moment."""
        cameras = [Pinhole.from_intrinsics(FOCAL, tuple(middle), (ROWS, COLS)) for middle in MIDDLES]
        return CameraRig.from_cameras(cameras, np.tile(np.eye(3), (2, 1, 1)), PLACES)

    def world(self, pose, points=SHAPE):
        return points @ Rotation.from_euler("ZYX", pose[3:]).as_matrix().T + pose[:3]

    def pixels(self, camera, world):
        observed = world + PLACES[camera]
        return FOCAL * observed[..., :2] / observed[..., 2:] + MIDDLES[camera]

    def uv(self, pose, points=SHAPE):
        return np.stack([self.pixels(c, self.world(pose, points)) for c in range(2)])

    def hit(self, camera, k, pixels, pose, normals=None, points=SHAPE):
        """Points of a patch's plane, model frame, that are seen at pixels (..., 2)."""
        normals = self.normals if normals is None else normals
        turn = Rotation.from_euler("ZYX", pose[3:]).as_matrix()
        ray = np.concatenate([(pixels - MIDDLES[camera]) / FOCAL, np.ones((*pixels.shape[:-1], 1))], axis=-1) @ turn
        eye = (-PLACES[camera] - pose[:3]) @ turn
        reach = ((points[k] - eye) @ normals[k]) / (ray @ normals[k])
        return eye + reach[..., None] * ray

    def images(self, pose, normals=None, points=SHAPE):
        """Grey levels without noise, 120 with a deviation of some 30."""
        normals = self.normals if normals is None else normals
        v, u = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
        grid = np.stack([u, v], axis=-1).astype(float)
        images = np.zeros((2, ROWS, COLS))
        for c, uv in enumerate(self.uv(pose, points)):
            nearest = np.linalg.norm(grid[:, :, None] - uv, axis=-1).argmin(axis=-1)
            for k in range(len(points)):
                across = np.cross(normals[k], [0.0, 1, 0])
                across /= np.linalg.norm(across)
                away = self.hit(c, k, grid[nearest == k], pose, normals, points) - points[k]
                place = away @ np.stack([across, np.cross(normals[k], across)], axis=-1)
                images[c][nearest == k] = 120 + 15 * np.cos(place @ self._waves[k].T + self._phases[k]).sum(axis=-1)
        return images


@pytest.fixture(scope="session")
def plane_scene():
    return PlaneScene()


@pytest.fixture(scope="session")
def head_poses():
    """Some poses near the registered one: moved, turned by up to 15 degrees, nearer and farther."""
    rng = np.random.default_rng(5)
    poses = REGISTERED + rng.uniform(-1, 1, (8, 6)) * np.array([6.0, 6, 40, 0.2, 0.25, 0.2])
    return SimpleNamespace(near=poses[:4], more=poses)
