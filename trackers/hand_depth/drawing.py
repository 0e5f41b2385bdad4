"""Pictures of a tracked hand: colour-mapped depth with the skeleton over it, as images and as a video."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.app.canvas import WHITE, draw_dot, draw_line
from jaxfilters.trackers.app.video import STATUS_COLORS, caption, write_video
from jaxfilters.trackers.hand_depth.recording import DepthSequence
from jaxfilters.trackers.hand_depth.table import TimedHandTrack
from jaxfilters.trackers.tracker import STATUS_NAMES

BONES = tuple((0 if joint % 4 == 1 else joint - 1, joint) for joint in range(1, 21))
"""Pairs of joints, base first: five chains of four from the wrist."""
FINGER_COLORS = ((84, 92, 255), (60, 176, 255), (110, 220, 90), (255, 190, 70), (255, 120, 215))
"""Blue, green, red: thumb, index, middle, ring, little."""
_TRUTH_COLOR = (235, 235, 235)
_SMALLEST_HEIGHT = 480
"""Images with fewer rows are enlarged, so that lines and text stay fine against the hand."""


def depth_range(joints: np.ndarray, margin: float = 0.08) -> tuple[float, float]:
    """`(near, far)` in metres around the depths that the joints (frames, 21, 3) take, outliers aside."""
    depths = joints[..., 2][np.isfinite(joints[..., 2])]
    if not depths.size:
        return 0.3, 1.5
    near, far = np.percentile(depths, (2, 98))
    return max(float(near) - margin, 0.0), float(far) + margin


def color_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """(rows, cols, 3) uint8, blue green red: near is bright, `far` and beyond dark, no reading black."""
    closeness = np.clip((far - depth) / (far - near), 0.0, 1.0)
    levels = (30 + 225 * np.where(np.isfinite(closeness), closeness, 0.0)).astype(np.uint8)
    colors = cv2.applyColorMap(levels, cv2.COLORMAP_BONE)
    colors[~np.isfinite(depth)] = 0
    return colors


def draw_skeleton(
    image: np.ndarray, camera: Pinhole, joints: np.ndarray, scale: int = 1, *, color: tuple | None = None
) -> None:
    """Draw the joints (21, 3), metres in the camera frame, into `image`, which shows `scale` pixels per camera pixel.

    Joints that are not finite or not in front of the camera are left out. `color` replaces the colours of the fingers.
    """
    visible = np.isfinite(joints).all(axis=-1) & (joints[:, 2] > 1e-3)
    in_front = np.where(visible[:, None], joints, (0.0, 0.0, 1.0))
    # The centre of camera pixel 0 is the centre of a block of `scale` pixels.
    points = (np.asarray(camera.project(jnp.asarray(in_front, jnp.float32))) + 0.5) * scale - 0.5
    thickness = max(1, round(image.shape[0] / (400 if color else 240)))
    for base, tip in BONES:
        if visible[base] and visible[tip]:
            paint = color or FINGER_COLORS[(tip - 1) // 4]
            draw_line(image, points[base], points[tip], paint, thickness)
    if color is None:
        for joint in np.flatnonzero(visible):
            draw_dot(image, points[joint], WHITE, thickness + 0.8)


def draw_frame(sequence: DepthSequence, results: TimedHandTrack, index: int, limits: tuple[float, float]) -> np.ndarray:
    """Frame `index` of the recording with the estimate over it, and the true joints in white where they are known.

    `limits` are the depths (near, far) in metres that the colours span.
    """
    truth = None if sequence.joints is None else sequence.joints[index]
    return draw_hand(sequence[index], sequence.camera, results.joints[index], limits, truth)


def draw_hand(
    depth: np.ndarray, camera: Pinhole, joints: np.ndarray, limits: tuple[float, float], truth: np.ndarray | None = None
) -> np.ndarray:
    """As `draw_frame`, of a depth image (rows, cols) in metres and joints (21, 3), metres in the camera frame."""
    scale = max(1, -(-_SMALLEST_HEIGHT // camera.shape[0]))
    image = color_depth(depth, *limits).repeat(scale, axis=0).repeat(scale, axis=1)
    if truth is not None:
        draw_skeleton(image, camera, truth, scale, color=_TRUTH_COLOR)
    draw_skeleton(image, camera, joints, scale)
    return image


def write_overlay(
    path: Path,
    sequence: DepthSequence,
    results: TimedHandTrack,
    frames_per_second: float,
    on_progress: Callable[[int], None],
) -> None:
    """Write the recording with skeleton, status and speed drawn over it as a video of its own pace.

    Raises:
        OutputError: the video cannot be written.
    """
    write_video(path, _captioned(sequence, results, frames_per_second), results.times_s, on_progress)


def _captioned(sequence: DepthSequence, results: TimedHandTrack, frames_per_second: float) -> Iterator[np.ndarray]:
    limits = depth_range(results.joints)
    speed = f"{frames_per_second:.0f} frames/s" if np.isfinite(frames_per_second) else ""
    for i, time_s in enumerate(results.times_s - results.times_s[0]):
        image = draw_frame(sequence, results, i, limits)
        status, ess = int(results.status[i]), results.effective_sample_size[i]
        count = f"ESS {ess:4.0f}" if np.isfinite(ess) else "        "
        caption(image, f"frame {i}   {time_s:6.2f} s   {count}   {speed}", 0)
        caption(image, STATUS_NAMES[status], 1, STATUS_COLORS[status])
        yield image
