"""The simplest thing that follows what each of the six systems follows: no filter, no model of motion."""

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.hand.observation import crop
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, register, target_from_image
from jaxfilters.models.hand.skeleton import TANGENT_SIZE, HandGeometry, forward_kinematics, hand_center
from jaxfilters.models.synthetic.articulated import LAYOUT, ArticulatedSequence, paper_hand

WINDOW = ((32, 32), 4)
"""Rows and columns about a hand, and how many pixels apart."""
PATCH: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 3}
"""Of the optical flow of landmarks, pixels."""
POINTS = 32
"""Of a stroke that is compared."""
GATE_M = 1.0
DIFFERENCE, SMALLEST_BLOB = 30, 0.002
"""Grey levels from the background, and share of the image of a blob that counts."""
DEEP, FINGER = 0.06, 0.15
"""Depth of a gap between fingers, and width of a finger, in roots of the area of a hand."""


def registered_hands(
    camera: Pinhole, frames: Float[np.ndarray, "t rows cols"], start: Float[np.ndarray, " 22"], geometry: HandGeometry
) -> Float[np.ndarray, "t 21 3"]:
    """Joints by registration of the hand to each depth image alone, from the pose of the frame before.

    Args:
        camera: Of the frames.
        frames: Metres, NaN where there is background or no reading.
        start: Pose from which the first frame is registered.
        geometry: Of the hand.
    """
    wide = jnp.asarray(np.diag(np.r_[3 * [0.1], 3 * [0.5], (TANGENT_SIZE - 6) * [1.0]]), jnp.float32)

    @jax.jit
    def step(pose: Array, frame: Array) -> tuple[Array, Array]:
        window, observed = crop(camera, jnp.where(jnp.isnan(frame), jnp.inf, frame), hand_center(pose), *WINDOW)
        target = target_from_image(window, observed)
        pose = register(window, target, geometry, pose, PosePrior(pose, wide), RegistrationConfig()).pose
        return pose, forward_kinematics(pose, geometry).joints

    pose, joints = jnp.asarray(start, jnp.float32), []
    for frame in frames:
        pose, found = step(pose, jnp.asarray(frame, jnp.float32))
        joints.append(np.asarray(found))
    return np.stack(joints)


def reprojected_hand(sequence: ArticulatedSequence) -> Float[np.ndarray, "t n"]:
    """States of an articulated hand by least squares of each frame's features, from the estimate of the frame before.

    The belief at the start is a prior on pose, lengths and palm in the first frame, and on lengths and palm in all
    others; rates stay as believed.
    """
    hand, mean = paper_hand(), np.asarray(sequence.initial_mean, float)
    noise = np.asarray(sequence.noise_std, float)
    std = np.sqrt(np.maximum(np.diagonal(np.asarray(sequence.initial_covariance, float)), 1e-6))
    free = np.r_[LAYOUT.moving, LAYOUT.static]
    constant = free >= LAYOUT.static.start

    @jax.jit
    def residuals(x: Array, y: Array, mask: Array, believed: Array) -> Array:
        state = jnp.asarray(mean).at[free].set(x)
        off = jnp.where(mask, hand.residual(jnp.where(mask, y, 0.0), hand.observe(state)) / noise, 0.0)
        return jnp.concatenate([off, believed * (x - mean[free]) / std[free]])

    jacobian = jax.jit(jax.jacfwd(residuals))
    x, states, believed = mean[free], [], np.ones(len(free))
    for y, mask in zip(np.asarray(sequence.features), np.asarray(sequence.masks), strict=True):
        of_frame = (y, mask, believed)
        found = least_squares(
            lambda x: np.asarray(residuals(x, *of_frame), float),  # noqa: B023
            x,
            lambda x: np.asarray(jacobian(x, *of_frame), float),  # noqa: B023
            method="lm",
            max_nfev=200,
        )
        x, believed = found.x, constant.astype(float)
        state = mean.copy()
        state[free] = x
        states.append(state)
    return np.stack(states)


def followed_blobs(
    images: Iterable[UInt8[np.ndarray, "rows cols 3"]], empty: UInt8[np.ndarray, "rows cols 3"], camera: FloorCamera
) -> list[tuple[int, int, float, float]]:
    """Frame, identity, X and Y in metres of blobs that differ from the image of the empty floor.

    The middle of the lower edge of a blob is projected back to the floor, and takes the identity of the nearest blob of
    the frame before within a metre.
    """
    kernel = np.ones((5, 5), np.uint8)
    rows: list[tuple[int, int, float, float]] = []
    last: dict[int, np.ndarray] = {}
    next_identity = 0
    for index, image in enumerate(images):
        mask = (cv2.absdiff(image, empty).max(axis=2) > DIFFERENCE).astype(np.uint8)
        mask = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel, iterations=2)
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
        boxes = stats[1:][stats[1:, cv2.CC_STAT_AREA] > SMALLEST_BLOB * mask.size]
        feet = np.stack([boxes[:, 0] + boxes[:, 2] / 2, boxes[:, 1] + boxes[:, 3]], axis=-1).astype(np.float32)
        places = np.asarray(camera.floor_points(jnp.asarray(feet.reshape(-1, 2)))[0], float)
        here = {}
        for place in places:
            near = {identity: np.linalg.norm(place - at) for identity, at in last.items() if identity not in here}
            identity = min(near, key=near.__getitem__, default=-1)
            if identity < 0 or near[identity] > GATE_M:
                identity, next_identity = next_identity, next_identity + 1
            here[identity] = place
            rows.append((index, identity, float(place[0]), float(place[1])))
        last = here
    return rows


def flowed_points(
    images: Iterable[UInt8[np.ndarray, "rows cols"]], start: Float[np.ndarray, "K 2"]
) -> Float[np.ndarray, "t K 2"]:
    """Landmarks carried from image to image by optical flow, the first ones included."""
    points: Any = np.asarray(start, np.float32)[:, None]
    before: np.ndarray | None = None
    found = []
    for image in images:
        if before is not None:
            points, _, _ = cv2.calcOpticalFlowPyrLK(before, image, points, points.copy(), **PATCH)
        found.append(points[:, 0].astype(float))
        before = image
    return np.stack(found)


def pose_by_pnp(shape: Float[np.ndarray, "K 3"], uv: Float[np.ndarray, "t K 2"], rig: CameraRig) -> np.ndarray:
    """(t, 6) millimetres and radians of a rigid shape before one camera, by `solvePnP` from the frame before."""
    (fx, fy), (cx, cy) = np.asarray(rig.focal[0], float), np.asarray(rig.center[0], float)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    turn: Any = np.zeros((3, 1))
    place: Any = np.array([[0.0], [0.0], [700.0]])
    poses = []
    for points in uv:
        _, turn, place = cv2.solvePnP(shape, points, K, np.zeros(5), turn, place, useExtrinsicGuess=True)
        poses.append(np.r_[place.ravel(), Rotation.from_rotvec(turn.ravel()).as_euler("ZYX")])
    return np.stack(poses)


def pose_by_triangulation(
    shape: Float[np.ndarray, "K 3"], uv: Float[np.ndarray, "t 2 K 2"], projections: Float[np.ndarray, "2 3 4"]
) -> np.ndarray:
    """(t, 6) of a rigid shape before two cameras: points from both, then the rotation and translation of `shape`."""
    poses = []
    for left, right in uv:
        homogeneous = cv2.triangulatePoints(projections[0], projections[1], left.T, right.T)
        points = (homogeneous[:3] / homogeneous[3]).T
        turn, _ = Rotation.align_vectors(points - points.mean(axis=0), shape - shape.mean(axis=0))
        place = points.mean(axis=0) - turn.apply(shape.mean(axis=0))
        poses.append(np.r_[place, turn.as_euler("ZYX")])
    return np.stack(poses)


def projections(rig: CameraRig) -> Float[np.ndarray, "2 3 4"]:
    """From millimetres in the world to pixels."""
    found = []
    for k in range(2):
        (fx, fy), (cx, cy) = np.asarray(rig.focal[k], float), np.asarray(rig.center[k], float)
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        found.append(K @ np.c_[np.asarray(rig.rotation[k], float), np.asarray(rig.translation[k], float)])
    return np.stack(found)


def fingers_by_hull(mask: np.ndarray) -> int:
    """How many fingers are out, by the gaps between them in the convex hull of the largest outline."""
    outline = _largest_outline(mask)
    if outline is None:
        return 0
    gaps = len(_gaps(outline))
    return gaps + 1 if gaps else 1


def hand_by_colour(image: UInt8[np.ndarray, "rows cols 3"]) -> Bool[np.ndarray, "rows cols"]:
    """Where a hand is in a BGR image that N. Otsu's threshold (1979) in the red chrominance divides.

    Of the two parts, the one that has less of the border.
    """
    red = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb)[..., 1], (5, 5), 0)
    redder = cv2.threshold(red, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1] > 0
    border = np.concatenate([redder[0], redder[-1], redder[:, 0], redder[:, -1]])
    return redder if border.mean() < 1 / 2 else ~redder


def tips_by_hull(mask: np.ndarray) -> Float[np.ndarray, "n 2"]:
    """Pixels of the ends of the gaps between fingers on the convex hull of the largest outline, one for each finger.

    Ends that are nearer to one another than a finger is wide are one, at their mean.
    """
    outline = _largest_outline(mask)
    if outline is None:
        return np.zeros((0, 2))
    together: list[list[np.ndarray]] = []
    for end in (end for gap in _gaps(outline) for end in gap):
        near = [one for one in together if np.linalg.norm(np.mean(one, axis=0) - end) < FINGER * _size(outline)]
        if near:
            near[0].append(end)
        else:
            together.append([end])
    return np.array([np.mean(one, axis=0) for one in together]).reshape(-1, 2)


def _largest_outline(mask: np.ndarray) -> np.ndarray | None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return max(contours, key=cv2.contourArea) if contours else None


def _size(outline: np.ndarray) -> float:
    """Root of the area, pixels."""
    return float(np.sqrt(cv2.contourArea(outline)))


def _gaps(outline: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Both ends on the hull of every gap that is deep, and narrower than a right angle."""
    hull = cv2.convexHull(outline, returnPoints=False)
    defects = cv2.convexityDefects(outline, np.sort(hull, axis=0)[::-1]) if len(hull) > 3 else None
    if defects is None:
        return []
    first, last, deepest = (outline[defects[:, 0, i], 0].astype(float) for i in range(3))
    a, b = first - deepest, last - deepest
    cosine = np.sum(a * b, axis=1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-9)
    chosen = (cosine > 0) & (defects[:, 0, 3] / 256 > DEEP * _size(outline))
    return list(zip(first[chosen], last[chosen], strict=True))


def nearest_by_warping(
    known: Sequence[Float[np.ndarray, "_ d"]], labels: Sequence[str], strokes: Sequence[Float[np.ndarray, "_ d"]]
) -> list[str]:
    """Labels of the strokes that are nearest by dynamic time warping, size and place removed."""
    alike = np.stack([_normalised(path) for path in known])
    found = []
    for stroke in strokes:
        apart = np.linalg.norm(_normalised(stroke)[None, :, None] - alike[:, None], axis=-1)
        along = np.cumsum(apart, axis=2)
        total = along[:, 0]
        for i in range(1, POINTS):
            # A row after the other: into each place from the row before, then on along the row.
            entered = np.minimum(total, np.pad(total[:, :-1], ((0, 0), (1, 0)), constant_values=np.inf))
            total = along[:, i] + np.minimum.accumulate(entered - along[:, i] + apart[:, i], axis=1)
        found.append(labels[int(np.argmin(total[:, -1]))])
    return found


def _normalised(path: np.ndarray) -> np.ndarray:
    """`POINTS` points evenly along the path, about their centroid, with the larger extent 1."""
    path = np.asarray(path, float)
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    even = np.linspace(0.0, along[-1], POINTS)
    points = np.stack([np.interp(even, along, path[:, k]) for k in range(path.shape[1])], axis=-1)
    points = points - points.mean(axis=0)
    return points / max(np.ptp(points, axis=0).max(), 1e-9)
