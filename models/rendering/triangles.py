"""Triangle meshes as inverse depth over the image plane.

The ray d with d_z = 1 is d = A a + B b + C c in the corners of a triangle, with A = d . (b x c) / det and so on, where
det = a . (b x c). Inverse depth is A + B + C, and the triangle is hit when none of the three is negative. All are
affine in the pixel and need no clipping at z = 0. Triangles are drawn in clusters of neighbours.
"""

import jax.numpy as jnp

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.geometry import Mesh
from jaxfilters.models.rendering.parts import Parts, Surface, anchor_of
from jaxfilters.models.rendering.polyhedra import corner_box
from jaxfilters.models.rendering.rays import components, cross, dot, minus, pixel_basis

_CLUSTER = 8
# Pixels by which triangles are widened: more than rounding, so that no ray slips between neighbours.
_SEAM = 1e-4


def mesh_parts(camera: Pinhole, mesh: Mesh) -> Parts:
    """Clusters of successive triangles of a mesh in the camera frame, prepared for `TRIANGLES`."""
    corners = mesh.vertices[mesh.faces]
    missing = -len(corners) % _CLUSTER
    filled = jnp.concatenate([corners, jnp.broadcast_to(corners[-1], (missing, 3, 3))])
    clusters = filled.reshape(-1, _CLUSTER, 3, 3)
    box = corner_box(camera, clusters.reshape(len(clusters), -1, 3))
    anchor = anchor_of(camera, box)
    coefficients, drawn = _barycentric(camera, anchor, clusters, mesh.closed)
    unseen = jnp.asarray([jnp.inf, jnp.inf, -jnp.inf, -jnp.inf], box.dtype)
    box = jnp.where(jnp.any(drawn, axis=-1)[:, None], box, unseen)
    return Parts(coefficients.reshape(len(clusters), -1), anchor, box)


def _barycentric(camera, anchor, clusters, closed):
    """Inverse depth, A, B, C as affine functions of the pixel, (clusters, triangles, 12); which triangles are drawn."""
    a, b, c = (components(clusters[:, :, index]) for index in range(3))
    # b x (c - b) is b x c without the rounding of a difference of large products; likewise det.
    edges = cross(b, minus(c, b)), cross(c, minus(a, c)), cross(a, minus(b, a))
    normal = cross(minus(b, a), minus(c, a))
    det = dot(a, normal)
    drawn = (det < 0) if closed else (det != 0)
    inverse = jnp.where(drawn, 1 / jnp.where(drawn, det, 1.0), 0.0)
    basis = pixel_basis(camera, anchor[:, None])
    columns = [dot(normal, direction) * inverse for direction in basis]
    for edge in edges:
        constant, along_x, along_y = (dot(edge, direction) * inverse for direction in basis)
        constant += _SEAM * (jnp.abs(along_x) + jnp.abs(along_y))
        columns += [jnp.where(drawn, constant, -1.0), along_x, along_y]
    return jnp.stack(columns, axis=-1), drawn


def _pieces(coefficients, x, y):
    return [_triangle(triangle, x, y) for triangle in coefficients.reshape(_CLUSTER, -1)]


def _triangle(c, x, y):
    inverse, *sides = (_affine(c[k : k + 3], x, y) for k in (0, 3, 6, 9))
    for side in sides:
        inverse = jnp.where(side >= 0, inverse, 0.0)
    return inverse


def _affine(c, x, y):
    return (c[0] + c[2] * y) + c[1] * x


def _inverse_depth(coefficients, x, y):
    nearest = jnp.zeros_like(x + y)
    for inverse in _pieces(coefficients, x, y):
        nearest = jnp.where(inverse > nearest, inverse, nearest)
    return nearest


TRIANGLES = Surface(
    inverse_depth=_inverse_depth,
    pieces=_pieces,
    rows=lambda coefficients: coefficients.reshape(len(coefficients), _CLUSTER, -1)[..., :3],
    smooth=_affine,
    has_root=False,
)
"""One piece a triangle."""
