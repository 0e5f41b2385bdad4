"""A triangle hand made procedurally: one watertight convex part per capsule, posed rigidly with its bone."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.hand.parts import part_transforms
from jaxfilters.models.hand.skeleton import PART_NAMES, HandGeometry, check_geometry


# Shapes are those of one hand; under `vmap` the leaves may carry one axis more, so they are not checked at run time.
@pytree_dataclass
class HandMesh:
    """Triangles of all parts in the frames of their parts (`part_transforms`)."""

    vertices: Float[Array, "v 3"]
    """Metres, each in the frame of its part."""
    faces: Int[Array, "f 3"]
    """Vertex indices, counter-clockwise from outside."""
    part: Int[Array, " v"]
    """Index into `PART_NAMES` of every vertex."""


def hand_mesh(geometry: HandGeometry, *, sections: int = 8, latitudes: int = 0) -> HandMesh:
    """Mesh of a (concrete) hand of `19 * 4 * sections * (1 + latitudes)` triangles.

    The default has 608 triangles, `sections=10, latitudes=1` has 1520. Every part has the volume of its capsule: an
    inscribed mesh would be 1-2 mm too thin on average.
    """
    check_geometry(geometry)
    parts = [
        capsule_mesh(start, end, radius, sections=sections, latitudes=latitudes)
        for start, end, radius in zip(*_part_capsules(geometry), strict=True)
    ]
    sizes = [len(part.vertices) for part in parts]
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return HandMesh(
        vertices=jnp.asarray(np.concatenate([part.vertices for part in parts]), dtype=geometry.lengths.dtype),
        faces=jnp.asarray(np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]), dtype=jnp.int32),
        part=jnp.asarray(np.repeat(np.arange(len(parts)), sizes), dtype=jnp.int32),
    )


def pose_vertices(pose: Float[Array, " 22"], mesh: HandMesh, geometry: HandGeometry) -> Float[Array, "v 3"]:
    """The vertices in the camera frame, metres, of a mesh made for `geometry`."""
    T_camera_part = part_transforms(pose, geometry)
    return jax.vmap(lambda T, point: T.apply(point))(
        jax.tree.map(lambda leaf: leaf[mesh.part], T_camera_part), mesh.vertices
    )


def posed_trimesh(pose: Float[Array, " 22"], mesh: HandMesh, geometry: HandGeometry) -> trimesh.Trimesh:
    """The whole posed hand in the camera frame, for export: `posed_trimesh(...).export("hand.ply")`."""
    vertices = np.asarray(pose_vertices(pose, mesh, geometry), dtype=float)
    return trimesh.Trimesh(vertices, np.asarray(mesh.faces), process=False)


def part_meshes(mesh: HandMesh) -> list[trimesh.Trimesh]:
    """The parts as separate convex meshes in their own frames, in the order of `PART_NAMES`."""
    part = np.asarray(mesh.part)
    face_part = part[np.asarray(mesh.faces)[:, 0]]
    meshes = []
    for index in range(len(PART_NAMES)):
        first = int(np.argmax(part == index))
        vertices = np.asarray(mesh.vertices, dtype=float)[part == index]
        meshes.append(trimesh.Trimesh(vertices, np.asarray(mesh.faces)[face_part == index] - first, process=False))
    return meshes


def capsule_mesh(
    start: np.ndarray, end: np.ndarray, radius: float, *, sections: int, latitudes: int
) -> trimesh.Trimesh:
    """A watertight convex polyhedron with the axis and the volume of a capsule.

    It has `sections` sides and `latitudes` rings on each cap besides the equator and the pole:
    `4 * sections * (1 + latitudes)` triangles.
    """
    if sections < 3 or latitudes < 0:
        raise ValueError(f"sections must be >= 3 and latitudes >= 0; got {sections} and {latitudes}.")
    axis = np.asarray(end, dtype=float) - np.asarray(start, dtype=float)
    length = float(np.linalg.norm(axis))
    outer = _volume_preserving_radius(length, float(radius), sections, latitudes)
    mesh = _revolved(length, outer, sections, latitudes)
    mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis / length))
    mesh.apply_translation(start)
    return mesh


def _revolved(length, radius, sections, latitudes):
    """A tessellated capsule from the origin along +z."""
    angles = np.linspace(np.pi / 2, 0, latitudes + 2)
    cap = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    cap[0, 0] = 0.0
    profile = np.concatenate([cap * [1, -1], cap[::-1] + np.array([0, length])])
    return trimesh.creation.revolve(profile, sections=sections)


def _volume_preserving_radius(length, radius, sections, latitudes):
    """The radius whose tessellation has the capsule's volume: the root of a cubic, `prism r^2 + cap r^3 = volume`."""
    prism = sections / 2 * np.sin(2 * np.pi / sections) * length
    cap = _revolved(length, 1.0, sections, latitudes).volume - prism
    volume = np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3
    roots = np.roots([cap, prism, 0.0, -volume])  # one is positive, the others have negative real parts
    return float(roots.real.max())


def _part_capsules(geometry):
    """Axis ends (19, 3) and radii (19,) of the capsules in the frames of their parts."""
    tips = np.stack([np.zeros(15), -np.asarray(geometry.lengths).reshape(15), np.zeros(15)], axis=1)
    mirror = np.array([float(geometry.side), 1.0, 1.0])
    starts = np.concatenate([np.zeros((15, 3)), np.asarray(geometry.metacarpal_starts) * mirror])
    ends = np.concatenate([tips, np.asarray(geometry.bases)[1:] * mirror])
    radii = np.concatenate([np.asarray(geometry.radii).reshape(15), np.full(4, float(geometry.metacarpal_radius))])
    return starts, ends, radii
