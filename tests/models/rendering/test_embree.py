"""All renderers against a ray tracer on finely tessellated or the very same geometry."""

import jax
import numpy as np
import pytest
import trimesh

from jaxfilters.math.lie import RigidTransform, quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.depth import render_mesh
from jaxfilters.models.rendering.geometry import mesh_from_trimesh

pytest.importorskip("embreex")


@pytest.fixture
def embree():
    from jaxfilters.benchmarks.scenarios._embree import Embree

    return Embree


def tessellated(kind):
    """Triangles (f, 3, 3) of a shape of the fixture `kind`, in its own frame."""
    shape = kind.shape()
    if hasattr(shape, "faces"):
        return np.asarray(shape.vertices)[np.asarray(shape.faces)]
    if hasattr(shape, "corners"):
        return np.concatenate([trimesh.PointCloud(corners).convex_hull.triangles for corners in shape.corners])
    ball = trimesh.creation.icosphere(subdivisions=6, radius=1.0)
    solids = []
    if hasattr(shape, "radii"):
        for center, rotation, radii in zip(shape.center, shape.rotation, shape.radii, strict=True):
            solids.append((ball.vertices * np.asarray(radii)) @ np.asarray(quaternion_to_matrix(rotation)).T + center)
        return np.concatenate([np.asarray(solid)[ball.faces] for solid in solids])
    # The convex hull of two fine balls is a fine capsule.
    for start, end, radius in zip(shape.start, shape.end, shape.radius, strict=True):
        balls = np.concatenate([np.asarray(end_) + float(radius) * ball.vertices for end_ in (start, end)])
        solids.append(trimesh.PointCloud(balls).convex_hull.triangles)
    return np.concatenate(solids)


def check_agreement(ours, theirs):
    both = np.isfinite(ours) & np.isfinite(theirs)
    assert both.sum() > 500
    assert np.abs(ours[both] - theirs[both]).mean() < 1e-4
    assert both.sum() / (np.isfinite(ours) | np.isfinite(theirs)).sum() > 0.995


@pytest.mark.system
@pytest.mark.parametrize("seed", range(2))
def test_against_embree(kind, random_transform, embree, seed):
    camera = Pinhole.from_intrinsics((365.0, 365.0), (63.5, 63.5), (128, 128))
    T = random_transform(seed)
    ours = np.asarray(jax.jit(kind.render)(camera, kind.shape(), T))
    triangles = np.asarray(T.apply(tessellated(kind).astype(np.float32)))
    check_agreement(ours, embree(camera).depth(triangles))


@pytest.mark.system
def test_a_scan_of_many_triangles(embree):
    """Open, not convex, near the camera and beyond the image's border."""
    camera = Pinhole.from_intrinsics((500.0, 500.0), (319.5, 239.5), (480, 640))
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.15)
    x, y, _ = (mesh.vertices / 0.15).T
    mesh.vertices *= (1 + 0.2 * np.sin(8 * x) * np.cos(6 * y))[:, None]
    mesh.update_faces(mesh.triangles_center[:, 1] < 0.08)
    mesh.apply_translation([0.12, 0.06, 0.35])
    ours = mesh_from_trimesh(mesh)
    assert not ours.closed
    assert len(ours.faces) > 10000
    check_agreement(np.asarray(render_mesh(camera, ours)), embree(camera).depth(mesh.triangles))


def test_large_and_small_triangles_and_a_moved_mesh(embree):
    camera = Pinhole.from_intrinsics((200.0, 200.0), (63.5, 47.5), (96, 128))
    floor = trimesh.creation.box((3.0, 0.1, 3.0))
    floor.apply_translation([0, 0.5, 1.0])
    scene = trimesh.util.concatenate([floor, trimesh.creation.icosphere(subdivisions=4, radius=0.1)])
    T = RigidTransform(np.asarray([1.0, 0, 0, 0], np.float32), np.asarray([0.05, 0.02, 0.9], np.float32))
    moved = scene.copy()
    moved.apply_translation([0.05, 0.02, 0.9])
    check_agreement(np.asarray(render_mesh(camera, mesh_from_trimesh(scene), T)), embree(camera).depth(moved.triangles))
