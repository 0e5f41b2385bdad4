"""Convex polyhedra as inverse depth over the image plane.

A face n . p <= b, viewed along p = d / w with d_z = 1, bounds inverse depth by n . d / b, which is affine in the pixel:
from above when the face looks at the camera (b < 0), from below when it looks away. The surface is the least upper
bound, and is hit when that exceeds every lower bound: no edges, no sorting.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.geometry import ConvexParts
from jaxfilters.models.rendering.parts import Parts, Surface, anchor_of
from jaxfilters.models.rendering.rays import components, dot, pixel_basis

# Faces through the camera centre bound nothing but their two sides; a nanometre keeps their coefficients finite.
_LEAST_OFFSET = 1e-9
_NO_BOUND = 1e9
_UNROLLED_FACES = 64


def convex_forms(camera: Pinhole, parts: ConvexParts, T_camera_parts: RigidTransform) -> Parts:
    """Polyhedra placed by one transform each (leaves with a leading axis k), prepared for `CONVEX`."""
    normals = jax.vmap(lambda q, n: RigidTransform(q, jnp.zeros(3, n.dtype)).apply(n))(
        T_camera_parts.rotation, parts.normals
    )
    offsets = parts.offsets + dot(components(normals), components(T_camera_parts.translation[:, None]))
    offsets = jnp.where(jnp.abs(offsets) < _LEAST_OFFSET, jnp.copysign(_LEAST_OFFSET, offsets), offsets)
    corners = jax.vmap(lambda T, points: T.apply(points))(T_camera_parts, parts.corners)
    box = corner_box(camera, jax.lax.stop_gradient(corners))
    anchor = anchor_of(camera, box)
    faces = components(normals / offsets[..., None])
    affine = jnp.stack([dot(faces, direction) for direction in pixel_basis(camera, anchor[:, None])], axis=-1)
    front = (offsets < 0)[..., None]
    above = jnp.where(front, affine, jnp.asarray([_NO_BOUND, 0, 0], affine.dtype))
    below = jnp.where(front, 0.0, affine)
    coefficients = jnp.concatenate([above, below], axis=-1)
    return Parts(coefficients.reshape(len(coefficients), -1), anchor, box)


def corner_box(camera: Pinhole, corners: Float[Array, "k v 3"]) -> Float[Array, "k 4"]:
    """Bounds (u_min, v_min, u_max, v_max) of projected corners: empty behind the camera, unbounded across z = 0."""
    z = corners[..., 2:]
    in_front = z > 0
    uv = corners[..., :2] / jnp.where(in_front, z, 1.0) * camera.focal + camera.center
    all_in_front, all_behind = jnp.all(in_front, axis=-2), ~jnp.any(in_front, axis=-2)
    outside = jnp.where(all_behind, jnp.inf, -jnp.inf)
    low = jnp.where(all_in_front, jnp.min(uv, axis=-2), outside)
    high = jnp.where(all_in_front, jnp.max(uv, axis=-2), -outside)
    return jnp.concatenate([low, high], axis=-1)


def _bounds(coefficients, x, y):
    def bound(bounds, face):
        above, below = bounds
        upper, lower = _affine(face[:3], x, y), _affine(face[3:], x, y)
        return (jnp.where(upper < above, upper, above), jnp.where(lower > below, lower, below)), None

    faces = coefficients.reshape(-1, 6)
    none = jnp.full_like(x + y, _NO_BOUND), jnp.zeros_like(x + y)
    return jax.lax.scan(bound, none, faces, unroll=len(faces) if len(faces) <= _UNROLLED_FACES else 1)[0]


def _affine(face, x, y):
    return (face[0] + face[2] * y) + face[1] * x


def _inverse_depth(coefficients, x, y):
    above, below = _bounds(coefficients, x, y)
    return jnp.where((above > below) & (above < _NO_BOUND), above, 0.0)


def _pieces(coefficients, x, y):
    inverse = _inverse_depth(coefficients, x, y)
    # Of faces that meet at the pixel any may stand for the surface, hence the margin for rounding.
    most = inverse * (1 + 64 * jnp.finfo(inverse.dtype).eps)
    return [jnp.where(_affine(face, x, y) <= most, inverse, 0.0) for face in coefficients.reshape(-1, 6)]


CONVEX = Surface(
    inverse_depth=_inverse_depth,
    pieces=_pieces,
    rows=lambda coefficients: coefficients.reshape(len(coefficients), -1, 6)[..., :3],
    smooth=_affine,
    has_root=False,
)
"""One piece a face."""
