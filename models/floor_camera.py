"""Fixed cameras over a floor: world points to undistorted pixels and back onto the plane Z = 0."""

from collections.abc import Sequence
from dataclasses import field

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host

STEEP = np.cos(np.deg2rad(10.0))
"""An optical axis nearer to the vertical than this has no useful direction on the floor."""


@pytree_dataclass
class FloorCamera:
    """A projection matrix of a camera that stands still, in its canonical scale.

    World coordinates are metres with Z up and the floor at Z = 0. The centre of pixel (row i, column j) is the point
    (u, v) = (j, i), without lens distortion.
    """

    P: Float[Array, "3 4"]
    """World to homogeneous pixels; the third coordinate is the depth along the optical axis in metres, positive in
    front of the camera."""
    shape: tuple[int, int] = field(metadata=dict(static=True))
    """Image size (rows, columns)."""

    @classmethod
    def from_matrix(cls, P: ArrayLike | Sequence, shape: Sequence[int]) -> "FloorCamera":
        """Camera from a projection matrix of any scale, checked.

        Raises:
            ValueError: if `P` is not (3, 4), not finite or singular; if the camera stands on or below the floor; if
                no pixel of the image sees the floor in front of it, or only pixels above the horizon (it looks away,
                or `P` is mirrored); if `shape` is not two positive integers.
        """
        if len(shape) != 2 or any(int(size) != size or size < 1 for size in shape):
            raise ValueError(f"shape must be (rows, columns), two positive integers; got {tuple(shape)}.")
        P = np.asarray(P, float)
        if P.shape != (3, 4) or not np.all(np.isfinite(P)):
            raise ValueError(f"P must be a finite matrix of shape (3, 4); got shape {P.shape}.")
        if np.linalg.cond(P[:, :3] / np.linalg.norm(P[:, :3], axis=1, keepdims=True).clip(1e-300)) > 1e8:
            raise ValueError("P is singular: its left 3 x 3 block has no inverse, so it is no camera at a place.")
        P = canonical(P)
        height = -np.linalg.solve(P[:, :3], P[:, 3])[2]
        if height <= 0:
            raise ValueError(f"P puts the camera at a height of {height:.3g} m; it must be above the floor, Z = 0.")
        rows, cols = int(shape[0]), int(shape[1])
        sees_floor = _floor_depth(P, _grid(rows, cols)) > 0
        if not sees_floor.any():
            raise ValueError(
                "P shows no floor in front of the camera at any pixel: it looks away from Z = 0, or P is mirrored "
                "(world axes must be right-handed, Z up, pixels u right and v down)."
            )
        if not sees_floor.all() and _is_upside_down(P, rows, cols):
            raise ValueError(
                "P shows the floor above the horizon: P is mirrored, or the image upside down (turn it by 180 degrees)."
            )
        return cls(from_host(P), (rows, cols))

    def position(self) -> Float[Array, " 3"]:
        """Camera centre in the world, metres."""
        return -jnp.linalg.solve(self.P[:, :3], self.P[:, 3])

    def project(self, points: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
        """Pixels (u, v) of world points, and their depths; the pixels mean nothing where the depth is not positive."""
        homogeneous = dot(points, self.P[:, :3].T) + self.P[:, 3]
        depth = homogeneous[..., 2]
        safe = jnp.where(jnp.abs(depth) > 1e-9, depth, 1e-9)
        return homogeneous[..., :2] / safe[..., None], depth

    def floor_points(self, uv: Float[Array, "*batch 2"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
        """Floor points (X, Y) at pixels, and their depths; not positive where a pixel sees no floor."""
        directions = self.rays(uv)
        center = self.position()
        down = jnp.where(jnp.abs(directions[..., 2]) > 1e-12, directions[..., 2], 1e-12)
        depth = -center[2] / down
        return center[:2] + depth[..., None] * directions[..., :2], depth

    def rays(self, uv: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """World directions through pixels, whose parameter is the depth along the optical axis."""
        inverse = jnp.linalg.inv(self.P[:, :3])
        return dot(uv, inverse[:, :2].T) + inverse[:, 2]

    def floor_axes(self) -> Float[Array, "2 2"]:
        """Rows: unit vectors on the floor along the optical axis and at right angles to it, to the right.

        A camera that looks within 10 degrees of straight down has the direction towards the top of its image instead.
        """
        axis, steep = self.P[2, :3], jnp.abs(self.P[2, 2]) > STEEP
        up = jnp.linalg.solve(self.P[:, :3], jnp.array([0.0, -1.0, 0.0], self.P.dtype))
        forward = jnp.where(steep, up[:2], axis[:2])
        forward = forward / jnp.linalg.norm(forward)
        return jnp.stack([forward, jnp.stack([forward[1], -forward[0]])])


def canonical(P: np.ndarray) -> np.ndarray:
    """`P` scaled so that its third row gives depths in the unit of the world, positive in front (Kato et al., [1])."""
    return P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3])


def _grid(rows: int, cols: int) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, cols - 1, 9), np.linspace(0, rows - 1, 9))
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])


def _floor_depth(P: np.ndarray, homogeneous: np.ndarray) -> np.ndarray:
    down = np.linalg.solve(P[:, :3], homogeneous)[2]
    height = -np.linalg.solve(P[:, :3], P[:, 3])[2]
    return -height / np.where(np.abs(down) > 1e-12, down, 1e-12)


def _is_upside_down(P: np.ndarray, rows: int, cols: int) -> bool:
    """Whether things that fall rise, in the middle of the image, more than they move sideways."""
    middle = np.array([(cols - 1) / 2, (rows - 1) / 2])
    u, v = middle * P[2, 2] - P[:2, 2]
    return bool(v < -abs(u))
