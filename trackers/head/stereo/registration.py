"""The start of a track: landmarks in the first image become a rigid model of the face, where it is, and templates."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, UInt8

from jaxfilters._xla.from_host import from_host
from jaxfilters.models.face import pose as head
from jaxfilters.models.face import rig as cameras
from jaxfilters.models.face.landmarks import EYES, MOUTH, NAMES, NOSTRILS, PEOPLE_SHAPE
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.shape_model import FaceModel, rigid
from jaxfilters.trackers.head.common.image_position import EYES_APART_MM
from jaxfilters.trackers.head.stereo import epipolar
from jaxfilters.trackers.head.stereo.contradiction import LEAST_SCORE, MOST_RETURN, why_unmatched

MOST_REPROJECTION = 1.0
"""Pixels between matches and the triangulated point."""
EYE_WIDTH = (20.0, 45.0)
"""Millimetres between the corners of an eye."""
INSIDE_OUT = 5.0
"""Millimetres by which nostrils may lie behind the plane of eyes and mouth."""
_LANDMARK_STD, _ANGLE_STD = 4.0, np.radians(10.0)
"""Of one face from the average, millimetres; of a face that looks into the camera."""
_WORST_LANDMARK = 15.0


class RegistrationError(ValueError):
    """Why the start failed, in one line."""


class Registration(NamedTuple):
    """A face at the start of a track."""

    model: FaceModel
    """Rigid, with room for modes."""
    pose: Float[Array, "6"]
    """Millimetres and radians."""
    uv: Float[Array, "C K 2"]
    """The landmarks' pixels: the model's projections."""


def register(
    images: UInt8[np.ndarray, "C rows cols"],
    points: Float[np.ndarray, "K 2"],
    rig: CameraRig,
    *,
    num_modes: int = 0,
) -> Registration:
    """Face whose model frame has the axes of the first camera: registered without a rotation.

    Each landmark is matched along its epipolar line in the other images, back again, and triangulated.

    Args:
        images: Grey, of one moment, without lens distortion.
        points: The ten landmarks in the first image, pixels.
        rig: Two cameras or more.
        num_modes: Room for modes of deformation in the model.

    Raises:
        RegistrationError: if a landmark is near the border or not matched, if matches and rig contradict each other,
            or if what they give is no face.
        ValueError: if images, points and rig do not belong together.
    """
    world = _triangulated(images, points, rig)
    return _registration(images, rig, world, np.eye(3), num_modes)


def register_monocular(
    image: UInt8[np.ndarray, "rows cols"],
    points: Float[np.ndarray, "K 2"],
    rig: CameraRig,
    *,
    eyes_apart_mm: float = EYES_APART_MM,
    num_modes: int = 0,
) -> Registration:
    """Face of average depth that has exactly the given projections, for one camera, which sees no depth.

    The average face of people, its eyes `eyes_apart_mm` apart, is posed so that it projects to the points best and
    looks into the camera, from where it is, as far as they allow; each landmark then moves to the ray through its
    pixel, at the depth that it has. All lengths are wrong in proportion to the assumed distance between the eyes.

    Args:
        image: Grey, without lens distortion.
        points: The ten landmarks, pixels.
        rig: One camera.
        eyes_apart_mm: Between the eyes' centres.
        num_modes: Room for modes of deformation in the model.

    Raises:
        RegistrationError: if a landmark is near the border, or the points are no face.
        ValueError: if image, points and rig do not belong together, or the distance is not positive.
    """
    if not eyes_apart_mm > 0:
        raise ValueError(f"eyes_apart_mm must be positive; got {eyes_apart_mm}.")
    if rig.num_cameras != 1:
        raise ValueError(f"rig must have one camera; got {rig.num_cameras}.")
    points = _checked(image[None], points, rig)
    rays = np.column_stack([(points - np.asarray(rig.center[0])) / np.asarray(rig.focal[0]), np.ones(len(points))])
    right, left = PEOPLE_SHAPE[list(EYES)].reshape(2, 2, 3).mean(axis=1)
    shape = PEOPLE_SHAPE * (eyes_apart_mm / np.linalg.norm(left - right))
    R, t, worst = _posed(shape, rays)
    if worst > _WORST_LANDMARK:
        raise RegistrationError(f"the points are no face: one is {worst:.0f} mm from where the average face has it.")
    depth = (shape @ R.T + t)[:, 2]
    in_camera = rays * depth[:, None]
    to_world = np.asarray(rig.rotation[0], float).T
    world = (in_camera - np.asarray(rig.translation[0], float)) @ to_world.T
    return _registration(image[None], rig, world, to_world @ R, num_modes)


def face_axes(points: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3 3"]:
    """Columns: the face's x (through the middles of the eyes), y and z (normal to the plane of eyes and mouth)."""
    right, left = points[list(EYES)].reshape(2, 2, 3).mean(axis=1)
    x = (left - right) / np.linalg.norm(left - right)
    z = np.cross(x, points[list(MOUTH)].mean(axis=0) - 0.5 * (right + left))
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _registration(
    images: np.ndarray, rig: CameraRig, world: np.ndarray, axes: np.ndarray, num_modes: int
) -> Registration:
    middle = world.mean(axis=0)
    mean = from_host((world - middle) @ axes)
    pose, uv = _placed(rig, mean, from_host(middle), from_host(axes))
    templates = jnp.stack([epipolar.windows(image, np.asarray(at)) for image, at in zip(images, uv, strict=True)])
    return Registration(rigid(mean, templates, num_modes=num_modes), pose, uv)


def _triangulated(images: np.ndarray, points: np.ndarray, rig: CameraRig) -> Float[np.ndarray, "K 3"]:
    """The landmarks in the world, millimetres, checked."""
    if rig.num_cameras < 2:
        raise ValueError("rig must have two cameras or more; one is the matter of register_monocular.")
    points = _checked(images, points, rig)
    uv = [points]
    for c in range(1, rig.num_cameras):
        there, scores = epipolar.match(images, rig, points, source=0, target=c)
        again, _ = epipolar.match(images, rig, there, source=c, target=0)
        returned = np.linalg.norm(again - points, axis=1)
        if scores.min() < LEAST_SCORE or returned.max() > MOST_RETURN:
            raise RegistrationError(why_unmatched(images, rig, points, c, scores, returned))
        uv.append(there)
    world, observed, in_front = _nearest(rig, from_host(np.stack(uv)))
    errors = np.linalg.norm(np.asarray(observed) - np.stack(uv), axis=-1)
    if not np.all(in_front) or errors.max() > MOST_REPROJECTION:
        c, k = np.unravel_index(np.nan_to_num(errors, nan=np.inf).argmax(), errors.shape)
        raise RegistrationError(
            f"epipolar error: the rig contradicts the images; {NAMES[k]} is {errors[c, k]:.1f} px from its projection "
            f"in camera {c}, where {MOST_REPROJECTION:g} px are allowed."
        )
    _check_face(np.asarray(world, float))
    return np.asarray(world, float)


@jax.jit
def _nearest(rig: CameraRig, uv: Array) -> tuple[Array, Array, Array]:
    world = cameras.triangulate(rig, uv)
    return world, *rig.project(world)


@jax.jit
def _placed(rig: CameraRig, mean: Array, middle: Array, axes: Array) -> tuple[Array, Array]:
    pose = jnp.concatenate([middle, head.angles(axes)])
    return pose, cameras.project_shape(rig, mean, pose)[0]


def _check_face(world: np.ndarray) -> None:
    widths = np.linalg.norm(world[[1, 3]] - world[[0, 2]], axis=1)
    if widths.min() < EYE_WIDTH[0] or widths.max() > EYE_WIDTH[1]:
        raise RegistrationError(
            f"the eyes are {widths[0]:.0f} and {widths[1]:.0f} mm wide, where {EYE_WIDTH[0]:.0f} to {EYE_WIDTH[1]:.0f} "
            "are expected: the baseline of the rig is wrong, or the points are no eyes."
        )
    eyes = world[list(EYES)].mean(axis=0)
    behind = ((world[list(NOSTRILS)] - eyes) @ face_axes(world)[:, 2]).mean()
    if behind > INSIDE_OUT:
        raise RegistrationError(
            f"the face is inside out, its nostrils {behind:.0f} mm behind its eyes and mouth: the cameras are swapped."
        )


def _checked(images: np.ndarray, points: np.ndarray, rig: CameraRig) -> Float[np.ndarray, "K 2"]:
    """The points, if they lie like a face's inside the image."""
    expected = (rig.num_cameras, *rig.shape)
    if images.shape != expected or images.dtype != np.uint8:
        raise ValueError(f"images must be {expected} of uint8, as the rig; got {images.shape} of {images.dtype}.")
    points = np.asarray(points, float)
    if points.shape != (len(NAMES), 2) or not np.isfinite(points).all():
        raise ValueError(f"points must be ({len(NAMES)}, 2) and finite; got {points.tolist()}.")
    limit = np.array(rig.shape[::-1]) - 1 - epipolar.SIZE / 2
    outside = np.any((points < epipolar.SIZE / 2) | (points > limit), axis=1)
    if outside.any():
        name = NAMES[int(outside.argmax())]
        raise RegistrationError(f"{name} is within {epipolar.SIZE // 2} px of the image's border, or outside.")
    right, left = points[list(EYES)].reshape(2, 2, 2).mean(axis=1)
    across, down = left - right, points[list(MOUTH)].mean(axis=0) - 0.5 * (right + left)
    along = points[list(EYES)] @ across
    if np.any(np.diff(along) <= 0) or across[0] * down[1] - across[1] * down[0] <= 0:
        raise RegistrationError(
            "the points are in no face's order: from the subject's right eye to the left one, then the mouth below."
        )
    return points


def _posed(shape: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation and translation of a shape that looks into the camera and lies near the rays, and its worst distance."""
    sight = _to_camera(rays.mean(axis=0))

    def placed(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R = sight @ cv2.Rodrigues(x[3:])[0]
        posed = shape @ R.T + x[:3]
        return R, (posed[:, :2] - rays[:, :2] * posed[:, 2:])

    size = np.linalg.norm(rays[:, :2] - rays[:, :2].mean(axis=0)) / np.linalg.norm(shape[:, :2])
    start = np.concatenate([rays.mean(axis=0) / size, np.zeros(3)])
    residuals = lambda x: np.concatenate([placed(x)[1].ravel() / _LANDMARK_STD, x[3:] / _ANGLE_STD])
    fit = scipy.optimize.least_squares(residuals, start)  # imported here, by SciPy: it takes as long as JAX
    R, misplaced = placed(fit.x)
    return R, fit.x[:3], float(np.linalg.norm(misplaced, axis=1).max())


def _to_camera(ray: np.ndarray) -> np.ndarray:
    """Rotation of a head on a ray that looks into the lens: that of the optical axis into the ray, without a roll."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = np.linalg.norm(axis)
    return cv2.Rodrigues(axis / sine * np.arctan2(sine, ray[2]) if sine > 0 else axis)[0]
