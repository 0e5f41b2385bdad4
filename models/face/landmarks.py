"""The ten landmarks of a face: names, mean places, which of them move with expressions.

Left and right are the subject's: right is at negative x, left in the image. The order is fixed.
"""

import numpy as np

NAMES = (
    "right eye outer",
    "right eye inner",
    "left eye inner",
    "left eye outer",
    "right mouth",
    "left mouth",
    "right nostril",
    "left nostril",
    "right brow inner",
    "left brow inner",
)
NUM_LANDMARKS = len(NAMES)
MIRROR = (3, 2, 1, 0, 5, 4, 7, 6, 9, 8)
"""The landmark on the other side of the face."""
EYES, MOUTH, NOSTRILS, BROWS = (0, 1, 2, 3), (4, 5), (6, 7), (8, 9)
FROM_68 = (36, 39, 42, 45, 48, 54, 32, 34, 21, 22)
"""Where the landmarks are among the 68 of iBUG, counted from 0."""

_TABLE = np.array(
    [
        (-45.0, 0.0, 9.0),
        (-17.0, 2.0, 0.0),
        (17.0, 2.0, 0.0),
        (45.0, 0.0, 9.0),
        (-25.0, 71.0, -3.0),
        (25.0, 71.0, -3.0),
        (-9.0, 47.0, -16.0),
        (9.0, 47.0, -16.0),
        (-13.0, -19.0, -8.0),
        (13.0, -19.0, -8.0),
    ]
)
MEAN_SHAPE = _TABLE - _TABLE.mean(axis=0)
"""(10, 3) millimetres about the centroid: x to the image's right, y down, z away from a camera that the face faces."""

_PEOPLE = np.array(
    [
        (-44.5, -26.6, -31.7),
        (-18.6, -25.9, -37.6),
        (18.6, -25.9, -37.6),
        (44.5, -26.6, -31.7),
        (-24.6, 43.4, -42.8),
        (24.6, 43.4, -42.8),
        (-6.0, 20.1, -58.7),
        (6.0, 20.1, -58.7),
        (-14.0, -50.1, -53.2),
        (14.0, -50.1, -53.2),
    ]
)
_COS, _SIN = np.cos(np.radians(1.4)), np.sin(np.radians(1.4))
"""The upright heads of two models of people, this one and the ICT face model, differ by 2.8 degrees of pitch and by .9
mm beside that; what is upright here lies in the middle."""
PEOPLE_SHAPE = (_PEOPLE - _PEOPLE.mean(axis=0)) @ np.array([[1, 0, 0], [0, _COS, -_SIN], [0, _SIN, _COS]])
"""(10, 3) the same of people: vertices 33, 133, 61, 97 and 107 of the canonical face of MediaPipe, and those opposite
(`face_model_with_iris.obj`, Apache licence 2.0), in millimetres and these axes. Eyes lie farther back, nostrils nearer
together than in `MEAN_SHAPE`, which the synthetic faces vary about."""

RIGID_WEIGHTS = np.array([1.0, 1.0, 1.0, 1.0, 0.02, 0.02, 1.0, 1.0, 0.1, 0.1])
"""(10,) how far each landmark speaks for the motion of the skull."""
