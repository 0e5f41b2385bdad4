"""What a hand is rendered as: capsules, or convex triangle parts. Either is compared with depth in the same way."""

from dataclasses import replace
from typing import Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.parts import part_transforms
from jaxfilters.models.hand.skeleton import HandGeometry, forward_kinematics
from jaxfilters.models.rendering.comparison import DepthTerms, compare_capsules, compare_convex_parts
from jaxfilters.models.rendering.geometry import ConvexParts, convex_parts


class HandSurface(Protocol):
    """A pytree that knows its skeleton and how it looks."""

    @property
    def geometry(self) -> HandGeometry:
        """Of the skeleton."""

    def scaled(self, scale: float | Float[Array, ""]) -> "HandSurface":
        """The same hand with every length multiplied by `scale` (may be traced)."""

    def of_side(self, side: Float[Array, ""]) -> "HandSurface":
        """The same hand on the right (1) or on the left (-1); may be traced."""

    def compare(
        self, camera: Pinhole, pose: Float[Array, " 22"], observed: Float[Array, "rows cols"], max_error: float
    ) -> DepthTerms:
        """Depth terms of the posed hand against an image of `camera`, metres; see `compare_capsules`."""


@pytree_dataclass
class CapsuleHand:
    """One capsule for each part: exact, and the fastest."""

    geometry: HandGeometry

    def scaled(self, scale: float | Array) -> "CapsuleHand":
        return CapsuleHand(self.geometry.scaled(scale))

    def of_side(self, side: Array) -> "CapsuleHand":
        return CapsuleHand(replace(self.geometry, side=side))

    def compare(self, camera: Pinhole, pose: Array, observed: Array, max_error: float) -> DepthTerms:
        return compare_capsules(camera, forward_kinematics(pose, self.geometry).capsules, observed, max_error)


@pytree_dataclass
class MeshHand:
    """One convex polyhedron for each part, moved with its bone: any shape, e.g. cut from a scanned hand."""

    geometry: HandGeometry
    parts: ConvexParts
    """In the frames of `part_transforms`, in the order of `PART_NAMES`."""

    def scaled(self, scale: float | Array) -> "MeshHand":
        parts = replace(self.parts, offsets=self.parts.offsets * scale, corners=self.parts.corners * scale)
        return MeshHand(self.geometry.scaled(scale), parts)

    def of_side(self, side: Array) -> "MeshHand":
        across = jnp.stack([side * self.geometry.side, jnp.ones_like(side), jnp.ones_like(side)])
        parts = replace(self.parts, normals=self.parts.normals * across, corners=self.parts.corners * across)
        return MeshHand(replace(self.geometry, side=side), parts)

    def compare(self, camera: Pinhole, pose: Array, observed: Array, max_error: float) -> DepthTerms:
        return compare_convex_parts(camera, self.parts, part_transforms(pose, self.geometry), observed, max_error)


def triangle_hand(geometry: HandGeometry) -> MeshHand:
    """The procedural mesh of 608 triangles of a (concrete) hand."""
    # Imported here, since trimesh, which makes the parts, takes a quarter of a second.
    from jaxfilters.models.hand.mesh import hand_mesh, part_meshes

    return MeshHand(geometry, convex_parts(part_meshes(hand_mesh(geometry))))
