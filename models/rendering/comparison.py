"""Rendered against observed depth, for whole ensembles of poses, without an image of every pose in memory."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.folding import nearest_inverse, pull_back, winning_pieces
from jaxfilters.models.rendering.geometry import Capsules, ConvexParts, Ellipsoids, Mesh
from jaxfilters.models.rendering.parts import Parts, Surface, depth_of
from jaxfilters.models.rendering.placement import map_poses, poses_in_turn
from jaxfilters.models.rendering.polyhedra import CONVEX, convex_forms
from jaxfilters.models.rendering.quadrics import CAPSULE, ELLIPSOID, capsule_parts, ellipsoid_parts
from jaxfilters.models.rendering.triangles import TRIANGLES, mesh_parts
from jaxfilters.models.rendering.windows import COARSE, FINE, plan_windows

_FEW_POSES = 32
"""Below which half the time to compile is worth more than half the pixels."""


class DepthTerms(NamedTuple):
    """Sums over the image from which depth costs are made; counts are whole numbers of a float type."""

    absolute_sum: Float[Array, "*poses"]
    """Metres: sum of min(|rendered - observed|, max_error) over rendered pixels with a valid reading."""
    rendered_count: Float[Array, "*poses"]
    """Rendered pixels with a valid reading, background included."""
    overlap_count: Float[Array, "*poses"]
    """Rendered pixels with a finite reading."""


@jax.jit
def compare_capsules(
    camera: Pinhole,
    capsules: Capsules,
    observed: Float[Array, "rows cols"],
    max_error: Float[ArrayLike, ""],
) -> DepthTerms:
    """Depth terms of capsules in the camera frame against an observed image.

    Written for one pose and fast for many: `vmap` over the capsules renders pose after pose without a stack of images.
    Derivatives in camera, capsules and `max_error` are those inside silhouettes (who is visible where is held fixed).

    Args:
        camera: of `observed`.
        capsules: in the camera frame, metres.
        observed: metres; `inf` where the reading says that nothing is near; `nan` where there is no reading.
        max_error: metres, the largest error that a pixel can have; also that of rendered pixels before background.

    Raises:
        ValueError: if shapes do not agree, or at differentiation in `observed`.
    """
    return compare_parts(capsule_parts(camera, capsules), CAPSULE, observed, max_error)


@jax.jit
def compare_convex_parts(
    camera: Pinhole,
    parts: ConvexParts,
    T_camera_parts: RigidTransform,
    observed: Float[Array, "rows cols"],
    max_error: Float[ArrayLike, ""],
) -> DepthTerms:
    """Depth terms of convex polyhedra, each moved by its own transform (rotation (k, 4), translation (k, 3)).

    Everything else as in `compare_capsules`; map it over the transforms.
    """
    return compare_parts(convex_forms(camera, parts, T_camera_parts), CONVEX, observed, max_error)


@jax.jit
def compare_ellipsoids(
    camera: Pinhole, ellipsoids: Ellipsoids, observed: Float[Array, "rows cols"], max_error: Float[ArrayLike, ""]
) -> DepthTerms:
    """Depth terms of ellipsoids in the camera frame; everything else as in `compare_capsules`."""
    return compare_parts(ellipsoid_parts(camera, ellipsoids), ELLIPSOID, observed, max_error)


@jax.jit
def compare_mesh(
    camera: Pinhole, mesh: Mesh, observed: Float[Array, "rows cols"], max_error: Float[ArrayLike, ""]
) -> DepthTerms:
    """Depth terms of any triangle mesh in the camera frame; everything else as in `compare_capsules`.

    Prepared triangles take 48 bytes each for every pose.
    """
    return compare_parts(mesh_parts(camera, mesh), TRIANGLES, observed, max_error)


def compare_parts(
    parts: Parts, surface: Surface, observed: Float[Array, "rows cols"], max_error: Float[ArrayLike, ""]
) -> DepthTerms:
    """Depth terms of parts of any kind, see `compare_capsules`."""
    parts = Parts(parts.coefficients, *jax.lax.stop_gradient((parts.anchor, parts.box)))
    one = jax.tree.map(lambda leaf: leaf[None], parts)
    terms = _compare(surface, one, observed, jnp.asarray(max_error, observed.dtype))
    return jax.tree.map(lambda leaf: leaf[0], terms)


class _Frame(NamedTuple):
    """What the pixels of one observed image contribute, prepared once for all poses."""

    depth: Float[Array, "rows cols"]
    cap: Float[Array, "rows cols"]
    counts: tuple[Array, ...]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _compare(surface, poses, observed, max_error):
    """Depth terms of the poses along the leading axis of `poses`."""
    return _mapped(partial(_terms_of_pose, surface))(poses, observed, max_error)


@partial(_compare.defjvp, symbolic_zeros=True)
def _compare_jvp(surface, primals, tangents):
    poses_dot, observed_dot, max_error_dot = tangents
    if not isinstance(observed_dot, SymbolicZero):
        raise ValueError("observed is data: depth terms have no derivative in it; wrap it in jax.lax.stop_gradient.")
    terms, gradient, saturated = _mapped(partial(_gradient_of_pose, surface))(*primals)
    change = jnp.zeros_like(terms.absolute_sum)
    if not isinstance(poses_dot.coefficients, SymbolicZero):
        change += jnp.sum(gradient * poses_dot.coefficients, axis=(1, 2))
    if not isinstance(max_error_dot, SymbolicZero):
        change += saturated * max_error_dot
    zeros = jax.tree.map(partial(zero_from_primal, symbolic_zeros=True), terms)
    return terms, zeros._replace(absolute_sum=change)


def _mapped(of_one):
    """`of_one((parts, plan), frame)` for the poses along the leading axis; under `vmap` the new axis joins that one."""

    @custom_vmap
    def mapped(poses, observed, max_error):
        few = poses.box.shape[0] < _FEW_POSES
        plan = plan_windows(poses.box, observed.shape, COARSE if few else FINE) if poses_in_turn() else None
        return map_poses(of_one, (poses, plan), _frame(observed, max_error), observed.size)

    @mapped.def_vmap
    def rule(size, batched, poses, observed, max_error):
        poses_batched, *frame_batched = batched
        poses = jax.tree.map(
            lambda leaf, is_batched: leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape)),
            poses,
            poses_batched,
        )
        if any(frame_batched):  # every member has an image of its own
            frames = [
                leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))
                for leaf, is_batched in zip((observed, max_error), frame_batched, strict=True)
            ]
            results = jax.lax.map(lambda member: mapped(*member), (poses, *frames))
        else:
            joined = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), poses)
            results = mapped(joined, observed, max_error)
            results = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return mapped


def _terms_of_pose(surface, pose, frame):
    parts, plan = pose
    return _terms(nearest_inverse(parts, plan, surface, frame.depth.shape), frame, parts)


def _gradient_of_pose(surface, pose, frame):
    """Depth terms, and the gradient of `absolute_sum` in the coefficients and in `max_error`."""
    parts, plan = pose
    nearest = nearest_inverse(parts, plan, surface, frame.depth.shape)
    winner = winning_pieces(parts, plan, surface, nearest)

    cotangent = jax.grad(lambda inverse: jnp.sum(_error(inverse, frame)))(nearest)
    gradient = pull_back(parts, plan, surface, winner, cotangent)
    error = jnp.abs(depth_of(nearest) - frame.depth)
    saturated = jnp.sum((nearest > 0) & (frame.cap > 0) & (error >= frame.cap), dtype=jnp.int32)
    return _terms(nearest, frame, parts), gradient, saturated.astype(nearest.dtype)


def _frame(observed, max_error):
    valid, finite = ~jnp.isnan(observed), jnp.isfinite(observed)
    if observed.size < 1 << 16:  # both counts in one word: a third reduction would cost as much as a few parts
        counts = (valid.astype(jnp.uint32) + (finite.astype(jnp.uint32) << 16),)
    else:
        counts = (valid.astype(jnp.uint32), finite.astype(jnp.uint32))
    return _Frame(jnp.where(valid, observed, 0.0), jnp.where(valid, max_error, 0.0), counts)


def _terms(nearest, frame, parts):
    hit = nearest > 0
    counts = [jnp.sum(jnp.where(hit, count, 0), dtype=jnp.uint32) for count in frame.counts]
    rendered, overlap = counts if len(counts) == 2 else (counts[0] & 0xFFFF, counts[0] >> 16)
    # Comparisons are false for NaN, so that a broken pose would look like one that sees nothing.
    total = jnp.where(jnp.all(jnp.isfinite(parts.coefficients)), jnp.sum(_error(nearest, frame)), jnp.nan)
    return DepthTerms(total, rendered.astype(nearest.dtype), overlap.astype(nearest.dtype))


def _error(inverse, frame):
    hit = inverse > 0
    error = jnp.abs(1 / jnp.where(hit, inverse, 1.0) - frame.depth)
    return jnp.where(hit, jnp.where(error < frame.cap, error, frame.cap), 0.0)
