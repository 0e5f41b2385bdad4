"""Depth images: metres along z, `inf` where nothing is visible.

Inside silhouettes they are differentiable in camera, shape and pose: which surface is visible where is found first and
then held fixed, and the visible surface is evaluated again. Functions are compiled as a whole, outside `jit` too.
"""

import jax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.folding import nearest_inverse, smooth_inverse, winning_pieces
from jaxfilters.models.rendering.geometry import Capsules, ConvexParts, Ellipsoids, Mesh
from jaxfilters.models.rendering.parts import Parts, Surface, depth_of
from jaxfilters.models.rendering.placement import poses_in_turn
from jaxfilters.models.rendering.polyhedra import CONVEX, convex_forms
from jaxfilters.models.rendering.quadrics import CAPSULE, ELLIPSOID, capsule_parts, ellipsoid_parts
from jaxfilters.models.rendering.triangles import TRIANGLES, mesh_parts
from jaxfilters.models.rendering.windows import COARSE, plan_windows

SMALL = 1024
"""Pixels of an image up to which windows save less than they cost to compile."""


@jax.jit
def render_capsules(
    camera: Pinhole, capsules: Capsules, T_camera_object: RigidTransform | None = None
) -> Float[Array, "rows cols"]:
    """Depth of a union of capsules; without a transform they are in the camera frame already.

    A sphere or cylinder that contains the camera is not visible. To compare many poses with one image,
    `compare_capsules` is faster.
    """
    if T_camera_object is not None:
        capsules = capsules.moved(T_camera_object)
    return render_parts(capsule_parts(camera, capsules), CAPSULE, camera.shape)


def capsule_depth(camera: Pinhole, capsules: Capsules) -> Float[Array, "rows cols"]:
    """The values of `render_capsules` without its derivative, which is zero here: a third of the program to compile."""
    return _depth(capsule_parts(camera, capsules), CAPSULE, camera.shape)


def ellipsoid_depth(camera: Pinhole, ellipsoids: Ellipsoids) -> Float[Array, "rows cols"]:
    """The values of `render_ellipsoids` without its derivative, as `capsule_depth`."""
    return _depth(ellipsoid_parts(camera, ellipsoids), ELLIPSOID, camera.shape)


def _depth(parts: Parts, surface: Surface, shape: tuple[int, int]) -> Array:
    parts = jax.lax.stop_gradient(parts)
    sides = () if shape[0] * shape[1] <= SMALL else COARSE

    def in_windows(parts: Parts) -> Array:
        return nearest_inverse(parts, plan_windows(parts.box, shape, sides), surface, shape)

    if poses_in_turn():
        return depth_of(sequential_vmap(in_windows)(parts))
    return depth_of(nearest_inverse(parts, None, surface, shape))


@jax.jit
def render_ellipsoids(
    camera: Pinhole, ellipsoids: Ellipsoids, T_camera_object: RigidTransform | None = None
) -> Float[Array, "rows cols"]:
    """Depth of a union of ellipsoids; without a transform they are in the camera frame already.

    An ellipsoid that contains the camera is not visible.
    """
    if T_camera_object is not None:
        ellipsoids = ellipsoids.moved(T_camera_object)
    return render_parts(ellipsoid_parts(camera, ellipsoids), ELLIPSOID, camera.shape)


@jax.jit
def render_convex_parts(
    camera: Pinhole, parts: ConvexParts, T_camera_parts: RigidTransform
) -> Float[Array, "rows cols"]:
    """Depth of convex polyhedra, each moved by its own transform: rotation (k, 4), translation (k, 3).

    A polyhedron that contains the camera is not visible.
    """
    return render_parts(convex_forms(camera, parts, T_camera_parts), CONVEX, camera.shape)


@jax.jit
def render_mesh(
    camera: Pinhole, mesh: Mesh, T_camera_object: RigidTransform | None = None
) -> Float[Array, "rows cols"]:
    """Depth of a triangle mesh; without a transform its vertices are in the camera frame already.

    Open meshes are visible from both sides. Memory is in proportion to image and triangles.
    """
    if T_camera_object is not None:
        mesh = mesh.moved(T_camera_object)
    return render_parts(mesh_parts(camera, mesh), TRIANGLES, camera.shape)


def render_parts(parts: Parts, surface: Surface, shape: tuple[int, int]) -> Float[Array, "rows cols"]:
    """Depth of parts of any kind."""
    return depth_of(smooth_inverse(parts, surface, _visible(jax.lax.stop_gradient(parts), surface, shape)))


def _visible(parts: Parts, surface: Surface, shape: tuple[int, int]) -> Int[Array, "rows cols"]:
    def in_windows(parts):
        plan = plan_windows(parts.box, shape, COARSE)
        return winning_pieces(parts, plan, surface, nearest_inverse(parts, plan, surface, shape))

    if poses_in_turn():
        return sequential_vmap(in_windows)(parts)
    return winning_pieces(parts, None, surface, nearest_inverse(parts, None, surface, shape))
