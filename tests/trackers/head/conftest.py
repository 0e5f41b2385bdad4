import cv2
import numpy as np
import pytest

EYE, EYES = 0.226, 0.5
LANDMARKS = [(-0.726, 0), (-0.274, 0), (0.274, 0), (0.726, 0), (-0.4, 1.16), (0.4, 1.16)]
LANDMARKS += [(-0.145, 0.74), (0.145, 0.74), (-0.21, -0.315), (0.21, -0.315)]
"""Of the drawn face, in distances between its eyes."""


def drawn_face(middle, distance, roll=0.0, shape=(480, 640), image=None):
    """A face of a few grey shapes that OpenCV's cascades take for one, and its ten landmarks in pixels."""
    over = 4
    grey = np.full((shape[0] * over, shape[1] * over), 40, np.uint8)
    if image is not None:
        grey = cv2.resize(image, None, fx=over, fy=over, interpolation=cv2.INTER_NEAREST)
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    at = lambda points: np.asarray(middle) + distance * np.asarray(points, float) @ turn.T
    fine = lambda points: np.round((at(points) + 0.5) * over - 0.5).astype(np.int32)

    def ellipse(center, axes, value):
        axes = tuple(int(distance * over * a) for a in axes)
        cv2.ellipse(grey, fine(center).tolist(), axes, np.degrees(roll), 0, 360, value, -1, cv2.LINE_AA)

    def shape_of(points, value):
        cv2.fillPoly(grey, [fine(points)], value, cv2.LINE_AA)

    angles = np.linspace(0, 2 * np.pi, 40)
    almond = np.stack([np.cos(angles), np.sin(angles) * np.abs(np.sin(angles))], axis=-1)
    ellipse((0, 0.45), (1.15, 1.6), 170)
    ellipse((0, -1.0), (1.1, 0.55), 60)
    for side in (-1, 1):
        ellipse((side * EYES, 0), (0.34, 0.22), 125)
        brow = [(0.87, -0.36), (0.5, -0.44), (0.21, -0.36), (0.21, -0.27), (0.5, -0.33), (0.87, -0.27)]
        shape_of(np.array(brow) * (side, 1), 60)
        shape_of(almond * (EYE, 0.11) + (side * EYES, 0), 220)
        ellipse((side * EYES, 0), (0.1, 0.1), 40)
        ellipse((side * 0.145, 0.74), (0.07, 0.05), 50)
        shape_of(np.array([(0.12, 0.1), (0.2, 0.62), (0.1, 0.3)]) * (side, 1), 140)
    ellipse((0, 0.82), (0.2, 0.03), 135)
    shape_of(almond * (0.4, 0.12) + (0, 1.16), 120)
    shape_of([(-0.4, 1.16), (0, 1.135), (0.4, 1.16), (0, 1.185)], 60)
    small = cv2.resize(grey, shape[::-1], interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.012 * distance), at(LANDMARKS)


@pytest.fixture(scope="session")
def draw_face():
    return drawn_face
