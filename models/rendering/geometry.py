"""What can be rendered: shapes in metres, in whatever frame their user says.

Fields are annotated with the shapes of one object; under `vmap` each leaf carries one axis more, so they are not
checked at run time.
"""

from collections.abc import Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.lie import RigidTransform, quaternion_multiply

if TYPE_CHECKING:  # it takes a quarter of a second to import, and only those who load meshes need it
    import trimesh


@pytree_dataclass
class Capsules:
    """A union of k capsules: all points within `radius` of a segment; a segment of length 0 makes a sphere."""

    start: Float[Array, "k 3"]
    """Metres."""
    end: Float[Array, "k 3"]
    """Metres."""
    radius: Float[Array, " k"]
    """Metres, positive."""

    def moved(self, T_target_source: RigidTransform) -> "Capsules":
        """The same capsules in the target frame."""
        return Capsules(T_target_source.apply(self.start), T_target_source.apply(self.end), self.radius)


@pytree_dataclass
class Ellipsoids:
    """A union of k ellipsoids."""

    center: Float[Array, "k 3"]
    """Metres."""
    rotation: Float[Array, "k 4"]
    """Unit quaternions (w, x, y, z) from the principal axes to the frame of the centres."""
    radii: Float[Array, "k 3"]
    """Half lengths of the principal axes, metres, positive."""

    def moved(self, T_target_source: RigidTransform) -> "Ellipsoids":
        """The same ellipsoids in the target frame."""
        rotation = jax.vmap(quaternion_multiply, in_axes=(None, 0))(T_target_source.rotation, self.rotation)
        return Ellipsoids(T_target_source.apply(self.center), rotation, self.radii)


@pytree_dataclass
class ConvexParts:
    """Rigid convex polyhedra, each in its own frame; padded to equal numbers by repetition."""

    normals: Float[Array, "k f 3"]
    """Outward unit normals of the faces."""
    offsets: Float[Array, "k f"]
    """Metres: a point x is inside when normal . x <= offset for every face."""
    corners: Float[Array, "k v 3"]
    """Metres."""


@pytree_dataclass
class Mesh:
    """Any triangles. Rendering is fast when successive faces are neighbours, as `mesh_from_trimesh` arranges them."""

    vertices: Float[Array, "v 3"]
    """Metres."""
    faces: Int[Array, "f 3"]
    """Vertex indices, counter-clockwise from outside."""
    closed: bool = field(default=False, metadata=dict(static=True))
    """Whether the faces bound a solid, so that those turned away from the camera need not be drawn."""

    def moved(self, T_target_source: RigidTransform) -> "Mesh":
        """The same mesh in the target frame."""
        return replace(self, vertices=T_target_source.apply(self.vertices))


def mesh_from_trimesh(mesh: "trimesh.Trimesh") -> Mesh:
    """A mesh in metres, its faces reordered along a space-filling curve.

    Raises:
        ValueError: if there are no faces, or a vertex is not finite.
    """
    if len(mesh.faces) == 0:
        raise ValueError("mesh must have faces; it has none.")
    if not np.all(np.isfinite(mesh.vertices)):
        raise ValueError("mesh must have finite vertices; some are not.")
    order = np.argsort(_morton_codes(mesh.triangles_center), kind="stable")
    return Mesh(
        vertices=jnp.asarray(mesh.vertices, float),
        faces=jnp.asarray(mesh.faces[order], jnp.int32),
        closed=bool(mesh.is_volume),
    )


def _morton_codes(points):
    low = points.min(axis=0)
    cells = ((points - low) / max(np.ptp(points, axis=0).max(), 1e-30) * 1023).astype(np.uint64)
    codes = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return codes


def convex_parts(meshes: Sequence["trimesh.Trimesh"]) -> ConvexParts:
    """The convex hulls of meshes in metres, coplanar triangles merged into one face.

    Raises:
        ValueError: if there is no mesh, or one has no volume.
    """
    if not meshes:
        raise ValueError("meshes must hold one mesh or more; got none.")
    for index, mesh in enumerate(meshes):
        if _is_flat(np.asarray(mesh.vertices)):
            raise ValueError(f"meshes[{index}] must have a volume; its {len(mesh.vertices)} vertices are in a plane.")
    hulls = [mesh.convex_hull for mesh in meshes]
    planes = [_distinct_planes(hull) for hull in hulls]
    return ConvexParts(
        normals=jnp.asarray(_stacked([plane[:, :3] for plane in planes]), float),
        offsets=jnp.asarray(_stacked([plane[:, 3] for plane in planes]), float),
        corners=jnp.asarray(_stacked([hull.vertices for hull in hulls]), float),
    )


def _is_flat(vertices):
    if len(vertices) < 4:
        return True
    widths = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    return widths[2] <= 1e-9 * widths[0]


def _distinct_planes(hull):
    """Rows (normal, offset), one for all triangles of a face: it has cost and rounding once."""
    normals = np.asarray(hull.face_normals)
    offsets = np.einsum("ij,ij->i", normals, hull.triangles[:, 0])
    order = np.argsort(-hull.area_faces)  # a large triangle knows its plane best
    planes = np.column_stack([normals, offsets])[order]
    kept: list = []
    for plane in planes:
        if not any(plane[:3] @ other[:3] > 1 - 1e-9 and abs(plane[3] - other[3]) < 1e-6 * hull.scale for other in kept):
            kept.append(plane)
    return np.array(kept)


def _stacked(rows):
    longest = max(map(len, rows))
    return np.stack([np.concatenate([row, np.repeat(row[-1:], longest - len(row), axis=0)]) for row in rows])
