"""Pictures of a tracked head: its axes and landmarks over the images of all cameras."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.face.landmarks import BROWS, EYES, MOUTH, NOSTRILS
from jaxfilters.models.face.pose import place
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.app.canvas import BLACK, draw_dot, draw_line
from jaxfilters.trackers.app.video import caption, side_by_side
from jaxfilters.trackers.head.common.table import SHOWN_STATUS, TRACKED, HeadRows, displayed

HEAD_STATUS_COLORS = ((0, 200, 255), (230, 190, 80), (110, 220, 90), (84, 92, 255), (60, 160, 255), (190, 190, 190))
"""Blue, green, red, in the order of `SHOWN_STATUS`."""
AXIS_COLORS = ((84, 92, 255), (110, 220, 90), (255, 150, 70))
"""Of the axes to the image's right, downwards, and out of the face."""
OUTLINES = (EYES[:2], EYES[2:], MOUTH, (BROWS[0], *NOSTRILS, BROWS[1]))
"""Landmarks that lines join."""
_AXES_MM = np.array([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, -80]], np.float32)
_MILLIMETRES = np.array([1e3, 1e3, 1e3, 1, 1, 1], np.float32)
"""In which the rig projects; poses of rows are in metres and radians."""
_LANDMARK, _LINE = (255, 255, 255), (220, 220, 120)


def draw_frame(images: list[np.ndarray | None], rig: CameraRig, track: HeadRows, i: int) -> np.ndarray:
    """(rows, cols, 3) uint8: the images of all cameras side by side with row `i` of the track.

    `images` are straightened, (rows, cols, 3) uint8, or None where there is none; they are not changed.
    """
    axes = _axes(rig, track.pose[i]) if int(track.status[i]) in TRACKED else None
    pictures = []
    for camera, image in enumerate(images):
        picture = np.full((*rig.shape, 3), 40, np.uint8) if image is None else image.copy()
        if image is None:
            caption(picture, "no image of this moment", 3, HEAD_STATUS_COLORS[-1])
        if axes is not None:
            _draw_face(picture, track.image_points[i, camera])
            _draw_axes(picture, axes[camera])
        pictures.append(picture)
    whole = side_by_side(pictures, float(track.times_s[i]))
    _write_state(whole, track, i)
    return whole


def draw_points(image: np.ndarray, points: np.ndarray, color: tuple, line: tuple, size: float) -> None:
    """Landmarks (10, 2) in pixels of the picture, joined to eyes, mouth, and the outline of the nose."""
    for outline in OUTLINES:
        for a, b in pairwise(outline):
            draw_line(image, points[a], points[b], line, 1)
    for point in points:
        draw_dot(image, point, color, size)


def _axes(rig: CameraRig, pose: np.ndarray) -> np.ndarray:
    """(C, 4, 2) pixels of the head's origin and of the ends of its axes."""
    return np.asarray(_placed_axes(rig, jnp.asarray(pose) * _MILLIMETRES))


@jax.jit
def _placed_axes(rig: CameraRig, pose: jax.Array) -> jax.Array:
    return rig.project(place(jnp.asarray(_AXES_MM), pose))[0]


def _draw_face(picture: np.ndarray, points: np.ndarray) -> None:
    draw_points(picture, points, (0, 0, 0), (0, 0, 0), 3.4)
    draw_points(picture, points, _LANDMARK, _LINE, 2.2)


def _draw_axes(picture: np.ndarray, ends: np.ndarray) -> None:
    for end, color in zip(ends[1:], AXIS_COLORS, strict=True):
        draw_line(picture, ends[0], end, BLACK, 5)
        draw_line(picture, ends[0], end, color, 3)


def _write_state(picture: np.ndarray, track: HeadRows, i: int) -> None:
    status, score = int(track.status[i]), float(track.score[i])
    scored = f"   score {score:.2f}" if np.isfinite(score) else ""
    caption(picture, f"{SHOWN_STATUS[status]}{scored}", 1, HEAD_STATUS_COLORS[status])
    if status in TRACKED:
        # Adding zero takes the sign of a negative zero away.
        x, y, z, roll, pitch, yaw = np.round(displayed(track.pose[i])) + 0.0
        caption(picture, f"x {x:4.0f}  y {y:4.0f}  z {z:4.0f} mm", 2)
        caption(picture, f"roll {roll:4.0f}  pitch {pitch:4.0f}  yaw {yaw:4.0f}", 3)
