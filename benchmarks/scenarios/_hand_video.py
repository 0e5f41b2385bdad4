"""The recording dexretarget_hand_video: fingertips found in its pixels, beside the key points that came with it.

The key points are another detector's, in metres in a frame that turns with the wrist, without a camera. What is said
about distances is therefore after a fit: in each frame a weak-perspective camera (rotation, scale, shift: six numbers)
takes the key points to the detected tips and palm, starting from the frame before and held near it. The distance of a
tip to what was fitted without it (`tip_left_out_px`) is the stricter figure.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.fingertip.first_image import base_angles, fit_hand_to_mask
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.skin import SkinModel, fit_skin_model, skin_mask

REDUCTION = 2
"""The video is looked at in half its 1280 x 720 pixels; what is reported is in its own."""
TIPS, KNUCKLES, PALM, WRIST, MIDDLE = [4, 8, 12, 16, 20], [2, 5, 9, 13, 17], [0, 5, 9, 13, 17], 0, 12
"""MediaPipe's points; the middle of the palm is the mean of `PALM`."""
STRETCHED, FOLDED = 0.85, 0.6
"""Of the largest distance from a finger's knuckle to its tip: more is extended; less, of all but the thumb, a fist."""
BESIDE_PALM = 1.5
"""Palm radii from its middle: nearer tips lie before the palm, and show in no silhouette."""
GATE = 0.15
"""Hand lengths between a tip and the key point that it belongs to, at most."""
PALM_WEIGHT = 0.4
"""In the fit: the middle of a silhouette's palm is not exactly a mean of key points."""
ROTATION_STEP, SCALE_STEP, SHIFT_STEP = 0.1, 0.02, 0.15
"""Standard deviations from frame to frame against which the fit is held: radians, of the logarithm, hand lengths."""
GAUSS_NEWTON = 4
"""Iterations from the frame before."""
TIP_STD = 0.02
"""Hand lengths."""
FEWEST_LEFT = 4
"""Matched tips in frames in which one is left out."""


@dataclass(frozen=True)
class HandVideo:
    """What is known before the first frame is looked at again."""

    frames: list[np.ndarray]
    """Reduced, (rows, cols, 3) uint8."""
    joints: Float[np.ndarray, "frames 21 3"]
    """Metres."""
    skin: SkinModel
    parameters: HandParameters
    """Both of the first frame, an open hand."""


class FrameFit(NamedTuple):
    """One frame beside its key points; reduced pixels."""

    observation: HandObservation
    camera: Float[np.ndarray, "6"]
    """Rotation vector, logarithm of pixels per metre, shift."""
    tips: Float[np.ndarray, "5 2"]
    """Key points in the image, the thumb first."""
    finger: np.ndarray
    """(5,) for each slot of the observation the finger, or -1."""
    distance: Float[np.ndarray, "5"]
    """From each matched slot to its key point, NaN otherwise."""
    left_out: Float[np.ndarray, "5"]
    """Likewise, to where the fit without that tip puts it."""
    hand_length: float
    """From wrist to the middle finger's tip of a stretched hand."""


def hand_video_metrics(folder: Path, out: Path | None = None, *, num_frames: int | None = None) -> dict[str, float]:
    """Distances of detected tips to the key points, and how many extended fingers have a tip.

    Args:
        folder: The recording.
        out: Where overlays of some frames go, if anywhere.
        num_frames: Only the first ones; all by default.

    Raises:
        RecordingError: a file that cannot be read.
    """
    video = load_hand_video(folder, num_frames=num_frames)
    fits = list(fit_frames(video))
    if out is not None:
        for i in range(0, len(fits), max(1, len(fits) // 24)):
            cv2.imwrite(str(out / f"hand_video_{i:04d}.png"), overlay(video.frames[i], fits[i]))
    return _metrics(fits, finger_reach(video.joints))


def load_hand_video(folder: Path, *, num_frames: int | None = None) -> HandVideo:
    """The recording, with the skin and the hand of its first frame estimated.

    Raises:
        RecordingError: a file that cannot be read.
    """
    try:
        joints = np.load(folder / "detected_joints.npz")["xyz"].astype(float)
    except (OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{folder / 'detected_joints.npz'} cannot be read: {error}") from error
    frames = list(_reduced(folder / "human_hand_video.mp4", num_frames or len(joints)))
    if not frames or len(frames) > len(joints):
        raise RecordingError(f"{folder}: {len(frames)} frames and key points of {len(joints)}.")
    skin = fit_skin_model(frames[0])
    return HandVideo(frames, joints[: len(frames)], skin, fit_hand_to_mask(skin_mask(frames[0], skin)))


def observations(video: HandVideo) -> Iterator[HandObservation]:
    """What is detected in each frame, in reduced pixels."""
    for frame in video.frames:
        yield detect_hand(skin_mask(frame, video.skin), video.parameters)


def finger_reach(joints: Float[np.ndarray, "frames 21 3"]) -> Float[np.ndarray, "frames 5"]:
    """Distances from knuckle to tip, as shares of the finger's 95th percentile over the frames."""
    reach = np.linalg.norm(joints[:, TIPS] - joints[:, KNUCKLES], axis=-1)
    return reach / np.percentile(reach, 95, axis=0)


def fit_frames(video: HandVideo) -> Iterator[FrameFit]:
    """Each frame's tips matched to its key points, with the camera that was fitted."""
    camera: np.ndarray | None = None
    reach = np.linalg.norm(video.joints[:, MIDDLE] - video.joints[:, WRIST], axis=-1)
    length_m = float(np.percentile(reach, 95))
    for observation, joints in zip(observations(video), video.joints, strict=True):
        if camera is None:
            camera = _first_camera(observation, joints, video.parameters.handedness)
        fit = _frame_fit(observation, joints, camera, length_m)
        camera = fit.camera
        yield fit


def overlay(frame: np.ndarray, fit: FrameFit) -> np.ndarray:
    """Tips (red), bases, palm and axis as detected, and key points of tips (green), on the frame."""
    image, observed = frame.copy(), fit.observation

    def at(point):
        return tuple(int(n) for n in np.rint(point))

    for tip, base in zip(observed.tips[observed.is_tip], observed.bases[observed.is_tip], strict=True):
        cv2.circle(image, at(tip), 6, (0, 0, 255), 1, cv2.LINE_AA)
        if base.any():
            cv2.line(image, at(tip), at(base), (0, 255, 255), 1, cv2.LINE_AA)
    for point in fit.tips:
        cv2.drawMarker(image, at(point), (0, 255, 0), cv2.MARKER_CROSS, 7)
    cv2.circle(image, at(observed.palm), int(observed.palm_radius), (255, 255, 0), 1, cv2.LINE_AA)
    cv2.line(image, at(observed.palm), at(observed.palm - 60 * observed.axis), (255, 255, 0), 1, cv2.LINE_AA)
    return image


def _reduced(path: Path, num_frames: int) -> Iterator[np.ndarray]:
    video = cv2.VideoCapture(str(path))
    for _ in range(num_frames):
        ok, frame = video.read()
        if not ok:
            raise RecordingError(f"{path} cannot be read, or has fewer than {num_frames} frames.")
        yield cv2.resize(frame, None, fx=1 / REDUCTION, fy=1 / REDUCTION, interpolation=cv2.INTER_AREA)


def _projected(camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    turned = points @ Rotation.from_rotvec(camera[:3]).as_matrix()[:2].T
    return np.exp(camera[3]) * turned + camera[4:]


def _first_camera(observation: HandObservation, joints: np.ndarray, handedness: int) -> np.ndarray:
    """From an open hand, whose fingers are known by their order about the palm; the best of many starts."""
    order = np.argsort(-handedness * base_angles(observation))
    observed = np.concatenate([observation.tips[order], observation.palm[None]]).astype(float)
    points = np.concatenate([joints[TIPS], joints[PALM].mean(axis=0)[None]])
    weights = np.array([1.0] * MAX_TIPS + [PALM_WEIGHT])[:, None]
    scale = np.linalg.norm(observed[2] - observed[5]) / np.linalg.norm(points[2] - points[5])
    starts = [np.array([*r.as_rotvec(), np.log(scale), *observed[5]]) for r in Rotation.create_group("O")]
    fits = [
        least_squares(lambda x: (weights * (_projected(x, points) - observed)).ravel(), start, method="lm")
        for start in starts
    ]
    return min(fits, key=lambda fit: fit.cost).x


def _frame_fit(observation: HandObservation, joints: np.ndarray, before: np.ndarray, length_m: float) -> FrameFit:
    camera, finger = before, np.full(MAX_TIPS, -1)
    length = float(np.exp(before[3]) * length_m)
    for _ in range(2):
        finger = _matched(observation, _projected(camera, joints[TIPS]), GATE * length)
        camera = _fitted(observation, joints, finger, before, length)
    tips = _projected(camera, joints[TIPS])
    finger = _matched(observation, tips, GATE * length)
    distance, left_out = np.full(MAX_TIPS, np.nan), np.full(MAX_TIPS, np.nan)
    slots = np.flatnonzero(finger >= 0)
    distance[slots] = np.linalg.norm(observation.tips[slots] - tips[finger[slots]], axis=1)
    for slot in slots if len(slots) >= FEWEST_LEFT else []:
        others = np.where(np.arange(MAX_TIPS) == slot, -1, finger)
        without = _projected(_fitted(observation, joints, others, before, length), joints[TIPS])
        left_out[slot] = np.linalg.norm(observation.tips[slot] - without[finger[slot]])
    return FrameFit(observation, camera, tips, finger, distance, left_out, float(np.exp(camera[3]) * length_m))


def _matched(observation: HandObservation, tips: np.ndarray, gate: float) -> np.ndarray:
    """(5,) the finger of each slot, or -1: least sum of distances, none beyond the gate."""
    finger = np.full(MAX_TIPS, -1)
    slots = np.flatnonzero(observation.is_tip)
    distance = np.linalg.norm(observation.tips[slots, None] - tips, axis=-1)
    for row, column in zip(*linear_sum_assignment(np.minimum(distance, 2 * gate)), strict=True):
        if distance[row, column] < gate:
            finger[slots[row]] = column
    return finger


def _fitted(
    observation: HandObservation, joints: np.ndarray, finger: np.ndarray, before: np.ndarray, length: float
) -> np.ndarray:
    """The camera of the matched tips and the palm, held near the one before."""
    slots = np.flatnonzero(finger >= 0)
    points = np.concatenate([joints[TIPS][finger[slots]], joints[PALM].mean(axis=0)[None]])
    observed = np.concatenate([observation.tips[slots], observation.palm[None]]).astype(float)
    weights = np.array([1.0] * len(slots) + [PALM_WEIGHT * float(observation.is_hand)])[:, None] / (TIP_STD * length)
    steps = np.array([*[ROTATION_STEP] * 3, SCALE_STEP, SHIFT_STEP * length, SHIFT_STEP * length])
    last, camera = Rotation.from_rotvec(before[:3]), before
    for _ in range(GAUSS_NEWTON):
        turn = Rotation.from_rotvec(camera[:3])
        x, y, z = np.exp(camera[3]) * turn.apply(points).T
        none, one = np.zeros_like(x), np.ones_like(x)
        columns = np.stack(
            [np.stack([none, z, -y, x, one, none], axis=1), np.stack([-z, none, x, y, none, one], axis=1)], axis=1
        )
        residual = weights * (np.stack([x, y], axis=1) + camera[4:] - observed)
        near = np.concatenate([(turn * last.inv()).as_rotvec(), camera[3:] - before[3:]]) / steps
        design = np.concatenate([(weights[..., None] * columns).reshape(-1, 6), np.diag(1 / steps)])
        step = np.linalg.lstsq(design, -np.concatenate([residual.ravel(), near]), rcond=None)[0]
        turned = (Rotation.from_rotvec(step[:3]) * turn).as_rotvec()
        camera = np.concatenate([turned, camera[3:] + step[3:]])
    return camera


def _metrics(fits: list[FrameFit], reach: np.ndarray) -> dict[str, float]:
    distance = np.stack([fit.distance for fit in fits]) * REDUCTION
    left_out = np.stack([fit.left_out for fit in fits]) * REDUCTION
    length = np.array([fit.hand_length for fit in fits])[:, None] * REDUCTION
    finger = np.stack([fit.finger for fit in fits])
    is_tip = np.stack([fit.observation.is_tip for fit in fits])
    found = (finger[:, :, None] == np.arange(MAX_TIPS)).any(axis=1)
    palm = np.stack([fit.observation.palm for fit in fits])
    radius = np.array([float(fit.observation.palm_radius) for fit in fits])
    beside = (
        np.linalg.norm(np.stack([fit.tips for fit in fits]) - palm[:, None], axis=-1) > BESIDE_PALM * radius[:, None]
    )
    shown, fist = (reach > STRETCHED) & beside, (reach[:, 1:] < FOLDED).all(axis=1)
    return {
        "frames": float(len(fits)),
        "tip_distance_px": float(np.nanmean(distance)),
        "tip_distance_percent_of_hand": float(np.nanmean(100 * distance / length)),
        "tip_left_out_px": float(np.nanmean(left_out)),
        "tip_left_out_median_px": float(np.nanmedian(left_out)),
        "tip_left_out_percent_of_hand": float(np.nanmean(100 * left_out / length)),
        "extended_with_tip_percent": float(100 * found[shown].mean()),
        "tips_without_finger_percent": float(100 * (is_tip & (finger < 0)).sum() / max(is_tip.sum(), 1)),
        "fist_frames": float(fist.sum()),
        "tips_per_fist": float(is_tip[fist].sum(axis=1).mean()) if fist.any() else 0.0,
    }
