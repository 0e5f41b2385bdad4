"""What stands in a room: depth images of furniture, and where people can walk."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import pixel_grid
from jaxfilters.models.rendering.depth import render_mesh
from jaxfilters.models.rendering.geometry import Mesh


def patch_depth(camera: FloorCamera, patches: Float[Array, "n 3 3"]) -> Float[Array, "rows cols"]:
    """Depth along the optical axis of the nearest of some parallelograms, metres; `inf` where there is none.

    Args:
        camera: who looks.
        patches: a corner and two edges each, metres, as rows.
    """
    return _nearest(camera, patches, jnp.ones(camera.shape))


def patch_floor_distance(camera: FloorCamera, patches: Float[Array, "n 3 3"]) -> Float[Array, "rows cols"]:
    """Distance to the nearest parallelogram measured on the floor, metres; `inf` where there is none (section 3.3)."""
    return _nearest(camera, patches, jnp.linalg.norm(camera.rays(pixel_grid(camera.shape))[..., :2], axis=-1))


def _nearest(camera, patches, per_depth):
    rays, origin = camera.rays(pixel_grid(camera.shape)), camera.position()

    def one(nearest, patch):
        corner, first, second = patch
        normal = jnp.cross(first, second)
        facing = dot(rays, normal)
        depth = dot(corner - origin, normal) / jnp.where(facing == 0, 1.0, facing)
        on_plane = origin + depth[..., None] * rays - corner
        squared = dot(normal, normal)
        along = dot(jnp.cross(on_plane, second), normal) / squared
        across = dot(jnp.cross(first, on_plane), normal) / squared
        inside = (along >= 0) & (along <= 1) & (across >= 0) & (across <= 1)
        hit = inside & (depth > 0) & (facing != 0)
        return jnp.minimum(nearest, jnp.where(hit, depth * per_depth, jnp.inf)), None

    return jax.lax.scan(one, jnp.full(camera.shape, jnp.inf, rays.dtype), patches)[0]


def mesh_depth(camera: FloorCamera, vertices: np.ndarray, triangles: np.ndarray) -> Float[Array, "rows cols"]:
    """Depth along the optical axis of a triangle mesh in world coordinates, metres; `inf` where there is none.

    Args:
        camera: who looks.
        vertices: (n, 3) metres.
        triangles: (m, 3) indices of vertices.
    """
    rows, cols = camera.shape
    pinhole = Pinhole.from_intrinsics(float(max(rows, cols)), ((cols - 1) / 2, (rows - 1) / 2), camera.shape)
    # Any projection matrix is this pinhole after a linear map of space, which leaves triangles and depths as they are.
    P = np.linalg.solve(np.asarray(pinhole.matrix(), float), np.asarray(camera.P, float))
    observed = dot(vertices, P[:, :3].T) + P[:, 3]
    return render_mesh(pinhole, Mesh(jnp.asarray(observed, jnp.float32), jnp.asarray(triangles, jnp.int32)))


def upright_depth(camera: FloorCamera, xy: Float[Array, " 2"]) -> Float[Array, "rows cols"]:
    """Depth of the vertical plane through a floor point that faces the camera: of thin things outlined in the image."""
    rays, origin = camera.rays(pixel_grid(camera.shape)), camera.position()
    away = xy - origin[:2]
    towards = dot(rays[..., :2], away)
    return jnp.where(towards > 0, dot(away, away) / jnp.where(towards > 0, towards, 1.0), jnp.inf)


@jax.jit
def walkable(polygon: Float[Array, "n 2"], xy: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
    """Which floor points lie inside a polygon (even-odd rule)."""
    a, b = polygon, jnp.roll(polygon, -1, axis=0)
    x, y = xy[..., None, 0], xy[..., None, 1]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = jnp.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    left_of = x < a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return jnp.sum(spans & left_of, axis=-1) % 2 == 1


def nearest_on_border(polygon: Float[Array, "n 2"], xy: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """The points of the border of a polygon that are nearest to floor points, inside or outside."""
    corners, edges = polygon, jnp.roll(polygon, -1, axis=0) - polygon
    along = jnp.sum((xy[..., None, :] - corners) * edges, axis=-1) / jnp.maximum(jnp.sum(edges**2, axis=-1), 1e-12)
    points = corners + jnp.clip(along, 0.0, 1.0)[..., None] * edges
    nearest = jnp.argmin(jnp.sum((points - xy[..., None, :]) ** 2, axis=-1), axis=-1)
    return jnp.take_along_axis(points, nearest[..., None, None], axis=-2)[..., 0, :]
