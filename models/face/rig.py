"""Cameras that look at one head together: projection, its derivatives, triangulation.

The world is the frame of the first camera, unless its pose says otherwise: x right, y down, z forward, millimetres.
Pixels as everywhere: the centre of pixel (row i, column j) is the point (u, v) = (j, i), without lens distortion.
"""

from collections.abc import Sequence
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import qr
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face import pose as head

NEAREST = 1.0
"""Millimetres before a camera's centre; points that are nearer, or behind it, have no image."""


@pytree_dataclass
class CameraRig:
    """C calibrated cameras: `X_c = rotation_c X_world + translation_c`."""

    focal: Float[Array, "C 2"]
    """Focal lengths (fx, fy), pixels."""
    center: Float[Array, "C 2"]
    """Principal points (cx, cy), pixels."""
    rotation: Float[Array, "C 3 3"]
    """World to camera."""
    translation: Float[Array, "C 3"]
    """Origin of the world in each camera's frame, millimetres."""
    shape: tuple[int, int] = field(metadata=dict(static=True))
    """Size (rows, columns) of every image."""

    @classmethod
    def from_cameras(
        cls, cameras: Sequence[Pinhole], rotations: ArrayLike | Sequence, translations: ArrayLike | Sequence
    ) -> "CameraRig":
        """Rig from concrete numbers, checked.

        Args:
            cameras: Intrinsics, one or more.
            rotations: (C, 3, 3) world to camera.
            translations: (C, 3) origin of the world in each camera's frame, millimetres.

        Raises:
            ValueError: if there is no camera, or not one rotation and one translation for each; if intrinsics are
                singular or a number is not finite; if a rotation is not one to 1e-6, or mirrors; if two cameras
                stand at the same place; if image sizes differ.
        """
        focal, center = (np.array([getattr(c, name) for c in cameras], float) for name in ("focal", "center"))
        rotation, translation = np.asarray(rotations, float), np.asarray(translations, float)
        _check_intrinsics(cameras, focal, center)
        _check_poses(len(cameras), rotation, translation)
        f, c, R, t = (from_host(a) for a in (focal, center, rotation, translation))
        return cls(f, c, R, t, cameras[0].shape)

    @property
    def num_cameras(self) -> int:
        """C."""
        return self.focal.shape[-2]

    def project(self, points: Float[Array, "K 3"]) -> tuple[Float[Array, "C K 2"], Bool[Array, "C K"]]:
        """Pixels of world points in every camera, and whether they lie in front of it; NaN where they do not."""
        observed, in_front = _in_cameras(self, points)
        uv = observed[..., :2] / observed[..., 2:] * self.focal[:, None] + self.center[:, None]
        return jnp.where(in_front[..., None], uv, jnp.nan), in_front


def nominal(baseline_mm: float = 120.0) -> CameraRig:
    """Two parallel cameras of 800 px and 640 x 480 pixels."""
    camera = Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640))
    return CameraRig.from_cameras([camera] * 2, np.tile(np.eye(3), (2, 1, 1)), [(0, 0, 0), (-baseline_mm, 0, 0)])


def monocular(camera: Pinhole) -> CameraRig:
    """A rig of one camera, whose frame is the world."""
    return CameraRig.from_cameras([camera], np.eye(3)[None], np.zeros((1, 3)))


def project_shape(
    rig: CameraRig, shape: Float[Array, "K 3"], pose: Float[Array, "6"]
) -> tuple[Float[Array, "C K 2"], Bool[Array, "C K"]]:
    """Pixels of a posed shape in every camera, and whether its points lie in front ([S3.4]); NaN where they do not."""
    return rig.project(head.place(shape, pose))


def jacobian(
    rig: CameraRig, shape: Float[Array, "K 3"], pose: Float[Array, "6"]
) -> tuple[Float[Array, "C K 2 3"], Float[Array, "C K 2 6"]]:
    """Derivatives of the pixels by their model points (px/mm) and by the pose (px/mm, px/rad).

    `d(u, v)/dX_c = [[fx/Z, 0, -fx X/Z^2], [0, fy/Z, -fy Y/Z^2]]`, times `R_c` for world points; times `R(pose)` for
    model points. NaN for points that are not in front.
    """
    R = head.rotation(pose[3:])
    turned = head.turn(shape, R)
    observed, in_front = _in_cameras(rig, turned + pose[:3])
    x, y, inverse = observed[..., 0], observed[..., 1], 1 / observed[..., 2]
    zero = jnp.zeros_like(x)
    u = jnp.stack([inverse, zero, -x * inverse**2], axis=-1) * rig.focal[:, None, :1]
    v = jnp.stack([zero, inverse, -y * inverse**2], axis=-1) * rig.focal[:, None, 1:]
    by_camera = jnp.where(in_front[..., None, None], jnp.stack([u, v], axis=-2), jnp.nan)
    by_world = _times(by_camera, rig.rotation[:, None])
    by_angles = jnp.swapaxes(jnp.cross(head.turning_axes(pose[3:]), turned[:, None]), -1, -2)
    return _times(by_world, R), jnp.concatenate([by_world, _times(by_world, by_angles)], axis=-1)


def triangulate(rig: CameraRig, uv: Float[Array, "C K 2"]) -> Float[Array, "K 3"]:
    """World points in millimetres nearest to their pixels in the algebraic sense: linear least squares.

    Each camera adds two equations, `f_x r_1 X - (u - c_x) r_3 X = (u - c_x) t_3 - f_x t_1` and the like for v, whose
    residuals are pixels times depth. May lie behind a camera where the pixels contradict each other: `project` says so.

    Raises:
        ValueError: if the rig has fewer than two cameras.
    """
    if rig.num_cameras < 2:
        raise ValueError(f"rig must have two cameras or more to triangulate; got {rig.num_cameras}.")
    offset = (uv - rig.center[:, None])[..., None]
    A = rig.focal[:, None, :, None] * rig.rotation[:, None, :2] - offset * rig.rotation[:, None, 2:]
    b = offset[..., 0] * rig.translation[:, None, 2:] - rig.focal[:, None] * rig.translation[:, None, :2]
    A, b = (jnp.moveaxis(a, 0, 1).reshape(uv.shape[1], -1, *a.shape[3:]) for a in (A, b))
    Q, R = qr(A)
    projected = jnp.sum(Q * b[..., None], axis=-2)
    return jax.scipy.linalg.solve_triangular(R, projected[..., None])[..., 0]


@jax.jit  # traced once for each shape, though called at many places of a program
def _in_cameras(rig, points):
    """Points in the camera frames (C, K, 3), before the lens where they are not in front, and whether they are."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    R, t = rig.rotation[..., None], rig.translation[..., None]
    observed = R[:, :, 0] * x + R[:, :, 1] * y + R[:, :, 2] * z + t
    in_front = observed[:, 2] > NEAREST
    return jnp.moveaxis(jnp.where(in_front[:, None], observed, 1.0), 1, 2), in_front


def _times(A, B):
    """Matrix product over the last two axes in full precision on every device."""
    return jnp.matmul(A, B, precision="highest")


def _check_intrinsics(cameras, focal, center):
    if len(cameras) < 1:
        raise ValueError("cameras must be one or more; got none.")
    if not (np.all(np.isfinite(focal)) and np.all(focal > 0) and np.all(np.isfinite(center))):
        raise ValueError(f"cameras must have positive focal lengths and finite centres; got {focal}, {center}.")
    sizes = {tuple(camera.shape) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"cameras must have images of one size; got {sorted(sizes)}.")


def _check_poses(num_cameras, rotation, translation):
    if rotation.shape != (num_cameras, 3, 3) or translation.shape != (num_cameras, 3):
        raise ValueError(
            f"rotations and translations must be ({num_cameras}, 3, 3) and ({num_cameras}, 3), one for each camera; "
            f"got {rotation.shape} and {translation.shape}."
        )
    if not (np.all(np.isfinite(rotation)) and np.all(np.isfinite(translation))):
        raise ValueError("rotations and translations must be finite.")
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max()
    if error > 1e-6 or np.any(np.linalg.det(rotation) < 0):
        raise ValueError(f"rotations must be orthonormal to 1e-6, of determinant 1; R R^T - 1 is {error:.3g}.")
    places = -np.einsum("cji,cj->ci", rotation, translation)
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.where(np.eye(num_cameras, dtype=bool), np.inf, 0)
    if apart.min() < 1e-6:
        raise ValueError("cameras must stand at different places; a baseline is 0.")
