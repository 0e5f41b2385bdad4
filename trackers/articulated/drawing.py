"""Pictures of a tracked articulated hand: its links over what was measured, as images and as a video."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.layout import LINKS
from jaxfilters.trackers.app.canvas import WHITE, can_be_drawn, draw_dot, draw_line, draw_outline
from jaxfilters.trackers.app.video import STATUS_COLORS, caption, write_video
from jaxfilters.trackers.articulated.recording import FeatureSequence
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack
from jaxfilters.trackers.hand_depth.drawing import FINGER_COLORS
from jaxfilters.trackers.tracker import STATUS_NAMES

_PAPER, _MEASURED, _TRUTH, _PALM = (26, 24, 22), (140, 125, 105), (235, 235, 235), (190, 190, 190)
"""Blue, green, red: the background, what was measured, the truth, the outline of the palm."""
_SMALLEST_HEIGHT = 480
"""Images with fewer rows are enlarged, so that lines and text stay fine against the hand."""
_MARGIN = 0.12
"""Of a picture without a camera image: free space around the hand, as a share of its extent."""
_LONGEST = 1.3
"""A measured line is drawn over the link that it belongs to, and beyond it by this factor."""


@dataclass(frozen=True)
class Canvas:
    """A picture of a part of the image plane."""

    shape: tuple[int, int]
    """Rows and columns of the picture."""
    corner: tuple[float, float]
    """The point of the image plane, x and y in pixels, at the middle of the upper left pixel of the image."""
    scale: float
    """Pixels of the picture per pixel of the image."""

    def place(self, points: np.ndarray) -> np.ndarray:
        """Where points (..., 2) of the image plane lie in the picture."""
        return (points - np.asarray(self.corner) + 0.5) * self.scale - 0.5


class Measured(NamedTuple):
    """Features as geometry, frames first, NaN where nothing was measured."""

    points: np.ndarray
    """(frames, 1 + 4 fingers, 2) wrist and joints, pixels."""
    lines: np.ndarray
    """(frames, fingers, 3, 2): angle and distance from the origin of every link's axis."""
    palm: np.ndarray
    """(frames, 3): angle and the two distances of the palm's outline."""


class Scene(NamedTuple):
    """Everything that is drawn of a recording, in pixels of the image plane, frames first."""

    canvas: Canvas
    measured: Measured
    wrist: np.ndarray
    """(frames, 2) estimated."""
    joints: np.ndarray
    """(frames, fingers, 4, 2) estimated, base to tip."""
    palm: np.ndarray
    """(frames, 8, 2) estimated corners of the palm."""
    true_joints: np.ndarray | None
    """(frames, fingers, 4, 2), where known."""
    origin: np.ndarray
    """(2,) that distances of lines are measured from."""


def scene(sequence: FeatureSequence, hand: ArticulatedHand, results: TimedArticulatedTrack, *, first: int = 0) -> Scene:
    """What is to be drawn of the frames in `results`, of which `first` is the number of the first one."""
    frames = slice(first, first + len(results.times_s))
    joints = results.image_points.astype(float)
    return Scene(
        canvas=_canvas(sequence.image_shape, _measured(sequence, slice(None)), joints),
        measured=_measured(sequence, frames),
        wrist=np.asarray(_wrists(jnp.asarray(results.mean), hand), float),
        joints=joints,
        palm=np.asarray(_palm_corners(jnp.asarray(results.mean), hand), float),
        true_joints=_true_joints(sequence, hand, frames),
        origin=np.asarray(hand.origin, float),
    )


def draw_frame(scene: Scene, index: int) -> np.ndarray:
    """(rows, cols, 3) uint8: what was measured, faint; in white the truth, where known; the estimate above."""
    canvas = scene.canvas
    image = np.full((*canvas.shape, 3), _PAPER, np.uint8)
    fine = max(1, round(canvas.shape[0] / 400))
    _draw_measured(image, scene, index, fine)
    draw_outline(image, canvas.place(scene.palm[index]), _PALM, fine)
    if scene.true_joints is not None:
        for chain in scene.true_joints[index]:
            _draw_chain(image, canvas.place(chain), _TRUTH, fine)
    for finger, chain in enumerate(scene.joints[index]):
        wrist = scene.wrist[index][None]
        _draw_chain(image, canvas.place(np.concatenate([wrist, chain[:1]])), _faded(_color(finger)), fine)
        _draw_chain(image, canvas.place(chain), _color(finger), 2 * fine)
        for point in canvas.place(chain[np.isfinite(chain).all(axis=-1)]):
            draw_dot(image, point, WHITE, fine + 1.2)
    return image


def write_overlay(
    path: Path,
    scene: Scene,
    results: TimedArticulatedTrack,
    frames_per_second: float,
    on_progress: Callable[[int], None],
) -> None:
    """Write the frames with status, hypotheses and speed over them as a video of the recording's own pace.

    Raises:
        OutputError: the video cannot be written.
    """
    write_video(path, _captioned(scene, results, frames_per_second), results.times_s, on_progress)


def _captioned(scene: Scene, results: TimedArticulatedTrack, frames_per_second: float) -> Iterator[np.ndarray]:
    speed = f"{frames_per_second:.0f} frames/s" if np.isfinite(frames_per_second) else ""
    for i, time_s in enumerate(results.times_s - results.times_s[0]):
        image = draw_frame(scene, i)
        status, count = int(results.status[i]), int(results.num_hypotheses[i])
        hypotheses = f"{count} hypothes{'i' if count == 1 else 'e'}s"
        caption(image, f"frame {i}   {time_s:6.2f} s   {speed}", 0)
        caption(image, f"{STATUS_NAMES[status]}   {hypotheses}", 1, STATUS_COLORS[status])
        yield image


def _measured(sequence: FeatureSequence, frames: slice) -> Measured:
    names = sequence.features.names(sequence.num_fingers)
    rows = dict(zip(names, sequence.y[frames].T, strict=True))

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([rows.get(name, np.full(len(sequence.y[frames]), np.nan)) for name in wanted], axis=-1)

    fingers = range(1, sequence.num_fingers + 1)
    joints = [f"p_{finger}{joint}" for finger in fingers for joint in range(LINKS + 1)]
    lines = [[f"{finger}{link}" for link in range(1, LINKS + 1)] for finger in fingers]
    return Measured(
        points=np.stack([columns(f"{point}_x", f"{point}_y") for point in ("wrist", *joints)], axis=1),
        lines=np.stack(
            [np.stack([columns(f"alpha_{link}", f"rho_{link}") for link in row], axis=1) for row in lines], axis=1
        ),
        palm=columns("palm_alpha", "palm_rho_min", "palm_rho_max"),
    )


def _canvas(image_shape: tuple[int, int] | None, measured: Measured, joints: np.ndarray) -> Canvas:
    if image_shape is not None:
        times = max(1, -(-_SMALLEST_HEIGHT // image_shape[0]))
        return Canvas((times * image_shape[0], times * image_shape[1]), (0.0, 0.0), float(times))
    points = np.concatenate([measured.points.reshape(-1, 2), joints.reshape(-1, 2)])
    points = points[np.isfinite(points).all(axis=-1)]
    low, high = np.percentile(points, (0.5, 99.5), axis=0) if len(points) else (np.zeros(2), np.ones(2))
    extent = np.maximum(high - low, 1e-3) * (1 + 2 * _MARGIN)
    rows = max(float(extent[1]), 0.75 * float(extent[0]))
    width = max(float(extent[0]), rows)
    scale = _SMALLEST_HEIGHT / rows
    columns = 2 * round(0.5 * scale * width)
    corner = 0.5 * (low + high) - 0.5 * np.asarray([columns, _SMALLEST_HEIGHT]) / scale + 0.5
    return Canvas((_SMALLEST_HEIGHT, columns), (float(corner[0]), float(corner[1])), scale)


@jax.jit
def _palm_corners(states: jax.Array, hand: ArticulatedHand) -> jax.Array:
    """(frames, 8, 2) pixels of the palm's corners, whose outline is what a camera sees of it."""
    shares = jnp.asarray([(a, b, c) for a in (0.0, 1.0) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])

    def corners(x: jax.Array) -> jax.Array:
        width, height, thickness = x[hand.layout.palm]
        points = shares * jnp.stack([height, thickness, width])
        return hand.projection.image_points(hand.projection.camera_points(x, hand.layout, points))

    return jax.vmap(corners)(states)


@jax.jit
def _wrists(states: jax.Array, hand: ArticulatedHand) -> jax.Array:
    """(frames, 2) pixels."""
    return jax.vmap(lambda x: hand.projection.image_points(hand.wrist(x)))(states)


@jax.jit
def _joints(states: jax.Array, hand: ArticulatedHand) -> jax.Array:
    return jax.vmap(hand.image_points)(states)


def _true_joints(sequence: FeatureSequence, hand: ArticulatedHand, frames: slice) -> np.ndarray | None:
    if sequence.truth is None:
        return None
    return np.asarray(_joints(jnp.asarray(sequence.truth[frames], dtype=float), hand), float)


def _draw_measured(image: np.ndarray, scene: Scene, index: int, fine: int) -> None:
    canvas, measured = scene.canvas, scene.measured
    for point in canvas.place(measured.points[index]):
        draw_dot(image, point, _MEASURED, 3.0 * fine)
    for chain, lines in zip(scene.joints[index], measured.lines[index], strict=True):
        for start, end, line in zip(chain[:-1], chain[1:], lines, strict=True):
            _draw_line(image, scene, line, np.stack([start, end]), fine)
    axis = scene.palm[index].reshape(2, 4, 2).mean(axis=1)
    alpha, nearest, farthest = measured.palm[index]
    for rho in (nearest, farthest):
        _draw_line(image, scene, np.asarray([alpha, rho]), axis, fine)


def _draw_line(image: np.ndarray, scene: Scene, line: np.ndarray, link: np.ndarray, fine: int) -> None:
    """The part of a measured line (angle, distance) that lies beside a link (2, 2)."""
    if not np.isfinite(line).all() or not can_be_drawn(link):
        return
    direction = np.asarray([np.cos(line[0]), np.sin(line[0])])
    normal = np.asarray([-direction[1], direction[0]])
    middle = link.mean(axis=0) - scene.origin
    foot = scene.origin + line[1] * normal + (middle @ direction) * direction
    half = 0.5 * _LONGEST * float(np.linalg.norm(link[1] - link[0])) * direction
    _draw_chain(image, scene.canvas.place(np.stack([foot - half, foot + half])), _MEASURED, fine)


def _draw_chain(image: np.ndarray, points: np.ndarray, color: tuple, thickness: int) -> None:
    for start, end in pairwise(points):
        draw_line(image, start, end, color, thickness)


def _color(finger: int) -> tuple[int, int, int]:
    return FINGER_COLORS[finger % len(FINGER_COLORS)]


def _faded(color: tuple[int, int, int]) -> tuple:
    return tuple((part + paper) // 2 for part, paper in zip(color, _PAPER, strict=True))
