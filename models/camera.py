"""Pinhole cameras: pixels to rays and back."""

from collections.abc import Sequence
from dataclasses import field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host


@pytree_dataclass
class Pinhole:
    """A pinhole camera without distortion: x right, y down, z forward.

    The centre of pixel (row i, column j) is the point (u, v) = (j, i), as in OpenCV. Depth is along z.
    """

    focal: Float[Array, " 2"]
    """Focal lengths (fx, fy) in pixels, positive."""
    center: Float[Array, " 2"]
    """Principal point (cx, cy) in pixels."""
    shape: tuple[int, int] = field(metadata=dict(static=True))
    """Image size (rows, columns)."""

    @classmethod
    def from_intrinsics(
        cls, focal: ArrayLike | Sequence, center: ArrayLike | Sequence, shape: Sequence[int]
    ) -> "Pinhole":
        """Camera from concrete numbers, checked.

        Raises:
            ValueError: if `focal` is not positive, `center` not finite, or `shape` not two positive integers.
        """
        f = _checked_pair("focal", np.broadcast_to(focal, (2,)))
        c = _checked_pair("center", np.asarray(center))
        if np.any(f <= 0):
            raise ValueError(f"focal must be positive, in pixels; got {f}.")
        return cls(from_host(f), from_host(c), _checked_shape("shape", shape))

    @classmethod
    def from_matrix(cls, K: ArrayLike | Sequence, shape: Sequence[int]) -> "Pinhole":
        """Camera from the calibration matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].

        Raises:
            ValueError: if `K` is not such a matrix (skew included), or `shape` not two positive integers.
        """
        K = np.asarray(K, float)
        if K.shape != (3, 3):
            raise ValueError(f"K must have shape (3, 3); got {K.shape}.")
        if K[0, 1] != 0 or K[1, 0] != 0 or np.any(K[2] != (0, 0, 1)):
            raise ValueError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got {K.tolist()}.")
        return cls.from_intrinsics(K[[0, 1], [0, 1]], K[:2, 2], shape)

    @jax.jit
    def matrix(self) -> Float[Array, "3 3"]:
        """Calibration matrix."""
        (fx, fy), (cx, cy) = self.focal, self.center
        zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
        return jnp.stack([jnp.stack([fx, zero, cx]), jnp.stack([zero, fy, cy]), jnp.stack([zero, zero, one])])

    @jax.jit
    def project(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels (u, v) of points in metres in the camera frame; meaningless where z <= 0, finite except at z = 0."""
        return points[..., :2] / points[..., 2:] * self.focal + self.center

    def unproject(self, uv: Float[Array, "*batch 2"], depth: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
        """Points in metres in the camera frame at pixels (u, v) and depths along z."""
        return self._rays_through(uv) * depth[..., None]

    def rays(self) -> Float[Array, "rows cols 3"]:
        """Directions through all pixels, with z = 1, so that the ray parameter is the depth."""
        rows, cols = self.shape
        v, u = jnp.meshgrid(jnp.arange(rows, dtype=float), jnp.arange(cols, dtype=float), indexing="ij")
        return self._rays_through(jnp.stack([u, v], axis=-1))

    def crop(self, origin: Float[Array, " 2"], shape: Sequence[int], stride: int = 1) -> "Pinhole":
        """Camera whose pixel (row i, column j) looks along pixel (u0 + stride j, v0 + stride i) of this one.

        Args:
            origin: (u0, v0) in pixels, traced or not; the window may reach over the image's border.
            shape: rows and columns of the window, counted in its own pixels.
            stride: every how many pixels one is kept; one or more.

        Raises:
            ValueError: if `stride` or `shape` is not positive.
        """
        if stride < 1:
            raise ValueError(f"stride must be 1 or more; got {stride}.")
        return replace(
            self,
            focal=self.focal / stride,
            center=(self.center - origin) / stride,
            shape=_checked_shape("shape", shape),
        )

    def _rays_through(self, uv):
        slopes = (uv - self.center) / self.focal
        return jnp.concatenate([slopes, jnp.ones_like(slopes[..., :1])], axis=-1)


def _checked_pair(name, value):
    value = value.astype(float)
    if value.shape != (2,) or not np.all(np.isfinite(value)):
        raise ValueError(f"{name} must be two finite numbers; got {value.tolist()}.")
    return value


def _checked_shape(name, shape):
    if len(shape) != 2 or any(int(size) != size or size < 1 for size in shape):
        raise ValueError(f"{name} must be (rows, columns), two positive integers; got {tuple(shape)}.")
    return (int(shape[0]), int(shape[1]))
