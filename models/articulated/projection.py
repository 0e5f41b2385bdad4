"""How a camera sees an articulated hand: weak perspective in pixels, or full perspective in metres.

Strategies with the same verbs; everything else about the hand is the same for both. Camera frames are right-handed:
x right, y down, z away from the camera.
"""

import math
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.lie import quaternion_normalize
from jaxfilters.models.articulated.kinematics import scaled_rotation, turn, unit_rotation
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.camera import Pinhole


@pytree_dataclass
class WeakPerspective:
    """Orthographic projection times one scale, the quaternion's squared length; everything is in pixels [9]."""

    position_size: ClassVar[int] = 2
    acceleration_std: ClassVar[tuple[float, float, float]] = (1.0, 0.006, math.radians(1.5))
    """Of wrist (pixels), quaternion and angles (radians), per frame squared, unless one knows better."""

    def center(self) -> Float[Array, " 2"]:
        """The pixel on the optical axis: positions are counted from it."""
        return jnp.zeros(2)

    def camera_points(
        self, x: Float[Array, " n"], layout: Layout, points: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """Points of the palm frame in the camera frame, pixels; depth is counted from the wrist's."""
        wrist = jnp.concatenate([x[layout.position], jnp.zeros(1, x.dtype)])
        return turn(scaled_rotation(x[layout.quaternion]), points) + wrist

    def image_points(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels of points in the camera frame."""
        return points[..., :2]

    def image_direction(self, point: Float[Array, " 3"], vector: Float[Array, " 3"]) -> Float[Array, " 2"]:
        """How the image of a point moves, per unit, as the point moves along a vector of the camera frame."""
        del point
        return vector[:2]

    def line_of_sight(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Unit vectors away from the camera at points in the camera frame."""
        return jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], points.dtype), points.shape)

    def settle(self, x: Float[Array, " n"], layout: Layout) -> Float[Array, " n"]:
        """A predicted state as it is: the length of the quaternion means the scale."""
        del layout
        return x


@pytree_dataclass
class Perspective:
    """A pinhole camera: position and lengths in metres, the length of the quaternion means nothing."""

    camera: Pinhole
    position_size: ClassVar[int] = 3
    acceleration_std: ClassVar[tuple[float, float, float]] = (0.0015, 0.006, math.radians(1.5))
    """Of wrist (metres), quaternion and angles (radians), per frame squared: those of weak perspective at 0.75 m."""

    def center(self) -> Float[Array, " 2"]:
        """The pixel on the optical axis."""
        return self.camera.center

    def camera_points(
        self, x: Float[Array, " n"], layout: Layout, points: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """Points of the palm frame in the camera frame, metres."""
        return turn(unit_rotation(x[layout.quaternion]), points) + x[layout.position]

    def image_points(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels of points in the camera frame; they must lie in front of the camera."""
        return self.camera.project(points)

    def image_direction(self, point: Float[Array, " 3"], vector: Float[Array, " 3"]) -> Float[Array, " 2"]:
        """How the image of a point moves, per metre, as the point moves along a vector of the camera frame."""
        return self.camera.focal * (vector[:2] - point[:2] / point[2] * vector[2]) / point[2]

    def line_of_sight(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Unit vectors away from the camera at points in the camera frame."""
        return points / jnp.sqrt(jnp.sum(points * points, axis=-1, keepdims=True))

    def settle(self, x: Float[Array, " n"], layout: Layout) -> Float[Array, " n"]:
        """A predicted state with a unit quaternion that its rate leaves so: nothing observed would hold them there."""
        q, rate = quaternion_normalize(x[layout.quaternion]), x[layout.quaternion_rate]
        tangent = rate - q * jnp.sum(q * rate)
        return x.at[layout.quaternion].set(q).at[layout.quaternion_rate].set(tangent)


Projection = WeakPerspective | Perspective
