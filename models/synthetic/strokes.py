"""Symbols that people draw on a desk with one finger or two, with known truth: twelve shapes, as tips are tracked.

Drawn in NumPy, and the same for the same seed
everywhere. Image coordinates: x right, y down, pixels; 30 frames a second.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from jaxfilters.models.gesture.codes import displacements, observed

HALF_SIZE_PX, SPEED_PX = (50.0, 110.0), (4.0, 9.0)
"""Of a symbol, and its mean in a frame; both are uniform."""
PERSON_SPEED, PERSON_TURN_DEG = 0.15, 3.0
"""Standard deviations between people: of the logarithm of their speed, and of how they hold the desk."""
TURN_DEG, ASPECT = 7.0, 0.12
"""Standard deviations between symbols of a person: of their turn, and of the logarithm of width to height."""
ROUNDING_FRAMES = 1.2
TREMOR_MEMORY, TREMOR_PX = 0.9, 0.35
TIP_NOISE_PX = 1.0
DROPPED, SPURIOUS, LOST = 0.04, 0.01, 0.005
"""Shares of frames: one of two tips is not visible, there is one too many, none is visible."""
SECOND_TIP_PX = (26.0, 6.0)
"""Of the second finger from the first."""
_FRAMES = 64
WARP = 0.25
"""Standard deviation of each of two waves in the logarithm of the speed along a symbol."""

_TURN = np.linspace(0, 2 * np.pi, 49)
_CIRCLE = np.stack([np.sin(_TURN), -np.cos(_TURN)], axis=1)
_BOWS = np.radians(np.concatenate([np.linspace(-30, -270, 25), np.linspace(-90, 150, 25)[1:]]))
_BOW_CENTERS = np.repeat([-0.5, 0.5], [25, 24])
SHAPES: dict[str, Float[np.ndarray, "corners 2"]] = {
    "circle cw": _CIRCLE,
    "circle ccw": _CIRCLE * [-1, 1],
    "square": np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], float),
    "triangle": np.array([(0, -1), (1, 1), (-1, 1), (0, -1)], float),
    "Z": np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)], float),
    "S": np.stack([0.75 * np.cos(_BOWS), 0.5 * np.sin(_BOWS) + _BOW_CENTERS], axis=1),
    "V": np.array([(-1, -1), (0, 1), (1, -1)], float),
    "caret": np.array([(-1, 1), (0, -1), (1, 1)], float),
    "L": np.array([(-1, -1), (-1, 1), (1, 1)], float),
    "N": np.array([(-1, 1), (-1, -1), (1, 1), (1, -1)], float),
    "figure eight": np.stack([0.8 * np.sin(2 * _TURN), -np.cos(_TURN)], axis=1),
    "left bracket": np.array([(0.5, -1), (-0.5, -1), (-0.5, 1), (0.5, 1)], float),
}
"""Corners of each shape in the order in which they are drawn; the shape's half-size is 1."""


class Drawings(NamedTuple):
    """What one writer drew: tips of fingers in the frames of every symbol, the n symbols last."""

    tips: Float[np.ndarray, "t 2 2 n"]
    """Frame, finger, (x, y); zero where it is not visible."""
    present: Bool[np.ndarray, "t 2 n"]
    """Whether each finger is visible; `False` after the last frame of a symbol."""
    lengths: Int[np.ndarray, " n"]
    """Frames of each symbol."""
    labels: tuple[str, ...]
    """Shape and number of fingers, as in "square 2"."""


class Tracked(NamedTuple):
    """What a tracker says of strokes, one after the other."""

    codes: list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]
    """Direction codes and numbers of tips in the frames of each stroke."""
    paths: list[tuple[Float[np.ndarray, "_ 2"], Int[np.ndarray, " _"]]]
    """Positions in pixels, from where each begins, and numbers of tips."""
    labels: tuple[str, ...]


def drawn(seed: int, num_trials: int, *, shapes: Sequence[str] = tuple(SHAPES), turn_deg: float = 0.0) -> Drawings:
    """Every shape, with one finger and with two, that many times by the writer of a seed.

    Args:
        seed: Of the writer and of all that varies.
        num_trials: How often each shape is drawn with each number of fingers.
        shapes: Which of `SHAPES`.
        turn_deg: By how much the writer turns all of them, beside what varies between people.

    Raises:
        ValueError: If a shape is unknown, there is none, or `num_trials < 1`.
    """
    if num_trials < 1:
        raise ValueError(f"num_trials must be at least 1; got {num_trials}.")
    if not shapes or (unknown := set(shapes) - set(SHAPES)):
        raise ValueError(f"shapes must be some of {', '.join(SHAPES)}; got {sorted(unknown) if shapes else 'none'}.")
    rng = np.random.default_rng(seed)
    haste, turn = np.exp(rng.normal(0, PERSON_SPEED)), np.radians(turn_deg + rng.normal(0, PERSON_TURN_DEG))
    found, labels = [], []
    for shape in shapes:
        for fingers in (1, 2):
            for _ in range(num_trials):
                found.append(_tips(rng, _path(rng, SHAPES[shape], haste, turn), fingers))
                labels.append(f"{shape} {fingers}")
    lengths = np.array([len(tips) for tips, _ in found])
    tips = np.zeros((lengths.max(), 2, 2, len(found)))
    present = np.zeros((lengths.max(), 2, len(found)), bool)
    for i, (where, visible) in enumerate(found):
        tips[: len(where), ..., i], present[: len(where), :, i] = where, visible
    return Drawings(tips, present, lengths, tuple(labels))


def tracked(drawings: Drawings, *, still_px: float = 1.5) -> Tracked:
    """What a tracker says of the fingertips.

    Args:
        drawings: Made by `drawn`.
        still_px: Length of a displacement below which it has no direction, pixels a frame.
    """
    # Few lengths, few programs.
    missing = [(0, -len(drawings.tips) % _FRAMES)] + [(0, 0)] * 3
    tips = np.pad(drawings.tips, missing).astype(np.float32)
    present = np.pad(drawings.present, missing[:-1])
    codes, counts, steps = (np.asarray(leaf) for leaf in _observed(jnp.asarray(tips), jnp.asarray(present), still_px))
    places = np.cumsum(steps, axis=0)
    frames = list(enumerate(drawings.lengths))
    return Tracked(
        [(codes[:length, i], counts[:length, i]) for i, length in frames],
        [(places[:length, :, i], counts[:length, i]) for i, length in frames],
        drawings.labels,
    )


@jax.jit
def _observed(tips, present, still):
    codes, counts = jax.vmap(observed, (-1, -1, None), -1)(tips, present, still)
    return codes, counts, jax.vmap(displacements, -1, -1)(tips, present)


def _path(rng, corners, haste, turn):
    """Where the hand is in every frame (t, 2), with a steady hand."""
    angle = turn + np.radians(rng.normal(0, TURN_DEG))
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    wide = np.exp(0.5 * rng.normal(0, ASPECT))
    outline = rng.uniform(*HALF_SIZE_PX) * (corners * [wide, 1 / wide]) @ turned.T
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    num_frames = max(8, round(along[-1] / (haste * rng.uniform(*SPEED_PX))))
    phase = np.linspace(0, 2 * np.pi, num_frames)
    waves = rng.normal(0, WARP, (2, 1)) * np.sin(np.array([[0.5], [1.0]]) * phase + rng.uniform(0, 2 * np.pi, (2, 1)))
    passed = np.cumsum(np.exp(waves.sum(axis=0)))
    place = along[-1] * (passed - passed[0]) / (passed[-1] - passed[0])
    path = np.stack([np.interp(place, along, outline[:, k]) for k in range(2)], axis=1)
    return gaussian_filter1d(path, ROUNDING_FRAMES, axis=0, mode="nearest")


def _tips(rng, path, fingers):
    """Tips (t, 2, 2) after a running mean over three frames, and whether each is visible (t, 2)."""
    num_frames = len(path)
    tremor = np.zeros_like(path)
    for t in range(1, num_frames):
        tremor[t] = TREMOR_MEMORY * tremor[t - 1] + rng.normal(0, TREMOR_PX, 2)
    both = (path + tremor)[:, None] + np.array([(0.0, 0.0), SECOND_TIP_PX])
    both += rng.normal(0, TIP_NOISE_PX, both.shape)
    padded = np.pad(both, ((1, 1), (0, 0), (0, 0)), mode="edge")
    both = (padded[:-2] + padded[1:-1] + padded[2:]) / 3
    present = np.ones((num_frames, 2), bool)
    if fingers == 1:
        present[:, 1] = rng.uniform(size=num_frames) < SPURIOUS
        both[:, 1] = path + rng.uniform(-HALF_SIZE_PX[0], HALF_SIZE_PX[0], path.shape)
    else:
        dropped = rng.uniform(size=num_frames) < DROPPED
        present[dropped, rng.integers(2, size=dropped.sum())] = False
    present[rng.uniform(size=num_frames) < LOST] = False
    return np.where(present[..., None], both, 0.0), present
