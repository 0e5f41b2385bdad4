"""Fingertips as a detector would report them, missed ones and false ones included, and thumbs' angles, without images.

Points in place of images, for statistics of tracking.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.fingertip.observation import MAX_TIPS, WHOLE_IMAGE, HandObservation
from jaxfilters.models.fingertip.thumb import POSTURE, Posture
from jaxfilters.typing import AnyKey

FINGER_ANGLES = np.deg2rad([58.0, 20.0, 0.0, -18.0, -38.0])
"""From the arm's axis to the side of the thumb, the thumb first."""
TIP_DISTANCES = np.array([85.0, 115.0, 125.0, 115.0, 95.0])
BASE_DISTANCES = np.array([41.0, 51.0, 53.0, 51.0, 48.0])
"""Pixels of a 640x480 image, from the palm."""
SHOWN = ((1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), (0, 1, 2, 3, 4))
"""Which fingers are out when there are one to five."""
PALM = np.array([320.0, 270.0])
REACH = np.array([[110.0, 60.0], [14.0, 9.0]])
"""Of the path and of its harmonic, across and down the image."""
CYCLES_HZ = np.array([[0.43, 0.57], [1.5, 1.9]])
LEAN, LEAN_HZ = math.radians(10), 0.2
PALM_RADIUS = 46.0
FRAME_S = 1 / 30
FALSE_ANGLE, FALSE_NEAR, FALSE_FAR = math.radians(69), 50.0, 110.0


class Flaws(NamedTuple):
    """What a detector does wrong."""

    noise_sd: float = 1.0
    """Pixels."""
    missed: float = 0.02
    """Share of the frames in which a finger is missed, of an average subject; others have half as much more or less."""
    burst: float = 1.6
    """Frames for which it then is, on average."""
    false_tips: float = 0.02
    """Probability of one in a frame."""


USUAL = Flaws()


class PointSequence(NamedTuple):
    """What was detected of one hand, and the truth; frames first."""

    observed: HandObservation
    """Of one tip more than a hand has; in an order of no meaning, without scores."""
    tips: Float[Array, "frames 5 2"]
    """Pixels, the thumb first."""
    fingers: Bool[Array, "5"]
    """Which are out."""


def points(
    key: AnyKey, fingers: Bool[Array, "5"], num_frames: int, flaws: Flaws = USUAL, *, side: float = 1.0
) -> PointSequence:
    """Detections of a hand that moves over a desk (section 4.1).

    Args:
        key: Decides about everything.
        fingers: Which are out, the thumb first.
        num_frames: At 30 a second.
        flaws: Of the detector.
        side: -1 for the hand with the thumb clockwise of the arm's axis.
    """
    keys = jax.random.split(key, 6)
    palm, lean = _path(keys[0], num_frames)
    axis = _direction(lean)
    angles = lean[:, None] - side * jnp.asarray(FINGER_ANGLES, float)
    tips = palm[:, None] + jnp.asarray(TIP_DISTANCES, float)[:, None] * _direction(angles)
    bases = palm[:, None] + jnp.asarray(BASE_DISTANCES, float)[:, None] * _direction(angles)

    visible = ~_missed(keys[1], num_frames, flaws) & fingers
    there, wrong = _false_tip(keys[2], palm, lean, flaws)
    measured = tips + flaws.noise_sd * jax.random.normal(keys[3], tips.shape)
    everything = jnp.concatenate([measured, wrong[:, None]], axis=1)
    is_tip = jnp.concatenate([visible, there[:, None]], axis=1)
    based = jnp.concatenate([bases, (palm + 0.4 * (wrong - palm))[:, None]], axis=1)
    order = jnp.argsort(jax.random.uniform(keys[4], is_tip.shape), axis=1)
    everything, based = (jnp.take_along_axis(array, order[..., None], axis=1) for array in (everything, based))
    is_tip = jnp.take_along_axis(is_tip, order, axis=1)
    always = jnp.ones(num_frames, bool)
    observed = HandObservation(
        tips=jnp.where(is_tip[..., None], everything, 0.0),
        is_tip=is_tip,
        scores=is_tip.astype(tips.dtype),
        bases=jnp.where(is_tip[..., None], based, 0.0),
        has_base=is_tip,
        palm=palm + flaws.noise_sd * jax.random.normal(keys[5], palm.shape),
        palm_radius=jnp.full(num_frames, PALM_RADIUS, tips.dtype),
        axis=axis,
        has_axis=always,
        is_hand=always,
        coverage=jnp.ones((num_frames, 1, 1), tips.dtype),
        cell=jnp.full((num_frames, 2), WHOLE_IMAGE, tips.dtype),
    )
    return PointSequence(observed, tips, fingers)


def fingers_out(count: int) -> Bool[Array, "5"]:
    """Which fingers are out when there are so many.

    Raises:
        ValueError: If there are not one to five.
    """
    if not 1 <= count <= MAX_TIPS:
        raise ValueError(f"count must be from 1 to {MAX_TIPS}; got {count}.")
    return jnp.isin(jnp.arange(MAX_TIPS), jnp.asarray(SHOWN[count - 1]))


def base_angles(
    key: AnyKey,
    mean: float | Float[Array, "*b"],
    num_frames: int,
    posture: Posture = POSTURE,
) -> Float[Array, "frames *b"]:
    """Angles of fingers with a drifting posture and noise (section 4.3), radians.

    Args:
        key: Decides about drift and noise.
        mean: Of each finger, with the person's own offset.
        num_frames: Of each track.
        posture: How angles drift.
    """
    mean = jnp.asarray(mean, dtype=float)
    first, rest, noise = jax.random.split(key, 3)
    a = posture.correlation
    push = posture.drift_sd * math.sqrt(1 - a * a) * jax.random.normal(rest, (num_frames, *mean.shape))

    def step(drift: Array, push: Array) -> tuple[Array, Array]:
        return a * drift + push, drift

    _, drift = jax.lax.scan(step, posture.drift_sd * jax.random.normal(first, mean.shape), push)
    return mean + drift + posture.measurement_sd * jax.random.normal(noise, drift.shape)


def _path(key, num_frames):
    """Palm (frames, 2) and direction of the arm (frames,) in the image, y down."""
    phase_key, pace_key = jax.random.split(key)
    phases = jax.random.uniform(phase_key, (5,), maxval=2 * math.pi)
    pace = jax.random.uniform(pace_key, (), minval=0.85, maxval=1.1)
    time = 2 * math.pi * FRAME_S * pace * jnp.arange(num_frames)
    swing = jnp.sin(time[:, None, None] * jnp.asarray(CYCLES_HZ, float) + phases[:4].reshape(2, 2))
    palm = jnp.asarray(PALM, float) + jnp.sum(jnp.asarray(REACH, float) * swing, axis=1)
    return palm, -math.pi / 2 + LEAN * jnp.sin(LEAN_HZ * time + phases[4])


def _direction(angle):
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _missed(key, num_frames, flaws):
    """(frames, 5) of a chain that leaves a burst with the same probability in every frame."""
    subject_key, first_key, chain_key = jax.random.split(key, 3)
    share = flaws.missed * jax.random.uniform(subject_key, (), minval=0.5, maxval=1.5)
    leave = 1 / flaws.burst
    enter = leave * share / (1 - share)

    def step(missed: Array, draw: Array) -> tuple[Array, Array]:
        return draw < jnp.where(missed, 1 - leave, enter), missed

    draws = jax.random.uniform(chain_key, (num_frames, MAX_TIPS))
    return jax.lax.scan(step, jax.random.uniform(first_key, (MAX_TIPS,)) < share, draws)[1]


def _false_tip(key, palm, lean, flaws):
    there_key, angle_key, distance_key = jax.random.split(key, 3)
    there = jax.random.uniform(there_key, lean.shape) < flaws.false_tips
    angle = lean + jax.random.uniform(angle_key, lean.shape, minval=-FALSE_ANGLE, maxval=FALSE_ANGLE)
    distance = jax.random.uniform(distance_key, lean.shape, minval=FALSE_NEAR, maxval=FALSE_FAR)
    return there, palm + distance[:, None] * _direction(angle)
