"""Capsules and ellipsoids as inverse depth over the image plane.

Along the ray s d with d_z = 1, a quadric is A s^2 + 2 B s + C = 0, and s is the depth. In inverse depth w = 1 / s it is
A + 2 B w + C w^2 = 0, whose nearer root is w = -B / C + sqrt(B^2 - A C) / C when the camera is outside (C > 0).
B is linear and B^2 - A C quadratic in the pixel, so a pixel costs one square root and no division. Coefficients are
expanded about an anchor pixel within the part, because differences of large coordinates would cost float32 its digits.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.math.lie import quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.geometry import Capsules, Ellipsoids
from jaxfilters.models.rendering.parts import Parts, Surface, anchor_of
from jaxfilters.models.rendering.rays import Vector, components, cross, dot, minus, pixel_basis, scale


def capsule_parts(camera: Pinhole, capsules: Capsules) -> Parts:
    """Capsules in the camera frame, prepared for `CAPSULE`."""
    start, end, radius = components(capsules.start), components(capsules.end), capsules.radius
    ends = Vector(*(jnp.stack(pair, axis=-1) for pair in zip(start, end, strict=True)))
    boxes = jax.vmap(_sphere_box, in_axes=(None, -1, None), out_axes=-2)(camera, ends, radius)
    box = jax.lax.stop_gradient(_hull(boxes[..., 0, :], boxes[..., 1, :]))
    anchor = anchor_of(camera, box)
    basis = _based(pixel_basis(camera, anchor))
    axis, length = _direction(minus(end, start))
    caps = jax.vmap(_sphere, in_axes=(None, -1, None), out_axes=-2)(basis, ends, radius)
    begins = dot(axis, start)[..., None]
    columns = [
        _cylinder(basis, start, axis, radius),
        caps.reshape(*radius.shape, 18),
        _linear(axis, basis),
        begins,
        begins + length[..., None],
    ]
    return Parts(jnp.concatenate(columns, axis=-1), anchor, box)


def ellipsoid_parts(camera: Pinhole, ellipsoids: Ellipsoids) -> Parts:
    """Ellipsoids in the camera frame, prepared for `ELLIPSOID`."""
    axes = jax.vmap(quaternion_to_matrix)(ellipsoids.rotation)
    spread = jnp.einsum("kij,kj,klj->kil", axes, ellipsoids.radii**2, axes, precision=jax.lax.Precision.HIGHEST)
    center, moments = components(ellipsoids.center), (spread[:, [0, 1, 2], [0, 1, 2]], spread[:, 2])
    box = jax.lax.stop_gradient(_box(camera, center, components(moments[0]), moments[1]))
    anchor = anchor_of(camera, box)

    # In the frame of the axes, divided by the radii, an ellipsoid is the unit sphere.
    def scaled(vector):
        return Vector(*(dot(vector, components(axes[:, :, i])) / ellipsoids.radii[:, i] for i in range(3)))

    basis = _based([scaled(direction) for direction in pixel_basis(camera, anchor)])
    return Parts(_sphere(basis, scaled(center), jnp.ones_like(center.x)), anchor, box)


def _box(camera, center, square, cross_z):
    """Exact bounds (u_min, v_min, u_max, v_max) of projected ellipsoids.

    Empty (inf, -inf) behind the camera, unbounded for one that touches the plane z = 0. `square` holds the diagonal of
    the matrix of squared radii, `cross_z` its last column: of a sphere (r^2, r^2, r^2) and (0, 0, r^2).
    """
    reach = jnp.sqrt(square.z)
    in_front, behind = center.z > reach, center.z <= -reach
    bounds = []
    for axis in range(2):
        slopes = _tangent_slopes(center[axis], center.z, square[axis], square.z, cross_z[..., axis], in_front)
        bounds.append(slopes * camera.focal[axis] + camera.center[axis])
    low, high = (jnp.stack([bounds[0][side], bounds[1][side]], axis=-1) for side in (0, 1))
    outside = jnp.where(behind, jnp.inf, -jnp.inf)[..., None]
    observed = in_front[..., None]
    return jnp.concatenate([jnp.where(observed, low, outside), jnp.where(observed, high, -outside)], axis=-1)


def _tangent_slopes(across, depth, square_across, square_depth, mixed, in_front):
    # Tangents from the origin to an ellipse in the plane of one image axis and z: the slopes s at which the quadratic
    # form of the dual conic, (depth^2 - square_depth) s^2 - 2 (across depth - mixed) s + ..., vanishes.
    depth, square_depth = jnp.where(in_front, depth, 1.0), jnp.where(in_front, square_depth, 0.5)
    denominator = depth**2 - square_depth
    half = across**2 * square_depth - 2 * across * depth * mixed + mixed**2 + square_across * denominator
    middle, half = across * depth - mixed, jnp.sqrt(jnp.maximum(half, 0.0))
    return jnp.stack([middle - half, middle + half]) / denominator


def _sphere_box(camera, center, radius):
    zero = jnp.zeros_like(radius)
    return _box(camera, center, Vector(*[radius**2] * 3), jnp.stack([zero, zero, radius**2], axis=-1))


def _hull(a, b):
    """Bounds of the convex hull of two bounded things."""
    hull = jnp.concatenate([jnp.minimum(a[..., :2], b[..., :2]), jnp.maximum(a[..., 2:], b[..., 2:])], axis=-1)
    # From behind the camera to its front a hull passes through the plane z = 0, where nothing bounds it.
    one_is_behind = (a[..., 0] > a[..., 2]) != (b[..., 0] > b[..., 2])
    unbounded = jnp.asarray([-jnp.inf, -jnp.inf, jnp.inf, jnp.inf], hull.dtype)
    return jnp.where(one_is_behind[..., None], unbounded, hull)


def _direction(vector):
    """Unit vector and length; both zero for a zero vector, with zero derivative."""
    square = dot(vector, vector)
    proper = square > 0
    length = jnp.sqrt(jnp.where(proper, square, 1.0))
    inverse = jnp.where(proper, 1 / length, 0.0)
    return scale(vector, inverse), jnp.where(proper, length, 0.0)


class _Basis(NamedTuple):
    """Directions of a pixel's ray and of its derivatives in u and v, on a last axis.

    All coefficients of a form are then one array: computed one by one they were most of the program to compile.
    """

    each: Vector
    """The three of them (*parts, 3)."""
    first: Vector
    """Of each of the six pairs (*parts, 6)."""
    second: Vector


_FIRST, _SECOND = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
_TIMES = np.array([1, 2, 2, 1, 2, 1])
"""How often each pair is in the square of the ray; a pair of different directions counts in either order."""


def _based(basis: Sequence[Vector]) -> _Basis:
    def stacked(indices: Sequence[int]) -> Vector:
        return Vector(*(jnp.stack(part, axis=-1) for part in zip(*(basis[i] for i in indices), strict=True)))

    return _Basis(stacked(range(3)), stacked(_FIRST), stacked(_SECOND))


def _each(vector: Vector) -> Vector:
    """The vector of each part beside the directions of its basis."""
    return Vector(*(component[..., None] for component in vector))


def _linear(vector, basis):
    return dot(_each(vector), basis.each)


def _quadratic(form: Callable, basis):
    return _TIMES.astype(basis.first.x.dtype) * form(basis.first, basis.second)


def _root(gap, line, discriminant):
    """Coefficients of -B / C and (B^2 - A C) / C^2; a camera inside (gap C <= 0) sees nothing."""
    outside = gap > 0
    inverse = jnp.where(outside, 1 / jnp.where(outside, gap, 1.0), 0.0)[..., None]
    return jnp.concatenate([line * inverse, discriminant * inverse**2], axis=-1)


def _sphere(basis, center, radius):
    # r^2 d.d - |c x d|^2 is (d.c)^2 - d.d (c.c - r^2) without its cancellation.
    def form(a, b):
        return radius[..., None] ** 2 * dot(a, b) - dot(cross(_each(center), a), cross(_each(center), b))

    return _root(dot(center, center) - radius**2, _linear(center, basis), _quadratic(form, basis))


def _cylinder(basis, point, axis, radius):
    across = minus(point, scale(axis, dot(axis, point)))
    moment = _each(cross(point, axis))

    def form(a, b):
        turned = dot(cross(_each(axis), a), cross(_each(axis), b))
        return radius[..., None] ** 2 * turned - dot(moment, a) * dot(moment, b)

    return _root(dot(across, across) - radius**2, _linear(across, basis), _quadratic(form, basis))


def _nearer_root(c, x, y):
    # Grouped by row: what depends on y alone is computed once a row.
    discriminant = (c[3] + (c[5] + c[8] * y) * y) + ((c[4] + c[7] * y) + c[6] * x) * x
    hit = discriminant > 0
    root = (c[0] + c[2] * y) + c[1] * x + jnp.sqrt(jnp.where(hit, discriminant, 1.0))
    return jnp.where(hit, root, 0.0)


def _capsule_pieces(c, x, y):
    body = _nearer_root(c[:9], x, y)
    reach = c[27] + c[28] * x + c[29] * y  # axis . d, to be compared with axis . point = (axis . d) / w
    body = jnp.where((reach > c[30] * body) & (reach < c[31] * body), body, 0.0)
    return body, _nearer_root(c[9:18], x, y), _nearer_root(c[18:27], x, y)


def _capsule_inverse_depth(c, x, y):
    nearest, *caps = _capsule_pieces(c, x, y)
    for cap in caps:
        nearest = jnp.where(cap > nearest, cap, nearest)
    return nearest


CAPSULE = Surface(
    inverse_depth=_capsule_inverse_depth,
    pieces=_capsule_pieces,
    rows=lambda coefficients: coefficients[:, :27].reshape(-1, 3, 9),
    smooth=_nearer_root,
    has_root=True,
)
"""Side, cap at the start, cap at the end."""

ELLIPSOID = Surface(
    inverse_depth=_nearer_root,
    pieces=lambda coefficients, x, y: [_nearer_root(coefficients, x, y)],
    rows=lambda coefficients: coefficients[:, None],
    smooth=_nearer_root,
    has_root=True,
)
