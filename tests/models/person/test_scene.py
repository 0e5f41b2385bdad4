"""Depth images of furniture and the walkable floor: oracle 11 of the specification, section 7."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_triangle import RayMeshIntersector

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import pixel_grid
from jaxfilters.models.person.scene import (
    mesh_depth,
    nearest_on_border,
    patch_depth,
    patch_floor_distance,
    upright_depth,
    walkable,
)

SHAPE = (30, 40)
BOXES = (
    ((-0.6, 1.0, 0.365), (1.2, 0.6, 0.73)),
    ((-1.8, 2.0, 0.5), (0.5, 0.5, 1.0)),
    ((-1.0, 0.4, 0.2), (0.3, 0.3, 0.4)),
)
"""Centres and sizes, metres."""


@pytest.fixture
def camera(x64):
    return FloorCamera.from_matrix(small_camera(), SHAPE)


def small_camera():
    pitch = np.deg2rad(37)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]])
    K = np.array([[34.0, 0, 19.6], [0, 34, 14.7], [0, 0, 1]])
    return K @ np.column_stack([R, -R @ [-1, -1.74, 2.64]])


def faces(center, size):
    """(6, 3, 3) the rectangles of a box."""
    low, (a, b, c) = np.asarray(center) - np.asarray(size) / 2, np.diag(size)
    high = low + a + b + c
    return np.array([[low, a, b], [low, a, c], [low, b, c], [high, -a, -b], [high, -a, -c], [high, -b, -c]])


def traced(camera, vertices, triangles):
    """Depths by trimesh's ray caster in float64, and where no neighbour is another face."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    rays = np.asarray(camera.rays(pixel_grid(camera.shape))).reshape(-1, 3)
    origin = np.asarray(camera.position())
    points, index, _ = RayMeshIntersector(mesh).intersects_location(np.broadcast_to(origin, rays.shape), rays)
    depth = np.full(len(rays), np.inf)
    np.minimum.at(depth, index, np.linalg.norm(points - origin, axis=1) / np.linalg.norm(rays[index], axis=1))
    depth = depth.reshape(camera.shape)
    finite = np.isfinite(depth).astype(np.uint8)
    inside = cv2.erode(finite, np.ones((3, 3), np.uint8)) > 0
    outside = cv2.dilate(finite, np.ones((3, 3), np.uint8)) == 0
    return depth, inside | outside


def scene_of_boxes():
    return np.concatenate([faces(*box) for box in BOXES])


def mesh_of_boxes():
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(center)) for center, size in BOXES]
    return trimesh.util.concatenate(boxes)


def test_patch_depth_is_that_of_a_ray_caster(camera):
    mesh = mesh_of_boxes()
    expected, away_from_edges = traced(camera, mesh.vertices, mesh.faces)
    found = np.asarray(patch_depth(camera, jnp.asarray(scene_of_boxes())))
    assert np.isfinite(expected).sum() > 150
    assert away_from_edges.mean() > 0.7
    np.testing.assert_allclose(found[away_from_edges], expected[away_from_edges], atol=1e-9)


@pytest.mark.system
def test_mesh_depth_is_that_of_a_ray_caster(camera):
    mesh = mesh_of_boxes()
    expected, away_from_edges = traced(camera, mesh.vertices, mesh.faces)
    found = np.asarray(mesh_depth(camera, mesh.vertices, mesh.faces))
    # Rendered in single precision.
    np.testing.assert_allclose(found[away_from_edges], expected[away_from_edges], rtol=2e-5)


def test_floor_distance_is_measured_on_the_floor(camera):
    patches = jnp.asarray(scene_of_boxes())
    depth, distance = (np.asarray(f(camera, patches)) for f in (patch_depth, patch_floor_distance))
    hit = np.isfinite(depth)
    np.testing.assert_array_equal(np.isfinite(distance), hit)
    points = np.asarray(camera.position()) + depth[hit, None] * np.asarray(camera.rays(pixel_grid(SHAPE)))[hit]
    np.testing.assert_allclose(distance[hit], np.linalg.norm(points[:, :2] - [-1, -1.74], axis=1), rtol=1e-9)


def test_patches_may_be_slanted_and_none_hides_nothing(camera):
    patch = np.array([[-1.5, 1.0, 0.2], [0.9, 0.3, 0.1], [0.2, -0.1, 0.8]])
    vertices = np.array([patch[0], patch[0] + patch[1], patch[0] + patch[2], patch.sum(axis=0)])
    expected, away_from_edges = traced(camera, vertices, [[0, 1, 3], [0, 3, 2]])
    found = np.asarray(patch_depth(camera, jnp.asarray(patch[None])))
    np.testing.assert_allclose(found[away_from_edges], expected[away_from_edges], atol=1e-9)
    assert np.all(np.isinf(patch_depth(camera, jnp.zeros((0, 3, 3)))))


def test_what_is_behind_the_camera_hides_nothing(camera):
    wall = jnp.array([[[-3.0, -3.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 4.0]]])
    assert np.all(np.isinf(patch_depth(camera, wall)))
    assert np.all(np.isinf(patch_floor_distance(camera, wall)))


def test_upright_things_stand_in_a_plane_that_faces_the_camera(camera):
    xy = np.array([-0.3, 1.5])
    depth = np.asarray(upright_depth(camera, jnp.asarray(xy)))
    observed = np.isfinite(depth)
    points = (
        np.asarray(camera.position()) + depth[observed, None] * np.asarray(camera.rays(pixel_grid(SHAPE)))[observed]
    )
    away = xy - np.array([-1, -1.74])
    np.testing.assert_allclose((points[:, :2] - xy) @ away, 0, atol=1e-9)


@pytest.mark.system
def test_walkable_agrees_with_opencv():
    polygon = np.array([[0, 0], [4, 0.3], [3.5, 3], [2, 1.2], [0.5, 2.8], [1, 1]], np.float32)
    xy = np.random.default_rng(0).uniform(-1, 5, (500, 2)).astype(np.float32)
    distance = np.array([cv2.pointPolygonTest(polygon, (float(x), float(y)), True) for x, y in xy])
    clear = np.abs(distance) > 1e-3
    found = np.asarray(walkable(jnp.asarray(polygon), jnp.asarray(xy.reshape(50, 10, 2)))).ravel()
    np.testing.assert_array_equal(found[clear], distance[clear] > 0)


def test_nearest_point_of_the_border_is_that_of_a_dense_polyline():
    """The border sampled every millimetre, for points inside and outside of a polygon that is not convex."""
    polygon = np.array([(0.0, 0), (4, 0), (4, 3), (2, 1), (0, 3)])
    ends = np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)
    border = np.concatenate([np.linspace(a, b, int(1000 * np.linalg.norm(b - a)) + 1) for a, b in ends])
    xy = np.random.default_rng(0).uniform(-2, 6, (40, 2))
    found = np.asarray(nearest_on_border(jnp.asarray(polygon), jnp.asarray(xy)))
    expected = border[np.argmin(np.linalg.norm(xy[:, None] - border, axis=-1), axis=1)]
    np.testing.assert_allclose(np.linalg.norm(xy - found, axis=1), np.linalg.norm(xy - expected, axis=1), atol=1e-3)
