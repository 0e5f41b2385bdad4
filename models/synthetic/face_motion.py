"""Courses of head motion, expression, occlusion and light at 30 frames a second.

Specification of the stereo head tracker: motions of section 4, deformation of section 5.2, disturbances of section 5.1.
Computed in NumPy, and the same for the same seed everywhere.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

FPS = 30.0
STEREO_PLACE_MM, MONOCULAR_PLACE_MM = (60.0, 0.0, 650.0), (0.0, 0.0, 650.0)
"""Where heads are before two cameras and before one."""
NUM_SINUSOIDS, AMPLITUDE_SHARE = 3, 1 / 2.2
"""Sinusoids a degree of freedom, and the share of a motion's amplitude that each of them has."""
REST_SHARE, REST_PERIOD_S = 0.4, (5.0, 8.0)
"""Of the time in which a motion with rests stands still, and how long it is from rest to rest, drawn once a course."""
_REST_SLOPE = 0.3
EASE_S = 1.0
OCCLUSION_FRAMES, DIMMING_FRAMES, DIMMED = (200, 230), (300, 340), 0.7
"""First frame, and the first one after; the gain at the end of the dimming."""


class Motion(NamedTuple):
    """How heads move in one kind of sequence."""

    amplitude: tuple[float, ...]
    """Of x, y, z in millimetres; roll, yaw, pitch in degrees."""
    band_hz: tuple[float, float]
    """Frequencies are uniform in it."""
    rests: bool


MOTIONS = {
    "slow": Motion((30, 15, 35, 8, 18, 10), (0.08, 0.22), rests=True),
    "fast": Motion((70, 35, 80, 15, 35, 18), (0.35, 1.0), rests=False),
    "mix": Motion((40, 20, 60, 10, 25, 12), (0.12, 0.45), rests=False),
}


def motion(
    kind: str, num_frames: int, seed: int, *, place_mm: tuple[float, float, float] = STEREO_PLACE_MM
) -> Float[np.ndarray, "frames 6"]:
    """Poses (x, y, z in millimetres; roll, yaw, pitch in radians) that leave a place where the head faces ahead.

    Three sinusoids of random frequency and phase for each degree of freedom, eased in over a second. In `slow` the
    time of the sinusoids stands still now and then, and with it the head.

    Args:
        kind: `slow`, `fast` or `mix`.
        num_frames: How many.
        seed: Of frequencies, phases and rests.
        place_mm: Of the first frame.

    Raises:
        ValueError: if `kind` is none of these or `num_frames` is not positive.
    """
    if kind not in MOTIONS:
        raise ValueError(f"kind must be one of {', '.join(MOTIONS)}; got {kind!r}.")
    if num_frames < 1:
        raise ValueError(f"num_frames must be 1 or more; got {num_frames}.")
    chosen, draw = MOTIONS[kind], np.random.default_rng(seed)
    frequency = draw.uniform(*chosen.band_hz, (NUM_SINUSOIDS, 6))
    phase = draw.uniform(0, 2 * math.pi, (NUM_SINUSOIDS, 6))
    times = np.arange(num_frames) / FPS
    warped = _with_rests(times, draw) if chosen.rests else times
    waves = np.sin(2 * math.pi * warped[:, None, None] * frequency + phase).sum(axis=1)
    offset = AMPLITUDE_SHARE * np.array(chosen.amplitude) * waves * _eased(times / EASE_S)[:, None]
    offset[:, 3:] = np.radians(offset[:, 3:])
    return offset + np.array([*place_mm, 0.0, 0.0, 0.0])


def deformation_schedule(
    num_frames: int, amp: float = 1.8, *, start: int = 120, stop: int = 1200
) -> Float[np.ndarray, "frames 2"]:
    """Expressions (e1, e2) of a face that is neutral until `start` and from `stop` on.

    With w the one-second ramps after `start` and before `stop` and s the time in seconds,
    `e1 = amp w 0.5 max(0, sin(2 pi .23 s)) sign(sin(2 pi .06 s) + .3)` and
    `e2 = amp w 0.65 max(0, sin(2 pi .31 s + 1))`. As printed, e1 changes its sign in one frame: the mouth jumps.
    """
    frame = np.arange(num_frames)
    s = frame / FPS
    w = np.clip((frame - start) / FPS, 0, 1) * np.clip((stop - frame) / FPS, 0, 1)
    sign = np.sign(np.sin(2 * math.pi * 0.06 * s) + 0.3)
    e1 = 0.5 * np.maximum(0, np.sin(2 * math.pi * 0.23 * s)) * sign
    e2 = 0.65 * np.maximum(0, np.sin(2 * math.pi * 0.31 * s + 1))
    return amp * w[:, None] * np.stack([e1, e2], axis=-1)


def speech_schedule(num_frames: int, *, start: int = 60) -> Float[np.ndarray, "frames 2"]:
    """Expressions (e1, e2) of a face that is neutral until `start`.

    With w a one-second ramp and s the time in seconds, `e1 = w .45 max(0, sin(2 pi .17 s)) sign(sin(2 pi .05 s) + .3)`
    and `e2 = w .6 max(0, sin(2 pi .23 s + 1))`.
    """
    frame = np.arange(num_frames)
    s = frame / FPS
    w = np.clip((frame - start) / FPS, 0, 1)
    e1 = 0.45 * np.maximum(0, np.sin(2 * math.pi * 0.17 * s)) * np.sign(np.sin(2 * math.pi * 0.05 * s) + 0.3)
    e2 = 0.6 * np.maximum(0, np.sin(2 * math.pi * 0.23 * s + 1))
    return w[:, None] * np.stack([e1, e2], axis=-1)


def occlusion_schedule(num_frames: int, *, frames: tuple[int, int] = OCCLUSION_FRAMES) -> Bool[np.ndarray, " frames"]:
    """Whether mouth and nostrils are covered: 30 frames."""
    frame = np.arange(num_frames)
    return (frame >= frames[0]) & (frame < frames[1])


def gain_schedule(
    num_frames: int, *, frames: tuple[int, int] = DIMMING_FRAMES, final: float = DIMMED
) -> Float[np.ndarray, " frames"]:
    """Factor of the light: 1, then down in 40 frames to `final`, where it stays."""
    share = np.clip((np.arange(num_frames) - frames[0]) / (frames[1] - frames[0]), 0, 1)
    return 1 + share * (final - 1)


def _with_rests(times, draw):
    """Time that stands still for `REST_SHARE` of the time, and else runs at its usual speed."""
    period, phase = draw.uniform(*REST_PERIOD_S), draw.uniform(0, 2 * math.pi)
    least = -math.sin(math.pi * (0.5 - REST_SHARE))
    speed = _eased((np.sin(2 * math.pi * times / period + phase) - least) / _REST_SLOPE)
    return np.cumsum(speed) / FPS


def _eased(share):
    share = np.clip(share, 0, 1)
    return share * share * (3 - 2 * share)
