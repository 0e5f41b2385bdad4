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
        [10.0, 10.0, 0.0] + [25.0, 0.0, 35.0] * 4,
        [0.0] * 15,
        [0.0] * 3 + [0.0, 12.0, 0.0] + [0.0] * 3 + [0.0, -12.0, 0.0] + [0.0, -27.0, 0.0],
        [30.0, 30.0, 0.0] + [75.0, 0.0, 90.0] * 4,
        [10.0, 10.0, 0.0] + [70.0, 0.0, 15.0] * 4,
        [20.0, 20.0, 0.0] + [45.0, 0.0, 60.0] * 4,
    ]
)
"""Joint angles of a relaxed, an open, a spread and a closed hand, of straight fingers at right angles to the palm, and
of a hand half closed, (6, 15)."""
NUM_ROLLS, NUM_FLIPS = 12, 8
"""Orientations about the optical axis, and about the axis of the forearm: palm, back and both edges to the camera."""
TILTS = np.deg2rad([-70.0, -35.0, 0.0, 35.0, 70.0])
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
    """Relaxed hands about the middle of a palm, in all orientations: rolls, flips, tilts, for each of the sides."""
    rotation, wrist = _orientations()
    angles = np.tile(GESTURES[0], (len(rotation), 1))
    poses = np.concatenate([center + scale * wrist, rotation, angles], axis=1).astype(np.float32)
    count = len(poses)
    return Hypotheses(
        np.tile(poses, (len(sides), 1)),
        np.full(count * len(sides), scale, np.float32),
        np.repeat(np.asarray(sides, np.float32), count),
    )


def of_every_gesture(tried: Hypotheses) -> Hypotheses:
    """Every hypothesis with each of the gestures in place of its own: those of the first one come first."""
    repeated = tried.rows(np.repeat(np.arange(len(tried.poses)), len(GESTURES)))
    repeated.poses[:, 7:] = np.tile(GESTURES, (len(tried.poses), 1))
    return repeated


@cache
def _orientations() -> tuple[np.ndarray, np.ndarray]:
    """Rotations (h, 4), and wrists from the middle of the palm (h, 3)."""

    def about(axis: int, angle: float) -> np.ndarray:
        turn = np.zeros(4)
        turn[[0, 1 + axis]] = math.cos(0.5 * angle), math.sin(0.5 * angle)
        return turn

    rolls, flips = (np.arange(count) * (2 * math.pi / count) for count in (NUM_ROLLS, NUM_FLIPS))
    rotations = np.stack(
        [
            multiplied(multiplied(about(2, roll), about(1, flip)), about(0, tilt))
            for roll, flip, tilt in product(rolls, flips, TILTS)
        ]
    )
    return rotations, PALM_TO_WRIST * np.stack([second_axis(rotation) for rotation in rotations])


def multiplied(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Product of two quaternions (4,)."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], vector])


def second_axis(q: np.ndarray) -> np.ndarray:
    """Where a rotation, as a quaternion (4,), takes the y axis."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
