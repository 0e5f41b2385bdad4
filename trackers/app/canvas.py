"""Lines, dots and words in pictures, at fractions of a pixel; what lies far outside or is not finite is left out."""

import cv2
import numpy as np

Color = tuple[int, int, int]
"""Blue, green, red."""
BLACK, WHITE, INK = (0, 0, 0), (255, 255, 255), (60, 60, 60)
_SUBPIXEL = 4
"""Fractional bits of the coordinates that OpenCV draws with."""
_FARTHEST = 1e5
"""Pixels from the corner of a picture, within which there may be something to draw."""


def can_be_drawn(points: np.ndarray) -> bool:
    """Whether points (..., 2) are somewhere near the picture."""
    return bool(np.isfinite(points).all()) and float(np.abs(points).max()) < _FARTHEST


def draw_line(image: np.ndarray, start: np.ndarray, end: np.ndarray, color: tuple, thickness: int) -> None:
    """A straight line between two points (2,) in pixels of the picture."""
    if can_be_drawn(np.stack([start, end])):
        cv2.line(image, _fixed(start), _fixed(end), color, thickness, cv2.LINE_AA, _SUBPIXEL)


def draw_dot(image: np.ndarray, point: np.ndarray, color: tuple, radius: float) -> None:
    """A filled circle around a point (2,); the radius in pixels."""
    if can_be_drawn(point):
        cv2.circle(image, _fixed(point), round(radius * 2**_SUBPIXEL), color, -1, cv2.LINE_AA, _SUBPIXEL)


def draw_outline(image: np.ndarray, points: np.ndarray, color: tuple, thickness: int) -> None:
    """The convex outline of points (n, 2)."""
    if can_be_drawn(points):
        hull = cv2.convexHull(np.asarray([_fixed(point) for point in points], np.int32))
        cv2.polylines(image, [hull], True, color, thickness, cv2.LINE_AA, _SUBPIXEL)


def write(image: np.ndarray, text: str, place: tuple[int, int], color: tuple = INK, size: float = 0.45) -> int:
    """Words whose lower left corner is at `place`; their width in pixels."""
    style = (cv2.FONT_HERSHEY_SIMPLEX, size)
    cv2.putText(image, text, place, *style, color, 1, cv2.LINE_AA)
    return int(cv2.getTextSize(text, *style, 1)[0][0])


def write_outlined(
    image: np.ndarray, text: str, place: tuple[int, int], color: tuple = WHITE, size: float = 0.55, thickness: int = 1
) -> None:
    """Words with a black outline, which stay legible on anything."""
    style = (cv2.FONT_HERSHEY_SIMPLEX, size)
    cv2.putText(image, text, place, *style, BLACK, 4 if size > 0.5 else 3, cv2.LINE_AA)
    cv2.putText(image, text, place, *style, color, thickness, cv2.LINE_AA)


def color_of(identity: int) -> Color:
    """A colour for each identity: neighbours in number are far apart in hue."""
    hue = int(180 * (identity * 0.618034 % 1))
    b, g, r = cv2.cvtColor(np.array([[[hue, 200, 235]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return int(b), int(g), int(r)


def _fixed(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0]) * 2**_SUBPIXEL), round(float(point[1]) * 2**_SUBPIXEL)
