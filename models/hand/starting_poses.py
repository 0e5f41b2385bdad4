"""Hypotheses of where a hand may be and how it is held, about the middle of a palm that an image shows."""

import math
from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

PALM_TO_WRIST = 0.055
"""Metres from the middle of the palm to the wrist of an average hand."""
GESTURES = np.deg2rad(
    [
        [0.0] * 15,
        [0.0] * 3 + [0.0, 12.0, 0.0] + [0.0] * 3 + [0.0, -12.0, 0.0] + [0.0, -27.0, 0.0],
        [10.0, 10.0, 0.0] + [25.0, 0.0, 35.0] * 4,
        [30.0, 30.0, 0.0] + [75.0, 0.0, 90.0] * 4,
    ]
)
"""Joint angles of an open, a spread, a relaxed and a closed hand, (4, 15)."""
NUM_ROLLS = 12
TILTS = np.deg2rad([-45.0, 0.0, 45.0])
"""Of the fingers towards the camera and away from it."""


class Hypotheses(NamedTuple):
    """Poses of hands; leaves (h, ...)."""

    poses: Float[np.ndarray, "h 22"]
    scales: Float[np.ndarray, " h"]
    sides: Float[np.ndarray, " h"]

    def rows(self, index: np.ndarray | slice) -> "Hypotheses":
        """Some of them."""
        return Hypotheses(*(leaf[index] for leaf in self))


def starting_poses(center: Float[np.ndarray, " 3"], scale: float, sides: Sequence[float]) -> Hypotheses:
    """Hands about the middle of a palm: rolls about the optical axis, palm or back to the camera, tilts, gestures."""
    rotation, wrist, angles = _grid()
    poses = np.concatenate([center + scale * wrist, rotation, angles], axis=1).astype(np.float32)
    count = len(poses)
    return Hypotheses(
        np.tile(poses, (len(sides), 1)),
        np.full(count * len(sides), scale, np.float32),
        np.repeat(np.asarray(sides, np.float32), count),
    )


@cache
def _grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (h, 4), wrists from the middle of the palm (h, 3) and angles (h, 15)."""

    def about(axis: int, angle: float) -> np.ndarray:
        turn = np.zeros(4)
        turn[[0, 1 + axis]] = math.cos(0.5 * angle), math.sin(0.5 * angle)
        return turn

    rolls = np.arange(NUM_ROLLS) * (2 * math.pi / NUM_ROLLS)
    rotations = np.stack(
        [
            multiplied(multiplied(about(2, roll), about(1, flip)), about(0, tilt))
            for roll, flip, tilt in product(rolls, (0.0, math.pi), TILTS)
        ]
    )
    wrists = PALM_TO_WRIST * np.stack([second_axis(rotation) for rotation in rotations])
    repeat = len(GESTURES)
    angles = np.tile(GESTURES, (len(rotations), 1))
    return np.repeat(rotations, repeat, axis=0), np.repeat(wrists, repeat, axis=0), angles


def multiplied(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Product of two quaternions (4,)."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], vector])


def second_axis(q: np.ndarray) -> np.ndarray:
    """Where a rotation, as a quaternion (4,), takes the y axis."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
