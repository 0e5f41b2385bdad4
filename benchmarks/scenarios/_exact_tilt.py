"""How far the palm of a tracked hand turns away from the truth although its keypoints are exact.

An average hand at ease rests before a camera; the tracker begins at the true state and has the exact image of all 21
joints, with the noise that it takes for keypoints of a network. What is left is the tracker's own: the prior of the
pose, the limits and the linear approximation.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.math.lie import quaternion_multiply, so3_exp
from jaxfilters.models.articulated.anatomy import (
    five_finger_limits,
    motion_about_ease,
    relaxed_angles,
    template_shape,
)
from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.filters import inequalities
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.kinematics import unit_rotation
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.limits import limit_rows
from jaxfilters.models.articulated.motion import FRAME_INTERVAL
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.articulated import start
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.recording import FeatureFrame, Start, keypoint_noise, persistence
from jaxfilters.trackers.articulated.tracker import tracker_of

CAMERA = Pinhole.from_intrinsics(240.0, (159.5, 119.5), (240, 320))
"""Like that of ICVL."""
DISTANCE = 0.5
"""Metres: the hand is about 90 pixels large, as on ICVL."""
TILTS = {"facing": 0.0, "towards": 30.0, "away": -30.0}
"""Degrees of the long axis from the image plane: in it, fingers to the camera, fingers away from it."""
NO_PREFERENCE = 1e6
"""For `LEAN_STD`: all rotations are equally likely."""
NUM_FRAMES = 30
"""At 30 frames/s."""


def tilt_metrics(quick: bool) -> dict[str, Metric]:
    """Angle of the palm to the true one after `NUM_FRAMES` frames, with and without the preference for flat hands.

    Args:
        quick: Whether a hand that faces the camera is enough.
    """
    found = {}
    for name, tilt in list(TILTS.items())[: 1 if quick else None]:
        for suffix, lean in (("", True), ("_without_lean", False)):
            degrees = float(palm_errors_deg(tilt, with_lean=lean)[-1])
            found[f"exact_{name}_palm_deg{suffix}"] = Metric(degrees, "deg", "lower")
    return found


def palm_errors_deg(tilt_deg: float, *, with_lean: bool, num_frames: int = NUM_FRAMES) -> Float[np.ndarray, " t"]:
    """Degrees between the estimated and the true rotation of the palm in each frame.

    Args:
        tilt_deg: Of the long axis of the true hand from the image plane, fingers to the camera.
        with_lean: Whether the motion model prefers hands whose long axis lies near the image plane.
        num_frames: How long the hand rests.
    """
    layout = five_fingers(3)
    motion = motion_about_ease(layout)
    if not with_lean:
        motion = dataclasses.replace(motion, lean_std=jnp.asarray(NO_PREFERENCE, dtype=float))
    hand = articulated_hand(layout, projection=Perspective(CAMERA), features=KEYPOINTS, motion=motion)
    truth = true_state(layout, tilt_deg)
    y = np.tile(np.asarray(hand.exact_features(truth), np.float32), (num_frames, 1))
    times = FRAME_INTERVAL * np.arange(num_frames)
    noise = keypoint_noise(y.reshape(num_frames, -1, 2))
    hand = dataclasses.replace(hand, point_std=jnp.asarray(noise, dtype=float))
    frames = FeatureFrame(y, np.isfinite(y), np.full(y.shape, persistence(times) * noise, np.float32))
    limits = inequalities(limit_rows(layout, five_finger_limits(layout)))
    begins = Start(truth, start.start_covariance(hand, start.AVERAGE_SIZE, truth))
    tracker = tracker_of(hand, limits, begins, ArticulatedConfig(focal=float(CAMERA.focal[0])))
    state = tracker.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], frames))
    _, track = tracker.step(state, frames, times)
    palms = jax.vmap(unit_rotation)(jnp.asarray(track.mean)[:, layout.quaternion])
    turned = np.asarray(palms) @ np.asarray(unit_rotation(truth[layout.quaternion])).T
    cosine = 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def true_state(layout: Layout, tilt_deg: float) -> Float[Array, " n"]:
    """An average right hand at ease and at rest: wrist on the optical axis, fingers up, palm to the camera."""
    upright = jnp.array([0.5, -0.5, 0.5, -0.5])  # as `trackers.articulated.start` has it
    tilt = so3_exp(math.radians(tilt_deg) * jnp.eye(3)[0])
    x = jnp.zeros(layout.size).at[layout.quaternion].set(quaternion_multiply(tilt, upright))
    x = x.at[layout.position].set(jnp.array([0.0, 0.0, DISTANCE]))
    x = x.at[layout.static].set(1e-3 * jnp.asarray(template_shape(), dtype=float))
    return x.at[layout.angles].set(jnp.asarray(relaxed_angles(layout), dtype=float).ravel())
